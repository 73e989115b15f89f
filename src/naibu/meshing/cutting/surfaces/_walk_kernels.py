"""Kernels: the way of a cut from vertex to vertex along the path of a tool."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu.core.arrays import FloatArray, IntArray
from naibu.meshing.cutting.surfaces._search_kernels import (
    along,
    dot,
    first_at,
    folded,
    from_to,
    nearest,
    nearest_on_triangle,
    normal_of,
    on_path,
    on_side_of_path,
)
from naibu.meshing.cutting.surfaces._surface_kernels import (
    INSIDE,
    LIP,
    RIM,
    bisect,
    corner,
    divide,
    fan,
    has_room,
    on_boundary,
    on_edge_of,
    separate,
    size2,
    swap,
)
from naibu.meshing.cutting.surfaces._trace_kernels import MOST_CREASES

WAITING, STEPPED, LEFT, ENDED, STUCK, FULL = 0, 1, 2, 3, 4, 5
NO_ROOM = -2
RECENT = 3.0  # distances: length of the latest edges of a cut, onto which it does not turn back
FINEST = 4  # times that the allowed edge is halved where no edge leads on
TOO_FLAT = 1e-6  # of the longest edge: height of a triangle
BESIDE_FOLD = 1e-6  # of the distance
ONWARD, HARDLY = 0.1, 1e-3  # of an edge: how much further along the path it leads, and where an edge is divided for want of one
BLUNT = 0.1  # of an edge: its parts are not shorter, where the way through it allows that

# entries of `ToolArrays.whole`: lengths of the path and of the list of cut edges, where the cut is, and how far a movement has come
COUNT, EDGES, NOW, AT_BOUNDARY, BEGAN, LEFT_BEFORE, FREE, PIECE, PIECES, SAMPLED = range(10)
# entries of `ToolArrays.real`: distance, reach, length of the path beside the cut, height of the tip, length at which a loop is closed,
# where the cut left the surface, where a movement began, length at which the path of the cut came over the boundary
DISTANCE, REACH, AT, HEIGHT, CLOSING, LAST, BEGIN, ENTERED = 0, 1, 2, 3, 4, 5, 8, 11
# rows of `ToolArrays.work`: the tip and the point beneath it, those where it crosses a boundary, where a cut begins, and folds on the way
TIP, BENEATH, MIDDLE, CROSSED, TARGET, NEAREST, FOLDS = 0, 1, 2, 3, 4, 5, 6
ROWS = FOLDS + 2 * MOST_CREASES


class ToolArrays(NamedTuple):
    """The path of a tool, with room to grow, and the state of its cut."""

    points: FloatArray  # (p, 3) beneath the tip on the surface, mm
    length: FloatArray  # (p,) of the path so far, mm
    tips: FloatArray  # (p, 3) mm
    triangle: IntArray  # (p,) beneath
    over: IntArray  # (p,) 0 beside the surface, INSIDE its boundary, or over its RIM
    normals: FloatArray  # (p, 3) of the triangle beneath the way there, or nearest to it
    folds: IntArray  # (p,) number of folds of the surface on the way there
    edges: IntArray  # (k, 2) that were cut, over all paths
    queue: IntArray
    around: IntArray
    whole: IntArray
    real: FloatArray
    work: FloatArray  # (ROWS, 3) places that kernels pass on, each to others than its own rows


@njit(cache=True, **UNCOUNTED)
def refine_around(s, v, bound, around):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Bisect until no triangle around a vertex has an edge of `bound` or more; False where there is no room."""
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


@njit(cache=True, **UNCOUNTED)
def _facing(s, t):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Vector normal to a triangle; zero, so that all pieces of the path face as it does, where the triangle is too flat to tell."""
    x, y, z = normal_of(s.position, s.triangles[t, 0], s.triangles[t, 1], s.triangles[t, 2])
    return (x, y, z) if np.sqrt(dot(x, y, z, x, y, z)) > TOO_FLAT * size2(s, t) else (0.0, 0.0, 0.0)


@njit(cache=True, **UNCOUNTED)
def _fits(s, k, r, c, t, u, size, least, back):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the length of the path beside vertex c if the way from r leads on and stays near the path, and -1 otherwise.

    Near are those pieces of the path that face as triangle t does beside the way, or u on its other side, which may be none. On the way
    `back` to a point of the path, it leads on if c is nearer to that.
    """
    p, m, at, distance = s.position, k.whole[COUNT], k.real[AT], k.real[DISTANCE]
    low, high = at - distance if back else at, at + 3.0 * max(size, distance)
    one = _facing(s, t)
    two = one if u < 0 else _facing(s, u)
    gap, reached = on_side_of_path(k.points, k.length, k.normals, k.folds, m, p[c, 0], p[c, 1], p[c, 2], low, high, one, two)
    if folded(one, two):  # on a fold, what lies behind it is not reached before the fold is
        for facing in (one, two):
            there, first = on_side_of_path(k.points, k.length, k.normals, k.folds, m, p[c, 0], p[c, 1], p[c, 2], low, high, facing, facing)
            if there <= 0.5 * distance and first < reached:
                gap, reached = there, first
    onward = reached > at + least * size
    if k.length[m - 1] - at < distance:
        nearer = _from_end2(s, k, c) < _from_end2(s, k, r)
        if k.over[m - 1] == INSIDE:  # the end of the path is where the cut is to end
            onward = nearer
        elif not onward and nearer:  # beyond the end of the path, too, it leads over the boundary
            x, y, z = from_to(p, r, c)
            ax, ay, az = from_to(k.points, m - 2, m - 1)
            onward = dot(x, y, z, ax, ay, az) > least * size * (k.length[m - 1] - k.length[m - 2])
    if not (_nearer(s, k, r, c, max(least * size, HARDLY * distance)) if back else onward):
        return -1.0
    if k.whole[FREE]:
        return reached
    if gap > 0.5 * distance or _strays(s, k, r, c, gap, low, high, one, two):
        return -1.0
    return at if back else reached


@njit(cache=True, **UNCOUNTED)
def _strays(s, k, r, c, gap, low, high, one, two):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether the way from r to c, which is `gap` from the path, leads too far from it in between.

    It is looked at in quarters, and in the middle of those in which it may lead too far: a distance changes by no more than the way.
    """
    p, most = s.position, 0.5 * k.real[DISTANCE]
    x, y, z = from_to(p, r, c)
    quarter, before = 0.25 * np.sqrt(dot(x, y, z, x, y, z)), most
    for i in range(1, 5):
        there = _gap_between(k, p, r, c, 0.25 * i, low, high, one, two) if i < 4 else gap
        if there > most:
            return True
        if before + there + quarter > 2.0 * most and _gap_between(k, p, r, c, 0.25 * i - 0.125, low, high, one, two) > most:
            return True
        before = there
    return False


@njit(cache=True, **UNCOUNTED)
def _gap_between(k, p, r, c, share, low, high, one, two):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return how far from the path lies what is a share of the way from r to c away from r."""
    x, y, z = from_to(p, r, c)
    px, py, pz = p[r, 0] + share * x, p[r, 1] + share * y, p[r, 2] + share * z
    return on_side_of_path(k.points, k.length, k.normals, k.folds, k.whole[COUNT], px, py, pz, low, high, one, two)[0]


@njit(cache=True, **UNCOUNTED)
def _folds_near(k, low, high):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether the path crosses a fold between two lengths."""
    m = k.whole[COUNT]
    i, j = first_at(k.length, m, low), first_at(k.length, m, high)
    return k.folds[min(max(i, 1), m - 1)] != k.folds[min(j + 1, m - 1)]


@njit(cache=True, **UNCOUNTED)
def _nearer(s, k, r, c, least):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether vertex c is nearer than r to the point of the path beside the cut."""
    x, y, z = along(k.points, k.length, k.whole[COUNT], k.real[AT])
    p = s.position
    rx, ry, rz, cx, cy, cz = p[r, 0] - x, p[r, 1] - y, p[r, 2] - z, p[c, 0] - x, p[c, 1] - y, p[c, 2] - z
    return np.sqrt(dot(cx, cy, cz, cx, cy, cz)) < np.sqrt(dot(rx, ry, rz, rx, ry, rz)) - least


@njit(cache=True, **UNCOUNTED)
def _leaves(s, k, r):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether the path leaves the surface within two distances ahead of the cut, as far as it is known."""
    m, at = k.whole[COUNT], k.real[AT]
    j = first_at(k.length, m, at)
    while j < m and (k.length[j] <= k.real[ENTERED] or (k.over[j] != INSIDE and on_edge_of(s, r) == RIM)):
        j += 1  # it has just come over the surface
    while j < m and k.length[j] <= at + 2.0 * k.real[DISTANCE]:
        if k.over[j] != INSIDE:
            return True
        j += 1
    return False


@njit(cache=True, **UNCOUNTED)
def _turns_back(s, k, c):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether a vertex lies on the latest edges of the cut."""
    p, e, gone, distance = s.position, k.whole[EDGES] - 1, 0.0, k.real[DISTANCE]
    while e >= 0 and gone < RECENT * distance:
        a, b = k.edges[e, 0], k.edges[e, 1]
        if nearest_on_triangle(p, a, b, b, p[c, 0], p[c, 1], p[c, 2])[0] < (1e-9 * distance) ** 2:
            return True
        x, y, z = from_to(p, a, b)
        gone += np.sqrt(dot(x, y, z, x, y, z))
        e -= 1
    return False


@njit(cache=True, **UNCOUNTED)
def _may_end_at(s, k, r, c):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether the cut may go to a vertex: not to the boundary unless the path leaves the surface, nor back to where it comes from."""
    where = on_edge_of(s, c)
    return where == INSIDE or (where == RIM and _leaves(s, k, r)) or (where == LIP and not _turns_back(s, k, c))


@njit(cache=True, **UNCOUNTED)
def _from_end2(s, k, v):  # type: ignore[no-untyped-def]  # pragma: no cover
    last = k.whole[COUNT] - 1
    x, y, z = s.position[v, 0] - k.points[last, 0], s.position[v, 1] - k.points[last, 1], s.position[v, 2] - k.points[last, 2]
    return dot(x, y, z, x, y, z)


@njit(cache=True, **UNCOUNTED)
def _best(s, k, r, across, anywhere, back):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Vertex whose edge lies closest to the direction of the path, -1 if none, its triangle, corner and kind, and the length beside it.

    On the boundary of the surface only where the path leaves it there, on a lip only of an earlier cut, unless `anywhere`.
    """
    count, _ = fan(s, r, k.around)
    best, reached, found, beside, which, how = 0.0, -1.0, -1, -1, 0, 0
    p, at, m = s.position, k.real[AT], k.whole[COUNT]
    for h in range(count):
        t = k.around[h]
        i = corner(s, t, r)
        u = s.neighbours[t, i]
        for kind in range(3 if across and u >= 0 else 2):
            w = u
            if kind < 2:
                c = s.triangles[t, (i + 1 + kind) % 3]
                w = s.neighbours[t, (i + 2 - kind) % 3]
                if w < 0:
                    continue  # along a boundary there is nothing to part
            else:
                j = 0
                while s.neighbours[u, j] != t:
                    j += 1
                c = s.triangles[u, j]
            x, y, z = from_to(p, r, c)
            size = np.sqrt(dot(x, y, z, x, y, z))
            ax, ay, az = along(k.points, k.length, m, at if back else at + max(size, 0.5 * k.real[DISTANCE]))
            ax, ay, az = ax - p[r, 0], ay - p[r, 1], az - p[r, 2]
            cosine = dot(x, y, z, ax, ay, az) / max(size * np.sqrt(dot(ax, ay, az, ax, ay, az)), 1e-300)
            if cosine > best + (1e-9 if kind == 2 else 0.0):
                behind = _fits(s, k, r, c, t, w, size, ONWARD, back)
                if behind >= 0.0 and (anywhere or _may_end_at(s, k, r, c)):
                    best, reached = cosine, behind
                    found, beside, which, how = c, t, i, kind
    return found, beside, which, how, reached


@njit(cache=True, **UNCOUNTED)
def _next(s, k, r, anywhere, back):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Neighbour of a vertex, or the one across the longest edge of a triangle around it, closest to the path's direction; -1 if none."""
    found, t, i, kind, reached = _best(s, k, r, True, anywhere, back)
    if found >= 0 and kind == 2 and not swap(s, t, i):
        found, t, i, kind, reached = _best(s, k, r, False, anywhere, back)
    return found, reached


@njit(cache=True, **UNCOUNTED)
def _next_fold(k):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Length of the path at the next fold ahead of the cut, or at its end."""
    m = k.whole[COUNT]
    j = max(1, first_at(k.length, m, k.real[AT] + BESIDE_FOLD * k.real[DISTANCE]))
    while j + 1 < m and k.folds[j + 1] == k.folds[j]:
        j += 1
    return k.length[min(j, m - 1)]


@njit(cache=True, **UNCOUNTED)
def _ahead_of(s, k, r, back):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Triangle around a vertex through which the straight way back to the path leads, the vertex's corner, and the share of its edge.

    Of those triangles that face as the path does there, no farther than the next fold; where none does, behind it, or anywhere. On the way
    `back` to its point beside the cut, the way there.
    """
    count, _ = fan(s, r, k.around)
    m, now, far = k.whole[COUNT], k.real[AT], k.real[AT] + 0.5 * k.real[DISTANCE]
    for h in range(3):
        at = now if back else min(far, _next_fold(k)) if h == 0 else far
        facing = k.normals[min(max(first_at(k.length, m, at), 1), m - 1)]
        t, i, share, best = -1, 0, 0.5, 0.0
        ax, ay, az = along(k.points, k.length, m, at)
        for g in range(count):
            nx, ny, nz = normal_of(s.position, s.triangles[k.around[g], 0], s.triangles[k.around[g], 1], s.triangles[k.around[g], 2])
            if h < 2 and not back and dot(nx, ny, nz, facing[0], facing[1], facing[2]) < 0.0:
                continue
            corner_there, share_there, gain = _through(s, r, k.around[g], ax, ay, az)
            if gain > best:
                t, i, share, best = k.around[g], corner_there, share_there, gain
        if t >= 0:
            return t, i, share
    return -1, 0, 0.5


@njit(cache=True, **UNCOUNTED)
def _through(s, r, u, qx, qy, qz):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Corner of a triangle that a vertex is, the share of the edge opposite where the way to q leads over it, and its square within."""
    p, j = s.position, corner(s, u, r)
    b, c = s.triangles[u, (j + 1) % 3], s.triangles[u, (j + 2) % 3]
    ax, ay, az = qx - p[r, 0], qy - p[r, 1], qz - p[r, 2]
    bx, by, bz = from_to(p, r, b)
    cx, cy, cz = from_to(p, r, c)
    bb, bc, cc = dot(bx, by, bz, bx, by, bz), dot(bx, by, bz, cx, cy, cz), dot(cx, cy, cz, cx, cy, cz)
    ab, ac, det = dot(ax, ay, az, bx, by, bz), dot(ax, ay, az, cx, cy, cz), bb * cc - bc * bc
    if det <= 0.0:
        return j, 0.5, 0.0
    g, f = (cc * ab - bc * ac) / det, (bb * ac - bc * ab) / det  # the way in the plane of the triangle
    if f < 0.0:
        g, f = ab / bb, 0.0
    elif g < 0.0:
        g, f = 0.0, ac / cc
    if g < 0.0 or f < 0.0 or g + f <= 0.0:
        return j, 0.5, 0.0
    return j, f / (g + f), g * ab + f * ac


@njit(cache=True, **UNCOUNTED)
def _divided(s, k, r, anywhere, back):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Vertex that divides an edge where the straight way back to the path crosses it, and the length beside it; -1 if none."""
    t, i, exact = _ahead_of(s, k, r, back)
    if t < 0:
        return -1, -1.0
    b, c, new = s.triangles[t, (i + 1) % 3], s.triangles[t, (i + 2) % 3], s.n[0]
    for share in (min(max(exact, BLUNT), 1.0 - BLUNT), min(max(exact, HARDLY), 1.0 - HARDLY)):
        for h in range(3):
            s.position[new, h] = (1.0 - share) * s.position[b, h] + share * s.position[c, h]
        x, y, z = from_to(s.position, r, new)
        reached = _fits(s, k, r, new, t, -1, np.sqrt(dot(x, y, z, x, y, z)), HARDLY, back)
        if reached >= 0.0 and (anywhere or s.neighbours[t, i] >= 0 or (s.neighbours[t, i] == -1 and _leaves(s, k, r))):
            divide(s, t, i, share)
            return new, reached
    return -1, -1.0


@njit(cache=True, **UNCOUNTED)
def advance(s, k, final):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take one step of the cut; returns what came of it."""
    whole, distance, free = k.whole, k.real[DISTANCE], k.whole[FREE] != 0  # a truth, as the other arguments of its kind are
    left = k.length[whole[COUNT] - 1] - k.real[AT]
    if not final and left < 2.0 * distance:
        return WAITING
    if whole[AT_BOUNDARY]:
        return LEFT
    r = whole[NOW]
    if whole[EDGES] == len(k.edges) or fan(s, r, k.around)[0] < 0:
        return FULL
    for h in range(FINEST + 1):
        if not free and not refine_around(s, r, distance * 0.5**h, k.around):
            return FULL
        if not has_room(s):
            return FULL
        c, reached = _next(s, k, r, free, False)
        at, reach = k.real[AT], distance if h == FINEST else BESIDE_FOLD * distance
        back = _folds_near(k, at - reach, at + reach)  # which it may have to come to before it leads on
        if c < 0 and back:
            c, reached = _next(s, k, r, free, True)
        if c < 0 and not free and h == FINEST:
            c, reached = _divided(s, k, r, False, False)
            if c < 0 and back:
                c, reached = _divided(s, k, r, False, True)
            if c < 0:
                c, reached = _next(s, k, r, True, False)
            if c < 0:
                c, reached = _divided(s, k, r, True, False)
        if c >= 0:
            ends_here = on_boundary(s, c, k.around)
            if not separate(s, r, c):
                return FULL
            k.edges[whole[EDGES], 0], k.edges[whole[EDGES], 1] = r, c
            whole[EDGES] += 1
            whole[NOW], whole[AT_BOUNDARY], k.real[AT] = c, ends_here, reached
            return STEPPED
        if free or (final and left < 0.5 * distance and k.over[whole[COUNT] - 1] == INSIDE):
            break
    return ENDED if left < distance or free else STUCK


@njit(cache=True, **UNCOUNTED)
def _leads_into(p, o, a, b, ahead):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether a direction leads over edge a-b towards the side on which corner o lies."""
    ex, ey, ez = from_to(p, a, b)
    ox, oy, oz = from_to(p, a, o)
    f = dot(ox, oy, oz, ex, ey, ez) / dot(ex, ey, ez, ex, ey, ez)
    return dot(ox - f * ex, oy - f * ey, oz - f * ez, ahead[0], ahead[1], ahead[2]) > 0.0


@njit(cache=True, **UNCOUNTED)
def _end_near(s, t, q, ahead, same2, edge, count, queue):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Triangle and vertex whose edge, of a triangle or among those of the boundary nearby if `edge`, is nearest to q; -1 if none.

    Of the two lips of a cut, whose distances are the same, the one that lies ahead.
    """
    best, where, found, gap, into, p = np.inf, -1, -1, np.inf, False, s.position
    for h in range(count if edge else 1):
        u = queue[h] if edge else t
        for i in range(3):
            if edge and s.neighbours[u, i] >= 0:
                continue
            a, b = s.triangles[u, (i + 1) % 3], s.triangles[u, (i + 2) % 3]
            d2 = nearest_on_triangle(p, a, b, b, q[0], q[1], q[2])[0] if edge else 0.0
            x, y, z = p[a, 0] - q[0], p[a, 1] - q[1], p[a, 2] - q[2]
            da = dot(x, y, z, x, y, z)
            x, y, z = p[b, 0] - q[0], p[b, 1] - q[1], p[b, 2] - q[2]
            db = dot(x, y, z, x, y, z)
            onto = edge and _leads_into(p, s.triangles[u, i], a, b, ahead)
            as_near = abs(d2 - best) <= same2
            if (d2 < best and not as_near) or (as_near and (onto, -min(da, db)) > (into, -gap)):
                best, where, found, gap, into = d2, u, a if da < db else b, min(da, db), onto
    return where, found


@njit(cache=True, **UNCOUNTED)
def begin(s, k, t, q, low, high, edge, point):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Vertex near q within half the distance of the path, on the boundary if `edge`; -1 if there is none, -2 where there is no room."""
    distance, free, found = k.real[DISTANCE], k.whole[FREE], -1
    x, y, z = along(k.points, k.length, k.whole[COUNT], high)
    ahead = x - q[0], y - q[1], z - q[2]
    for h in range(FINEST + 1):
        bound = distance * 0.5**h
        while True:
            t, _, _, count = nearest(s, t, q, 2.0 * distance, False, k.queue, point)
            if edge:  # in the order around that triangle
                _, _, _, count = nearest(s, t, q, 2.0 * distance, False, k.queue, point)
            where, found = _end_near(s, t, q, ahead, (1e-9 * distance) ** 2, edge, count, k.queue)
            if where < 0 or free or size2(s, where) < bound * bound:
                break
            if not bisect(s, where):
                return NO_ROOM
        if found < 0 or free:
            return found
        p = s.position
        if on_path(k.points, k.length, k.whole[COUNT], p[found, 0], p[found, 1], p[found, 2], low, high)[0] <= 0.5 * distance:
            return found
    return -1
