"""Kernels: the path of a tool over the surface between two of its positions, where that is folded."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu.meshing.cutting.surfaces._search_kernels import dot, folded, nearest_on_triangle, normal_of

MOST_CREASES = 16
MOST_PASSED = 256  # triangles between two positions
FARTHEST = 4.0  # distances that the path may be longer between them
THERE = 1e-9  # of the distance


@njit(cache=True, **UNCOUNTED)
def _height(p, v, from_, w):  # type: ignore[no-untyped-def]  # pragma: no cover
    return dot(p[v, 0] - from_[0], p[v, 1] - from_[1], p[v, 2] - from_[2], w[0], w[1], w[2])


@njit(cache=True, **UNCOUNTED)
def _exit(s, t, behind, from_, w, ahead, here):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Corner opposite to the edge over which a plane leaves a triangle, not the edge towards the triangle behind; -1 if none. And where.

    Of the two edges of the first triangle, the one that lies ahead.
    """
    p, found, best, out = s.position, -1, -np.inf, (0.0, 0.0, 0.0)
    for i in range(3):
        if behind >= 0 and s.neighbours[t, i] == behind:
            continue
        a, b = s.triangles[t, (i + 1) % 3], s.triangles[t, (i + 2) % 3]
        fa, fb = _height(p, a, from_, w), _height(p, b, from_, w)
        if (fa >= 0.0) == (fb >= 0.0):
            continue
        f = fa / (fa - fb)
        x, y, z = p[a, 0] + f * (p[b, 0] - p[a, 0]), p[a, 1] + f * (p[b, 1] - p[a, 1]), p[a, 2] + f * (p[b, 2] - p[a, 2])
        onward = dot(x - here[0], y - here[1], z - here[2], ahead[0], ahead[1], ahead[2])
        if onward > best:
            found, best, out = i, onward, (x, y, z)
    return found, out


@njit(cache=True, **UNCOUNTED)
def creases(s, t, begin, end, facing, distance, points, normals):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Enter the points at which the way over the surface from `begin`, on a triangle, to `end` crosses folds, and the triangles' normals.

    The way lies in the plane through both along the mean normal there, `facing` being that at the end. Returns how many points there are;
    none if the way leads over the boundary, an earlier cut or far away.
    """
    p, start = s.position, (begin[0], begin[1], begin[2])
    here = start
    nx, ny, nz = normal_of(p, s.triangles[t, 0], s.triangles[t, 1], s.triangles[t, 2])
    fx, fy, fz = facing[0], facing[1], facing[2]
    n1, n2 = max(np.sqrt(dot(nx, ny, nz, nx, ny, nz)), 1e-300), max(np.sqrt(dot(fx, fy, fz, fx, fy, fz)), 1e-300)
    mx, my, mz = nx / n1 + fx / n2, ny / n1 + fy / n2, nz / n1 + fz / n2
    ex, ey, ez = end[0] - begin[0], end[1] - begin[1], end[2] - begin[2]
    mm, em, ee = dot(mx, my, mz, mx, my, mz), dot(ex, ey, ez, mx, my, mz), dot(ex, ey, ez, ex, ey, ez)
    if mm < 1e-12 or ee == 0.0:
        return 0
    ahead = ex - em / mm * mx, ey - em / mm * my, ez - em / mm * mz
    w = ahead[1] * mz - ahead[2] * my, ahead[2] * mx - ahead[0] * mz, ahead[0] * my - ahead[1] * mx
    if w[0] == 0.0 and w[1] == 0.0 and w[2] == 0.0:
        return 0
    behind, size, gone, limit = -1, 0, 0.0, np.sqrt(ee) + FARTHEST * distance
    for _ in range(MOST_PASSED):
        if (
            nearest_on_triangle(p, s.triangles[t, 0], s.triangles[t, 1], s.triangles[t, 2], end[0], end[1], end[2])[0]
            <= (THERE * distance) ** 2
        ):
            return size
        i, out = _exit(s, t, behind, start, w, ahead, here)
        if i < 0 or s.neighbours[t, i] < 0:
            return 0
        x, y, z = out[0] - here[0], out[1] - here[1], out[2] - here[2]
        gone += np.sqrt(dot(x, y, z, x, y, z))
        if gone > limit:
            return 0
        here, behind, t = out, t, s.neighbours[t, i]
        before = nx, ny, nz
        nx, ny, nz = normal_of(p, s.triangles[t, 0], s.triangles[t, 1], s.triangles[t, 2])
        if folded(before, (nx, ny, nz)):
            if size == MOST_CREASES:
                return 0
            points[size, 0], points[size, 1], points[size, 2] = here[0], here[1], here[2]
            normals[size, 0], normals[size, 1], normals[size, 2] = nx, ny, nz
            size += 1
    return 0
