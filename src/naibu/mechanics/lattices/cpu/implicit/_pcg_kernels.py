"""Preconditioned conjugate gradients :cite:p:`hestenes1952` for the implicit step of a lattice, by one thread or several.

Iterations are in single precision, their residual is corrected in double precision. The preconditioner is the diagonal, plus, where it
pays, a coarse correction (`naibu.mechanics.lattices.cpu.implicit.coarse_space`). It decides how many iterations there are, not where they
end: at the residual's norm in the diagonal's inverse, with either. What `solver` is, says `_solver_parts`.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu._numba.intrinsics.simd import WIDTH, load, splat, total
from naibu.mechanics.lattices.cpu.contact._operator import FACES, NODES, ROOM, add_contact, add_preconditioned, extra_energy
from naibu.mechanics.lattices.cpu.implicit._coarse_kernels import CREDIT, correct
from naibu.mechanics.lattices.cpu.implicit._solver_parts import (
    BEGIN,
    CHANGE,
    CORRECT,
    DESCEND,
    FURTHER,
    HELPED,
    MULTIPLY,
    MULTIPLY_FULL,
    NORM,
    OPERATOR,
    POOL,
    TURN,
    multiply_part,
    norm_part,
    project_part,
    share,
)

_FAST = {"contract", "nsz"}


@njit(cache=True, **UNCOUNTED)
def multiply(blocks, stiff, axes, mass, p, q):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set q to A p and return p . q; `stiff` is the table of h^2 a."""
    return multiply_part(blocks, stiff, axes, mass, p, q, (0, len(blocks[0]), 0, len(mass), len(mass)))


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def dot(a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return a . b of arrays whose length is a multiple of eight."""
    s = splat(a.dtype.type(0))
    for i in range(0, len(a), WIDTH):
        s = s + load(a, i) * load(b, i)
    return float(total(s))


@njit(cache=True, **UNCOUNTED)
def project(constrained, q, pad):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take the constrained components out of q; the directions at one node are orthogonal."""
    project_part(constrained, q, pad, 0, len(constrained[0]))


@njit(cache=True, **UNCOUNTED)
def residual_norm(r, smoother, constrained):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the square of the norm of the free part of r, in double precision, times `smoother`, in single."""
    return norm_part(r, smoother, constrained, 0, len(smoother), (0, len(constrained[0])))


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def conjugate_gradients(solver, unit, goal, limit, helped):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set w to about A^-1 r / unit with constrained components zero, until the square of the residual's norm is below `goal`.

    Coarse functions are used if `helped`. Returns the number of iterations and whether the goal was reached or the limit.
    """
    inner, constrained = solver[5], solver[6]
    _, _, light, _, _, r, p, _, coarse, (corners, _, rough, nodes, inverse, counts, _, room), pool = inner
    pad = len(light)
    pool[5][HELPED] = 1.0 if helped else 0.0
    norm = share(solver, BEGIN, 1.0 / unit)
    old, beta = 1.0, 0.0
    count = 0
    while count < limit and norm > goal:
        energy = norm
        if counts[NODES]:
            energy += extra_energy(nodes, inverse, counts[NODES], r)
        if helped:
            energy += correct(coarse)
        if not energy > 0.0:
            return count, False
        beta = energy / old if count else 0.0
        old = energy
        share(solver, TURN, beta)
        if counts[NODES]:
            add_preconditioned(nodes, inverse, counts[NODES], r, p)
            project(constrained, p, pad)
        curvature = share(solver, MULTIPLY, 0.0)
        if counts[FACES]:
            curvature += add_contact(corners, rough, counts[FACES], 1.0, p, pool[3], pool[1][1], room)
        if not curvature > 0.0:
            return count, False
        norm = share(solver, DESCEND, energy / curvature)
        count += 1
    return count, True


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def solve(solver, goal, limit):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Improve v, whose residual is r, by conjugate gradients in single precision, again while r in full precision asks for it.

    It stops where the square of the residual's norm is below `goal`. Returns the number of iterations.
    """
    p, inner = solver[4][2], solver[5]
    coarse, touched, (_, parts, full, _, _, _) = inner[8], inner[OPERATOR], inner[POOL]
    norm = share(solver, NORM, 0.0)
    count, helped = 0, len(coarse[5][2]) > 0
    for _ in range(8):
        if not norm > goal or count >= limit:
            break
        unit = np.sqrt(norm)
        done, well = conjugate_gradients(solver, unit, max(0.9 * goal / norm, 1e-10), limit - count, helped)
        count, helped = count + done, helped and well
        share(solver, CORRECT, unit)
        share(solver, MULTIPLY_FULL, 0.0)
        add_contact(touched[0], touched[1], touched[5][FACES], 1.0, p, full, parts[1], touched[ROOM])
        inner[POOL][5][FURTHER] = 0.0
        share(solver, CHANGE, 1.0)
        norm = share(solver, NORM, 0.0)
    if len(coarse[5][2]):
        coarse[5][2][CREDIT] += count
    return count
