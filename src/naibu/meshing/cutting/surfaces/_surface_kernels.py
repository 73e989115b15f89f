"""Kernels: triangles with neighbours that are bisected, swapped and separated in place, at a cost that the mesh around does not change."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from naibu._numba.compilation import COUNTED, UNCOUNTED, njit
from naibu.core.arrays import FloatArray, IntArray

MOST_AROUND = 512  # triangles at a vertex
INSIDE, RIM, LIP = 1, 2, 3  # where a vertex, or the path of a tool, lies


class SurfaceArrays(NamedTuple):
    """Arrays with room to grow."""

    rest: FloatArray  # (v, 3), mm
    position: FloatArray  # (v, 3), mm
    triangles: IntArray  # (t, 3)
    neighbours: IntArray  # (t, 3) across the edge opposite to each corner; -1 where there is none, -2 where it was cut off
    at: IntArray  # (v,) one of the triangles of a vertex
    twin: IntArray  # (v,) next vertex in the ring of copies
    ends: IntArray  # (v, 2) ends of the edge that a vertex divides, -1 of others
    share: FloatArray  # (v,) of that edge before the vertex: one half but where a cut found no edge that led on, 0 for others
    source: IntArray  # (v,) vertex that a vertex was copied from, itself of others
    parent: IntArray  # (t,) triangle of the surface before that a triangle is a part of
    next_part: IntArray  # (t,) next triangle in the list of these parts, which begins with the number of the triangle before; -1 at its end
    sides: IntArray  # (t, 3) number of the edge opposite to each corner; the two lips of a cut have edges of their own
    stamp: IntArray  # (t,)
    marked: IntArray  # (t,) 1 for triangles in `touched`
    touched: IntArray  # (t,) triangles that have changed since this list was emptied
    n: IntArray  # (5,) numbers of vertices and triangles, last stamp, numbers of edges and of touched triangles


@njit(cache=True, **UNCOUNTED)
def _length2(p, a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    x, y, z = p[a, 0] - p[b, 0], p[a, 1] - p[b, 1], p[a, 2] - p[b, 2]
    return x * x + y * y + z * z


@njit(cache=True, **UNCOUNTED)
def _cross(p, o, a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Vector product of the ways from o to a and to b."""
    ax, ay, az = p[a, 0] - p[o, 0], p[a, 1] - p[o, 1], p[a, 2] - p[o, 2]
    bx, by, bz = p[b, 0] - p[o, 0], p[b, 1] - p[o, 1], p[b, 2] - p[o, 2]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@njit(cache=True, **UNCOUNTED)
def _product(u, v):  # type: ignore[no-untyped-def]  # pragma: no cover
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@njit(cache=True, **UNCOUNTED)
def longest(s, t):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Corner opposite to the longest edge at rest; equal ones are told apart by their vertices."""
    best, where, low, high = -1.0, 0, 0, 0
    for i in range(3):
        a, b = s.triangles[t, (i + 1) % 3], s.triangles[t, (i + 2) % 3]
        l2 = _length2(s.rest, a, b)
        p, q = min(a, b), max(a, b)
        if l2 > best or (l2 == best and (q > high or (q == high and p > low))):
            best, where, low, high = l2, i, p, q
    return where


@njit(cache=True, **UNCOUNTED)
def _replace(s, t, old, new):  # type: ignore[no-untyped-def]  # pragma: no cover
    if t >= 0:
        for i in range(3):
            if s.neighbours[t, i] == old:
                s.neighbours[t, i] = new
                return


@njit(cache=True, **UNCOUNTED)
def corner(s, t, v):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return which corner of a triangle a vertex is."""
    return 0 if s.triangles[t, 0] == v else 1 if s.triangles[t, 1] == v else 2


@njit(cache=True, **UNCOUNTED)
def _touch(s, t):  # type: ignore[no-untyped-def]  # pragma: no cover
    if not s.marked[t]:
        s.marked[t], s.touched[s.n[4]] = 1, t
        s.n[4] += 1


@njit(cache=True, **UNCOUNTED)
def _set(s, t, vertices, neighbours, sides):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(3):
        s.triangles[t, i], s.neighbours[t, i], s.sides[t, i] = vertices[i], neighbours[i], sides[i]
    _touch(s, t)


@njit(cache=True, **UNCOUNTED)
def divide(s, t, i, share):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Divide the edge opposite to corner i, at a share of it from corner i + 1, and the triangles on both of its sides."""
    a, b, c = s.triangles[t, i], s.triangles[t, (i + 1) % 3], s.triangles[t, (i + 2) % 3]
    u, beside_b, beside_c = s.neighbours[t, i], s.neighbours[t, (i + 1) % 3], s.neighbours[t, (i + 2) % 3]
    m, t2 = s.n[0], s.n[1]
    u2 = t2 + 1 if u >= 0 else u
    s.n[0] += 1
    s.n[1] += 1 if u < 0 else 2
    for k in range(3):
        s.rest[m, k] = (1.0 - share) * s.rest[b, k] + share * s.rest[c, k]
        s.position[m, k] = (1.0 - share) * s.position[b, k] + share * s.position[c, k]
    s.twin[m], s.source[m], s.ends[m, 0], s.ends[m, 1], s.share[m] = m, m, b, c, share
    s.stamp[t2], s.parent[t2], s.marked[t2] = 0, s.parent[t], 0
    s.next_part[t2], s.next_part[t] = s.next_part[t], t2
    e0, at_b, at_c = s.sides[t, i], s.sides[t, (i + 1) % 3], s.sides[t, (i + 2) % 3]
    e1, e2 = s.n[3], s.n[3] + 1  # the second part of the edge, and the edge to the opposite corner
    s.n[3] += 2 if u < 0 else 3
    if u >= 0:
        j = 0
        while s.triangles[u, j] == b or s.triangles[u, j] == c:
            j += 1
        e, near_c, near_b = s.triangles[u, j], s.neighbours[u, (j + 1) % 3], s.neighbours[u, (j + 2) % 3]
        side_c, side_b = s.sides[u, (j + 1) % 3], s.sides[u, (j + 2) % 3]
        s.stamp[u2], s.parent[u2], s.marked[u2] = 0, s.parent[u], 0
        s.next_part[u2], s.next_part[u] = s.next_part[u], u2
        _set(s, u, (e, m, b), (t, near_c, u2), (e0, side_c, e2 + 1))
        _set(s, u2, (e, c, m), (t2, u, near_b), (e1, e2 + 1, side_b))
        _replace(s, near_b, u, u2)
    _set(s, t, (a, b, m), (u, t2, beside_c), (e0, e2, at_c))
    _set(s, t2, (a, m, c), (u2, beside_b, t), (e1, at_b, e2))
    _replace(s, beside_b, t, t2)
    s.at[m], s.at[c] = t, t2


@njit(cache=True, **UNCOUNTED)
def has_room(s):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether one more edge can be divided."""
    return s.n[0] + 1 < len(s.at) and s.n[1] + 2 < len(s.triangles)


@njit(cache=True, **UNCOUNTED)
def bisect(s, t):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Bisect a triangle and what its longest-edge propagation path makes necessary; False where there is no room."""
    while True:
        now = t
        while True:
            i = longest(s, now)
            u = s.neighbours[now, i]
            if u < 0 or s.neighbours[u, longest(s, u)] == now:
                break
            now = u
        if not has_room(s):
            return False
        divide(s, now, i, 0.5)
        if now == t or u == t:
            return True


@njit(cache=True, **UNCOUNTED)
def size2(s, t):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Square of the longest edge where the triangle is now."""
    a, b, c = s.triangles[t]
    return max(_length2(s.position, a, b), max(_length2(s.position, b, c), _length2(s.position, c, a)))


@njit(cache=True, **UNCOUNTED)
def fan(s, v, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Triangles around a vertex in counterclockwise order, and whether they close; their number is negative if there are too many."""
    first = s.at[v]
    t, count = first, 0
    while True:  # clockwise to the beginning
        back = s.neighbours[t, (corner(s, t, v) + 2) % 3]
        count += 1
        if back < 0 or back == first or count > len(out):
            break
        t = back
    closed = back == first and back >= 0
    if closed:
        t = first
    count, begin = 0, t
    while count < len(out):
        out[count] = t
        count += 1
        t = s.neighbours[t, (corner(s, t, v) + 1) % 3]
        if t < 0 or t == begin:
            return count, closed
    return -1, closed


@njit(cache=True, **UNCOUNTED)
def on_boundary(s, v, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether a vertex lies on the boundary or on a lip of a cut."""
    return not fan(s, v, out)[1]


@njit(cache=True, **UNCOUNTED)
def on_edge_of(s, v):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether a vertex lies INSIDE the surface, on its RIM as it was before any cut, or only on a LIP of a cut."""
    t = s.at[v]
    while True:  # clockwise to the beginning
        back = s.neighbours[t, (corner(s, t, v) + 2) % 3]
        if back < 0:
            break
        t = back
        if t == s.at[v]:
            return INSIDE
    while back != -1:
        back = s.neighbours[t, (corner(s, t, v) + 1) % 3]
        if back < 0:
            break
        t = back
    return RIM if back == -1 else LIP


@njit(cache=True, **UNCOUNTED)
def swap(s, t, i):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Swap the edge opposite to corner i if it is the longest of both triangles and they are one plane convex quadrilateral."""
    u = s.neighbours[t, i]
    if u < 0 or longest(s, t) != i or s.neighbours[u, longest(s, u)] != t:
        return False
    r, b, c = s.triangles[t, i], s.triangles[t, (i + 1) % 3], s.triangles[t, (i + 2) % 3]
    j = 0
    while s.triangles[u, j] == b or s.triangles[u, j] == c:
        j += 1
    e = s.triangles[u, j]
    p = s.rest
    normal, new, other, behind = _cross(p, r, b, c), _cross(p, r, b, e), _cross(p, r, e, c), _cross(p, e, c, b)
    area2 = _product(normal, normal)
    whole = np.sqrt(area2) + np.sqrt(_product(behind, behind))
    changed = abs(np.sqrt(_product(new, new)) + np.sqrt(_product(other, other)) - whole)
    height = abs(_product(normal, (p[e, 0] - p[r, 0], p[e, 1] - p[r, 1], p[e, 2] - p[r, 2])))
    least = 0.05 * area2
    turned = _product(new, normal) < least or _product(other, normal) < least
    if turned or changed > 1e-12 * whole or height > 1e-9 * area2**0.75:
        return False
    beside_b, beside_c = s.neighbours[t, (i + 1) % 3], s.neighbours[t, (i + 2) % 3]
    near_c, near_b = s.neighbours[u, (j + 1) % 3], s.neighbours[u, (j + 2) % 3]
    middle, at_b, at_c = s.sides[t, i], s.sides[t, (i + 1) % 3], s.sides[t, (i + 2) % 3]
    side_c, side_b = s.sides[u, (j + 1) % 3], s.sides[u, (j + 2) % 3]
    _set(s, t, (r, b, e), (near_c, u, beside_c), (side_c, middle, at_c))
    _set(s, u, (r, e, c), (near_b, beside_b, t), (side_b, at_b, middle))
    _replace(s, near_c, u, t)
    _replace(s, beside_b, t, u)
    s.at[b], s.at[c], s.at[r], s.at[e] = t, u, t, t
    return True


@njit(cache=True, **UNCOUNTED)
def _resolve(s, v, around, count):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Give each group of triangles that still hold together around a vertex a vertex of its own."""
    groups = 0
    for k in range(count):
        _touch(s, around[k])
        groups += s.neighbours[around[k], (corner(s, around[k], v) + 2) % 3] < 0
    if groups < 2:
        return
    start = 0
    while s.neighbours[around[start], (corner(s, around[start], v) + 2) % 3] >= 0:
        start += 1
    now = v
    for k in range(count):
        t = around[(start + k) % count]
        i = corner(s, t, v)
        if k > 0 and s.neighbours[t, (i + 2) % 3] < 0:
            now = s.n[0]
            s.n[0] += 1
            for j in range(3):
                s.rest[now, j], s.position[now, j] = s.rest[v, j], s.position[v, j]
            s.ends[now, 0], s.ends[now, 1], s.share[now] = -1, -1, 0.0
            s.source[now], s.twin[now], s.twin[v] = v, s.twin[v], now
        s.triangles[t, i] = now
        s.at[now] = t


@njit(cache=True, **COUNTED)
def separate(s, a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Part the triangles on the two sides of an edge, and duplicate its ends where that divides the triangles around them."""
    first, second = np.empty(MOST_AROUND, dtype=np.int64), np.empty(MOST_AROUND, dtype=np.int64)
    n1, n2 = fan(s, a, first)[0], fan(s, b, second)[0]
    if n1 < 0 or n2 < 0 or s.n[0] + 2 >= len(s.at):
        return False
    for k in range(n1):
        t = first[k]
        i = corner(s, t, a)
        if s.triangles[t, (i + 1) % 3] == b:
            u = s.neighbours[t, (i + 2) % 3]
            s.neighbours[t, (i + 2) % 3] = -2
            _replace(s, u, t, -2)
            s.sides[t, (i + 2) % 3] = s.n[3]
            s.n[3] += 1
            break
    _resolve(s, a, first, n1)
    _resolve(s, b, second, n2)
    return True


@njit(cache=True, **UNCOUNTED)
def number_edges(neighbours, sides):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill the numbers of the edges; returns how many there are."""
    count = 0
    for t in range(len(neighbours)):
        for i in range(3):
            u = neighbours[t, i]
            if u > t or u < 0:
                sides[t, i] = count
                count += 1
            else:
                j = 0
                while neighbours[u, j] != t:
                    j += 1
                sides[t, i] = sides[u, j]
    return count


@njit(cache=True, **UNCOUNTED)
def link(triangles, order, keys, neighbours):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill the neighbours from sorted keys of half edges; an edge of three triangles or more, or of equal direction, stays open."""
    seams, n, k = 0, len(order), 0
    while k < n:
        stop = k + 1
        while stop < n and keys[order[stop]] == keys[order[k]]:
            stop += 1
        if stop - k == 2:
            t, i, u, j = order[k] // 3, order[k] % 3, order[k + 1] // 3, order[k + 1] % 3
            if triangles[t, (i + 1) % 3] == triangles[u, (j + 2) % 3]:
                neighbours[t, i], neighbours[u, j] = u, t
            else:
                seams += 1
        elif stop - k > 2:
            seams += 1
        k = stop
    return seams
