"""Jobs of the solver of an implicit step, in parts that threads can take.

A part has blocks of elements, the nodes in which these begin, and the constrained components of these nodes. What its blocks exert goes to
a row of its own, (3 pad,), since the last blocks reach into the nodes of later parts; these add it up, always in the same order.

`solver` are blocks, tables, masses, the velocity v, `work` (axes, r, p and q in double precision), `inner` (h^2 a, axes, mass, smoother, w,
r, p and q in single precision, what coarse functions need, what contact adds, and the pool) and what `solver_entries` makes of the
constrained components. A pool are the control of `naibu._numba.thread_pool`; blocks (parts + 1,), nodes (parts + 1,), the ends of the nodes
that blocks reach (parts,), and constrained components (parts + 1,) of the parts; rows in double and in single precision; the sums of each
part; and numbers for all.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu._numba.intrinsics.simd import WIDTH, double, load, single, splat, store, total
from naibu._numba.thread_pool import end_job, first_part, following_part
from naibu.mechanics.lattices.cpu.implicit._coarse_kernels import gather, turn_with

_FAST = {"contract", "nsz"}
SOLVER_JOBS = 9
# typed numbers, or Numba would compile what takes a job once for each; coarse functions gather the residual after the first two
DESCEND, BEGIN, TURN, MULTIPLY, CORRECT, MULTIPLY_FULL, CHANGE, NORM, ALIGN = np.arange(SOLVER_JOBS, dtype=np.int64)
FACTOR, FURTHER, HELPED = range(3)  # places of the numbers for all
COARSE, OPERATOR, POOL = 8, 9, 10  # places in `inner`


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def multiply_part(blocks, stiff, axes, mass, p, q, span):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set q to A p of blocks and the masses of nodes, and return p . q; `stiff` is the table of h^2 a.

    `span` are the first and the last block, the first and the last node, and the end of the nodes that blocks reach.
    """
    first, second, rows = blocks
    b, end, begin_node, end_node, reached = span
    pad = len(p) // 3
    e0, e1, e2 = axes[0], axes[1], axes[2]
    p0, p1, p2, q0, q1, q2 = p[:pad], p[pad : 2 * pad], p[2 * pad :], q[:pad], q[pad : 2 * pad], q[2 * pad :]
    zero = splat(p.dtype.type(0))
    energy = zero
    for i in range(begin_node, end_node, WIDTH):
        m = load(mass, i)
        px, py, pz = load(p0, i), load(p1, i), load(p2, i)
        energy = energy + m * (px * px + py * py + pz * pz)
        store(q0, i, m * px)
        store(q1, i, m * py)
        store(q2, i, m * pz)
    q0[end_node:reached] = 0
    q1[end_node:reached] = 0
    q2[end_node:reached] = 0
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


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def project_part(constrained, q, pad, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take the constrained components begin to end out of q; the directions at one node are orthogonal."""
    node, direction = constrained[0], constrained[1]
    for h in range(begin, end):
        i = node[h]
        along = direction[h, 0] * q[i] + direction[h, 1] * q[pad + i] + direction[h, 2] * q[2 * pad + i]
        for a in range(3):
            q[a * pad + i] -= along * direction[h, a]


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def take_out_part(constrained, q, pad, begin, end, factor):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Do what `project_part` does, and count what is taken out, times a factor, in the last array of `constrained`."""
    node, direction, taken = constrained[0], constrained[1], constrained[4]
    for h in range(begin, end):
        i = node[h]
        along = direction[h, 0] * q[i] + direction[h, 1] * q[pad + i] + direction[h, 2] * q[2 * pad + i]
        taken[h] += factor * along
        for a in range(3):
            q[a * pad + i] -= along * direction[h, a]


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def norm_part(r, smoother, constrained, begin, end, own):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the square of the norm of the free part of r, in double precision, times `smoother`, in single, at the nodes begin to end."""
    pad = len(smoother)
    s = splat(0.0)
    for axis in range(3):
        ra = r[axis * pad : (axis + 1) * pad]
        for i in range(begin, end, WIDTH):
            residual = load(ra, i)
            s = s + residual * (residual * double(load(smoother, i)))
    norm = float(total(s))
    for h in range(own[0], own[1]):
        i = constrained[0][h]
        along = constrained[1][h, 0] * r[i] + constrained[1][h, 1] * r[pad + i] + constrained[1][h, 2] * r[2 * pad + i]
        norm -= along * along * smoother[i]
    return norm


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _scaled_square(r, smoother, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return r . smoother r of the nodes begin to end."""
    pad = len(smoother)
    s = splat(r.dtype.type(0))
    for axis in range(3):
        ra = r[axis * pad : (axis + 1) * pad]
        for i in range(begin, end, WIDTH):
            residual = load(ra, i)
            s = s + residual * (residual * load(smoother, i))
    return float(total(s))


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _begin(r, factor, w, rough, along, pad, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the residual in single precision to that in double precision, r, times a factor, and w and p to zero."""
    scale, zero = splat(factor), splat(w.dtype.type(0))
    for axis in range(3):
        for i in range(axis * pad + begin, axis * pad + end, WIDTH):
            store(rough, i, single(scale * load(r, i)))
            store(w, i, zero)
            store(along, i, zero)


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _turn(p, r, smoother, beta, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set p to smoother r + beta p."""
    pad, part = len(smoother), splat(beta)
    for axis in range(3):
        pa, ra = p[axis * pad :], r[axis * pad :]
        for i in range(begin, end, WIDTH):
            store(pa, i, load(smoother, i) * load(ra, i) + part * load(pa, i))


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _descend(v, r, p, q, smoother, alpha, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move v by alpha p and r by -alpha q; return r . smoother r."""
    pad = len(smoother)
    s, along = splat(v.dtype.type(0)), splat(alpha)
    for axis in range(3):
        va, ra, pa, qa = v[axis * pad :], r[axis * pad :], p[axis * pad :], q[axis * pad :]
        for i in range(begin, end, WIDTH):
            store(va, i, load(va, i) + along * load(pa, i))
            residual = load(ra, i) - along * load(qa, i)
            store(ra, i, residual)
            s = s + residual * (residual * load(smoother, i))
    return float(total(s))


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _correct(v, p, w, factor, pad, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set p to w times a factor, in double precision, and add it to v."""
    scale = splat(factor)
    for axis in range(3):
        for i in range(axis * pad + begin, axis * pad + end, WIDTH):
            change = scale * double(load(w, i))
            store(p, i, change)
            store(v, i, load(v, i) + change)


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _change(v, r, p, q, factor, further, pad, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take q times a factor from r, and add p times a further one to v."""
    one, other = splat(factor), splat(further)
    for axis in range(3):
        for i in range(axis * pad + begin, axis * pad + end, WIDTH):
            store(r, i, load(r, i) - one * load(q, i))
            if further != 0.0:
                store(v, i, load(v, i) + other * load(p, i))


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _aligned(v, p, r, constrained, pad, begin, end, own):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set p to the free part of v, and return p . r."""
    for axis in range(3):
        for i in range(axis * pad + begin, axis * pad + end, WIDTH):
            store(p, i, load(v, i))
    project_part(constrained, p, pad, own[0], own[1])
    s = splat(0.0)
    for axis in range(3):
        for i in range(axis * pad + begin, axis * pad + end, WIDTH):
            s = s + load(p, i) * load(r, i)
    return float(total(s))


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def collect(rows, nodes, high, c, pad):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add to the row of part c what the blocks of parts before it exert on its nodes."""
    own = rows[c]
    for p in range(c):
        other = rows[p]
        for axis in range(3):
            for i in range(axis * pad + nodes[c], axis * pad + min(nodes[c + 1], high[p])):
                own[i] += other[i]


@njit(cache=True, **UNCOUNTED)
def part_entries(pool, c, constrained):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return where the constrained components of a part begin and end; a single part has all."""
    mine = pool[1][3]
    if len(mine) == 2:
        return 0, len(constrained[0])
    return mine[c], mine[c + 1]


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def solver_part(job, c, solver):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Do part c of a job."""
    blocks, tables, mass, v, (axes, r, p, _), inner, constrained = solver
    table, directions, light, smoother, w, rough, along, _, coarse, _, pool = inner
    _, (cuts, nodes, high, _), full, rows, sums, numbers = pool
    begin, end, pad, kind = nodes[c], nodes[c + 1], len(mass), w.dtype.type
    span, own = (cuts[c], cuts[c + 1], begin, end, high[c]), part_entries(pool, c, constrained)
    factor = numbers[FACTOR]
    if job == MULTIPLY:
        sums[c, 0] = multiply_part(blocks, table, directions, light, along, rows[c], span)
    elif job == DESCEND:
        q = rows[c]
        collect(rows, nodes, high, c, pad)
        take_out_part(constrained, q, pad, own[0], own[1], factor)
        sums[c, 0] = _descend(w, rough, along, q, smoother, kind(factor), begin, end)
    elif job == TURN:
        if numbers[HELPED] > 0.0:
            ends = (begin, min(end, pad - WIDTH))
            turn_with(coarse[0][0], coarse[1][1], along.reshape(3, pad), rough.reshape(3, pad), smoother, kind(factor), ends[0], ends[1])
            project_part(constrained, along, pad, own[0], own[1])
        else:
            _turn(along, rough, smoother, kind(factor), begin, end)
    elif job == BEGIN:
        _begin(r, factor, w, rough, along, pad, begin, end)
        constrained[4][own[0] : own[1]] = 0.0
        project_part(constrained, rough, pad, own[0], own[1])
        sums[c, 0] = _scaled_square(rough, smoother, begin, end)
    elif job == CORRECT:
        _correct(v, p, w, factor, pad, begin, end)
    elif job == MULTIPLY_FULL:
        sums[c, 0] = multiply_part(blocks, tables[5], axes, mass, p, full[c], span)
    elif job == CHANGE:
        collect(full, nodes, high, c, pad)
        _change(v, r, p, full[c], factor, numbers[FURTHER], pad, begin, end)
    elif job == NORM:
        sums[c, 0] = norm_part(r, smoother, constrained, begin, end, own)
    elif job == ALIGN:
        sums[c, 0] = _aligned(v, p, r, constrained, pad, begin, end, own)
    if numbers[HELPED] > 0.0 and job <= BEGIN:
        columns = coarse[1][0][c]
        if job == BEGIN:
            columns[:] = 0
        gather(coarse[0][0], columns, rough.reshape(3, pad), begin, min(end, pad - WIDTH))


@njit(cache=True, **UNCOUNTED)
def summed(sums, k):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the sum of a column, in the order of the parts."""
    found = 0.0
    for c in range(len(sums)):
        found += sums[c, k]
    return found


@njit(cache=True, **UNCOUNTED)
def share(solver, job, factor):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Have all parts of a job done, with a factor, and return the sum of what they give."""
    pool = solver[5][POOL]
    control, sums = pool[0], pool[4]
    pool[5][FACTOR] = factor
    part = first_part(control, job)
    while part >= 0:
        solver_part(job, part, solver)
        part = following_part(control, part)
    end_job(control)
    return summed(sums, 0)
