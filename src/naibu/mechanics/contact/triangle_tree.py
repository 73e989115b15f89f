"""Bounding volume hierarchy of a triangulated surface, for closest points and signed distances :cite:p:`ericson2005`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.contact._triangle_kernels import fit_boxes

_LEAF = 4  # triangles in a leaf, at most


@dataclass(frozen=True, slots=True, eq=False)
class TriangleTree:
    """Triangles of a surface in a complete binary tree, which serves all deformed positions of their corners.

    Attributes
    ----------
    triangles : ndarray, shape (t, 3), int64
        Vertices, counter-clockwise seen from outside.
    order : ndarray, shape (t,), int64
        Triangles in the order of the leaves.
    start : ndarray, shape (nodes, 2), int64
        First and past-the-last index in `order` of every node of the tree.
    """

    triangles: IntArray
    order: IntArray
    start: IntArray

    @classmethod
    def of(cls, triangles: ArrayLike, positions: ArrayLike) -> TriangleTree:
        """Build the tree of triangles (t, 3) from positions of the vertices in the reference configuration (n, 3), mm."""
        corners, points = np.array(triangles, dtype=np.int64), np.asarray(positions, dtype=float)
        centre = points[corners].mean(axis=1)
        levels = max(int(np.ceil(np.log2(max(len(corners) / _LEAF, 1.0)))), 0)
        order, start = np.arange(len(corners)), np.zeros((2 ** (levels + 1) - 1, 2), dtype=np.int64)
        start[0, 1] = len(corners)
        for node in range(2**levels - 1):
            low, high = start[node]
            mine = order[low:high]
            axis = int(np.argmax(np.ptp(centre[mine], axis=0)))
            order[low:high] = mine[np.argsort(centre[mine, axis], kind="stable")]
            middle = (low + high) // 2
            start[2 * node + 1], start[2 * node + 2] = (low, middle), (middle, high)
        return cls(corners, order, start)

    def boxes(self, positions: FloatArray) -> FloatArray:
        """Return the bounding boxes (nodes, 6), low and high corner, for positions of the vertices (n, 3), mm."""
        boxes = np.empty((len(self.start), 6))
        fit_boxes(positions, self.triangles, self.order, self.start, boxes)
        return boxes
