"""Kernels: a tool that moves over a surface, and the cut that follows it."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu.meshing.cutting.surfaces._grid_kernels import nearest_listed
from naibu.meshing.cutting.surfaces._search_kernels import dot, first_at, folded, nearest, normal_of, on_path, on_side_of_path
from naibu.meshing.cutting.surfaces._surface_kernels import INSIDE, RIM
from naibu.meshing.cutting.surfaces._trace_kernels import MOST_CREASES, creases
from naibu.meshing.cutting.surfaces._walk_kernels import (
    AT,
    AT_BOUNDARY,
    BEGAN,
    BEGIN,
    BENEATH,
    CLOSING,
    COUNT,
    CROSSED,
    DISTANCE,
    ENDED,
    ENTERED,
    FOLDS,
    FULL,
    HEIGHT,
    LAST,
    LEFT,
    LEFT_BEFORE,
    MIDDLE,
    NEAREST,
    NO_ROOM,
    NOW,
    PIECE,
    PIECES,
    REACH,
    SAMPLED,
    STEPPED,
    STUCK,
    TARGET,
    TIP,
    WAITING,
    advance,
    begin,
)

SAMPLES = 4  # of the tool's path in one distance
BESIDE = 1e-6  # of the distance: how far beside its boundary the tool has left the surface
CROSSING_STEPS = 20
MOST_OF_SAMPLE = 2 * MOST_CREASES + 2  # points of the path that one position of the tip may add


@njit(cache=True, **UNCOUNTED)
def _apart(a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    return np.sqrt(dot(x, y, z, x, y, z))


@njit(cache=True, **UNCOUNTED)
def append(k, point, tip, triangle, over, normal):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Append a position of the tip and the point beneath it to the path, unless the point is the last one."""
    m = k.whole[COUNT]
    if m:
        step = _apart(k.points[m - 1], point)
        if step < 1e-9 * max(1.0, k.length[m - 1]):
            return
        k.length[m] = k.length[m - 1] + step
    else:
        k.length[m] = 0.0
    size = max(np.sqrt(dot(*normal, *normal)), 1e-300)
    for i in range(3):
        k.points[m, i], k.tips[m, i], k.normals[m, i] = point[i], tip[i], normal[i] / size
    k.folds[m] = 0 if m < 2 else k.folds[m - 1] + folded((k.normals[m - 1, 0], k.normals[m - 1, 1], k.normals[m - 1, 2]), normal)
    k.triangle[m], k.over[m] = triangle, over
    k.whole[COUNT] = m + 1


@njit(cache=True, **UNCOUNTED)
def _beneath(s, k, grid, tip, near, point):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Triangle beneath a position of the tip, searched from one nearby (-1: everywhere), and where the tip is, as in `ToolArrays.over`.

    Also the square of its distance, and the point beneath is written to `point`.
    """
    distance, reach = k.real[DISTANCE], k.real[REACH]
    radius = 2.0 * distance + k.real[HEIGHT]
    t, beside, d2 = max(near, 0), 0.0, np.inf
    if near >= 0:
        t, beside, d2, _ = nearest(s, near, tip, radius, True, k.queue, point)
    if d2 > reach * reach:  # far from where the tool was
        found = nearest_listed(s, grid, tip[0], tip[1], tip[2], reach)
        if found >= 0:
            t, beside, d2, _ = nearest(s, found, tip, radius, True, k.queue, point)
    return t, 0 if beside > BESIDE * distance or d2 > reach * reach else RIM if beside >= 0.0 else INSIDE, d2


@njit(cache=True, **UNCOUNTED)
def sample(s, k, grid, tip, near):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Append a position of the tip and the point of the surface beneath it, searched from a triangle (-1: everywhere).

    Before it, the point of the boundary over which the tip comes or goes, and those of folds of the surface.
    """
    point = k.work[BENEATH]
    t, over, d2 = _beneath(s, k, grid, tip, near, point)
    k.real[HEIGHT] = np.sqrt(d2) if over else 0.0
    last = k.whole[COUNT] - 1
    if last >= 0 and (over == 0) != (k.over[last] == 0):
        _append_crossing(s, k, grid, tip, t if over else k.triangle[last])
    if over:
        _append_over(s, k, point, tip, t, over)
    else:
        append(k, tip, tip, t, 0, normal_of(s.position, s.triangles[t, 0], s.triangles[t, 1], s.triangles[t, 2]))


@njit(cache=True, **UNCOUNTED)
def _append_over(s, k, point, tip, t, over):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Append a position over the surface, and before it the folds between it and the last one."""
    last = k.whole[COUNT] - 1
    facing = normal_of(s.position, s.triangles[t, 0], s.triangles[t, 1], s.triangles[t, 2])
    if last >= 0 and k.over[last] and k.triangle[last] != t:
        points, normals = k.work[FOLDS : FOLDS + MOST_CREASES], k.work[FOLDS + MOST_CREASES :]
        count = creases(s, t, point, k.points[last], k.normals[last], k.real[DISTANCE], points, normals)
        for c in range(count - 1, -1, -1):  # they come from the end; the normals are those of the pieces before
            append(k, points[c], tip, t, INSIDE, (normals[c, 0], normals[c, 1], normals[c, 2]))
    append(k, point, tip, t, over, facing)


@njit(cache=True, **UNCOUNTED)
def _append_crossing(s, k, grid, tip, near):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Append where the way of the tip from its last position crosses the boundary, by bisection: the point nearest to it just outside.

    Just inside, another part of the surface may be nearer, where the boundary is that of a fold.
    """
    last = k.whole[COUNT] - 1
    inward = k.over[last] == 0
    low, high, middle, point = 0.0, 1.0, k.work[MIDDLE], k.work[CROSSED]
    for step in range(CROSSING_STEPS + 1):
        f = 0.5 * (low + high) if step < CROSSING_STEPS else (low if inward else high)
        for j in range(3):
            middle[j] = (1.0 - f) * k.tips[last, j] + f * tip[j]
        t, over, d2 = _beneath(s, k, grid, middle, near, point)
        if (over != 0) == inward:
            high = f
        else:
            low = f
    if d2 <= k.real[REACH] ** 2:
        _append_over(s, k, point, middle, t, RIM)


@njit(cache=True, **UNCOUNTED)
def _ahead(k, final):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Point of the path at which the cut begins or goes on; -1 where there is none yet."""
    m, distance = k.whole[COUNT], k.real[DISTANCE]
    i = first_at(k.length, m, k.real[AT] + 0.5 * distance) if k.whole[BEGAN] else 0
    while i < m and k.over[i] == 0:
        i += 1
    return -1 if i == m or (not final and k.length[m - 1] - k.length[i] < 2.0 * distance) else i


@njit(cache=True, **UNCOUNTED)
def _length_beside(s, k, v, low, high):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Length of the path beside a vertex, of the pieces that face as a triangle there does if any is near."""
    p, m, t = s.position, k.whole[COUNT], s.at[v]
    normal = normal_of(p, s.triangles[t, 0], s.triangles[t, 1], s.triangles[t, 2])
    gap, beside = on_side_of_path(k.points, k.length, k.normals, k.folds, m, p[v, 0], p[v, 1], p[v, 2], low, high, normal, normal)
    if gap <= 0.5 * k.real[DISTANCE]:
        return beside
    return on_path(k.points, k.length, m, p[v, 0], p[v, 1], p[v, 2], low, high)[1]


@njit(cache=True, **UNCOUNTED)
def _enter(s, k, final):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Find the vertex at which the cut begins, or goes on behind an edge or an earlier cut; returns STEPPED, WAITING or FULL."""
    whole, real, distance = k.whole, k.real, k.real[DISTANCE]
    target, point = k.work[TARGET], k.work[NEAREST]
    while True:
        i = _ahead(k, final)
        if i < 0:
            return WAITING
        k.triangle[i] = nearest(s, k.triangle[i], k.points[i], 2.0 * distance, True, k.queue, point)[0]  # it may have been cut since
        edge = whole[LEFT_BEFORE] != 0 or k.over[i] == RIM
        for a in range(3):
            target[a] = real[LAST + a] if whole[LEFT_BEFORE] else k.points[i, a]
        j = i - 1
        while j >= 0 and k.over[j] != 0 and k.length[j] >= real[AT] - distance:
            j -= 1
        comes = j >= 0 and k.over[j] == 0 and k.length[j] >= real[AT] - distance
        if comes:
            i, edge = j + 1, True
            k.triangle[i] = nearest(s, k.triangle[i], k.points[i], 2.0 * distance, True, k.queue, point)[0]
            for a in range(3):
                target[a] = k.points[i, a]
        low, high = max(real[AT], k.length[i] - 2.0 * distance), k.length[i] + distance
        found = begin(s, k, k.triangle[i], target, low, high, edge, point)
        if found == NO_ROOM:
            return FULL
        least = real[AT] + 0.1 * distance if whole[BEGAN] else 0.0  # it never goes on behind where it was, so that it comes to an end
        whole[BEGAN] = 1
        if found >= 0:
            whole[NOW], whole[AT_BOUNDARY] = found, 0
            real[AT], real[ENTERED] = max(least, _length_beside(s, k, found, low, high)), k.length[i] if comes else 0.0
            return STEPPED
        real[AT] = max(least, max(real[AT] + 0.1 * distance, k.length[i]))
        whole[LEFT_BEFORE] = 0  # the next try begins inside


@njit(cache=True, **UNCOUNTED)
def walk(s, k, final):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Let the cut follow the tool as far as it may; FULL where there is no room."""
    whole, real = k.whole, k.real
    if whole[COUNT] < 2:
        return WAITING
    while True:
        if whole[NOW] < 0:
            entered = _enter(s, k, final)
            if entered != STEPPED:
                return entered
        code = advance(s, k, final)
        if code in (FULL, WAITING):
            return code
        if code == ENDED:
            whole[NOW] = -1
            return WAITING
        if code in (LEFT, STUCK):
            for i in range(3):
                real[LAST + i] = s.position[whole[NOW], i]
            real[AT] += 0.25 * real[DISTANCE] if code == STUCK else 0.0
            whole[LEFT_BEFORE], whole[NOW] = code == LEFT, -1
            if real[AT] >= real[CLOSING]:
                return WAITING  # the loop is closed


@njit(cache=True, **UNCOUNTED)
def follow(s, k, grid, goal, again):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move the tip along a straight line; FULL where there is no room, after which it is called `again` with more."""
    whole, real = k.whole, k.real
    if not whole[COUNT]:
        sample(s, k, grid, goal, -1)
        return WAITING
    if not again:
        last = k.tips[whole[COUNT] - 1]
        for i in range(3):
            real[BEGIN + i] = last[i]
        whole[PIECES] = max(1, int(np.ceil(SAMPLES * _apart(last, goal) / real[DISTANCE])))
        whole[PIECE], whole[SAMPLED] = 1, 0
    tip = k.work[TIP]
    while whole[PIECE] <= whole[PIECES]:
        if not whole[SAMPLED]:
            if whole[COUNT] + MOST_OF_SAMPLE > len(k.length):
                return FULL
            for i in range(3):
                tip[i] = real[BEGIN + i] + whole[PIECE] / whole[PIECES] * (goal[i] - real[BEGIN + i])
            sample(s, k, grid, tip, k.triangle[whole[COUNT] - 1])
            whole[SAMPLED] = 1
        if walk(s, k, False) == FULL:
            return FULL
        whole[SAMPLED] = 0
        whole[PIECE] += 1
    return WAITING


@njit(cache=True, **UNCOUNTED)
def close(k):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Where the path ends at its beginning, follow it a little further, so that the cut meets its own beginning."""
    distance, last = k.real[DISTANCE], k.whole[COUNT] - 1
    if k.length[last] < 4.0 * distance or _apart(k.points[0], k.points[last]) > 0.5 * distance:
        return
    k.real[CLOSING] = k.length[last] - 2.0 * distance
    for i in range(1, first_at(k.length, last + 1, 2.0 * distance)):
        append(k, k.points[i], k.tips[i], k.triangle[i], k.over[i], (k.normals[i, 0], k.normals[i, 1], k.normals[i, 2]))
