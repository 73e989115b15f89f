"""Pieces that meet at vertices."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import BoolArray, IntArray


def of_more_pieces(cells: IntArray, before: IntArray, after: IntArray, n_vertices: int) -> BoolArray:
    """Return whether the cells around each vertex are of more pieces after a cut than before it.

    Such are cells that touch at a mere edge or vertex, and were joined elsewhere.

    Parameters
    ----------
    cells : ndarray, shape (m, k)
        Vertices of cells.
    before, after : ndarray, shape (m,)
        Number of the piece of each cell, 0 or more.
    n_vertices : int
        How many vertices there are.

    Returns
    -------
    ndarray, shape (n_vertices,)
    """
    return np.asarray(_pieces_around(cells, after, n_vertices) > _pieces_around(cells, before, n_vertices))


def _pieces_around(cells: IntArray, piece: IntArray, n_vertices: int) -> IntArray:
    count = int(piece.max(initial=0)) + 1
    return np.bincount(np.unique(cells * count + piece[:, None]) // count, minlength=n_vertices)
