"""Displacement and standard deviation at the voxels of a volume larger than memory, box by box."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from scipy import ndimage

from naibu.core.arrays import AnyFloatArray, BoolArray, Float32Array, FloatArray, Int32Array
from naibu.imaging.large_volumes.block_frame import BlockFrame
from naibu.imaging.large_volumes.correlate_blocks import BlockwiseCorrelation
from naibu.imaging.large_volumes.fine_outline import inside_block
from naibu.imaging.preprocessing.field_of_view import Box
from naibu.imaging.volume_correlation.rigid_parts.rigid_inclusions import InclusionMotion
from naibu.imaging.volume_correlation.splines.spline_grid import separable


@dataclass(frozen=True, slots=True, eq=False)
class VoxelField:
    """What the displacement at any voxel follows from.

    Attributes
    ----------
    frame : BlockFrame
        Voxels and spline grid.
    coefficients : ndarray, shape (NZ, NY, NX, 3)
        Of the splines, mm along the axes of the volume.
    direction : ndarray, shape (3, 3)
        These axes.
    valid, sd_mm : ndarray, shape (nz, ny, nx)
        Coarse voxels where the displacement was measured, and its standard deviation along the least certain direction, mm.
    labels, motions : ndarray, shape (nz, ny, nx), and tuple of InclusionMotion
        Rigid inclusions of the coarse voxels.
    """

    frame: BlockFrame
    coefficients: FloatArray
    direction: FloatArray
    valid: BoolArray
    sd_mm: Float32Array
    labels: Int32Array
    motions: tuple[InclusionMotion, ...]

    @classmethod
    def of(cls, found: BlockwiseCorrelation) -> VoxelField:
        """Return the field of a correlation."""
        result = found.result
        sd = np.full(result.valid.shape, np.nan, np.float32)
        at = result.volume.to_physical(np.argwhere(result.valid)[:, ::-1].astype(float))
        sd[result.valid] = np.sqrt(np.linalg.eigvalsh(result.covariance_at(at))[:, -1])
        # in between voxels that have one and others the nearest counts
        near = ndimage.distance_transform_edt(np.isnan(sd), return_distances=False, return_indices=True)
        direction = result.volume.direction
        return cls(found.frame, result.coefficients, direction, result.valid, sd[tuple(near)], result.inclusions, result.motions)

    def in_box(self, box: Box, outline: Any) -> tuple[Float32Array, Float32Array, BoolArray]:
        """Return displacement (nz, ny, nx, 3) and standard deviation (nz, ny, nx), mm, NaN where not measured, and where it was.

        Parameters
        ----------
        box : tuple of slice
            Voxels along z, y, x.
        outline : array with slicing, shape (nz, ny, nx)
            The mask if one was given, else the intensities of the reference.
        """
        frame = self.frame
        low, high = zip(*(s.indices(n)[:2] for s, n in zip(box, frame.shape, strict=True)), strict=True)
        at = frame.coarse(low, high)
        measured = inside_block(frame, low, high, outline)[0] & self.valid[at]
        shape = measured.shape
        if not measured.any():
            return np.full((*shape, 3), np.nan, np.float32), np.full(shape, np.nan, np.float32), measured
        axes = [frame.along(a, np.arange(low[2 - a], high[2 - a])) for a in range(3)]
        vectors = self._splines(axes)
        labels = self.labels[at]
        for motion in self.motions:
            z, y, x = np.nonzero(labels == motion.number)
            vectors[z, y, x] = motion.displacement(np.stack([axes[0][x], axes[1][y], axes[2][z]], axis=1))
        if not np.array_equal(self.direction, np.eye(3)):
            vectors = vectors @ self.direction.T
        vectors[~measured] = np.nan
        sd = np.where(measured, frame.interpolated(self.sd_mm, low, high), np.nan)
        return vectors.astype(np.float32), sd.astype(np.float32), measured

    def _splines(self, axes: list[FloatArray]) -> AnyFloatArray:
        """Return the field of the splines on a lattice, from the coefficients near it."""
        grid = self.frame.grid
        near, matrices = [], []
        for a in range(3):
            cell = grid.table(a, axes[a][[0, -1]])[0]
            near.append(slice(int(cell[0]), int(cell[1]) + 4))
            matrices.append(grid.matrix(a, axes[a])[:, near[-1]].astype(np.float32))
        x, y, z = near
        return separable(matrices, self.coefficients[z, y, x].astype(np.float32))


def boxes_of(shape: tuple[int, ...], edge: int) -> list[Box]:
    """Return boxes of at most `edge` voxels along z, y, x that make up a volume."""
    along = [[slice(a, min(a + edge, n)) for a in range(0, n, edge)] for n in shape]
    return [(z, y, x) for z, y, x in product(*along)]
