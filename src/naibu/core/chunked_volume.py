"""Image volume larger than memory: intensities that are read block by block, and their geometry in the frame of the scanner."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.volume import Volume


@dataclass(frozen=True, slots=True, eq=False)
class ChunkedVolume:
    """Image volume in a Zarr or Dask array, an HDF5 dataset or a memory map, with its geometry.

    Attributes
    ----------
    values : array with ``shape``, ``dtype`` and slicing, shape (nz, ny, nx)
        Intensities; only what is sliced is read.
    spacing_mm : ndarray, shape (3,)
        Distance between the centres of voxels along x, y, z, mm.
    origin_mm : ndarray, shape (3,)
        Centre of the first voxel, mm.
    direction : ndarray, shape (3, 3)
        Columns are the unit vectors along which x, y and z indices grow.
    """

    values: Any
    spacing_mm: FloatArray
    origin_mm: FloatArray
    direction: FloatArray

    @classmethod
    def from_array(
        cls, values: Any, *, spacing_mm: ArrayLike, origin_mm: ArrayLike = (0.0, 0.0, 0.0), direction: ArrayLike | None = None
    ) -> ChunkedVolume:
        """Return a volume after checking its geometry; no voxel is read.

        Parameters
        ----------
        values : array with ``shape``, ``dtype`` and slicing, shape (nz, ny, nx)
            Intensities.
        spacing_mm, origin_mm : array_like, shape (3,)
            As in `naibu.core.volume.Volume.from_array`.
        direction : array_like, shape (3, 3), optional
            As there.

        Raises
        ------
        InputError
            An array without three axes or of other than real numbers, or an invalid geometry.
        """
        shape, dtype = getattr(values, "shape", ()), np.dtype(getattr(values, "dtype", np.void))
        if len(shape) != 3 or 0 in shape or dtype.kind not in "biuf":
            raise InputError(f"values must have three axes z, y, x of real numbers, not shape {tuple(shape)} of {dtype}")
        grid = Volume.from_array(np.zeros((1, 1, 1)), spacing_mm=spacing_mm, origin_mm=origin_mm, direction=direction)
        return cls(values, grid.spacing_mm, grid.origin_mm, grid.direction)

    @classmethod
    def of(cls, volume: Volume) -> ChunkedVolume:
        """Return a volume in memory as one that is read block by block."""
        return cls(volume.values, volume.spacing_mm, volume.origin_mm, volume.direction)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along z, y, x."""
        nz, ny, nx = self.values.shape
        return int(nz), int(ny), int(nx)

    @property
    def grid(self) -> Volume:
        """The same grid with values of zero that take no memory."""
        return Volume(np.broadcast_to(np.float32(0.0), self.shape), self.spacing_mm, self.origin_mm, self.direction)

    def block(self, box: tuple[slice, slice, slice]) -> Volume:
        """Read the voxels of a box of slices along z, y, x."""
        low = [s.indices(n)[0] for s, n in zip(box[::-1], self.shape[::-1], strict=True)]
        return Volume(np.asarray(self.values[box]), self.spacing_mm, self.grid.to_physical(low), self.direction)

    def volume(self) -> Volume:
        """Read all voxels into memory."""
        return Volume.from_array(
            np.asarray(self.values[:, :, :]), spacing_mm=self.spacing_mm, origin_mm=self.origin_mm, direction=self.direction
        )
