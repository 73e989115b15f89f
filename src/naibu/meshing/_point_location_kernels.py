# mypy: disallow-untyped-decorators=False
"""Numba kernels of point location: shape functions, their inverse by Newton's method, and the search over bins."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, IntArray

# Kinds of cell by number of nodes: 4 tetra, 10 tetra10, 8 hexahedron.
_MAX_NEWTON = 30


@njit(cache=True)
def shape(k: int, u: FloatArray, n: FloatArray, dn: FloatArray) -> None:
    """Fill the shape functions n (k,) and their gradients dn (k, 3) at the reference point u (3,)."""
    if k == 8:
        for i in range(8):
            sx = 1.0 if (i & 3) in (1, 2) else -1.0
            sy = 1.0 if (i & 3) >= 2 else -1.0
            sz = 1.0 if i >= 4 else -1.0
            fx, fy, fz = 1 + sx * u[0], 1 + sy * u[1], 1 + sz * u[2]
            n[i] = fx * fy * fz / 8
            dn[i, 0], dn[i, 1], dn[i, 2] = sx * fy * fz / 8, sy * fx * fz / 8, sz * fx * fy / 8
        return
    dn[:, :] = 0.0
    b = (1 - u[0] - u[1] - u[2], u[0], u[1], u[2])
    if k == 4:
        for i in range(4):
            n[i] = b[i]
            for d in range(3):
                dn[i, d] = -1.0 if i == 0 else (1.0 if d == i - 1 else 0.0)
        return
    for i in range(4):
        n[i] = b[i] * (2 * b[i] - 1)
        for d in range(3):
            slope = -1.0 if i == 0 else (1.0 if d == i - 1 else 0.0)
            dn[i, d] = (4 * b[i] - 1) * slope
    first, second = (0, 1, 2, 0, 1, 2), (1, 2, 0, 3, 3, 3)
    for e in range(6):
        i, j = first[e], second[e]
        n[4 + e] = 4 * b[i] * b[j]
        for d in range(3):
            si = -1.0 if i == 0 else (1.0 if d == i - 1 else 0.0)
            sj = -1.0 if j == 0 else (1.0 if d == j - 1 else 0.0)
            dn[4 + e, d] = 4 * (si * b[j] + sj * b[i])


@njit(cache=True)
def excess(k: int, u: FloatArray) -> float:
    """Return the distance of the reference point from the cell as a fraction of its size; negative inside."""
    if k == 8:
        return float((max(abs(u[0]), abs(u[1]), abs(u[2])) - 1.0) / 2)
    return float(-min(u[0], u[1], u[2], 1.0 - u[0] - u[1] - u[2]))


@njit(cache=True)
def clamp(k: int, u: FloatArray, v: FloatArray) -> None:
    """Fill v with a point of the cell near u: clipped to the cube, or without the negative barycentric coordinates of a tetrahedron."""
    if k == 8:
        for d in range(3):
            v[d] = min(1.0, max(-1.0, u[d]))
        return
    total = max(0.0, 1.0 - u[0] - u[1] - u[2])
    for d in range(3):
        total += max(0.0, u[d])
    for d in range(3):
        v[d] = max(0.0, u[d]) / total


@njit(cache=True)
def invert(p: FloatArray, x: FloatArray, u: FloatArray, n: FloatArray, dn: FloatArray) -> bool:
    """Find the reference point u of x in the cell with nodes p (k, 3) by Newton's method; return whether it converged."""
    k = p.shape[0]
    u[:] = 0.0 if k == 8 else 0.25
    for _ in range(_MAX_NEWTON):
        shape(k, u, n, dn)
        r0, r1, r2 = x[0], x[1], x[2]
        a = np.zeros((3, 3))
        for i in range(k):
            r0 -= n[i] * p[i, 0]
            r1 -= n[i] * p[i, 1]
            r2 -= n[i] * p[i, 2]
            for d in range(3):
                for e in range(3):
                    a[d, e] += p[i, d] * dn[i, e]
        c0 = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
        c1 = a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2]
        c2 = a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0]
        det = a[0, 0] * c0 + a[0, 1] * c1 + a[0, 2] * c2
        if det == 0.0:
            return False
        s0 = (r0 * c0 + r1 * (a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2]) + r2 * (a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1])) / det
        s1 = (r0 * c1 + r1 * (a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0]) + r2 * (a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2])) / det
        s2 = (r0 * c2 + r1 * (a[0, 1] * a[2, 0] - a[0, 0] * a[2, 1]) + r2 * (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0])) / det
        u[0] += s0
        u[1] += s1
        u[2] += s2
        step = max(abs(s0), abs(s1), abs(s2))
        if not step < 1e3:
            return False
        # Newton converges quadratically: after a step this small the next one would be below rounding.
        if step < 1e-8:
            return True
    return False


@njit(cache=True)
def search_bins(
    points: FloatArray,
    cells: IntArray,
    boxes: FloatArray,
    queries: FloatArray,
    bin_of_query: IntArray,
    starts: IntArray,
    members: IntArray,
    slack: float,
    found: IntArray,
    local: FloatArray,
) -> None:
    """Set found (q,) and local (q, 3) for every query that lies in a cell listed in its bin, the deepest one; others keep -1."""
    k = cells.shape[1]
    p, n, dn, u = np.empty((k, 3)), np.empty(k), np.empty((k, 3)), np.empty(3)
    for q in range(len(queries)):
        b = bin_of_query[q]
        if b < 0:
            continue
        x = queries[q]
        best = slack
        for m in range(starts[b], starts[b + 1]):
            c = members[m]
            box = boxes[c]
            if x[0] < box[0] or x[1] < box[1] or x[2] < box[2] or x[0] > box[3] or x[1] > box[4] or x[2] > box[5]:
                continue
            for i in range(k):
                for d in range(3):  # one by one: the first assignment of arrays takes Numba a second to compile
                    p[i, d] = points[cells[c, i], d]
            if not invert(p, x, u, n, dn):
                continue
            out = excess(k, u)
            if out < best:
                best = out
                found[q] = c
                for d in range(3):
                    local[q, d] = u[d]
            if best <= 0.0:
                break


@njit(cache=True)
def search_nearest(
    points: FloatArray,
    cells: IntArray,
    queries: FloatArray,
    candidates: IntArray,
    offsets: IntArray,
    found: IntArray,
    local: FloatArray,
    distance: FloatArray,
) -> None:
    """For queries (q, 3) outside the mesh, pick the nearest of their candidate cells and extrapolate from it."""
    k = cells.shape[1]
    p, n, dn, u, v = np.empty((k, 3)), np.empty(k), np.empty((k, 3)), np.empty(3), np.empty(3)
    for q in range(len(queries)):
        x = queries[q]
        distance[q] = np.inf
        for m in range(offsets[q], offsets[q + 1]):
            c = candidates[m]
            for i in range(k):
                for d in range(3):  # one by one: the first assignment of arrays takes Numba a second to compile
                    p[i, d] = points[cells[c, i], d]
            if invert(p, x, u, n, dn):
                clamp(k, u, v)
            else:
                for d in range(3):
                    u[d] = v[d] = 0.0 if k == 8 else 0.25
            shape(k, v, n, dn)
            gap = 0.0
            for d in range(3):
                at = 0.0
                for i in range(k):
                    at += n[i] * p[i, d]
                gap += (x[d] - at) ** 2
            if gap**0.5 < distance[q]:
                distance[q] = gap**0.5
                found[q] = c
                for d in range(3):
                    local[q, d] = u[d]


@njit(cache=True)
def list_bins(low: IntArray, high: IntArray, dims: IntArray, starts: IntArray, members: IntArray) -> None:
    """Fill members with the cells that touch each bin; starts (bins + 1,) holds the running counts and is used as the cursor."""
    cursor = starts[:-1].copy()
    for c in range(len(low)):
        for iz in range(low[c, 2], high[c, 2] + 1):
            for iy in range(low[c, 1], high[c, 1] + 1):
                for ix in range(low[c, 0], high[c, 0] + 1):
                    b = ix + dims[0] * (iy + dims[1] * iz)
                    members[cursor[b]] = c
                    cursor[b] += 1


@njit(cache=True)
def count_bins(low: IntArray, high: IntArray, dims: IntArray, counts: IntArray) -> None:
    """Add to counts (bins,) one for every cell that touches the bin."""
    for c in range(len(low)):
        for iz in range(low[c, 2], high[c, 2] + 1):
            for iy in range(low[c, 1], high[c, 1] + 1):
                for ix in range(low[c, 0], high[c, 0] + 1):
                    counts[ix + dims[0] * (iy + dims[1] * iz)] += 1


@njit(cache=True)
def weights_at(k: int, local: FloatArray, weights: FloatArray) -> None:
    """Fill the shape functions weights (q, k) at the reference points local (q, 3)."""
    dn = np.empty((k, 3))
    for q in range(len(local)):
        shape(k, local[q], weights[q], dn)
