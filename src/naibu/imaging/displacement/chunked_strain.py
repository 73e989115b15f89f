"""Strain of displacement fields that do not fit into memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from naibu.core.arrays import Float32Array
from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.displacement.strain import green_lagrange_strain

COMPONENTS = ("xx", "yy", "zz", "xy", "xz", "yz")
_VOXELS = 250_000  # whose strain is computed at a time


@dataclass(frozen=True, slots=True, eq=False)
class ChunkedStrain:
    """Green-Lagrange strain of a displacement field in a file, computed for what is sliced, from what is read there and a voxel around it.

    It is that of `naibu.imaging.green_lagrange_strain`, and `naibu.io` writes it as it does an array: only a box is in memory at a time.

    Attributes
    ----------
    displacement : array with ``shape``, ``dtype`` and slicing, shape (nz, ny, nx, 3)
        Displacement along x, y, z, mm, such as ``displacement.zarr`` of `naibu.sense`.
    grid : Volume
        Grid of the displacement; its values are not read.
    """

    displacement: Any
    grid: Volume

    @classmethod
    def of(cls, displacement: Any, grid: Volume | ChunkedVolume) -> ChunkedStrain:
        """Return the strain of a displacement on a grid; nothing is read.

        Parameters
        ----------
        displacement : array with ``shape``, ``dtype`` and slicing, shape (nz, ny, nx, 3)
            Displacement along x, y, z, mm.
        grid : Volume or ChunkedVolume
            Its grid.

        Raises
        ------
        InputError
            The shape is not that of the grid.
        """
        shape = tuple(int(n) for n in displacement.shape)
        if shape != (*grid.shape, 3):
            raise InputError(f"displacement must have shape {(*grid.shape, 3)} (z, y, x, component), mm, not {shape}")
        return cls(displacement, grid.grid if isinstance(grid, ChunkedVolume) else grid)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Number of voxels along z, y, x, and of components, which are those of `COMPONENTS`."""
        return (*self.grid.shape, len(COMPONENTS))

    @property
    def dtype(self) -> np.dtype[np.float32]:
        """Type of the strain."""
        return np.dtype(np.float32)

    def __getitem__(self, box: int | slice | tuple[int | slice, ...]) -> Float32Array:
        """Return the strain in a box of voxels, numbers or slices without step along z, y, x; (..., 6), NaN beside unknown displacement."""
        given = box if isinstance(box, tuple) else (box,)
        chosen = [s if isinstance(s, slice) else slice(s, s + 1 or None) for s in (*given, *(slice(None),) * (3 - len(given)))]
        bounds = [s.indices(n)[:2] for s, n in zip(chosen, self.grid.shape, strict=True)]
        shape = [max(end - begin, 0) for begin, end in bounds]
        out = np.empty((*shape, len(COMPONENTS)), np.float32)
        (low, high), *across = bounds
        step = max(1, _VOXELS // max(shape[1] * shape[2], 1))
        for z in range(low, high if out.size else low, step):
            end = min(z + step, high)
            out[z - low : end - low] = self._slab([(z, end), *across])
        return np.asarray(out[tuple(slice(None) if isinstance(s, slice) else 0 for s in given)])

    def _slab(self, bounds: list[tuple[int, int]]) -> Float32Array:
        wider = [(max(begin - 1, 0), min(end + 1, n)) for (begin, end), n in zip(bounds, self.grid.shape, strict=True)]
        read = np.asarray(self.displacement[tuple(slice(*ends) for ends in wider)], dtype=float)
        values = np.broadcast_to(np.float32(0.0), read.shape[:3])
        strain = green_lagrange_strain(read, Volume(values, self.grid.spacing_mm, self.grid.origin_mm, self.grid.direction))
        inner = tuple(slice(begin - first, end - first) for (begin, end), (first, _) in zip(bounds, wider, strict=True))
        a, b = np.array([["xyz".index(axis) for axis in name] for name in COMPONENTS]).T
        return np.asarray(strain[inner][..., a, b], dtype=np.float32)
