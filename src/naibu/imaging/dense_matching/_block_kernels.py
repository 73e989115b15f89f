# mypy: disallow-untyped-decorators=False
"""Numba kernels for `naibu.imaging.dense_matching.block_matching` :cite:p:`hirai2008` (chapter 3.5): full search, sub-voxel fit.

Costs are least where the match is best: mean absolute difference (SAD), mean squared difference (SSD), or minus the normalised
cross-correlation (NCC).
"""

from __future__ import annotations

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray, BoolArray, Int32Array, IntArray

SAD, SSD, NCC = range(3)
# reassociation lets loops be vectorised; "nnan" is left out, as NaN marks what lies outside
FAST = {"reassoc", "contract", "arcp", "nsz"}


# All loops run from 0 over slices of long rows, so that they are vectorised, and take three or two rows together, because they are limited
# by memory bandwidth.
@njit(cache=True, fastmath=FAST)
def _differ(measure: int, a: AnyArray, b: AnyArray, at_a: int, at_b: int, step: int, depth: int, out: AnyArray) -> None:
    """Fill out (n,) with the sum of differences over an odd number of slices, `step` apart in a and b."""
    n = len(out)
    a0, b0 = a[at_a : at_a + n], b[at_b : at_b + n]
    if measure == SAD:
        for x in range(n):
            out[x] = abs(a0[x] - b0[x])
    elif measure == SSD:
        for x in range(n):
            out[x] = (a0[x] - b0[x]) * (a0[x] - b0[x])
    else:
        for x in range(n):
            out[x] = a0[x] * b0[x]
    for z in range(1, depth, 2):
        u, v = at_a + z * step, at_b + z * step
        a1, b1 = a[u : u + n], b[v : v + n]
        a2, b2 = a[u + step : u + step + n], b[v + step : v + step + n]
        if measure == SAD:
            for x in range(n):
                out[x] += abs(a1[x] - b1[x]) + abs(a2[x] - b2[x])
        elif measure == SSD:
            for x in range(n):
                out[x] += (a1[x] - b1[x]) * (a1[x] - b1[x]) + (a2[x] - b2[x]) * (a2[x] - b2[x])
        else:
            for x in range(n):
                out[x] += a1[x] * b1[x] + a2[x] * b2[x]


@njit(cache=True, fastmath=FAST)
def _sum(row: AnyArray, step: int, count: int, out: AnyArray) -> None:
    """Fill out (n,) with the sum of an odd number of values, `step` apart in row."""
    n = len(out)
    a = row[:n]
    if count == 1:
        for x in range(n):
            out[x] = a[x]
        return
    b, c = row[step : step + n], row[2 * step : 2 * step + n]
    for x in range(n):
        out[x] = a[x] + b[x] + c[x]
    for r in range(3, count, 2):
        b, c = row[r * step : r * step + n], row[(r + 1) * step : (r + 1) * step + n]
        for x in range(n):
            out[x] += b[x] + c[x]


@njit(cache=True, fastmath=FAST)
def _take_better(cost: AnyArray, number: np.int32, best: AnyArray, which: Int32Array) -> None:
    for x in range(len(cost)):
        better = cost[x] < best[x]
        which[x] = number if better else which[x]
        best[x] = cost[x] if better else best[x]


@njit(cache=True, fastmath=FAST)
def _correlate(cost: AnyArray, fraction: float, mean_a: AnyArray, scale_a: AnyArray, mean_b: AnyArray, scale_b: AnyArray) -> None:
    one = np.float32(fraction)
    for x in range(len(cost)):
        cost[x] = (mean_a[x] * mean_b[x] - cost[x] * one) * scale_a[x] * scale_b[x]


@njit(cache=True, parallel=True)
def full_search(
    measure: int,
    a: AnyArray,
    b: AnyArray,
    layout: IntArray,
    half: IntArray,
    offsets: IntArray,
    wanted: BoolArray,
    statistics_a: AnyArray,
    statistics_b: AnyArray,
    best: AnyArray,
    which: Int32Array,
) -> None:
    """Fill best and which with the least cost of every voxel and the index of its offset (m, 3), given along x, y, z.

    All volumes are flat: `layout` is nz, ny, the length of a row, and the number of values before the first one. Rows end with as many NaN
    as a block or a displacement reaches, and so do the volumes at both ends: a block that leaves the volume costs NaN, which is never
    better. `wanted` (nz, chunks) is true where a chunk of rows holds wanted voxels; statistics (2, size) are the means of the blocks and
    the inverses of their standard deviations, used by the correlation.
    """
    nz, ny, width, guard = layout[0], layout[1], layout[2], layout[3]
    hx, hy, hz = half[0], half[1], half[2]
    chunks = wanted.shape[1]
    rows = -(-ny // chunks)
    fraction = 1.0 / ((2 * hx + 1) * (2 * hy + 1) * (2 * hz + 1))
    for task in prange(nz * chunks):
        k, y0 = task // chunks, (task % chunks) * rows
        if not wanted[k, task % chunks] or k < hz or k + hz >= nz:
            continue
        room = (rows + 2 * hy) * width
        differences, columns, cost = np.empty(room, dtype=a.dtype), np.empty(room, dtype=a.dtype), np.empty(room, dtype=a.dtype)
        for number in range(len(offsets)):
            dx, dy, dz = offsets[number, 0], offsets[number, 1], offsets[number, 2]
            start, stop = max(y0, hy, hy - dy), min(y0 + rows, ny - hy, ny - hy - dy)
            if k + dz < hz or k + dz + hz >= nz or start >= stop:
                continue
            m = (stop - start) * width
            shift = (dz * ny + dy) * width + dx
            corner = guard + ((k - hz) * ny + start - hy) * width
            _differ(measure, a, b, corner, corner + shift, ny * width, 2 * hz + 1, differences[: m + 2 * hy * width])
            _sum(differences, width, 2 * hy + 1, columns[:m])
            n = m - 2 * hx
            _sum(columns, 1, 2 * hx + 1, cost[:n])
            at = guard + (k * ny + start) * width + hx
            if measure == NCC:
                to = at + shift
                _correlate(
                    cost[:n],
                    fraction,
                    statistics_a[0, at : at + n],
                    statistics_a[1, at : at + n],
                    statistics_b[0, to : to + n],
                    statistics_b[1, to : to + n],
                )
            _take_better(cost[:n], np.int32(number), best[at : at + n], which[at : at + n])


@njit(cache=True)
def _block_cost(measure: int, a: AnyArray, b: AnyArray, half: IntArray, k: int, j: int, i: int, dz: int, dy: int, dx: int) -> float:
    """Return the cost of one displacement of one block; NaN where it leaves the volume or has no contrast."""
    nz, ny, nx = a.shape
    z, y, x = k + dz, j + dy, i + dx
    if x < half[0] or y < half[1] or z < half[2] or x + half[0] >= nx or y + half[1] >= ny or z + half[2] >= nz:
        return np.nan
    n, total, sa, sb, saa, sbb, sab = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    # differences from the central voxel avoid cancellation in the sums of squares
    ca, cb = np.float64(a[k, j, i]), np.float64(b[z, y, x])
    for p in range(-half[2], half[2] + 1):
        for q in range(-half[1], half[1] + 1):
            for r in range(-half[0], half[0] + 1):
                va, vb = np.float64(a[k + p, j + q, i + r]), np.float64(b[z + p, y + q, x + r])
                n += 1
                if measure == SAD:
                    total += abs(va - vb)
                elif measure == SSD:
                    total += (va - vb) ** 2
                else:
                    va, vb = va - ca, vb - cb
                    sa, sb, saa, sbb, sab = sa + va, sb + vb, saa + va * va, sbb + vb * vb, sab + va * vb
    if measure != NCC:
        return total / n
    contrast = (saa - sa * sa / n) * (sbb - sb * sb / n)
    return float(-(sab - sa * sb / n) / np.sqrt(contrast)) if contrast > 0.0 else np.nan


@njit(cache=True)
def _costs_about(
    measure: int, a: AnyArray, b: AnyArray, half: IntArray, k: int, j: int, i: int, dz: int, dy: int, dx: int, out: AnyArray
) -> None:
    """Fill out (3, 3, 3), along z, y, x, with the costs about a displacement, but for the corners of the cube.

    Mean absolute differences are squared: they grow linearly with the distance from the minimum, their squares quadratically.
    """
    nz, ny, nx = a.shape
    for p in range(-1, 2):
        for q in range(-1, 2):
            for r in range(-1, 2):
                absent = (p != 0 and nz == 1) or (q != 0 and ny == 1) or (r != 0 and nx == 1)
                if absent or abs(p) + abs(q) + abs(r) == 3:
                    continue
                value = _block_cost(measure, a, b, half, k, j, i, dz + p, dy + q, dx + r)
                out[p + 1, q + 1, r + 1] = value * value if measure == SAD else value


@njit(cache=True)
def _along_axis(c: AnyArray, axis: int, sign: int) -> float:
    """Return the cost one step along x, y, z = 0, 1, 2."""
    return float(c[1 + sign * (axis == 2), 1 + sign * (axis == 1), 1 + sign * (axis == 0)])


@njit(cache=True)
def _minimum_of_quadratic(c: AnyArray, active: BoolArray, step: AnyArray) -> None:
    """Fill step (3,), along x, y, z, with the minimum of the quadratic function through costs (3, 3, 3).

    Where that function has no minimum within a voxel, axes are treated one by one; the step is 0 along one without a minimum.
    """
    gradient, bend, free = np.zeros(3), np.eye(3), np.zeros(3, dtype=np.bool_)
    for u in range(3):
        step[u] = 0.0
        if not active[u]:
            continue
        before, after = _along_axis(c, u, -1), _along_axis(c, u, 1)
        if not (before >= c[1, 1, 1] and after >= c[1, 1, 1] and before + after > 2.0 * c[1, 1, 1]):
            continue
        gradient[u], bend[u, u] = 0.5 * (after - before), before - 2.0 * c[1, 1, 1] + after
        step[u], free[u] = -gradient[u] / bend[u, u], True
        for v in range(u):
            if free[v]:
                mixed = 0.0
                for s in (-1, 1):
                    for t in (-1, 1):
                        mixed += (
                            s * t * c[1 + s * (u == 2) + t * (v == 2), 1 + s * (u == 1) + t * (v == 1), 1 + s * (u == 0) + t * (v == 0)]
                        )
                bend[u, v] = bend[v, u] = 0.25 * mixed
    d, e, f = bend[0, 1], bend[0, 2], bend[1, 2]
    minor = bend[0, 0] * bend[1, 1] - d * d
    det = bend[0, 0] * (bend[1, 1] * bend[2, 2] - f * f) - d * (d * bend[2, 2] - f * e) + e * (d * f - bend[1, 1] * e)
    if not (minor > 0.0 and det > 1e-3 * bend[0, 0] * bend[1, 1] * bend[2, 2]):
        return
    found = -np.linalg.solve(bend, gradient)
    if np.abs(found).max() <= 1.0:
        for u in range(3):
            step[u] = found[u]


@njit(cache=True, parallel=True)
def between_voxels(
    measure: int, a: AnyArray, b: AnyArray, half: IntArray, offsets: IntArray, which: Int32Array, fit: bool, move: AnyArray, cost: AnyArray
) -> None:
    """Fill move (3, nz, ny, nx) with the best offset, refined where asked for, and cost with the exact cost of the offset."""
    nz, ny, nx = a.shape
    for row in prange(nz * ny):
        k, j = row // ny, row % ny
        about, step = np.empty((3, 3, 3)), np.zeros(3)
        active = np.array([nx > 1, ny > 1, nz > 1])
        for i in range(nx):
            if which[k, j, i] < 0:
                continue
            dx, dy, dz = offsets[which[k, j, i], 0], offsets[which[k, j, i], 1], offsets[which[k, j, i], 2]
            cost[k, j, i] = _block_cost(measure, a, b, half, k, j, i, dz, dy, dx)
            if fit:
                about[:] = np.nan
                _costs_about(measure, a, b, half, k, j, i, dz, dy, dx, about)
                _minimum_of_quadratic(about, active, step)
            move[0, k, j, i], move[1, k, j, i], move[2, k, j, i] = dx + step[0], dy + step[1], dz + step[2]
