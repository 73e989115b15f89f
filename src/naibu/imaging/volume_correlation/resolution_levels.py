"""Resolution levels of digital volume correlation, from coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class ResolutionLevel:
    """How far voxels are thinned out, and how its fit differs from that of the finest level.

    Attributes
    ----------
    voxels_per_cell : int
        Voxels along a cell that are taken, at least one of every cell.
    robust, bending : float
        Factors on the settings `robust` and `bending_weight`: far from registered residuals are large, and a stiff field takes out most.
    steps : int
        Gauss-Newton steps.
    anchoring : float
        See `Iterations.anchoring`.
    """

    voxels_per_cell: int
    robust: float
    bending: float
    steps: int
    anchoring: float = 0.0


# the cells are halved between the first and the second level, and between the second and the third; the last level has all voxels
LEVELS = (
    ResolutionLevel(2, 3.0, 20.0, 8, 0.05),
    ResolutionLevel(2, 2.0, 1.0, 8, 0.01),
    ResolutionLevel(4, 1.0, 1.0, 3),
    ResolutionLevel(0, 1.0, 1.0, 4),
)
HALVINGS = 2


def voxel_stride(step: FloatArray, spacing: FloatArray, part: int) -> tuple[int, ...]:
    """Return the stride of voxels along x, y, z with which `part` of them lie along a cell."""
    return tuple(int(n) for n in np.maximum(np.round(step / part / spacing), 1))


def voxel_strides(step: FloatArray, spacing: FloatArray) -> list[tuple[int, ...]]:
    """Return the strides of all levels, the last of which takes every voxel."""
    fine = [voxel_stride(step, spacing, level.voxels_per_cell) for level in LEVELS[:-1]]
    return fine if max(fine[-1]) == 1 else [*fine, (1, 1, 1)]
