"""Settings of digital volume correlation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from naibu.core.arrays import FloatArray, require_positive
from naibu.core.errors import InputError

Gradients = Literal["reference", "mean", "deformed"]
# fraction of the image intensity gradient that is taken from the reference
REFERENCE_FRACTION: dict[Gradients, float] = {"reference": 1.0, "mean": 0.5, "deformed": 0.0}
VOXELS_PER_LONG_CELL = 2.5  # empirical: least number of voxels along a cell on the axis of the largest spacing
LEAST_SAMPLES = 8  # a 3 x 3 covariance of fewer is too uncertain to weight data by


@dataclass(frozen=True, slots=True)
class CorrelationSettings:
    """Settings of digital volume correlation; the defaults suit scans of soft objects.

    Attributes
    ----------
    node_spacing_mm : float, optional
        Cell size of the finest spline grid, mm, above 0. Larger cells give smoother fields and fewer unknowns. By default it follows from
        `cells_along` and `voxels_per_cell`.
    cells_along : float
        Number of cells along the cube root of the volume of the object, above 0; used without `node_spacing_mm`.
    voxels_per_cell : float
        Least number of voxels along a cell, above 0; used without `node_spacing_mm`.
    robust : float
        Residual, in residual standard deviations, at which the weight of a voxel has fallen to a quarter (Geman-McClure function); above 0,
        infinite for least squares. Smaller values reject more voxels.
    local_gain : bool
        Whether gain and offset between the intensities of the volumes vary in space; else there is one of each.
    gain_cell : float
        Cell size of the lattice of local gain, in cells of the spline grid, above 0.
    dilatation_penalty : bool
        Whether changes of volume are penalised.
    dilatation_weight : float
        Weight of the squared change of volume, per cell and in units of the residual variance, above 0; the largest one where the data
        choose the weight.
    adaptive_weight : bool
        Whether the weights of bending, cell by cell, and of dilatation are the most probable ones given the data; else they are those
        given here.
    bending_weight : float
        Weight of the squared second derivatives, mm^-1 per mm of cell size, above 0; with `adaptive_weight` only the first one.
    gradients : {"reference", "mean", "deformed"}
        Volume whose image intensity gradient enters the Gauss-Newton matrix on fine grids.
    rigid_inclusions : bool
        Whether inclusions that move rigidly, such as bones, are found and have a rigid motion each.
    samples : int
        Number of random fields from which the covariance is estimated, 8 or more; its relative error is about ``sqrt(2 / samples)``.
    jitter_sd_voxels : float
        Standard deviation of the sub-voxel jitter, voxels, 0 or more: the position error of a voxel's intensity, by which voxels of steep
        intensity gradient get a lower weight; with `adaptive_weight` at most so much, and less where residuals hardly grow with gradients.
    smoothing_voxels : float
        Standard deviation of the Gaussian by which both volumes are smoothed, voxels of each resolution level, 0 or more.
    seed : int
        Seed of the random fields, 0 or more.
    """

    node_spacing_mm: float | None = None
    cells_along: float = 12.5
    voxels_per_cell: float = 3.5
    robust: float = 3.0
    local_gain: bool = True
    gain_cell: float = 5.5
    dilatation_penalty: bool = True
    dilatation_weight: float = 5000.0
    adaptive_weight: bool = True
    bending_weight: float = 64.0
    gradients: Gradients = "reference"
    rigid_inclusions: bool = True
    samples: int = 32
    jitter_sd_voxels: float = 0.15
    smoothing_voxels: float = 0.5
    seed: int = 20080301

    def __post_init__(self) -> None:
        """Refuse settings out of range.

        Raises
        ------
        InputError
            A value out of its range; the message names the setting.
        """
        if self.gradients not in get_args(Gradients):
            raise InputError(f"gradients must be one of {', '.join(get_args(Gradients))}, not {self.gradients!r}")
        if self.node_spacing_mm is not None:
            require_positive("node_spacing_mm", self.node_spacing_mm, "mm")
        for name in ("cells_along", "voxels_per_cell", "gain_cell", "dilatation_weight", "bending_weight"):
            require_positive(name, getattr(self, name))
        if not self.robust > 0.0:
            raise InputError(f"robust must be positive, a number of residual standard deviations, not {self.robust}")
        if self.samples < LEAST_SAMPLES:
            raise InputError(f"samples must be {LEAST_SAMPLES} or more for a covariance, not {self.samples}")
        for name in ("jitter_sd_voxels", "smoothing_voxels"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"{name} must be 0 or more, voxels, not {value}")
        if self.seed < 0:
            raise InputError(f"seed must be 0 or more, not {self.seed}")

    def cell_size_mm(self, voxels: float, spacing_mm: FloatArray) -> FloatArray:
        """Return the size (3,) of the finest cells along x, y, z, mm, for an object of so many voxels with a spacing (3,), mm."""
        if self.node_spacing_mm is not None:
            return np.full(3, float(self.node_spacing_mm))
        voxel = float(np.prod(spacing_mm))
        h = max((voxels * voxel) ** (1 / 3) / self.cells_along, self.voxels_per_cell * voxel ** (1 / 3))
        return np.asarray(np.maximum(h, VOXELS_PER_LONG_CELL * spacing_mm))
