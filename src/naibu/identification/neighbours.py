"""Nearest neighbours of points."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from naibu.core.arrays import FloatArray, IntArray


def neighbours(points: FloatArray, count: int) -> tuple[FloatArray, IntArray]:
    """Return distances (k, n), mm, and indices (k, n) of the nearest others of points (k, d), `count` of them where there are as many."""
    distance, index = cKDTree(points).query(points, k=min(count + 1, len(points)))
    return np.asarray(distance)[:, 1:], np.asarray(index, dtype=np.int64)[:, 1:]
