"""Refinement edges of the coarsest mesh, from which repeated bisection makes cells of bounded quality on any conforming mesh.

The refinement edge of a cell and of every face is its longest edge, as Arnold, Mukherjee and Pouly mark them :cite:p:`arnold2000`. Their
four types of tetrahedra differ in where the marked edges of the two faces lie that do not contain the refinement edge. The children of all
four are of the type that :cite:t:`maubach1995` tags 2, and so on by his rule. (In the original the children of planar tetrahedra are
flagged, which is his tag 1; cells may then wait for each other in a circle where the types meet.)

All edges are bisected once in three bisections, longer ones first. Within a generation an edge waits for another one only if it is shorter
(at the roots), if both join an old vertex to a new one and its new vertex is younger, or if both join new vertices and the ages of its ends
differ less; so no circle is possible, and the closure of a bisection ends.
"""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray, Int8Array, IntArray
from naibu.meshing.refinement import _root_kernels as kernels

ADJACENT, OPPOSITE, MIXED, PLANAR = 3, 4, 5, 6
_EDGES = {3: np.array([[0, 1], [0, 2], [1, 2]]), 4: np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])}
_TIE = 1e-9  # of the longest edge: shorter differences are those of rounding


def tagged(points: FloatArray, cells: IntArray) -> tuple[IntArray, Int8Array]:
    """Return the vertices of every cell in the order of bisection, and its tag.

    Parameters
    ----------
    points : ndarray, shape (n, d)
        mm.
    cells : ndarray, shape (m, d + 1)
        Triangles or tetrahedra.

    Returns
    -------
    tuple of ndarray, shapes (m, d + 1) and (m,)
        The refinement edge of tetrahedra is x0 x3; the marked edges of the faces x0 x1 x2 and x1 x2 x3 are x0 x2 and x1 x3 (`ADJACENT`),
        x1 x2 and x1 x2 (`OPPOSITE`), x0 x2 and x1 x2 (`MIXED`), x0 x2 and x2 x3 (`PLANAR`). That of triangles is x0 x2, with tag 2.
    """
    ranks = _edge_ranks(points, cells)
    return _triangles(cells, ranks) if cells.shape[1] == 3 else _tetrahedra(cells, ranks)


def _edge_ranks(points: FloatArray, cells: IntArray) -> IntArray:
    """Return the place of every edge among those of its cell (m, e), the longest first; ties are decided alike in all cells."""
    edges = _EDGES[cells.shape[1]]
    ranks = np.empty((len(cells), len(edges)), dtype=np.int64)
    kernels.edge_ranks(np.ascontiguousarray(points), np.ascontiguousarray(cells, dtype=np.int64), edges, _TIE, np.empty(ranks.shape), ranks)
    return ranks


def _triangles(cells: IntArray, ranks: IntArray) -> tuple[IntArray, Int8Array]:
    places = np.array([[0, 2, 1], [0, 1, 2], [1, 0, 2]])[ranks.argmin(axis=1)]
    return np.take_along_axis(cells, places, axis=1), np.full(len(cells), 2, dtype=np.int8)


def _tetrahedra(cells: IntArray, ranks: IntArray) -> tuple[IntArray, Int8Array]:
    number = np.zeros((4, 4), dtype=np.int64)
    number[_EDGES[4][:, 0], _EDGES[4][:, 1]] = number[_EDGES[4][:, 1], _EDGES[4][:, 0]] = np.arange(6)
    ends = _EDGES[4][ranks.argmin(axis=1)]
    others = np.array([[2, 3], [1, 3], [1, 2], [0, 3], [0, 2], [0, 1]])[ranks.argmin(axis=1)]
    rows = np.arange(len(cells))

    def rank(i: IntArray, j: IntArray) -> IntArray:
        return np.asarray(ranks[rows, number[i, j]])

    (p, q), (a, b) = ends.T, others.T
    across = rank(a, b)
    # partner of p: the other end of the marked edge of the face (p, a, b) where it is at p, else -1
    partner = []
    for end in (p, q):
        to_a, to_b = rank(end, a), rank(end, b)
        at_a, at_b = (to_a < to_b) & (to_a < across), (to_b < to_a) & (to_b < across)
        partner.append(np.where(at_a, a, np.where(at_b, b, -1)))
    of_p, of_q = partner
    tags = np.full(len(cells), MIXED, dtype=np.int8)
    tags[(of_p >= 0) & (of_q >= 0)] = ADJACENT
    tags[(of_p >= 0) & (of_p == of_q)] = PLANAR
    tags[(of_p < 0) & (of_q < 0)] = OPPOSITE
    turned = (of_p < 0) & (of_q >= 0)
    start, stop = np.where(turned, q, p), np.where(turned, p, q)
    far = np.where(of_p >= 0, of_p, np.where(of_q >= 0, of_q, b))  # marked with the start, where the start is marked
    return np.take_along_axis(cells, np.stack([start, a + b - far, far, stop], axis=1), axis=1), tags
