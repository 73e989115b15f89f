"""A displacement for every voxel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.resampling import positions


@dataclass(frozen=True, slots=True, eq=False)
class DenseDisplacement:
    """Displacement at every voxel of a grid.

    Attributes
    ----------
    vectors : ndarray, shape (nz, ny, nx, 3)
        Displacement u along x, y, z, mm: the material at x is found at x + u(x); NaN where there is none.
    valid : ndarray, shape (nz, ny, nx), bool
        Where it was measured, not filled in.
    quality : ndarray, shape (nz, ny, nx)
        What the method gives for its match: see there; NaN where there is none.
    """

    vectors: FloatArray
    valid: BoolArray
    quality: FloatArray

    def field(self, grid: Volume, *, step: int = 1, sd_mm: ArrayLike = 0.0) -> DisplacementField:
        """Return the measured vectors at every `step`-th voxel as a field of points, with one standard deviation, mm, for all."""
        some = np.zeros(self.valid.shape, dtype=bool)
        some[::step, ::step, ::step] = True
        some &= self.valid
        return DisplacementField.from_arrays(positions(grid)[some], self.vectors[some], sd_mm=sd_mm)
