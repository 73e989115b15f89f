"""How triangles and tetrahedra between markers change: density in a layer, and in space."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial import Delaunay

from naibu.core.arrays import BoolArray, FloatArray, IntArray

_FLAT = 0.01  # least size of a simplex, over the power of its longest edge: flatter ones are rows of a lattice


def marker_cells(points: FloatArray, longest_mm: float) -> IntArray:
    """Return the Delaunay triangles (m, 3) or tetrahedra (m, 4) of markers (n, 2 or 3), without long and flat ones.

    Parameters
    ----------
    points : ndarray, shape (n, 2) or (n, 3)
        Markers, mm.
    longest_mm : float
        Longest edge that is kept: beyond, markers are no neighbours.
    """
    cells = Delaunay(points).simplices.astype(np.int64)
    pairs = list(itertools.combinations(range(cells.shape[1]), 2))
    edges = np.max([np.linalg.norm(points[cells[:, a]] - points[cells[:, b]], axis=1) for a, b in pairs], axis=0)
    size = np.abs(cell_sizes(points, cells))
    return np.asarray(cells[(edges <= longest_mm) & (size > _FLAT * edges ** points.shape[1])])


def cell_sizes(points: FloatArray, cells: IntArray) -> FloatArray:
    """Return signed areas or volumes (m,) of cells, mm^2 or mm^3."""
    corners = points[cells]
    return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]) / (2.0 if cells.shape[1] == 3 else 6.0))


def size_ratio(before: FloatArray, after: FloatArray, cells: IntArray, counted: BoolArray) -> float:
    """Return the size of the cells that are counted (m,), over that before."""
    old, new = cell_sizes(before, cells)[counted], cell_sizes(after, cells)[counted]
    return float((new * np.sign(old)).sum() / np.abs(old).sum())
