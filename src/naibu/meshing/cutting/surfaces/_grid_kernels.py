"""Kernels: which triangles of a surface are near a point, from a grid of cells in which those of the surface before the cut are listed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu.core.arrays import FloatArray, IntArray
from naibu.meshing.cutting.surfaces._search_kernels import nearest_on_triangle

MOST_CELLS = 8  # for each triangle, and as many places in their lists


class GridArrays(NamedTuple):
    """Cells of equal cubes, and the triangles whose boxes overlap each."""

    low: FloatArray  # (3,) mm
    size: FloatArray  # (1,) edge of the cubes, mm
    shape: IntArray  # (3,)
    start: IntArray  # (cells + 1,) of each cell in `listed`
    listed: IntArray


@njit(cache=True, **UNCOUNTED)
def _between(low, size, shape, axis, a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    """First and last cell along an axis between two coordinates."""
    first, last = int(np.floor((a - low[axis]) / size)), int(np.floor((b - low[axis]) / size))
    return min(max(first, 0), shape[axis] - 1), min(max(last, 0), shape[axis] - 1)


@njit(cache=True, **UNCOUNTED)
def _list(p, triangles, low, size, shape, count, listed, filled):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Count the triangles of each cell, or list them where `filled`; returns how many places they take."""
    total = 0
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        x0, x1 = _between(low, size, shape, 0, min(p[a, 0], min(p[b, 0], p[c, 0])), max(p[a, 0], max(p[b, 0], p[c, 0])))
        y0, y1 = _between(low, size, shape, 1, min(p[a, 1], min(p[b, 1], p[c, 1])), max(p[a, 1], max(p[b, 1], p[c, 1])))
        z0, z1 = _between(low, size, shape, 2, min(p[a, 2], min(p[b, 2], p[c, 2])), max(p[a, 2], max(p[b, 2], p[c, 2])))
        total += (x1 - x0 + 1) * (y1 - y0 + 1) * (z1 - z0 + 1)
        if len(count):
            for x in range(x0, x1 + 1):
                for y in range(y0, y1 + 1):
                    for z in range(z0, z1 + 1):
                        cell = (x * shape[1] + y) * shape[2] + z
                        if filled:
                            listed[count[cell]] = t
                        count[cell] += 1
    return total


def grid_of(points: FloatArray, triangles: IntArray, size_mm: float) -> GridArrays:
    """Return a grid of cubes of at least some size, mm, larger where the cells or their lists would be many."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    size, none, most = size_mm, np.zeros(0, dtype=np.int64), MOST_CELLS * (len(triangles) + 1000)
    while True:
        shape = np.floor(extent / size).astype(np.int64) + 1
        if np.prod(shape.astype(np.float64)) <= most and _list(points, triangles, low, size, shape, none, none, False) <= most:
            break
        size *= 2.0
    count = np.zeros(int(np.prod(shape)), dtype=np.int64)
    total = int(_list(points, triangles, low, size, shape, count, none, False))
    start = np.concatenate([[0], np.cumsum(count)])
    listed = np.zeros(total, dtype=np.int64)
    _list(points, triangles, low, size, shape, start[:-1].copy(), listed, True)
    return GridArrays(low, np.array([size]), shape, start, listed)


@njit(cache=True, **UNCOUNTED)
def nearest_listed(s, grid, qx, qy, qz, reach):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the triangle nearest to q among the parts of those listed within reach; -1 where none is so near."""
    best, where, low, size, shape = reach * reach, -1, grid.low, grid.size[0], grid.shape
    x0, x1 = _between(low, size, shape, 0, qx - reach, qx + reach)
    y0, y1 = _between(low, size, shape, 1, qy - reach, qy + reach)
    z0, z1 = _between(low, size, shape, 2, qz - reach, qz + reach)
    for x in range(x0, x1 + 1):
        for y in range(y0, y1 + 1):
            for z in range(z0, z1 + 1):
                cell = (x * shape[1] + y) * shape[2] + z
                for h in range(grid.start[cell], grid.start[cell + 1]):
                    t = grid.listed[h]
                    while t >= 0:
                        d2 = nearest_on_triangle(s.position, s.triangles[t, 0], s.triangles[t, 1], s.triangles[t, 2], qx, qy, qz)[0]
                        if d2 < best or (d2 == best and t < where):
                            best, where = d2, t
                        t = s.next_part[t]
    return where
