"""Kernels: the point of a surface nearest to a tool, and the way of a cut from vertex to vertex along the tool's path."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.meshing.cutting._surface_kernels import bisect, corner, fan, on_boundary, separate, size2, swap

WAITING, STEPPED, LEFT, ENDED, STUCK, FULL = 0, 1, 2, 3, 4, 5
NO_ROOM = -2
FINEST = 4  # times that the allowed edge is halved where no edge leads on


@njit(cache=True)
def nearest_on_triangle(q, a, b, c, weights):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Barycentric coordinates of the point of a triangle that is nearest to q; returns the square of its distance."""
    u, v, w = b - a, c - a, q - a
    uu, uv, vv, wu, wv = (u * u).sum(), (u * v).sum(), (v * v).sum(), (w * u).sum(), (w * v).sum()
    det = uu * vv - uv * uv
    best = np.inf
    if det > 0.0:
        g, h = (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det
        if g >= 0.0 and h >= 0.0 and g + h <= 1.0:
            weights[0], weights[1], weights[2] = 1.0 - g - h, g, h
            d = w - g * u - h * v
            return (d * d).sum()
    corners = (a, b, c)
    for i in range(3):
        p, e = corners[i], corners[(i + 1) % 3] - corners[i]
        f = min(1.0, max(0.0, ((q - p) * e).sum() / max((e * e).sum(), 1e-300)))
        d = q - p - f * e
        d2 = (d * d).sum()
        if d2 < best:
            best = d2
            weights[:] = 0.0
            weights[i], weights[(i + 1) % 3] = 1.0 - f, f
    return best


@njit(cache=True)
def nearest_of_all(s, q):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the triangle nearest to q."""
    best, where, weights = np.inf, 0, np.empty(3)
    for t in range(s.n[1]):
        a, b, c = s.triangles[t]
        d2 = nearest_on_triangle(q, s.position[a], s.position[b], s.position[c], weights)
        if d2 < best:
            best, where = d2, t
    return where


@njit(cache=True)
def nearby(s, start, q, radius, jump, queue):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Collect the triangles within a radius of q that hang together with one, also across cuts where `jump`; returns their number."""
    s.n[2] += 1
    mark, head, tail, weights = s.n[2], 0, 1, np.empty(3)
    queue[0], s.stamp[start] = start, mark
    while head < tail:
        t = queue[head]
        head += 1
        a, b, c = s.triangles[t]
        if head > 1 and nearest_on_triangle(q, s.position[a], s.position[b], s.position[c], weights) > radius * radius:
            continue
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


@njit(cache=True)
def nearest(s, start, q, radius, jump, queue, point):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Triangle nearest to q among those nearby, its point (written to `point`), and how far q is beside the surface across its boundary."""
    count = nearby(s, start, q, radius, jump, queue)
    best, where, weights, kept = np.inf, start, np.empty(3), np.empty(3)
    for k in range(count):
        a, b, c = s.triangles[queue[k]]
        d2 = nearest_on_triangle(q, s.position[a], s.position[b], s.position[c], weights)
        if d2 < best:
            best, where, kept[:] = d2, queue[k], weights
    a, b, c = s.triangles[where]
    p = s.position
    point[:] = kept[0] * p[a] + kept[1] * p[b] + kept[2] * p[c]
    beside = -1.0  # not at the boundary
    for i in range(3):
        if kept[i] == 0.0 and s.neighbours[where, i] < 0:
            normal = np.cross(p[b] - p[a], p[c] - p[a])
            gap = q - point
            gap = gap - (gap * normal).sum() / (normal * normal).sum() * normal
            beside = np.sqrt((gap * gap).sum())
    return where, beside, best


@njit(cache=True)
def on_path(path, length, m, q, low, high):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return distance of q from the part of the path between two lengths, and the length of the nearest point."""
    j = max(0, np.searchsorted(length[:m], low) - 1)
    best, where = np.inf, low
    while j < m - 1 and length[j] <= high:
        e = path[j + 1] - path[j]
        f = ((q - path[j]) * e).sum() / max((e * e).sum(), 1e-300)
        step = length[j + 1] - length[j]
        f = min(min(1.0, (high - length[j]) / step), max(max(0.0, (low - length[j]) / step), f))
        d = q - path[j] - f * e
        d2 = (d * d).sum()
        if d2 < best:
            best, where = d2, length[j] + f * step
        j += 1
    return np.sqrt(best), where


@njit(cache=True)
def along(path, length, m, at):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Point of the path at a length, held at its ends."""
    j = min(max(np.searchsorted(length[:m], at) - 1, 0), m - 2)
    f = min(1.0, max(0.0, (at - length[j]) / (length[j + 1] - length[j])))
    return (1.0 - f) * path[j] + f * path[j + 1]


@njit(cache=True)
def refine_around(s, v, bound):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Bisect until no triangle around a vertex has an edge of `bound` or more; False where there is no room."""
    around = np.empty(512, dtype=np.int64)
    while True:
        count, _ = fan(s, v, around)
        coarse = -1
        for k in range(count):
            if size2(s, around[k]) >= bound * bound:
                coarse = around[k]
        if coarse < 0:
            return count >= 0
        if not bisect(s, coarse):
            return False


@njit(cache=True)
def _fits(s, r, c, at, path, length, m, distance, free):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the length of the path beside vertex c if the way from r leads on and stays near the path, and -1 otherwise."""
    step = s.position[c] - s.position[r]
    size = np.sqrt((step * step).sum())
    high, reached = at + 3.0 * max(size, distance), -1.0
    gap, reached = on_path(path, length, m, s.position[c], at, high)
    end = path[m - 1]
    if length[m - 1] - at < distance:
        if ((s.position[c] - end) ** 2).sum() >= ((s.position[r] - end) ** 2).sum():
            return -1.0
    elif reached <= at + 0.1 * size:
        return -1.0
    if free:
        return reached
    if gap > 0.5 * distance:
        return -1.0
    for k in range(1, 4):
        if on_path(path, length, m, s.position[r] + 0.25 * k * step, at, high)[0] > 0.5 * distance:
            return -1.0
    return reached


@njit(cache=True)
def _best(s, r, at, path, length, m, distance, free, across, around, found):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Find the vertex whose edge lies closest to the direction of the path; `found` is filled with it, its triangle, corner and kind."""
    count, _ = fan(s, r, around)
    best, reached = 0.0, -1.0
    found[0] = -1
    for k in range(count):
        t = around[k]
        i = corner(s, t, r)
        u = s.neighbours[t, i]
        for kind in range(3 if across and u >= 0 else 2):
            if kind < 2:
                c = s.triangles[t, (i + 1 + kind) % 3]
                if s.neighbours[t, (i + 2 - kind) % 3] < 0:
                    continue  # along a boundary there is nothing to part
            else:
                j = 0
                while s.neighbours[u, j] != t:
                    j += 1
                c = s.triangles[u, j]
            step = s.position[c] - s.position[r]
            size = np.sqrt((step * step).sum())
            aim = along(path, length, m, at + max(size, 0.5 * distance)) - s.position[r]
            cosine = (step * aim).sum() / max(size * np.sqrt((aim * aim).sum()), 1e-300)
            if cosine > best + (1e-9 if kind == 2 else 0.0):
                behind = _fits(s, r, c, at, path, length, m, distance, free)
                if behind >= 0.0:
                    best, reached = cosine, behind
                    found[0], found[1], found[2], found[3] = c, t, i, kind
    return reached


@njit(cache=True)
def _next(s, r, at, path, length, m, distance, free):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Neighbour of a vertex, or the one across the longest edge of a triangle around it, closest to the path's direction; -1 if none."""
    around, found = np.empty(512, dtype=np.int64), np.empty(4, dtype=np.int64)
    reached = _best(s, r, at, path, length, m, distance, free, True, around, found)
    if found[0] >= 0 and found[3] == 2 and not swap(s, found[1], found[2]):
        reached = _best(s, r, at, path, length, m, distance, free, False, around, found)
    return found[0], reached


@njit(cache=True)
def advance(s, now, at, path, length, m, distance, final, free):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take one step of the cut; returns what came of it.

    `now` holds the vertex that the cut has reached, and 1 if it was on the boundary; `at` the length of the path beside it.
    """
    left = length[m - 1] - at[0]
    if not final and left < 2.0 * distance:
        return WAITING
    if now[1]:
        return LEFT
    around = np.empty(512, dtype=np.int64)
    r = now[0]
    for k in range(FINEST + 1):
        if not free and not refine_around(s, r, distance * 0.5**k):
            return FULL
        c, reached = _next(s, r, at[0], path, length, m, distance, free)
        if c >= 0:
            now[1] = on_boundary(s, c, around)
            if not separate(s, r, c):
                return FULL
            at[0], now[0] = reached, c
            return STEPPED
        if free or (final and left < 0.5 * distance):
            break
    return ENDED if left < distance or free else STUCK


@njit(cache=True)
def begin(s, t, q, path, length, m, low, high, distance, edge, free, queue):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Vertex near q within half the distance of the path, on the boundary if `edge`; -1 if there is none, -2 where there is no room."""
    point, weights, found = np.empty(3), np.empty(3), -1
    for k in range(FINEST + 1):
        bound = distance * 0.5**k
        while True:
            t, _, _ = nearest(s, t, q, 2.0 * distance, False, queue, point)
            count = nearby(s, t, q, 2.0 * distance, False, queue)
            best, where, found, gap = np.inf, -1, -1, np.inf
            for h in range(count if edge else 1):
                u = queue[h] if edge else t
                for i in range(3):
                    if edge and s.neighbours[u, i] >= 0:
                        continue
                    a, b = s.triangles[u, (i + 1) % 3], s.triangles[u, (i + 2) % 3]
                    pa, pb = s.position[a], s.position[b]
                    d2 = nearest_on_triangle(q, pa, pb, pb, weights) if edge else 0.0
                    da, db = ((pa - q) ** 2).sum(), ((pb - q) ** 2).sum()
                    if d2 < best or (d2 == best and min(da, db) < gap):
                        best, where, found, gap = d2, u, a if da < db else b, min(da, db)
            if where < 0 or free or size2(s, where) < bound * bound:
                break
            if not bisect(s, where):
                return NO_ROOM
        if found < 0 or free or on_path(path, length, m, s.position[found], low, high)[0] <= 0.5 * distance:
            return found
    return -1
