"""Velocities of a step in contact whose contacts change from pass to pass, by one thread.

A pass that may not be the last one ends early, with the residual that conjugate gradients in single precision carry along. The lattice
is multiplied in double precision once, at the end: by what all passes changed.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu.mechanics.lattices.cpu._contact_operator import FACES, NODES, add_contact
from naibu.mechanics.lattices.cpu.implicit._coarse_kernels import CREDIT
from naibu.mechanics.lattices.cpu.implicit._implicit_kernels import first_residual, settle
from naibu.mechanics.lattices.cpu.implicit._pcg_kernels import conjugate_gradients, dot, multiply, project, residual_norm
from naibu.mechanics.lattices.cpu.implicit._solver_parts import ALIGN, MULTIPLY, NORM, OPERATOR, POOL, share

_FAST = {"contract", "nsz"}
_ROUNDS = 8  # of conjugate gradients, at most, between which the residual is computed in double precision


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def plain_residual(data, base, plain, origin):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Constrain v; keep it in `origin` and its residual without contact, for the right side `base`, in `plain`, all (3 pad,).

    Returns the square of the norm below which rounding rules.
    """
    v, r, right = data[0][3], data[0][4][1], data[1][4]
    counts = data[0][5][OPERATOR][5]
    counts[FACES], counts[NODES] = 0, 0
    for i in range(len(v)):
        right[i] = base[i]
    floor = first_residual(data)
    for i in range(len(v)):
        plain[i], origin[i], right[i] = r[i], v[i], 0.0
    return floor


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def change_contacts(data, given, sign):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add what the contacts exert at the velocity v to its residual, with a sign; `given` are their impulses at no velocity (3 pad,)."""
    v, r, operator = data[0][3], data[0][4][1], data[0][5][OPERATOR]
    for i in range(len(r)):
        r[i] += sign * given[i]
    add_contact(operator[0], operator[1], operator[5][FACES], -sign, v, r)


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def extrapolate(data, ahead, tolerance, floor):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Correct the share of a change (3 pad,) that was added to v, whose residual is r; `ahead` are the two.

    Extrapolated motion is often nearly enough :cite:p:`fischer1998`. The share becomes that which leaves the least energy norm of the
    error. Returns the square of the residual's norm at which the solver is to end, that of the v without any change reduced by the
    tolerance, but `floor` at least, and the share.
    """
    _, _, mass, v, (_, r, p, q), inner, constrained = data[0]
    change, taken = ahead
    for i in range(len(p)):
        p[i] = change[i]
    project(constrained, p, len(mass))
    curvature = _product(data[0], p, q)
    for i in range(len(r)):
        r[i] += taken * q[i]
    goal = max(tolerance**2 * residual_norm(r, inner[3], constrained), floor)
    portion = dot(p, r) / curvature if curvature > 0.0 else 0.0
    for i in range(len(r)):
        v[i] += (portion - taken) * p[i]
        r[i] -= portion * q[i]
    return goal, portion


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def solve_roughly(solver, goal, limit):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Improve v, whose residual is r, until the square of the residual's norm is below `goal`, in single precision.

    Leaves in r the free part of the residual, as conjugate gradients carry it along. Returns the number of iterations.
    """
    v, r, inner = solver[3], solver[4][1], solver[5]
    w, rough, memory = inner[4], inner[5], inner[8][5][2]
    norm = share(solver, NORM, 0.0)
    if not norm > goal:
        return 0
    unit = np.sqrt(norm)
    count, _ = conjugate_gradients(solver, unit, max(0.9 * goal / norm, 1e-10), limit, len(memory) > 0)
    for i in range(len(v)):
        v[i] += unit * w[i]
        r[i] = unit * rough[i]
    if len(memory):
        memory[CREDIT] += count
    return count


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def solve_exactly(data, goal, limit, given, plain, origin):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Improve v until the square of the norm of its residual, in double precision, is below `goal`; returns the number of iterations."""
    solver = data[0]
    blocks, tables, mass, v, (axes, r, p, q), _, _ = solver
    count = 0
    for _ in range(_ROUNDS):
        count += solve_roughly(solver, goal, limit - count)
        for i in range(len(v)):
            p[i] = v[i] - origin[i]
        multiply(blocks, tables[5], axes, mass, p, q)
        for i in range(len(r)):
            r[i] = plain[i] - q[i]
        change_contacts(data, given, 1.0)
        if count >= limit or not share(solver, NORM, 0.0) > goal:
            break
    return count


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def settle_in_contact(data):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Do what `settle` does; single precision is enough for the small part of v that changes."""
    solver = data[0]
    v, (_, r, p, q), operator = solver[3], solver[4], solver[5][OPERATOR]
    if operator[5][FACES] == 0:
        return settle(data)
    lost = share(solver, ALIGN, 0.0)
    if lost >= 0.0:
        return lost
    curvature = _product(solver, p, q)
    fraction = lost / curvature if curvature > 0.0 else 0.0
    for i in range(len(v)):
        v[i] += fraction * p[i]
        r[i] -= fraction * q[i]
    return 0.0


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _product(solver, p, q):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set q to A p, in single precision, contacts included, and return p . q."""
    inner = solver[5]
    touched, along, product = inner[OPERATOR], inner[6], inner[POOL][3][0]
    for i in range(len(p)):
        along[i] = p[i]
    curvature = share(solver, MULTIPLY, 0.0)
    curvature += add_contact(touched[0], touched[2], touched[5][FACES], 1.0, along, product)
    for i in range(len(q)):
        q[i] = product[i]
    return curvature
