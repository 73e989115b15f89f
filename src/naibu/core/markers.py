"""Labelled material points measured in one state of an object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class Markers:
    """Positions of labelled markers; a missing coordinate is NaN.

    Attributes
    ----------
    ids : ndarray, shape (n,), int64
        Labels; the same label means the same material point in every state. Sorted, without duplicates.
    points : ndarray, shape (n, 3), float64
        Positions in the frame of the scan, mm. Any single coordinate may be NaN.
    trusted : ndarray, shape (n,), bool
        False for markers that must not be used in a fit or an accuracy figure (``suspect``).
    """

    ids: IntArray
    points: FloatArray
    trusted: BoolArray

    @classmethod
    def from_arrays(cls, ids: ArrayLike, points: ArrayLike, trusted: ArrayLike | None = None) -> Markers:
        """Check, sort by label and freeze.

        Raises
        ------
        InputError
            Wrong shapes, duplicate labels or infinite coordinates.
        """
        i = np.asarray(ids, dtype=np.int64)
        p = np.asarray(points, dtype=np.float64)
        t = np.ones(len(i), dtype=bool) if trusted is None else np.asarray(trusted, dtype=bool)
        if i.ndim != 1 or p.shape != (len(i), 3) or t.shape != (len(i),):
            raise InputError(f"markers need ids (n,), points (n, 3) and trusted (n,); got {i.shape}, {p.shape}, {t.shape}")
        if np.isinf(p).any():
            raise InputError(f"marker {i[np.isinf(p).any(axis=1)][0]} has an infinite coordinate; write NaN where it is missing")
        order = np.argsort(i, kind="stable")
        i, p, t = i[order], p[order], t[order]
        if (np.diff(i) == 0).any():
            raise InputError(f"marker {i[:-1][np.diff(i) == 0][0]} appears more than once; every label must be unique")
        return cls(i, p, t)

    def __len__(self) -> int:
        return len(self.ids)

    def aligned(self, ids: IntArray) -> FloatArray:
        """Return trusted positions (len(ids), 3) in the order of `ids`; NaN where a marker is absent or not trusted."""
        out = np.full((len(ids), 3), np.nan)
        where = np.searchsorted(self.ids, ids)
        where_safe = np.minimum(where, max(len(self.ids) - 1, 0))
        present = (self.ids[where_safe] == ids) & self.trusted[where_safe]
        out[present] = self.points[where_safe[present]]
        return out
