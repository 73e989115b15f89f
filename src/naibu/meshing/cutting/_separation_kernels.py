# mypy: disallow-untyped-decorators=False
"""Kernels: faces of a bisection forest that a blade crosses, which of them are too far from it, and the separation of cells along them.

Arrays of forests are those of `naibu.meshing.refinement._forest_kernels`. A list of faces has a row for each: cell, place of the vertex
opposite to it, the cell on the other side, the place there; the first cell is the one above the blade. A blade is its points, triangles
and their boxes, the number of triangles that are swept now, which come first, and which cells are `fresh`: the other triangles, swept
before, count for these only.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.meshing.cutting._crossing_kernels import crosses, distance
from naibu.meshing.refinement._forest_kernels import FLIPPED

_SHIFT = (1e-9, 1.4142135623730951e-9, 1.7320508075688772e-9)  # of an edge: keeps centres off surfaces that pass right through them


@njit(cache=True)
def inverted(cells, leaves, count, positions):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return a leaf without positive volume at the positions, or -1."""
    for n in range(count):
        t = leaves[n]
        a, b, c, d = positions[cells[t, 0]], positions[cells[t, 1]], positions[cells[t, 2]], positions[cells[t, 3]]
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        wx, wy, wz = d[0] - a[0], d[1] - a[1], d[2] - a[2]
        volume = ux * (vy * wz - vz * wy) + uy * (vz * wx - vx * wz) + uz * (vx * wy - vy * wx)
        if cells[t, FLIPPED] == 1:
            volume = -volume
        if not volume > 0.0:
            return t
    return -1


@njit(cache=True)
def crossed_faces(cells, leaves, count, positions, blade, centres, found):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Enter the faces whose cells have their centres on two sides of the blade; returns their number, also where they do not fit."""
    points, triangles, low, high, now, fresh = blade
    lowest, highest = np.empty(3), np.empty(3)
    for k in range(3):
        lowest[k], highest[k] = low[:, k].min(), high[:, k].max()
    for n in range(count):
        t = leaves[n]
        for k in range(3):
            first, second = positions[cells[t, 0], k], positions[cells[t, 1], k]
            rest = positions[cells[t, 2], k] + positions[cells[t, 3], k]
            centres[t, k] = 0.25 * (first + second + rest) + _SHIFT[k] * (second - first)
    size = 0
    for n in range(count):
        t = leaves[n]
        for s in range(4):
            u = cells[t, 4 + s]
            if u < t:  # boundary, or counted from the other side
                continue
            apart = False
            for k in range(3):
                p, q = centres[t, k], centres[u, k]
                apart |= min(p, q) > highest[k] or max(p, q) < lowest[k]
            if apart:
                continue
            side = crosses(centres[t], centres[u], points, triangles, low, high, len(triangles) if fresh[t] or fresh[u] else now)
            if side == 0:
                continue
            if size < len(found):
                place = 0
                while cells[u, 4 + place] != t:
                    place += 1
                if side > 0:
                    found[size, 0], found[size, 1], found[size, 2], found[size, 3] = t, s, u, place
                else:
                    found[size, 0], found[size, 1], found[size, 2], found[size, 3] = u, place, t, s
            size += 1
    return size


@njit(cache=True)
def too_coarse(cells, faces, positions, blade, tolerance, gap, coarse):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Enter the cells beside faces with a vertex that is farther from the blade than allowed; `gap` keeps distances, -1 where unknown.

    Returns the number of entries, and the largest distance.
    """
    points, triangles, low, high, _, _ = blade
    size, largest = 0, 0.0
    for f in range(len(faces)):
        far = False
        for s in range(4):
            if s == faces[f, 1]:
                continue
            v = cells[faces[f, 0], s]
            if gap[v] < 0.0:
                gap[v] = distance(positions[v], points, triangles, low, high)
            far |= gap[v] > tolerance
            largest = max(largest, gap[v])
        if far:
            coarse[size], coarse[size + 1] = faces[f, 0], faces[f, 2]
            size += 2
    return size, largest


@njit(cache=True)
def unresolved(cells, leaves, count, faces, positions, blade, centres, tolerance, gap, touched, coarse):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Enter the leaves from whose centre the blade parts a vertex that is on none of the faces, farther from it than allowed.

    So thin slices are found in cells whose centres all lie on one side. `touched` (vertices) is filled with 0 before. Returns the number of
    entries, also where they do not fit.
    """
    points, triangles, low, high, now, fresh = blade
    lowest, highest = np.empty(3), np.empty(3)
    for k in range(3):
        lowest[k], highest[k] = low[:, k].min(), high[:, k].max()
    for f in range(len(faces)):
        for s in range(4):
            if s != faces[f, 1]:
                touched[cells[faces[f, 0], s]] = 1
    size = 0
    for n in range(count):
        t = leaves[n]
        for s in range(4):
            v = cells[t, s]
            if touched[v] == 1:
                continue
            apart = False
            for k in range(3):
                p, q = centres[t, k], positions[v, k]
                apart |= min(p, q) > highest[k] or max(p, q) < lowest[k]
            if apart or crosses(centres[t], positions[v], points, triangles, low, high, len(triangles) if fresh[t] else now) == 0:
                continue
            if gap[v] < 0.0:
                gap[v] = distance(positions[v], points, triangles, low, high)
            if gap[v] > tolerance:
                if size < len(coarse):
                    coarse[size] = t
                size += 1
                break
    return size


@njit(cache=True)
def set_open(cells, faces, value):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Make faces boundary of this value on both sides, or, where it is 0, join them."""
    for f in range(len(faces)):
        t, s, u, r = faces[f, 0], faces[f, 1], faces[f, 2], faces[f, 3]
        cells[t, 4 + s] = value if value < 0 else u
        cells[u, 4 + r] = value if value < 0 else t


@njit(cache=True)
def components(cells, leaves, count, label, queue):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Number the leaves that faces join, from 0 in the order of `leaves`; `label` is -1 at leaves before. Returns how many there are."""
    number = 0
    for n in range(count):
        if label[leaves[n]] >= 0:
            continue
        queue[0], size, at = leaves[n], 1, 0
        label[leaves[n]] = number
        while at < size:
            t = queue[at]
            at += 1
            for s in range(4):
                u = cells[t, 4 + s]
                if u >= 0 and label[u] < 0:
                    label[u] = number
                    queue[size] = u
                    size += 1
        number += 1
    return number


@njit(cache=True)
def small_pieces(cells, faces, most):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Which of the two cells (f, 2) beside every face belong to pieces of `most` cells at most, where the faces are open."""
    small = np.zeros((len(faces), 2), dtype=np.bool_)
    piece, met = np.empty(most + 1, dtype=np.int64), np.full(len(cells), -1, dtype=np.int64)
    for f in range(len(faces)):
        for side in range(2):
            piece[0], size, at = faces[f, 2 * side], 1, 0
            met[piece[0]] = 2 * f + side
            while at < size and size <= most:
                t = piece[at]
                at += 1
                for s in range(4):
                    u = cells[t, 4 + s]
                    if u >= 0 and size <= most and met[u] != 2 * f + side:
                        met[u], piece[size] = 2 * f + side, u
                        size += 1
            small[f, side] = size <= most
    return small


@njit(cache=True)
def _root(parent, i):  # type: ignore[no-untyped-def]  # pragma: no cover
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True)
def corner_groups(cells, leaves, count, faces, touched, slot):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Group the corners at the vertices of open faces, and at those `touched` before, by the faces that still join their cells.

    `touched` (vertices) is 0 at others, and `slot` (cells) -1 before. Returns the cells at these vertices, the group (4 of every
    cell) of each corner, which is -1 at other vertices, and the number of groups beyond the first of each vertex.
    """
    for f in range(len(faces)):
        for s in range(4):
            if s != faces[f, 1]:
                touched[cells[faces[f, 0], s]] = 1
    n_around = 0
    for n in range(count):
        t = leaves[n]
        if touched[cells[t, 0]] or touched[cells[t, 1]] or touched[cells[t, 2]] or touched[cells[t, 3]]:
            slot[t] = n_around
            n_around += 1
    around, parent = np.empty(n_around, dtype=np.int64), np.arange(4 * n_around)
    for n in range(count):
        if slot[leaves[n]] >= 0:
            around[slot[leaves[n]]] = leaves[n]
    for a in range(n_around):
        t = around[a]
        for s in range(4):
            u = cells[t, 4 + s]
            if u < t or slot[u] < 0:
                continue
            for i in range(4):
                if i == s or not touched[cells[t, i]]:
                    continue
                for j in range(4):
                    if cells[u, j] == cells[t, i]:
                        parent[_root(parent, 4 * a + i)] = _root(parent, 4 * slot[u] + j)
    group, n_new = np.full(4 * n_around, -1, dtype=np.int64), 0
    for a in range(n_around):
        for i in range(4):
            v = cells[around[a], i]
            if not touched[v]:
                continue
            root = _root(parent, 4 * a + i)
            group[4 * a + i] = root
            if root == 4 * a + i:
                n_new += touched[v] == 2
                touched[v] = 2
    return around, group, n_new


@njit(cache=True)
def double_vertices(cells, points, nodes, around, group, touched, first, source):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Give every group of corners but one of each vertex a new vertex, numbered from `first`, and enter the old one in `source`."""
    number, size = np.full(len(group), -1, dtype=np.int64), 0
    for a in range(len(around)):
        for i in range(4):
            root = group[4 * a + i]
            if root < 0:
                continue
            v = cells[around[a], i]
            if number[root] < 0:
                number[root] = v
                if touched[v] == 3:
                    z = first + size
                    source[size], number[root] = v, z
                    points[z] = points[v]
                    nodes[z, 0], nodes[z, 1], nodes[z, 2] = -1, -1, 0
                    size += 1
                touched[v] = 3
    for a in range(len(around)):
        for i in range(4):
            root = group[4 * a + i]
            if root >= 0:
                cells[around[a], i] = number[root]
                nodes[number[root], 3] = around[a]
    return size
