"""Checks of a pair of volumes before they are compared, and their intensities in single precision."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import AnyArray, AnyFloatArray, Float32Array, FloatArray
from naibu.core.errors import InputError
from naibu.core.volume import Volume


def intensity_pair(reference: Volume, deformed: Volume) -> tuple[Float32Array, Float32Array]:
    """Return the intensities of two volumes on one grid.

    Parameters
    ----------
    reference, deformed : Volume
        Volumes before and after the deformation; NaN stands for unknown.

    Returns
    -------
    tuple of ndarray, shape (nz, ny, nx), float32
        Intensities less the mean of the reference, which keeps differences exact in single precision; NaN where unknown.

    Raises
    ------
    InputError
        Grids that differ, a volume without contrast, infinite values, or no voxel that is known in both.
    """
    if different := reference.grid_difference(deformed):
        ratio = deformed.spacing_mm / reference.spacing_mm
        units = " Their spacings differ by a power of ten: was one stored in other units?" if _power_of_ten(ratio) else ""
        raise InputError(
            f"reference and deformed lie on different grids: {different}; resample deformed to the grid of the reference with "
            f"naibu.imaging.resampled_to_grid.{units}"
        )
    known = np.isfinite(reference.values)
    if not (known & np.isfinite(deformed.values)).any():
        raise InputError("reference and deformed do not overlap: no voxel is known in both; check the transform that registered them")
    shift = float(np.mean(reference.values, dtype=np.float64, where=known))
    a, b = shifted_intensity(reference.values, shift, "reference"), shifted_intensity(deformed.values, shift, "deformed")
    for values, name in ((a, "reference"), (b, "deformed")):
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        if low == high:
            raise InputError(f"the {name} volume is constant (every voxel is {low + shift:g}): there is nothing to match")
    return a, b


def shifted_intensity(values: AnyArray, shift: float, name: str) -> Float32Array:
    """Return values less a shift, in single precision; NaN where unknown.

    Raises
    ------
    InputError
        Infinite values.
    """
    shifted = np.asarray(values - shift, dtype=np.float32)
    if np.isinf(shifted).any():
        raise InputError(f"the {name} volume has infinite values; mask or repair them")
    return np.ascontiguousarray(shifted)


def _power_of_ten(ratio: FloatArray) -> bool:
    exponent = np.log10(ratio)
    nearest = np.round(exponent)
    return bool(np.abs(exponent - nearest).max() < 1e-3 and (nearest != 0).all())


def to_millimetres(move: AnyFloatArray, grid: Volume) -> FloatArray:
    """Return displacements (nz, ny, nx, 3), mm, of displacements (3, nz, ny, nx) in voxels along the axes of a grid."""
    return np.asarray(np.moveaxis(np.asarray(move, dtype=float), 0, -1) * grid.spacing_mm @ grid.direction.T)


def to_voxels(displacement: AnyFloatArray, grid: Volume) -> Float32Array:
    """Return displacements (3, nz, ny, nx) in voxels along the axes of a grid, of displacements (nz, ny, nx, 3), mm."""
    if displacement.shape != (*grid.shape, 3):
        raise InputError(f"displacement must have shape {(*grid.shape, 3)} (z, y, x, component), mm, not {displacement.shape}")
    return np.ascontiguousarray(np.moveaxis(displacement @ grid.direction / grid.spacing_mm, -1, 0), dtype=np.float32)
