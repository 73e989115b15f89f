"""Kernels: the point of a surface nearest to a tool, searched from a triangle nearby, and points and distances along the tool's path."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import COUNTED, UNCOUNTED, njit

FOLD = 0.7  # cosine of the angle between two triangles, below which the path gets a point on their edge
_NO_FOLDS = np.zeros(0, dtype=np.int64)


@njit(cache=True, **UNCOUNTED)
def dot(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Scalar product of two vectors."""
    return ax * bx + ay * by + az * bz


@njit(cache=True, **UNCOUNTED)
def from_to(p, a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Vector from row a to row b."""
    return p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]


@njit(cache=True, **UNCOUNTED)
def _along_edge(p, a, b, qx, qy, qz):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Square of the distance of q from an edge, and the share of its length at which the nearest point lies."""
    ex, ey, ez = from_to(p, a, b)
    wx, wy, wz = qx - p[a, 0], qy - p[a, 1], qz - p[a, 2]
    f = min(1.0, max(0.0, dot(wx, wy, wz, ex, ey, ez) / max(dot(ex, ey, ez, ex, ey, ez), 1e-300)))
    dx, dy, dz = wx - f * ex, wy - f * ey, wz - f * ez
    return dot(dx, dy, dz, dx, dy, dz), f


@njit(cache=True, **UNCOUNTED)
def nearest_on_triangle(p, a, b, c, qx, qy, qz):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Square of the distance of q from a triangle, and the barycentric coordinates of the nearest point."""
    ux, uy, uz = from_to(p, a, b)
    vx, vy, vz = from_to(p, a, c)
    wx, wy, wz = qx - p[a, 0], qy - p[a, 1], qz - p[a, 2]
    uu, uv, vv = dot(ux, uy, uz, ux, uy, uz), dot(ux, uy, uz, vx, vy, vz), dot(vx, vy, vz, vx, vy, vz)
    wu, wv = dot(wx, wy, wz, ux, uy, uz), dot(wx, wy, wz, vx, vy, vz)
    det = uu * vv - uv * uv
    if det > 0.0:
        g, h = (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det
        if g >= 0.0 and h >= 0.0 and g + h <= 1.0:
            dx, dy, dz = wx - g * ux - h * vx, wy - g * uy - h * vy, wz - g * uz - h * vz
            return dot(dx, dy, dz, dx, dy, dz), 1.0 - g - h, g, h
    best, f = _along_edge(p, a, b, qx, qy, qz)
    first, second, third = 1.0 - f, f, 0.0
    d2, f = _along_edge(p, b, c, qx, qy, qz)
    if d2 < best:
        best, first, second, third = d2, 0.0, 1.0 - f, f
    d2, f = _along_edge(p, c, a, qx, qy, qz)
    if d2 < best:
        best, first, second, third = d2, f, 0.0, 1.0 - f
    return best, first, second, third


@njit(cache=True, **UNCOUNTED)
def _queue_beside(s, t, mark, jump, queue, tail):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Append what hangs together with a triangle and has not been met, also across cuts where `jump`; returns the number in the queue."""
    for i in range(3):
        u = s.neighbours[t, i]
        if u >= 0 and s.stamp[u] != mark and tail < len(queue):
            s.stamp[u] = mark
            queue[tail] = u
            tail += 1
        v = s.twin[s.triangles[t, i]]
        while jump and v != s.triangles[t, i]:
            u = s.at[v]
            if s.stamp[u] != mark and tail < len(queue):
                s.stamp[u] = mark
                queue[tail] = u
                tail += 1
            v = s.twin[v]
    return tail


@njit(cache=True, **UNCOUNTED)
def nearest(s, start, q, radius, jump, queue, point):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Triangle nearest to q within a radius of it, among those that hang together with one, also across cuts where `jump`.

    Returns the triangle, how far q is beside the surface across its boundary, the square of the distance, and how many triangles stand in
    the queue; the nearest point is written to `point`.
    """
    s.n[2] += 1
    mark, head, tail, p = s.n[2], 0, 1, s.position
    qx, qy, qz = q[0], q[1], q[2]
    queue[0], s.stamp[start] = start, mark
    best, where, first, second, third = np.inf, start, 0.0, 0.0, 0.0
    while head < tail:
        t = queue[head]
        head += 1
        d2, f, g, h = nearest_on_triangle(p, s.triangles[t, 0], s.triangles[t, 1], s.triangles[t, 2], qx, qy, qz)
        if d2 < best:
            best, where, first, second, third = d2, t, f, g, h
        if head == 1 or d2 <= radius * radius:
            tail = _queue_beside(s, t, mark, jump, queue, tail)
    a, b, c = s.triangles[where, 0], s.triangles[where, 1], s.triangles[where, 2]
    for k in range(3):
        point[k] = first * p[a, k] + second * p[b, k] + third * p[c, k]
    edge = s.neighbours[where, 0] < 0 and first == 0.0
    edge = edge or (s.neighbours[where, 1] < 0 and second == 0.0) or (s.neighbours[where, 2] < 0 and third == 0.0)
    return where, _beside(p, a, b, c, q, point) if edge else -1.0, best, tail


@njit(cache=True, **UNCOUNTED)
def normal_of(p, a, b, c):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Vector normal to a triangle, whose length is twice its area."""
    ux, uy, uz = from_to(p, a, b)
    vx, vy, vz = from_to(p, a, c)
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@njit(cache=True, **UNCOUNTED)
def folded(one, two):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether two normals differ by so much that the path has a point where the surface turns from one to the other."""
    return dot(*one, *two) < FOLD * np.sqrt(dot(*one, *one) * dot(*two, *two))


@njit(cache=True, **UNCOUNTED)
def _beside(p, a, b, c, q, point):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Distance of q from a point of a triangle, within the triangle's plane."""
    nx, ny, nz = normal_of(p, a, b, c)
    gx, gy, gz = q[0] - point[0], q[1] - point[1], q[2] - point[2]
    out = dot(gx, gy, gz, nx, ny, nz) / dot(nx, ny, nz, nx, ny, nz)
    gx, gy, gz = gx - out * nx, gy - out * ny, gz - out * nz
    return np.sqrt(dot(gx, gy, gz, gx, gy, gz))


@njit(cache=True, **UNCOUNTED)
def first_at(length, m, at):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Number of the first of m increasing lengths that is not below `at`."""
    low, high = 0, m
    while low < high:
        middle = (low + high) // 2
        if length[middle] < at:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, **UNCOUNTED)
def on_path(path, length, m, qx, qy, qz, low, high):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return distance of q from the part of the path between two lengths, and the length of the nearest point."""
    return on_side_of_path(path, length, path[:0], _NO_FOLDS, m, qx, qy, qz, low, high, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@njit(cache=True, **UNCOUNTED)
def on_side_of_path(path, length, normals, folds, m, qx, qy, qz, low, high, one, two):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return what `on_path` does, of those pieces of the path only that face as one of two normals does, where unit normals are given.

    So what lies across a fold is not near. `folds` counts those before each piece: behind one, pieces face as the normals do more exactly.
    The distance is infinite where no piece faces as they do.
    """
    j = max(0, first_at(length, m, low) - 1)
    best, where, before = np.inf, low, 0
    least1, least2 = FOLD * np.sqrt(dot(*one, *one)), FOLD * np.sqrt(dot(*two, *two))
    if len(normals) and j < m - 1:
        before = folds[j + 1]
    while j < m - 1 and length[j] <= high:
        if len(normals):
            x, y, z = normals[j + 1]
            d1, d2 = dot(x, y, z, *one), dot(x, y, z, *two)
            if (d1 < 0.0 and d2 < 0.0) or (folds[j + 1] > before and d1 < least1 and d2 < least2):
                j += 1
                continue
        ex, ey, ez = from_to(path, j, j + 1)
        wx, wy, wz = qx - path[j, 0], qy - path[j, 1], qz - path[j, 2]
        f = dot(wx, wy, wz, ex, ey, ez) / max(dot(ex, ey, ez, ex, ey, ez), 1e-300)
        step = length[j + 1] - length[j]
        f = min(min(1.0, (high - length[j]) / step), max(max(0.0, (low - length[j]) / step), f))
        dx, dy, dz = wx - f * ex, wy - f * ey, wz - f * ez
        gap2 = dot(dx, dy, dz, dx, dy, dz)
        if gap2 < best:
            best, where = gap2, length[j] + f * step
        j += 1
    return np.sqrt(best), where


@njit(cache=True, **UNCOUNTED)
def along(path, length, m, at):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Point of the path at a length, held at its ends."""
    j = min(max(first_at(length, m, at) - 1, 0), m - 2)
    f = min(1.0, max(0.0, (at - length[j]) / (length[j + 1] - length[j])))
    g = 1.0 - f
    return g * path[j, 0] + f * path[j + 1, 0], g * path[j, 1] + f * path[j + 1, 1], g * path[j, 2] + f * path[j + 1, 2]


@njit(cache=True, **COUNTED)
def distances_from_path(path, length, places):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Distances of places (k, 3) from the whole path."""
    out = np.empty(len(places))
    for i in range(len(places)):
        out[i] = on_path(path, length, len(length), places[i, 0], places[i, 1], places[i, 2], 0.0, length[-1])[0]
    return out


@njit(cache=True, **COUNTED)
def distances_from_edges(p, edges, places):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Distances of places (k, 3) from the nearest of edges (c, 2), infinite where there is none."""
    out = np.empty(len(places))
    for i in range(len(places)):
        best = np.inf
        for e in range(len(edges)):
            best = min(best, _along_edge(p, edges[e, 0], edges[e, 1], places[i, 0], places[i, 1], places[i, 2])[0])
        out[i] = np.sqrt(best)
    return out
