"""Kernels of preconditioned conjugate gradients :cite:p:`hestenes1952` for the implicit step of a lattice.

Iterations are in single precision, their residual is corrected in double precision. The preconditioner is the diagonal, plus, where it
pays, a coarse correction (`naibu.mechanics.lattices.cpu.coarse_space`). It decides how many iterations there are, not where they end:
at the residual's norm in the diagonal's inverse, with either.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu._numba.simd import WIDTH, double, load, splat, store, total
from naibu.mechanics.lattices.cpu._coarse_kernels import CREDIT, correct, gather, turn_with
from naibu.mechanics.lattices.cpu._contact_operator import FACES, NODES, add_contact, add_preconditioned, extra_energy

_FAST = {"contract", "nsz"}


@njit(cache=True, fastmath=_FAST)
def multiply(first, second, rows, stiff, axes, mass, p, q):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set q to A p and return p . q; `stiff` is the table of h^2 a."""
    pad = len(p) // 3
    e0, e1, e2 = axes[0], axes[1], axes[2]
    p0, p1, p2, q0, q1, q2 = p[:pad], p[pad : 2 * pad], p[2 * pad :], q[:pad], q[pad : 2 * pad], q[2 * pad :]
    zero = splat(p.dtype.type(0))
    energy = zero
    for i in range(0, pad, WIDTH):
        m = load(mass, i)
        px, py, pz = load(p0, i), load(p1, i), load(p2, i)
        energy = energy + m * (px * px + py * py + pz * pz)
        store(q0, i, m * px)
        store(q1, i, m * py)
        store(q2, i, m * pz)
    b, end = 0, len(first)
    while b < end:
        i = first[b]
        px, py, pz = load(p0, i), load(p1, i), load(p2, i)
        fx, fy, fz = zero, zero, zero
        while b < end and first[b] == i:
            j, at = second[b], WIDTH * b
            ex, ey, ez = load(e0, at), load(e1, at), load(e2, at)
            change = (load(p0, j) - px) * ex + (load(p1, j) - py) * ey + (load(p2, j) - pz) * ez
            force = load(stiff, rows[b]) * change
            energy = energy + force * change
            ex, ey, ez = ex * force, ey * force, ez * force
            fx, fy, fz = fx + ex, fy + ey, fz + ez
            store(q0, j, load(q0, j) + ex)
            store(q1, j, load(q1, j) + ey)
            store(q2, j, load(q2, j) + ez)
            b += 1
        store(q0, i, load(q0, i) - fx)
        store(q1, i, load(q1, i) - fy)
        store(q2, i, load(q2, i) - fz)
    return float(total(energy))


@njit(cache=True, fastmath=_FAST)
def dot(a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return a . b of arrays whose length is a multiple of eight."""
    s = splat(a.dtype.type(0))
    for i in range(0, len(a), WIDTH):
        s = s + load(a, i) * load(b, i)
    return float(total(s))


@njit(cache=True, fastmath=_FAST)
def _descend(v, r, p, q, smoother, alpha):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move v by alpha p and r by -alpha q; return r . smoother r."""
    pad = len(smoother)
    s, along = splat(v.dtype.type(0)), splat(alpha)
    for axis in range(3):
        va, ra, pa, qa = v[axis * pad :], r[axis * pad :], p[axis * pad :], q[axis * pad :]
        for i in range(0, pad, WIDTH):
            store(va, i, load(va, i) + along * load(pa, i))
            residual = load(ra, i) - along * load(qa, i)
            store(ra, i, residual)
            s = s + residual * (residual * load(smoother, i))
    return float(total(s))


@njit(cache=True, fastmath=_FAST)
def _turn(p, r, smoother, beta):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set p to smoother r + beta p."""
    pad, part = len(smoother), splat(beta)
    for axis in range(3):
        pa, ra = p[axis * pad :], r[axis * pad :]
        for i in range(0, pad, WIDTH):
            store(pa, i, load(smoother, i) * load(ra, i) + part * load(pa, i))


@njit(cache=True, fastmath=_FAST)
def project(constrained, q, pad):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take the constrained components out of q; the directions at one node are orthogonal."""
    node, direction = constrained[0], constrained[1]
    for h in range(len(node)):
        i = node[h]
        along = direction[h, 0] * q[i] + direction[h, 1] * q[pad + i] + direction[h, 2] * q[2 * pad + i]
        for a in range(3):
            q[a * pad + i] -= along * direction[h, a]


@njit(cache=True, fastmath=_FAST)
def _scaled_square(r, smoother):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return r . smoother r."""
    s = splat(r.dtype.type(0))
    for axis in range(3):
        ra = r[axis * len(smoother) : (axis + 1) * len(smoother)]
        for i in range(0, len(smoother), WIDTH):
            residual = load(ra, i)
            s = s + residual * (residual * load(smoother, i))
    return float(total(s))


@njit(cache=True, fastmath=_FAST)
def conjugate_gradients(first, second, rows, inner, constrained, goal, limit, helped):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set w to about A^-1 r with constrained components zero, until the square of the residual's norm, times `smoother`, is below `goal`.

    `inner` are h^2 a, axes, mass, smoother, w, r, p, q, what coarse functions need, which is used if `helped`, and what contact adds to
    the matrix. Returns the number of iterations and whether the goal was reached or the limit.
    """
    stiff, axes, mass, smoother, w, r, p, q, coarse, (corners, _, rough, nodes, inverse, counts) = inner
    kind, pad = w.dtype.type, len(mass)
    w[:] = 0
    p[:] = 0
    project(constrained, r, pad)
    norm = _scaled_square(r, smoother)
    old, beta = 1.0, 0.0
    count = 0
    while count < limit and norm > goal:
        energy = norm
        if counts[NODES]:
            energy += extra_energy(nodes, inverse, counts[NODES], r)
        if helped:
            gather(coarse[0][0], coarse[1][0][0], r.reshape(3, pad), 0, pad - WIDTH)
            energy += correct(coarse)
        if not energy > 0.0:
            return count, False
        beta = energy / old if count else 0.0
        old = energy
        if helped:
            turn_with(coarse[0][0], coarse[1][1], p.reshape(3, pad), r.reshape(3, pad), smoother, kind(beta), 0, pad - WIDTH)
        else:
            _turn(p, r, smoother, kind(beta))
        if counts[NODES]:
            add_preconditioned(nodes, inverse, counts[NODES], r, p)
        if helped or counts[NODES]:
            project(constrained, p, pad)
        curvature = multiply(first, second, rows, stiff, axes, mass, p, q)
        if counts[FACES]:
            curvature += add_contact(corners, rough, counts[FACES], 1.0, p, q)
        if not curvature > 0.0:
            return count, False
        project(constrained, q, pad)
        norm = _descend(w, r, p, q, smoother, kind(energy / curvature))
        count += 1
    return count, True


@njit(cache=True, fastmath=_FAST)
def residual_norm(r, smoother, constrained):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the square of the norm of the free part of r, in double precision, times `smoother`, in single."""
    pad = len(smoother)
    s = splat(0.0)
    for axis in range(3):
        ra = r[axis * pad :]
        for i in range(0, pad, WIDTH):
            residual = load(ra, i)
            s = s + residual * (residual * double(load(smoother, i)))
    norm = float(total(s))
    for h in range(len(constrained[0])):
        i = constrained[0][h]
        along = constrained[1][h, 0] * r[i] + constrained[1][h, 1] * r[pad + i] + constrained[1][h, 2] * r[2 * pad + i]
        norm -= along * along * smoother[i]
    return norm


@njit(cache=True, fastmath=_FAST)
def solve(first, second, rows, stiff, axes, mass, v, r, p, q, inner, constrained, goal, limit):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Improve v, whose residual is r, by conjugate gradients in single precision, again while r in full precision asks for it.

    It stops where the square of the residual's norm is below `goal`. Returns the number of iterations.
    """
    smoother, w, rough, coarse, touched = inner[3], inner[4], inner[5], inner[8], inner[9]
    norm = residual_norm(r, smoother, constrained)
    count, helped = 0, len(coarse[5][2]) > 0
    for _ in range(8):
        if not norm > goal or count >= limit:
            break
        unit = np.sqrt(norm)
        for i in range(len(r)):
            rough[i] = r[i] / unit
        done, well = conjugate_gradients(first, second, rows, inner, constrained, max(0.9 * goal / norm, 1e-10), limit - count, helped)
        count, helped = count + done, helped and well
        for i in range(len(v)):
            p[i] = unit * w[i]
            v[i] += p[i]
        multiply(first, second, rows, stiff, axes, mass, p, q)
        add_contact(touched[0], touched[1], touched[5][FACES], 1.0, p, q)
        for i in range(len(r)):
            r[i] -= q[i]
        norm = residual_norm(r, smoother, constrained)
    if len(coarse[5][2]):
        coarse[5][2][CREDIT] += count
    return count
