"""Image volume: intensities of voxels and their geometry in the frame of the scanner."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import AnyArray, FloatArray
from naibu.core.errors import InputError

# difference of direction cosines, or of positions in voxels, at which grids count as one: files store rounded numbers
NEARLY = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Volume:
    """Image volume with its geometry, as SimpleITK defines it (LPS); intensities are never rescaled.

    Attributes
    ----------
    values : ndarray, shape (nz, ny, nx)
        Intensities, in the type of the file.
    spacing_mm : ndarray, shape (3,)
        Distance between the centres of voxels along x, y, z, mm.
    origin_mm : ndarray, shape (3,)
        Centre of the first voxel, mm.
    direction : ndarray, shape (3, 3)
        Columns are the unit vectors along which x, y and z indices grow.
    """

    values: AnyArray
    spacing_mm: FloatArray
    origin_mm: FloatArray
    direction: FloatArray

    @classmethod
    def from_array(
        cls,
        values: ArrayLike,
        *,
        spacing_mm: ArrayLike,
        origin_mm: ArrayLike = (0.0, 0.0, 0.0),
        direction: ArrayLike | None = None,
        missing: bool = False,
    ) -> Volume:
        """Return a volume after checking the arrays.

        Parameters
        ----------
        values : array_like, shape (nz, ny, nx)
            Intensities, finite real numbers.
        spacing_mm : array_like, shape (3,)
            Distance between the centres of voxels along x, y, z, mm.
        origin_mm : array_like, shape (3,)
            Centre of the first voxel, mm.
        direction : array_like, shape (3, 3), optional
            Unit vectors along which x, y and z indices grow, as columns; by default the axes of space.
        missing : bool
            Whether voxels may be NaN: not measured.

        Raises
        ------
        InputError
            Values that are not a three-dimensional array of finite real numbers, a spacing that is not positive, or axes that are not
            orthonormal.
        """
        v = np.asarray(values)
        if v.ndim != 3 or 0 in v.shape:
            raise InputError(f"values must have three axes z, y, x, not shape {v.shape}; choose one time or one colour")
        if v.dtype.kind not in "biuf":
            raise InputError(f"intensities must be real numbers, not {v.dtype}")
        if v.dtype.kind == "f" and not np.isfinite(v).all():
            wrong = np.isinf(v) if missing else ~np.isfinite(v)
            if wrong.any():
                bad = tuple(int(i) for i in np.argwhere(wrong)[0])
                raise InputError(f"voxel {bad} (z, y, x) is {v[bad]}; mask or repair it")
        spacing, origin = np.array(spacing_mm, dtype=float), np.array(origin_mm, dtype=float)
        axes = np.eye(3) if direction is None else np.array(direction, dtype=float).reshape(3, 3)
        if spacing.shape != (3,) or not (np.isfinite(spacing).all() and (spacing > 0.0).all()):
            raise InputError(f"spacing_mm must be three positive numbers (x, y, z), mm, not {spacing.tolist()}")
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise InputError(f"origin_mm must be three numbers (x, y, z), mm, not {origin.tolist()}")
        if np.abs(axes.T @ axes - np.eye(3)).max() > NEARLY:
            raise InputError(f"direction is not orthonormal: {axes.tolist()}; resample sheared slices first")
        return cls(v, spacing, origin, axes)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along z, y, x."""
        nz, ny, nx = self.values.shape
        return int(nz), int(ny), int(nx)

    @property
    def frame(self) -> Volume:
        """The same grid with values of zero that take no memory."""
        return replace(self, values=np.broadcast_to(np.float32(0.0), self.values.shape))

    def positions(self) -> FloatArray:
        """Return the centres (nz, ny, nx, 3) of all voxels, mm."""
        nz, ny, nx = self.shape
        index = np.empty((nz, ny, nx, 3))
        index[..., 0], index[..., 1], index[..., 2] = np.arange(nx), np.arange(ny)[:, None], np.arange(nz)[:, None, None]
        return self.to_physical(index)

    def to_physical(self, index: ArrayLike) -> FloatArray:
        """Return positions (..., 3), mm, of continuous indices (..., 3) in the order x, y, z."""
        return np.asarray((np.asarray(index, dtype=float) * self.spacing_mm) @ self.direction.T + self.origin_mm)

    def to_index(self, points_mm: ArrayLike) -> FloatArray:
        """Return continuous indices (..., 3) in the order x, y, z of positions (..., 3), mm."""
        return np.asarray(((np.asarray(points_mm, dtype=float) - self.origin_mm) @ self.direction) / self.spacing_mm)

    def same_grid(self, other: Volume) -> bool:
        """Whether the voxels of another volume lie at the same positions."""
        return not self.grid_difference(other)

    def grid_difference(self, other: Volume) -> str:
        """Return in words what distinguishes the grid of another volume from this one: size, spacing, axes or origin; empty for none."""
        if self.shape != other.shape:
            sizes = (" x ".join(str(n) for n in volume.shape[::-1]) for volume in (self, other))
            return f"their sizes differ: {' and '.join(sizes)} voxels"
        limit = NEARLY * float(self.spacing_mm.min())
        if np.abs(self.spacing_mm - other.spacing_mm).max() >= limit:
            return f"their voxel spacings differ: {_rounded(self.spacing_mm)} and {_rounded(other.spacing_mm)} mm"
        if np.abs(self.direction - other.direction).max() >= NEARLY:
            return f"their axes differ: {_rounded(self.direction)} and {_rounded(other.direction)}"
        apart = float(np.linalg.norm(self.origin_mm - other.origin_mm))
        if np.abs(self.origin_mm - other.origin_mm).max() >= limit:
            ends = f"{_rounded(self.origin_mm)} and {_rounded(other.origin_mm)} mm"
            return f"they agree in size and spacing, but their origins lie {apart:.4g} mm apart: {ends}"
        return ""

    def with_values(self, values: ArrayLike) -> Volume:
        """Return other values on the same grid."""
        v = np.asarray(values)
        if v.shape != self.values.shape:
            raise InputError(f"values must have shape {self.values.shape} (z, y, x), not {v.shape}")
        return replace(self, values=v)

    def cropped(self, low: ArrayLike, high: ArrayLike) -> Volume:
        """Return the voxels with indices from `low` up to, not including, `high`, in the order x, y, z."""
        a, b = np.asarray(low, dtype=int), np.asarray(high, dtype=int)
        size = np.array(self.shape[::-1])
        if (a < 0).any() or (b > size).any() or (a >= b).any():
            raise InputError(f"cannot crop to {a.tolist()}..{b.tolist()}: the volume has {size.tolist()} voxels along x, y, z")
        box = tuple(slice(int(s), int(e)) for s, e in zip(a[::-1], b[::-1], strict=True))
        return replace(self, values=self.values[box], origin_mm=self.to_physical(a))


def _rounded(values: FloatArray) -> str:
    return str(np.round(values, 4).tolist())
