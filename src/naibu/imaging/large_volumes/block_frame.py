"""Blocks of a volume that is correlated out of core: which cells of the spline grid they hold, and which voxels of the object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np

from naibu.core.arrays import AnyArray, AnyFloatArray, BoolArray, Float32Array, FloatArray, Int8Array, IntArray
from naibu.imaging.preprocessing.field_of_view import Box
from naibu.imaging.volume_correlation.intensity_comparison import ComparisonSettings
from naibu.imaging.volume_correlation.splines.spline_grid import SplineGrid

MOST_CELLS = 16  # along an edge of a block: their matrix takes 90 MB


@dataclass(frozen=True, slots=True, eq=False)
class BlockFrame:
    """What all blocks share and no iteration changes. Coordinates are mm along the axes of the volume from the first coarse voxel.

    Attributes
    ----------
    shape : tuple of int
        Voxels of the volume along z, y, x.
    spacing : ndarray, shape (3,)
        Their distance along x, y, z, mm.
    factor : int
        Voxels along the edge of a coarse voxel.
    grid : SplineGrid
        Spline grid of the displacement.
    cells : ndarray, shape (CZ, CY, CX), bool
        Cells whose coefficients are unknown.
    mask, rigid : ndarray, shape (nz, ny, nx), bool
        Coarse voxels of the object, and of its rigid inclusions.
    zone : ndarray, shape (nz, ny, nx), int8
        0 where coarse voxels are outside of the object for sure, 2 where inside, 1 near its outline.
    threshold : float, optional
        Intensity of the outline in the reference; None for a mask that was given.
    depth_mm : ndarray, shape (nz, ny, nx), float32
        Depth of coarse voxels below the surface.
    views : tuple of Box
        Fields of view of the reference and the deformed volume, in voxels.
    shift : float
        Intensity that is subtracted from both volumes.
    gain_low, gain_step, gain_n : ndarray, shape (3,)
        Lattice of gain and offset: first point and distance, in coarse voxels, and number of points.
    settings : ComparisonSettings
        How intensities are compared.
    smoothing : float
        Standard deviation of the Gaussian on both volumes, voxels.
    edge : int
        Edge of the small blocks with independent errors, voxels.
    offset : float
        Index of the first coarse voxel along every axis.
    thinning : int
        Where above 1, voxels are means of so many of the volume along every axis.
    """

    shape: tuple[int, int, int]
    spacing: FloatArray
    factor: int
    grid: SplineGrid
    cells: BoolArray
    mask: BoolArray
    rigid: BoolArray
    zone: Int8Array
    threshold: float | None
    depth_mm: Float32Array
    views: tuple[Box, Box]
    shift: float
    gain_low: FloatArray
    gain_step: FloatArray
    gain_n: IntArray
    settings: ComparisonSettings
    smoothing: float
    edge: int
    offset: float = 0.0
    thinning: int = 1

    def thinned(self, factor: int) -> BlockFrame:
        """Return the frame of the means of factor^3 voxels, for a factor that divides that of the coarse voxels."""

        def coarser(view: Box) -> Box:
            z, y, x = (slice(-(-s.start // factor), s.stop // factor) for s in view)
            return z, y, x

        nz, ny, nx = (n // factor for n in self.shape)
        return replace(
            self,
            shape=(nz, ny, nx),
            spacing=self.spacing * factor,
            factor=self.factor // factor,
            views=(coarser(self.views[0]), coarser(self.views[1])),
            offset=-0.5 * (factor - 1) / factor,
            thinning=factor,
        )

    def position(self, index: IntArray) -> FloatArray:
        """Return the coordinates (3,) of the voxel with the indices x, y, z, mm."""
        return np.array([self.along(axis, index[axis]) for axis in range(3)])

    def along(self, axis: int, index: IntArray | FloatArray) -> FloatArray:
        """Return the coordinates of voxels with indices along an axis, 0 for x, mm."""
        return np.asarray((index - self.offset) * self.spacing[axis])

    def cell_along(self, axis: int) -> IntArray:
        """Return the cells of all voxels along an axis, 0 for x."""
        return self.grid.table(axis, self.along(axis, np.arange(self.shape[2 - axis])))[0]

    def interpolated(self, values: AnyArray, low: Sequence[int], high: Sequence[int]) -> AnyFloatArray:
        """Return values of coarse voxels (nz, ny, nx) at the voxels of a box (z, y, x), linear in between."""
        out = np.asarray(values)
        for axis, (a, b) in enumerate(zip(low, high, strict=True)):
            at = np.clip((np.arange(a, b) - self.offset) / self.factor, 0, values.shape[axis] - 1)
            first = np.minimum(at.astype(int), max(values.shape[axis] - 2, 0))
            share = (at - first).astype(np.float32).reshape(tuple(-1 if k == axis else 1 for k in range(3)))
            last = np.minimum(first + 1, values.shape[axis] - 1)
            out = out.take(first, axis) * (np.float32(1) - share) + out.take(last, axis) * share
        return out

    def coarse(self, low: Sequence[int], high: Sequence[int]) -> tuple[IntArray, IntArray, IntArray]:
        """Return indices of the coarse voxels in which the voxels of a box (z, y, x) lie, for indexing."""
        axes = (np.rint((np.arange(a, b) - self.offset) / self.factor).astype(int) for a, b in zip(low, high, strict=True))
        z, y, x = np.ix_(*(np.minimum(i, n - 1) for i, n in zip(axes, self.mask.shape, strict=True)))
        return z, y, x


@dataclass(frozen=True, slots=True)
class Block:
    """Cells of a block, and the box of its voxels.

    Attributes
    ----------
    number : int
        Number of the block, from 0.
    cells : tuple of tuple of int
        First cell, and the one after the last, along x, y, z.
    low, high : tuple of int
        First voxel, and the one after the last, along z, y, x.
    """

    number: int
    cells: tuple[tuple[int, int], tuple[int, int], tuple[int, int]]
    low: tuple[int, int, int]
    high: tuple[int, int, int]


def blocks_of(frame: BlockFrame, edge: int) -> list[Block]:
    """Return the blocks that hold voxels of the object, of whole cells and about `edge` voxels along an axis."""
    along = []
    for axis in range(3):
        of, n = frame.cell_along(axis), int(frame.grid.cells[axis])
        size = max(1, min(MOST_CELLS, round(edge * frame.spacing[axis] / frame.grid.step_mm[axis])))
        ends = np.round(np.linspace(0, n, -(-n // size) + 1)).astype(int)
        along.append([(int(a), int(b), int(np.searchsorted(of, a)), int(np.searchsorted(of, b))) for a, b in pairwise(ends)])
    out: list[Block] = []
    for z, y, x in product(*along[::-1]):
        low, high = (z[2], y[2], x[2]), (z[3], y[3], x[3])
        if all(a < b for a, b in zip(low, high, strict=True)) and frame.cells[z[0] : z[1], y[0] : y[1], x[0] : x[1]].any():
            out.append(Block(len(out), ((x[0], x[1]), (y[0], y[1]), (z[0], z[1])), low, high))
    return out
