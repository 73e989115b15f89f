"""Whether a surface is closed and seen from outside only, so that its inner side need not be drawn."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray, IntArray


def is_closed(points: FloatArray, faces: IntArray) -> bool:
    """Return whether every edge is passed as often one way as the other, and the triangles enclose a volume counterclockwise.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Nodes, mm.
    faces : ndarray, shape (f, 3), int
        Triangles.
    """
    if not len(faces):
        return False
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    sign = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    _, number = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    corners = points[faces] - points[faces[0, 0]]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))  # six times
    return bool(not np.bincount(number.ravel(), sign).any() and volume > 0.0)
