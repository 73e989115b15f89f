# mypy: disallow-untyped-decorators=False
"""Kernels of bisection forests: patches around an edge are bisected and restored as a whole, so that the mesh conforms at all times.

A forest is the tuple (cells, points, nodes, table, leaves, counters); k is 3 for triangles and 4 for tetrahedra.

cells, int32 (c, 16), one row a cell: its vertices x0 to x3, the neighbours opposite to them (or -1 - marker on the boundary), then the
columns named below. The two children of a cell stand in consecutive rows. nodes, int32 (n, 4), one row a vertex: the two ends of the edge
whose midpoint it is (-1 for vertices of the coarsest mesh), its generation (-1 where the row is free) and a leaf that touches it (the next
free row, where it is free). table: rows of midpoints plus one, found by a hash of the ends. leaves: rows of the cells that are not
bisected, in no order.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import Int32Array

PARENT, CHILD, TAG, LEVEL, REGION, FLIPPED, PLACE, MARK = 8, 9, 10, 11, 12, 13, 14, 15
WIDTH = 16
LEAF, FREE = -1, -2  # in the column CHILD
ROWS, FREE_PAIR, NODES, FREE_NODE, LEAVES, COUNT = 0, 1, 2, 3, 4, 5  # places in `counters`; COUNT is the number of vertices
DONE, FULL, CYCLE, CROWDED = 0, 1, 2, 3  # what the kernels return: CROWDED are patches of more than MAX_RING cells
MAX_RING, MAX_DEPTH = 1024, 1 << 15

# Tags: 1, 2, 3 are Maubach's, 4, 5 and 6 those of roots only (see `tagging`). The refinement edge joins x0 and x[SECOND[tag]].
SECOND = np.array([0, 1, 2, 3, 3, 3, 3])
CHILD_TAG_3D, CHILD_TAG_2D = np.array([0, 3, 1, 2, 2, 2, 2]), np.array([0, 2, 1, 0, 0, 0, 0])
# Vertex of the parent that stands at each place of the two children; 9 is the new one.
_SOURCES_3D = [[[9] * 4, [9] * 4], [[0, 9, 2, 3], [1, 9, 2, 3]], [[0, 1, 9, 3], [1, 2, 9, 3]], [[0, 1, 2, 9], [1, 2, 3, 9]],
               [[1, 0, 2, 9], [1, 3, 2, 9]], [[0, 1, 2, 9], [1, 3, 2, 9]], [[0, 1, 2, 9], [3, 1, 2, 9]]]  # fmt: skip
_SOURCES_2D = [[[9] * 4, [9] * 4], [[0, 9, 2, 8], [1, 9, 2, 8]], [[0, 1, 9, 8], [1, 2, 9, 8]]]
SOURCES_3D, SOURCES_2D = np.array(_SOURCES_3D), np.array(_SOURCES_2D)


def _mirrored(sources: list[list[list[int]]], k: int) -> Int32Array:
    """Return whether each child is mirrored: the parity of the parent's vertices, the lost one replaced by the new one."""
    out = np.zeros((7, 2), dtype=np.int32)
    for tag, pair in enumerate(sources[1:], start=1):
        for side, row in enumerate(pair):
            lost = SECOND[tag] if side == 0 else 0
            order = [lost if s == 9 else s for s in row[:k]]
            out[tag, side] = sum(order[i] > order[j] for i in range(k) for j in range(i + 1, k)) % 2
    return out


MIRRORED_3D, MIRRORED_2D = _mirrored(_SOURCES_3D, 4), _mirrored(_SOURCES_2D, 3)


@njit(cache=True, inline="always")
def _hash(a, b, size):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Place in a table of a power of two entries, the same for (a, b) and (b, a)."""
    low, high = np.uint64(min(a, b)), np.uint64(max(a, b))
    h = low * np.uint64(0x9E3779B97F4A7C15) + high * np.uint64(0xC2B2AE3D27D4EB4F)
    h ^= h >> np.uint64(29)
    return np.int64((h * np.uint64(0xBF58476D1CE4E5B9)) >> np.uint64(20)) & (size - 1)


@njit(cache=True)
def find_midpoint(nodes, table, a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the midpoint of the edge (a, b), or -1."""
    place = _hash(a, b, len(table))
    while table[place] > 0:
        m = table[place] - 1
        if (nodes[m, 0] == a and nodes[m, 1] == b) or (nodes[m, 0] == b and nodes[m, 1] == a):
            return m
        place = (place + 1) & (len(table) - 1)
    return -1


@njit(cache=True)
def insert_midpoint(nodes, table, m):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Enter a midpoint."""
    place = _hash(nodes[m, 0], nodes[m, 1], len(table))
    while table[place] > 0:
        place = (place + 1) & (len(table) - 1)
    table[place] = m + 1


@njit(cache=True)
def _remove_midpoint(nodes, table, m):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Remove a midpoint, and move back what its place had displaced."""
    size = len(table)
    hole = _hash(nodes[m, 0], nodes[m, 1], size)
    while table[hole] != m + 1:
        hole = (hole + 1) & (size - 1)
    place = hole
    while True:
        table[hole] = 0
        while True:
            place = (place + 1) & (size - 1)
            if table[place] == 0:
                return
            other = table[place] - 1
            home = _hash(nodes[other, 0], nodes[other, 1], size)
            if (place - home) & (size - 1) >= (place - hole) & (size - 1):
                break
        table[hole] = table[place]
        hole = place


@njit(cache=True)
def ring_of_edge(cells, k, t, i, j, ring):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill `ring` with the cells around the edge of cell t between its places i and j, t first; return their number, -1 if too many."""
    ring[0], n = t, 1
    if k == 3:
        other = cells[t, 4 + 3 - i - j]
        if other >= 0:
            ring[1], n = other, 2
        return n
    p, q = cells[t, i], cells[t, j]
    first, second = -1, -1
    for s in range(4):
        if s not in (i, j):
            first, second = second, s
    for turn in range(2):
        crossed, kept = (second, cells[t, first]) if turn == 0 else (first, cells[t, second])
        at = t
        while True:
            at = cells[at, 4 + crossed]
            if at == t and turn == 0:
                return n
            if at < 0:
                break
            if n == len(ring):
                return -1
            ring[n] = at
            n += 1
            fresh = kept
            for s in range(4):
                v = cells[at, s]
                if v == kept:
                    crossed = s
                elif v not in (p, q):
                    fresh = v
            kept = fresh
    return n


@njit(cache=True, inline="always")
def _replace(cells, k, t, old, new):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Make `new` the neighbour of t where `old` was."""
    if t >= 0:
        for s in range(k):
            if cells[t, 4 + s] == old:
                cells[t, 4 + s] = new


@njit(cache=True)
def _take_node(forest, p, q):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the row of a new vertex, the midpoint of (p, q)."""
    _, points, nodes, table, _, counters = forest
    z = counters[FREE_NODE]
    if z >= 0:
        counters[FREE_NODE] = nodes[z, 3]
    else:
        z = counters[NODES]
        counters[NODES] += 1
    for a in range(points.shape[1]):
        points[z, a] = 0.5 * (points[p, a] + points[q, a])
    nodes[z, 0], nodes[z, 1] = p, q
    nodes[z, 2] = max(nodes[p, 2], nodes[q, 2]) + 1
    insert_midpoint(nodes, table, z)
    counters[COUNT] += 1
    return z


@njit(cache=True)
def _bisect(forest, k, ring, n):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Bisect the cells of a ring, whose refinement edge is the same; return the new vertex."""
    cells, _, nodes, _, leaves, counters = forest
    sources, child_tag, mirrored = (SOURCES_3D, CHILD_TAG_3D, MIRRORED_3D) if k == 4 else (SOURCES_2D, CHILD_TAG_2D, MIRRORED_2D)
    head = ring[0]
    z = _take_node(forest, cells[head, 0], cells[head, SECOND[cells[head, TAG]]])
    for r in range(n):
        t, c = ring[r], counters[FREE_PAIR]
        if c >= 0:
            counters[FREE_PAIR] = cells[c, PARENT]
        else:
            c = counters[ROWS]
            counters[ROWS] += 2
        cells[t, CHILD] = c
    for r in range(n):
        t = ring[r]
        tag, c = cells[t, TAG], cells[t, CHILD]
        end = SECOND[tag]
        for side in range(2):
            child, own, lost = c + side, 0 if side == 0 else end, end if side == 0 else 0
            for place in range(k):
                s = sources[tag, side, place]
                if s == 9:
                    outer = cells[t, 4 + lost]
                    cells[child, place], cells[child, 4 + place] = z, outer
                    _replace(cells, k, outer, t, child)
                    continue
                v, across = cells[t, s], cells[t, 4 + s]
                if s == own:
                    across = c + 1 - side
                elif across >= 0:
                    across = cells[across, CHILD] + (0 if cells[across, 0] == cells[t, own] else 1)
                cells[child, place], cells[child, 4 + place] = v, across
                nodes[v, 3] = child
            cells[child, PARENT], cells[child, CHILD], cells[child, TAG] = t, LEAF, child_tag[tag]
            cells[child, LEVEL], cells[child, REGION] = cells[t, LEVEL] + 1, cells[t, REGION]
            cells[child, FLIPPED], cells[child, MARK] = cells[t, FLIPPED] ^ mirrored[tag, side], 0
        cells[c, PLACE] = cells[t, PLACE]
        leaves[cells[t, PLACE]] = c
        cells[t, PLACE] = -1
        cells[c + 1, PLACE] = counters[LEAVES]
        leaves[counters[LEAVES]] = c + 1
        counters[LEAVES] += 1
        nodes[z, 3] = c
    return z


@njit(cache=True)
def refine(forest, k, marked, begin, ring, stack, made, split):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Bisect marked cells that are leaves, and what has to be bisected before them.

    New vertices are entered in `made`, and bisected cells, their first children and the number of the entry of their vertex in `split`;
    returns (status, the first marked cell that is left, numbers of entries). On FULL the arrays have to grow; on CYCLE and CROWDED the
    caller undoes what was done.
    """
    cells, nodes, counters = forest[0], forest[2], forest[5]
    n_made, n_split, status = 0, 0, DONE
    for m in range(begin, len(marked)):
        stack[0], depth = marked[m], 1
        cells[marked[m], MARK] = 1
        while depth > 0:
            t = stack[depth - 1]
            if cells[t, CHILD] >= 0:
                cells[t, MARK] = 0
                depth -= 1
                continue
            tag = cells[t, TAG]
            end = SECOND[tag]
            n = ring_of_edge(cells, k, t, 0, end, ring)
            if n < 0:
                status = CROWDED
                break
            if counters[ROWS] + 2 * n > len(cells) or counters[NODES] >= len(nodes) or n_split + n > len(split) or n_made == len(made):
                status = FULL
                break
            p, q, before = cells[t, 0], cells[t, end], -1
            for r in range(1, n):
                u = ring[r]
                a, b = cells[u, 0], cells[u, SECOND[cells[u, TAG]]]
                if not ((a == p and b == q) or (a == q and b == p)):
                    before = u
                    break
            if before >= 0:
                if cells[before, MARK] == 1 or depth == len(stack):
                    status = CYCLE
                    break
                cells[before, MARK] = 1
                stack[depth] = before
                depth += 1
                continue
            made[n_made] = _bisect(forest, k, ring, n)
            for r in range(n):
                split[n_split, 0], split[n_split, 1], split[n_split, 2] = ring[r], cells[ring[r], CHILD], n_made
                n_split += 1
            n_made += 1
            cells[t, MARK] = 0
            depth -= 1
        for r in range(depth):
            cells[stack[r], MARK] = 0
        if status != DONE:
            return status, m, n_made, n_split
    return DONE, len(marked), n_made, n_split


@njit(cache=True)
def _restorable(cells, k, t, ring, need_marks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill `ring` with the cells that were bisected with t; return their number, or 0 where they cannot be restored."""
    n = ring_of_edge(cells, k, np.int64(t), 0, SECOND[cells[t, TAG]], ring)
    sources = SOURCES_3D if k == 4 else SOURCES_2D
    for r in range(n):
        u = ring[r]
        tag, c = cells[u, TAG], cells[u, CHILD]
        if c < 0:
            return 0
        for side in range(2):
            child, own = c + side, 0 if side == 0 else SECOND[tag]
            if cells[child, CHILD] != LEAF or (need_marks and cells[child, MARK] == 0):
                return 0
            for place in range(k):  # a cut may have changed a vertex or the neighbours
                s = sources[tag, side, place]
                if s == 9:
                    continue
                if cells[child, place] != cells[u, s] or (s == own and cells[child, 4 + place] != c + 1 - side):
                    return 0
                if s != own and (cells[child, 4 + place] < 0) != (cells[u, 4 + s] < 0):
                    return 0
    return max(n, 0)


@njit(cache=True)
def _restore(forest, k, ring, n):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Join the children of the cells of a ring; return the vertex that is removed."""
    cells, _, nodes, table, leaves, counters = forest
    sources = SOURCES_3D if k == 4 else SOURCES_2D
    z = 0
    for r in range(n):
        t = ring[r]
        tag, c = cells[t, TAG], cells[t, CHILD]
        for side in range(2):
            lost = SECOND[tag] if side == 0 else 0
            for place in range(k):
                s = sources[tag, side, place]
                if s == 9:
                    outer = cells[c + side, 4 + place]
                    z = cells[c + side, place]
                    cells[t, 4 + lost] = outer
                    _replace(cells, k, outer, c + side, t)
                elif cells[c + side, 4 + place] < 0:
                    cells[t, 4 + s] = cells[c + side, 4 + place]
            cells[c + side, CHILD] = FREE
        at, gap, last = cells[c, PLACE], cells[c + 1, PLACE], counters[LEAVES] - 1
        cells[t, PLACE], leaves[at] = at, t
        leaves[gap] = leaves[last]
        cells[leaves[gap], PLACE] = gap
        counters[LEAVES] = last
        cells[t, CHILD], cells[t, MARK] = LEAF, 0
        cells[c, PARENT] = counters[FREE_PAIR]
        counters[FREE_PAIR] = c
        for s in range(k):
            nodes[cells[t, s], 3] = t
    _remove_midpoint(nodes, table, z)
    nodes[z, 2], nodes[z, 3] = -1, counters[FREE_NODE]
    counters[FREE_NODE] = z
    counters[COUNT] -= 1
    return z


@njit(cache=True)
def coarsen(forest, k, marked, ring, removed, joined):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Undo the last bisection of marked leaves wherever all cells around the vertex it made are marked leaves.

    Removed vertices are entered in `removed`, and restored cells, the first of their children and the number of the entry of their vertex
    in `joined`; returns the numbers of entries.
    """
    cells = forest[0]
    n_removed, n_joined = 0, 0
    for t in marked:
        cells[t, MARK] = 1
    for t in marked:
        if cells[t, CHILD] != LEAF or cells[t, MARK] == 0 or cells[t, PARENT] < 0:
            continue
        n = _restorable(cells, k, cells[t, PARENT], ring, True)
        if n == 0:
            continue
        for r in range(n):
            joined[n_joined, 0], joined[n_joined, 1], joined[n_joined, 2] = ring[r], cells[ring[r], CHILD], n_removed
            n_joined += 1
        removed[n_removed] = _restore(forest, k, ring, n)
        n_removed += 1
    for t in marked:
        cells[t, MARK] = 0
    return n_removed, n_joined


@njit(cache=True)
def undo(forest, k, made, ring):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Remove the vertices `made` in the opposite order."""
    cells, nodes = forest[0], forest[2]
    for i in range(len(made) - 1, -1, -1):
        n = _restorable(cells, k, cells[nodes[made[i], 3], PARENT], ring, False)
        _restore(forest, k, ring, n)


@njit(cache=True)
def around_node(cells, nodes, k, v, found):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill `found` with the leaves that touch a vertex and are joined by faces; return their number, -1 if they do not fit."""
    found[0], n, at = nodes[v, 3], 1, 0
    cells[found[0], MARK] = 1
    fits = True
    while at < n and fits:
        t = found[at]
        at += 1
        for s in range(k):
            u = cells[t, 4 + s]
            if cells[t, s] == v or u < 0 or cells[u, MARK] == 1:
                continue
            if n == len(found):
                fits = False
                break
            cells[u, MARK] = 1
            found[n] = u
            n += 1
    for i in range(n):
        cells[found[i], MARK] = 0
    return n if fits else -1
