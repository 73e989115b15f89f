"""Comparison of marker lattices: whether two scans show the same specimen, since markers are never placed twice with the same errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.rigid_transform import registration

FEWEST_MARKERS = 8


@dataclass(frozen=True, slots=True)
class BlockMatch:
    """How well one lattice of markers can be laid on another.

    Attributes
    ----------
    distance_mm : float
        Root mean square distance of the markers known in both after the best rigid registration, mm.
    quarter_turns : int
        By which the first block is turned about the vertical for that.
    upside_down : bool
        Whether it is turned over as well.
    marker_count : int
        Number of markers compared.
    """

    distance_mm: float
    quarter_turns: int
    upside_down: bool
    marker_count: int


def block_match(first: FloatArray, second: FloatArray) -> BlockMatch:
    """Compare two lattices of markers in free blocks, in every way in which one can stand in place of the other.

    The same block twice differs by the noise of two scans only; two blocks of the same mould differ also by the errors with which the
    markers were placed in each.

    Parameters
    ----------
    first, second : ndarray, shape (nk, nj, ni, 3)
        Positions, mm, by layer, row and column; NaN where unknown. Both of the same shape, with nj = ni.

    Raises
    ------
    InputError
        Other shapes, or fewer than 8 markers known in both.
    """
    if first.shape != second.shape or first.ndim != 4 or first.shape[1] != first.shape[2] or first.shape[3] != 3:
        raise InputError(f"two lattices (layers, n, n, 3) of one shape are compared, not {first.shape} and {second.shape}")
    found = []
    for turns in range(4):
        for over in (False, True):
            turned = np.rot90(first, turns, axes=(1, 2))
            a = (turned[::-1, :, ::-1] if over else turned).reshape(-1, 3)
            b = second.reshape(-1, 3)
            both = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
            if both.sum() < FEWEST_MARKERS:
                continue
            distance = registration(a[both], b[both]).applied(a[both]) - b[both]
            found.append(BlockMatch(float(np.sqrt((distance**2).sum(axis=1).mean())), turns, over, int(both.sum())))
    if not found:
        raise InputError(f"fewer than {FEWEST_MARKERS} markers are known in both blocks")
    return min(found, key=lambda match: match.distance_mm)
