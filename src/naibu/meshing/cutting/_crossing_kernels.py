"""Kernels: crossings of segments and triangles, consistent at shared edges, and distances from triangles."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit


@njit(cache=True)
def _volume(a, b, c, d):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Six times the signed volume of a tetrahedron."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    wx, wy, wz = d[0] - a[0], d[1] - a[1], d[2] - a[2]
    return ux * (vy * wz - vz * wy) + uy * (vz * wx - vx * wz) + uz * (vx * wy - vy * wx)


@njit(cache=True)
def _beside(p, q, points, i, j):  # type: ignore[no-untyped-def]  # pragma: no cover
    """On which side of the segment p q the directed edge i j passes; the same number for both triangles of an edge, but for its sign."""
    if i < j:
        return _volume(p, q, points[i], points[j]) >= 0.0
    return not _volume(p, q, points[j], points[i]) >= 0.0


@njit(cache=True)
def crosses(p, q, points, triangles, low, high, count):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return 0 where the segment from p to q crosses no triangle, else which end sees the last one clockwise: 1 if p, -1 if q does.

    `low` and `high` are the boxes of the triangles, of which the first `count` are looked at.
    A segment through an edge or a vertex of a surface crosses one of its triangles, as the signs of zero volumes are agreed on.
    """
    side = 0
    for t in range(count):
        apart = False
        for k in range(3):
            apart |= min(p[k], q[k]) > high[t, k] or max(p[k], q[k]) < low[t, k]
        if apart:
            continue
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        before = _volume(points[a], points[b], points[c], p) >= 0.0
        behind = _volume(points[a], points[b], points[c], q) >= 0.0
        if before == behind:
            continue
        first = _beside(p, q, points, a, b)
        if first == _beside(p, q, points, b, c) and first == _beside(p, q, points, c, a):
            side = -1 if before else 1
    return side


@njit(cache=True)
def crossed_segments(starts, ends, points, triangles, low, high, side):  # type: ignore[no-untyped-def]  # pragma: no cover
    """What `crosses` says of every segment."""
    for s in range(len(starts)):
        side[s] = crosses(starts[s], ends[s], points, triangles, low, high, len(triangles))


@njit(cache=True)
def _square_distance(p, a, b, c):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Square of the distance of a point from a triangle, by the regions of Ericson's closest point."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = ab @ ap, ac @ ap
    if d1 <= 0.0 and d2 <= 0.0:
        return ap @ ap
    bp = p - b
    d3, d4 = ab @ bp, ac @ bp
    if d3 >= 0.0 and d4 <= d3:
        return bp @ bp
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        rest = ap - (d1 / (d1 - d3)) * ab
        return rest @ rest
    cp = p - c
    d5, d6 = ab @ cp, ac @ cp
    if d6 >= 0.0 and d5 <= d6:
        return cp @ cp
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        rest = ap - (d2 / (d2 - d6)) * ac
        return rest @ rest
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        rest = bp - ((d4 - d3) / ((d4 - d3) + (d5 - d6))) * (c - b)
        return rest @ rest
    total = va + vb + vc
    rest = ap - (vb / total) * ab - (vc / total) * ac
    return rest @ rest


@njit(cache=True)
def _nearest(p, points, triangles, low, high):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Square of the distance of a point from the nearest triangle, and which one this is."""
    best, found = np.inf, -1
    for t in range(len(triangles)):
        gap = 0.0
        for k in range(3):
            beyond = max(low[t, k] - p[k], p[k] - high[t, k], 0.0)
            gap += beyond * beyond
        if gap < best:
            a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
            square = _square_distance(p, points[a], points[b], points[c])
            if square < best:
                best, found = square, t
    return best, found


@njit(cache=True)
def distance(p, points, triangles, low, high):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Distance of a point from the nearest triangle."""
    return np.sqrt(_nearest(p, points, triangles, low, high)[0])


@njit(cache=True)
def nearest_triangles(queries, points, triangles, low, high, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Nearest triangle of every query point."""
    for i in range(len(queries)):
        out[i] = _nearest(queries[i], points, triangles, low, high)[1]


@njit(cache=True)
def distances(queries, points, triangles, low, high, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Distance of every query point from the nearest triangle."""
    for i in range(len(queries)):
        out[i] = distance(queries[i], points, triangles, low, high)


@njit(cache=True)
def interpolate_midpoints(values, ends, first):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Give the rows from `first` on the mean of the rows of their ends, which precede them."""
    for i in range(len(ends)):
        for c in range(values.shape[1]):
            values[first + i, c] = 0.5 * (values[ends[i, 0], c] + values[ends[i, 1], c])
