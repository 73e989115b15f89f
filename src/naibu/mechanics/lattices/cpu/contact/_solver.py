"""Velocities of a step in contact whose contacts change from pass to pass.

Passes end with the residual that conjugate gradients in single precision carry along, and what these take out of products along
constrained components is counted, so that the residual tells reactions as well. Only where the tolerance is tight is the lattice multiplied
in double precision, at the end of each pass: by what all passes changed. Beside a loose one, that adds nothing.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu.mechanics.lattices.cpu.contact._operator import FACES, NODES, ROOM, ROUGH_ROOM, add_contact
from naibu.mechanics.lattices.cpu.implicit._coarse_kernels import CREDIT
from naibu.mechanics.lattices.cpu.implicit._implicit_kernels import first_residual, settle
from naibu.mechanics.lattices.cpu.implicit._pcg_kernels import conjugate_gradients, project, residual_norm
from naibu.mechanics.lattices.cpu.implicit._solver_parts import (
    ALIGN,
    CHANGE,
    FURTHER,
    MULTIPLY,
    MULTIPLY_FULL,
    NORM,
    OPERATOR,
    POOL,
    collect,
    share,
    take_out_part,
)

_FAST, _SUMS = {"contract", "nsz"}, {"contract", "nsz", "reassoc"}
_ROUNDS = 8  # of conjugate gradients, at most, between which the residual is computed in double precision


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def plain_residual(data, plain, origin, kept):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Constrain v; if `kept`, put it in `origin`, and its residual without contact in `plain`, both (3 pad,).

    Returns the square of the norm below which rounding rules.
    """
    v, r, counts = data[0][3], data[0][4][1], data[0][5][OPERATOR][5]
    counts[FACES], counts[NODES] = 0, 0
    floor = first_residual(data)
    if kept:
        for i in range(len(v)):
            plain[i], origin[i] = r[i], v[i]
    return floor


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def change_contacts(data, given, sign):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add what the contacts exert at the velocity v to its residual, with a sign; `given` are their impulses at no velocity (3 pad,)."""
    v, r, operator = data[0][3], data[0][4][1], data[0][5][OPERATOR]
    pad = len(r) // 3
    for c in range(operator[5][NODES]):
        i = operator[3][c]
        for a in range(3):
            r[a * pad + i] += sign * given[a * pad + i]
    nodes = data[0][5][POOL][1][1]
    add_contact(operator[0], operator[1], operator[5][FACES], -sign, v, r.reshape(1, len(r)), nodes, operator[ROOM])


@njit(cache=True, **UNCOUNTED)
def forget_impulses(operator, given):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Clear the impulses (3 pad,) at the nodes of an operator."""
    pad = len(given) // 3
    for c in range(operator[5][NODES]):
        for a in range(3):
            given[a * pad + operator[3][c]] = 0.0


@njit(cache=True, fastmath=_SUMS, **UNCOUNTED)
def extrapolate(data, ahead, tolerance, floor):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Correct the share of a change (3 pad,) that was added to v, whose residual is r; `ahead` are the two.

    Extrapolated motion is often nearly enough :cite:p:`fischer1998`. The share becomes that which leaves the least energy norm of the
    error. Returns the square of the residual's norm at which the solver is to end, that of the v without any change reduced by the
    tolerance, but `floor` at least, and the share.
    """
    _, _, mass, v, (_, r, _, _), inner, constrained = data[0]
    change, taken = ahead
    along, q, smoother, pad = inner[6], inner[POOL][3][0], inner[3], len(mass)
    for i in range(len(r)):
        along[i] = change[i]
    project(constrained, along, pad)
    curvature = _product(data[0])
    constrained[4][:] = 0.0
    take_out_part(constrained, q, pad, 0, len(constrained[0]), 1.0)
    both, square = 0.0, 0.0  # r . q and q . q in the inverse of the diagonal
    work = 0.0
    for a in range(3):
        for i in range(pad):
            at = a * pad + i
            both += smoother[i] * r[at] * q[at]
            square += smoother[i] * q[at] * q[at]
            work += along[at] * r[at]
    norm = residual_norm(r, smoother, constrained) + taken * (2.0 * both + taken * square)
    portion = taken + work / curvature if curvature > 0.0 else 0.0
    _move_along(v, r, along, q, portion - taken)
    _give_back(constrained, r, portion - taken)
    return max(tolerance**2 * norm, floor), portion


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def solve_roughly(solver, goal, limit):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Improve v, whose residual is r, until the square of the residual's norm is below `goal`, in single precision.

    Leaves in r the residual as conjugate gradients carry it along. Returns the number of iterations.
    """
    v, r, inner, constrained = solver[3], solver[4][1], solver[5], solver[6]
    w, rough, memory = inner[4], inner[5], inner[8][5][2]
    norm = share(solver, NORM, 0.0)
    if not norm > goal:
        return 0
    unit = np.sqrt(norm)
    count, _ = conjugate_gradients(solver, unit, max(0.9 * goal / norm, 1e-10), limit, len(memory) > 0)
    node, direction, _, _, taken = constrained
    pad = len(v) // 3
    for h in range(len(node)):  # these components of r are not in the residual of conjugate gradients either
        i = node[h]
        along = direction[h, 0] * r[i] + direction[h, 1] * r[pad + i] + direction[h, 2] * r[2 * pad + i]
        taken[h] -= along / unit
    for i in range(len(v)):
        v[i] += unit * w[i]
        r[i] = unit * rough[i]
    _give_back(constrained, r, unit)
    if len(memory):
        memory[CREDIT] += count
    return count


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def solve_exactly(data, goal, limit, given, plain, origin):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Improve v until the square of the norm of its residual, in double precision, is below `goal`; returns the number of iterations."""
    solver = data[0]
    v, (_, r, p, _), numbers = solver[3], solver[4], solver[5][POOL][5]
    count = 0
    for _ in range(_ROUNDS):
        count += solve_roughly(solver, goal, limit - count)
        for i in range(len(v)):
            p[i], r[i] = v[i] - origin[i], plain[i]
        share(solver, MULTIPLY_FULL, 0.0)
        numbers[FURTHER] = 0.0
        share(solver, CHANGE, 1.0)
        change_contacts(data, given, 1.0)
        if count >= limit or not share(solver, NORM, 0.0) > goal:
            break
    return count


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def settle_in_contact(data):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Do what `settle` does; single precision is enough for the small part of v that changes."""
    solver = data[0]
    v, (_, r, p, _), operator = solver[3], solver[4], solver[5][OPERATOR]
    if operator[5][FACES] == 0:
        return settle(data)
    lost = share(solver, ALIGN, 0.0)
    if lost >= 0.0:
        return lost
    along = solver[5][6]
    for i in range(len(p)):
        along[i] = p[i]
    curvature = _product(solver)
    fraction = lost / curvature if curvature > 0.0 else 0.0
    _move_along(v, r, along, solver[5][POOL][3][0], fraction)
    return 0.0


@njit(cache=True, **UNCOUNTED)
def _product(solver):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Multiply p, in single precision, by the matrix, contacts included, and return p times that; the product is in the first row."""
    inner = solver[5]
    touched, along, (_, (_, nodes, high, _), _, rows, _, _) = inner[OPERATOR], inner[6], inner[POOL]
    curvature = share(solver, MULTIPLY, 0.0)
    curvature += add_contact(touched[0], touched[2], touched[5][FACES], 1.0, along, rows, nodes, touched[ROUGH_ROOM])
    pad = len(along) // 3
    for c in range(1, len(rows)):
        collect(rows, nodes, high, c, pad)
        for axis in range(3):
            for i in range(axis * pad + nodes[c], axis * pad + nodes[c + 1]):
                rows[0, i] = rows[c, i]
    return curvature


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _give_back(constrained, r, fraction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take from a residual r, times a fraction, what was taken out along constrained components."""
    node, direction, _, _, taken = constrained
    pad = len(r) // 3
    for h in range(len(node)):
        for a in range(3):
            r[a * pad + node[h]] -= fraction * taken[h] * direction[h, a]


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _move_along(v, r, p, q, fraction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move v by a fraction of p, and its residual r likewise, by that of q."""
    for i in range(len(v)):
        v[i] += fraction * p[i]
        r[i] -= fraction * q[i]
