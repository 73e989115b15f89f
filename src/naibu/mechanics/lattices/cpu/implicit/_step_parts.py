"""Jobs of an implicit step beside those of its solver, in parts that threads can take: see `_solver_parts`.

`data` are what `_solver_parts` calls `solver`, and x, the extensions y, the lengths that these know of, the velocity before the step, the
momenta with the impulses of external forces before (3 pad,), external forces (3 pad,) or none, and the length of the step.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu._numba.intrinsics.simd import WIDTH, inverse_root, load, single, splat, store, total
from naibu._numba.thread_pool import JOB, end_job, finish, first_part, following_part, next_part
from naibu.mechanics.lattices.cpu.implicit._solver_parts import POOL, SOLVER_JOBS, part_entries, solver_part

_FAST = {"contract", "nsz"}
START, CONSTRAIN, PREPARE, MOVE, EXTEND, LIMIT = np.arange(SOLVER_JOBS, SOLVER_JOBS + 6, dtype=np.int64)


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _prepare(blocks, tables, x, y, v, axes, rough, out, step, span):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Store the directions of elements (3, 8 nb), once more in single precision, and set `out` to what they take at the new velocity v.

    Returns the sum of the squares of the impulses of their extensions. `span` is that of `multiply_part`.
    """
    first, second, rows = blocks
    b, end, begin_node, _, reached = span
    pad = len(x) // 3
    tb, stiff = tables[1], tables[5]
    e0, e1, e2 = axes[0], axes[1], axes[2]
    g0, g1, g2 = rough[0], rough[1], rough[2]
    x0, x1, x2, v0, v1, v2 = x[:pad], x[pad : 2 * pad], x[2 * pad :], v[:pad], v[pad : 2 * pad], v[2 * pad :]
    f0, f1, f2 = out[:pad], out[pad : 2 * pad], out[2 * pad :]
    f0[begin_node:reached] = 0
    f1[begin_node:reached] = 0
    f2[begin_node:reached] = 0
    zero, dt = splat(x.dtype.type(0)), splat(step)
    strength = zero
    while b < end:
        i = first[b]
        xi, yi, zi, ui, vi, wi = load(x0, i), load(x1, i), load(x2, i), load(v0, i), load(v1, i), load(v2, i)
        fx, fy, fz = zero, zero, zero
        while b < end and first[b] == i:
            j, at = second[b], WIDTH * b
            dx, dy, dz = load(x0, j) - xi, load(x1, j) - yi, load(x2, j) - zi
            inverse = inverse_root(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
            store(e0, at, dx)
            store(e1, at, dy)
            store(e2, at, dz)
            store(g0, at, single(dx))
            store(g1, at, single(dy))
            store(g2, at, single(dz))
            impulse = dt * (load(tb, rows[b]) * load(y, at))
            strength = strength + impulse * impulse
            change = (load(v0, j) - ui) * dx + (load(v1, j) - vi) * dy + (load(v2, j) - wi) * dz
            impulse = impulse + load(stiff, rows[b]) * change
            dx, dy, dz = dx * impulse, dy * impulse, dz * impulse
            fx, fy, fz = fx + dx, fy + dy, fz + dz
            store(f0, j, load(f0, j) + dx)
            store(f1, j, load(f1, j) + dy)
            store(f2, j, load(f2, j) + dz)
            b += 1
        store(f0, i, load(f0, i) - fx)
        store(f1, i, load(f1, i) - fy)
        store(f2, i, load(f2, i) - fz)
    return float(total(strength))


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _extend(blocks, tables, axes, lengths, x, v, y, step, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move on extensions y and the lengths they know of after the nodes moved to x with the velocity v.

    Leaves in axes[1] what the rotation of elements added to the lengths, and in axes[0] what that added to the extensions.
    Returns the energy that the elements dissipated, and the linear and the square part of the energy that the addition stored.
    """
    first, second, rows = blocks
    pad = len(x) // 3
    ta, tb, te, tg, tk, _ = tables
    e0, e1, e2 = axes[0], axes[1], axes[2]
    x0, x1, x2, v0, v1, v2 = x[:pad], x[pad : 2 * pad], x[2 * pad :], v[:pad], v[pad : 2 * pad], v[2 * pad :]
    zero, half, dt = splat(x.dtype.type(0)), splat(x.dtype.type(0.5)), splat(step)
    dissipated, linear, square = zero, zero, zero
    b = begin
    while b < end:
        i = first[b]
        xi, yi, zi, ui, vi, wi = load(x0, i), load(x1, i), load(x2, i), load(v0, i), load(v1, i), load(v2, i)
        while b < end and first[b] == i:
            j, r, at = second[b], rows[b], WIDTH * b
            dx, dy, dz = load(x0, j) - xi, load(x1, j) - yi, load(x2, j) - zi
            distance = dx * dx + dy * dy + dz * dz
            change = (load(v0, j) - ui) * load(e0, at) + (load(v1, j) - vi) * load(e1, at)
            change = dt * (change + (load(v2, j) - wi) * load(e2, at))
            old, k = load(y, at), load(tk, r)
            new = load(te, r) * old + load(tg, r) * change
            length = distance * inverse_root(distance)
            turned = length - load(lengths, at) - change
            added = load(tg, r) * turned
            store(lengths, at, length)
            dissipated = dissipated + (load(ta, r) * change + load(tb, r) * old) * change - half * (k * (new * new - old * old))
            linear = linear + k * (new * added)
            square = square + half * (k * (added * added))
            store(y, at, new + added)
            store(e0, at, added)
            store(e1, at, turned)
            b += 1
    return float(total(dissipated)), float(total(linear)), float(total(square))


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _start(v, before, right, external, mass, step, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Keep the velocity before the step, and set `right` to the momenta and the impulses of external forces."""
    pad, dt = len(mass), splat(step)
    for axis in range(3):
        for i in range(begin, end, WIDTH):
            at = axis * pad + i
            speed = load(v, at)
            store(before, at, speed)
            momentum = load(mass, i) * speed
            store(right, at, momentum + dt * load(external, at) if len(external) else momentum)


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def constrain_part(constrained, v, pad, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Give the constrained components begin to end of v (3 pad,) their speeds."""
    node, direction, speed = constrained[0], constrained[1], constrained[2]
    for h in range(begin, end):
        i = node[h]
        lack = speed[h]
        for a in range(3):
            lack -= direction[h, a] * v[a * pad + i]
        for a in range(3):
            v[a * pad + i] += lack * direction[h, a]


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _left(v, r, right, mass, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set r to `right` less the momenta of v; return the greatest mass."""
    pad, most = len(mass), 0.0
    for axis in range(3):
        for i in range(begin, end, WIDTH):
            at = axis * pad + i
            store(r, at, load(right, at) - load(mass, i) * load(v, at))
    for i in range(begin, end):
        most = max(most, mass[i])
    return most


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _move(x, v, before, mass, step, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move nodes by the velocity v; return the kinetic energy of the change of v."""
    pad, dt = len(mass), splat(step)
    slowed, half = splat(0.0), splat(0.5)
    for axis in range(3):
        for i in range(begin, end, WIDTH):
            at = axis * pad + i
            new = load(v, at)
            store(x, at, load(x, at) + dt * new)
            change = load(before, at) - new
            slowed = slowed + half * (load(mass, i) * (change * change))
    return float(total(slowed))


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _limit(y, lengths, axes, left, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take a share of what the rotation of elements added out of their extensions and lengths."""
    share = splat(y.dtype.type(left))
    e0, e1 = axes[0], axes[1]
    for i in range(WIDTH * begin, WIDTH * end, WIDTH):
        store(y, i, load(y, i) - share * load(e0, i))
        store(lengths, i, load(lengths, i) - share * load(e1, i))


@njit(cache=True, **UNCOUNTED)
def _part(job, c, data):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Do part c of a job."""
    solver, (x, y, lengths, before, right, external, step) = data
    if job < SOLVER_JOBS:
        solver_part(job, c, solver)
        return
    blocks, tables, mass, v, (axes, r, _, _), inner, constrained = solver
    pool = inner[POOL]
    _, (cuts, nodes, high, _), full, _, sums, numbers = pool
    begin, end, pad = nodes[c], nodes[c + 1], len(mass)
    if job == START:
        _start(v, before, right, external, mass, step, begin, end)
    elif job == CONSTRAIN:
        own = part_entries(pool, c, constrained)
        constrain_part(constrained, v, pad, own[0], own[1])
        sums[c, 0] = _left(v, r, right, mass, begin, end)
    elif job == PREPARE:
        sums[c, 0] = _prepare(blocks, tables, x, y, v, axes, inner[1], full[c], step, (cuts[c], cuts[c + 1], begin, end, high[c]))
    elif job == MOVE:
        sums[c, 0] = _move(x, v, before, mass, step, begin, end)
    elif job == EXTEND:
        sums[c, 0], sums[c, 1], sums[c, 2] = _extend(blocks, tables, axes, lengths, x, v, y, step, cuts[c], cuts[c + 1])
    elif job == LIMIT:
        _limit(y, lengths, axes, numbers[0], cuts[c], cuts[c + 1])


@njit(cache=True, **UNCOUNTED)
def share_step(data, job, factor):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Have all parts of a job done, with a factor; what they give is in the sums of the pool."""
    pool = data[0][5][POOL]
    control = pool[0]
    pool[5][0] = factor
    part = first_part(control, job)
    while part >= 0:
        _part(job, part, data)
        part = following_part(control, part)
    end_job(control)


@njit(cache=True, nogil=True, **UNCOUNTED)
def implicit_worker(control, data):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take parts of the jobs of `implicit_steps` while there are some."""
    part = next_part(control)
    while part >= 0:
        _part(control[JOB], part, data)
        finish(control)
        part = next_part(control)
