"""Trilinear hat functions of a regular grid at places that need not lie on it."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray, IntArray

_EXACT = 1e-6  # cells from a plane of the grid below which a place counts as on it


def corner_weights(place: FloatArray, cells: IntArray) -> tuple[IntArray, FloatArray]:
    """Return the eight grid nodes around places, and their weights.

    Parameters
    ----------
    place : ndarray, shape (n, 3)
        In units of cells, from the first node of the grid.
    cells : ndarray, shape (3,)
        Cells along x, y and z.

    Returns
    -------
    number : ndarray, shape (n, 8), int64
        Numbers of the nodes, x first.
    weight : ndarray, shape (n, 8)
        Products of linear shares; zero at nodes that a place does not reach.
    """
    nearest = np.rint(place)
    place = np.where(np.abs(place - nearest) < _EXACT, nearest, place)
    low = np.minimum(place.astype(np.int64), cells - 1)
    t, shape = place - low, cells + 1
    corner, weight = [], []
    for side in np.ndindex(2, 2, 2):
        at = low + np.array(side)
        corner.append(at[:, 0] + shape[0] * (at[:, 1] + shape[1] * at[:, 2]))
        weight.append(np.prod(np.where(np.array(side, dtype=bool), t, 1.0 - t), axis=1))
    return np.stack(corner, axis=1), np.stack(weight, axis=1)
