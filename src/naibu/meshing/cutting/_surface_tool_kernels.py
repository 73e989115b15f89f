"""Kernels: a tool that moves over a surface, and the cut that follows it."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.meshing.cutting._surface_grid_kernels import nearest_listed
from naibu.meshing.cutting._surface_kernels import INSIDE, RIM
from naibu.meshing.cutting._surface_search_kernels import dot, first_at, nearest, on_path
from naibu.meshing.cutting._surface_walk_kernels import (
    AT,
    AT_BOUNDARY,
    BEGAN,
    BEGIN,
    CLOSING,
    COUNT,
    DISTANCE,
    ENDED,
    FULL,
    HEIGHT,
    LAST,
    LEFT,
    LEFT_BEFORE,
    NO_ROOM,
    NOW,
    PIECE,
    PIECES,
    REACH,
    SAMPLED,
    STEPPED,
    STUCK,
    WAITING,
    advance,
    begin,
)

SAMPLES = 4  # of the tool's path in one distance
BESIDE = 1e-6  # of the distance: how far beside its boundary the tool has left the surface
CROSSING_STEPS = 20


@njit(cache=True)
def _apart(a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    return np.sqrt(dot(x, y, z, x, y, z))


@njit(cache=True)
def append(k, point, tip, triangle, over):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Append a position of the tip and the point beneath it to the path, unless the point is the last one."""
    m = k.whole[COUNT]
    if m:
        step = _apart(k.points[m - 1], point)
        if step < 1e-9 * max(1.0, k.length[m - 1]):
            return
        k.length[m] = k.length[m - 1] + step
    else:
        k.length[m] = 0.0
    for i in range(3):
        k.points[m, i], k.tips[m, i] = point[i], tip[i]
    k.triangle[m], k.over[m] = triangle, over
    k.whole[COUNT] = m + 1


@njit(cache=True)
def sample(s, k, grid, tip, near):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Append a position of the tip and the point of the surface beneath it, searched from a triangle (-1: everywhere)."""
    distance, reach, point = k.real[DISTANCE], k.real[REACH], np.empty(3)
    radius = 2.0 * distance + k.real[HEIGHT]
    t, beside, d2 = max(near, 0), 0.0, np.inf
    if near >= 0:
        t, beside, d2, _ = nearest(s, near, tip, radius, True, k.queue, point)
    if d2 > reach * reach:  # far from where the tool was
        found = nearest_listed(s, grid, tip[0], tip[1], tip[2], reach)
        if found >= 0:
            t, beside, d2, _ = nearest(s, found, tip, radius, True, k.queue, point)
    if beside > BESIDE * distance or d2 > reach * reach:
        k.real[HEIGHT] = 0.0
        append(k, tip, tip, t, 0)
    else:
        k.real[HEIGHT] = np.sqrt(d2)
        append(k, point, tip, t, RIM if beside >= 0.0 else INSIDE)


@njit(cache=True)
def _crossing(s, k, i, q, point):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write to q where the path comes over the surface between its points i - 1 and i, by bisection."""
    outside, middle = k.points[i - 1].copy(), np.empty(3)
    q[:] = k.points[i]
    for _ in range(CROSSING_STEPS):
        for j in range(3):
            middle[j] = 0.5 * (outside[j] + q[j])
        _, beside, _, _ = nearest(s, k.triangle[i], middle, k.real[REACH], False, k.queue, point)
        if beside > BESIDE * k.real[DISTANCE]:
            outside[:] = middle
        else:
            q[:] = middle


@njit(cache=True)
def _ahead(k, final):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Point of the path at which the cut begins or goes on; -1 where there is none yet."""
    m, distance = k.whole[COUNT], k.real[DISTANCE]
    i = first_at(k.length, m, k.real[AT] + 0.5 * distance) if k.whole[BEGAN] else 0
    while i < m and k.over[i] == 0:
        i += 1
    return -1 if i == m or (not final and k.length[m - 1] - k.length[i] < 2.0 * distance) else i


@njit(cache=True)
def _enter(s, k, final):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Find the vertex at which the cut begins, or goes on behind an edge or an earlier cut; returns STEPPED, WAITING or FULL."""
    whole, real, distance, p = k.whole, k.real, k.real[DISTANCE], s.position
    target, point = np.empty(3), np.empty(3)
    while True:
        i = _ahead(k, final)
        if i < 0:
            return WAITING
        k.triangle[i] = nearest(s, k.triangle[i], k.points[i], 2.0 * distance, True, k.queue, point)[0]  # it may have been cut since
        edge = whole[LEFT_BEFORE] != 0 or k.over[i] == RIM
        target[:] = real[LAST : LAST + 3] if whole[LEFT_BEFORE] else k.points[i]
        j = i - 1
        while j >= 0 and k.over[j] != 0 and k.length[j] >= real[AT] - distance:
            j -= 1
        if j >= 0 and k.over[j] == 0 and k.length[j] >= real[AT] - distance:
            i, edge = j + 1, True
            k.triangle[i] = nearest(s, k.triangle[i], k.points[i], 2.0 * distance, True, k.queue, point)[0]
            _crossing(s, k, i, target, point)
        low, high = max(real[AT], k.length[i] - 2.0 * distance), k.length[i] + distance
        found = begin(s, k, k.triangle[i], target, low, high, edge, point)
        if found == NO_ROOM:
            return FULL
        least = real[AT] + 0.1 * distance if whole[BEGAN] else 0.0  # it never goes on behind where it was, so that it comes to an end
        whole[BEGAN] = 1
        if found >= 0:
            whole[NOW], whole[AT_BOUNDARY] = found, 0
            beside = on_path(k.points, k.length, whole[COUNT], p[found, 0], p[found, 1], p[found, 2], low, high)[1]
            real[AT] = max(least, beside)
            return STEPPED
        real[AT] = max(least, max(real[AT] + 0.1 * distance, k.length[i]))
        whole[LEFT_BEFORE] = 0  # the next try begins inside


@njit(cache=True)
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


@njit(cache=True)
def follow(s, k, grid, goal, again):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move the tip along a straight line; FULL where there is no room, after which it is called `again` with more."""
    whole, real = k.whole, k.real
    if not whole[COUNT]:
        sample(s, k, grid, goal, -1)
        return WAITING
    if not again:
        last = k.tips[whole[COUNT] - 1]
        real[BEGIN : BEGIN + 3] = last
        whole[PIECES] = max(1, int(np.ceil(SAMPLES * _apart(last, goal) / real[DISTANCE])))
        whole[PIECE], whole[SAMPLED] = 1, 0
    tip = np.empty(3)
    while whole[PIECE] <= whole[PIECES]:
        if not whole[SAMPLED]:
            if whole[COUNT] == len(k.length):
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


@njit(cache=True)
def close(k):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Where the path ends at its beginning, follow it a little further, so that the cut meets its own beginning."""
    distance, last = k.real[DISTANCE], k.whole[COUNT] - 1
    if k.length[last] < 4.0 * distance or _apart(k.points[0], k.points[last]) > 0.5 * distance:
        return
    k.real[CLOSING] = k.length[last] - 2.0 * distance
    for i in range(1, first_at(k.length, last + 1, 2.0 * distance)):
        append(k, k.points[i], k.tips[i], k.triangle[i], k.over[i])
