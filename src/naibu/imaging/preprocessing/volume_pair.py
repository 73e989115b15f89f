"""Checks of a pair of volumes before they are compared, and their intensities in single precision."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import AnyArray, AnyFloatArray, Float32Array, FloatArray
from naibu.core.errors import InputError
from naibu.core.volume import NEARLY, Volume
from naibu.imaging.preprocessing.field_of_view import Box
from naibu.imaging.preprocessing.resampling import covered, on_voxels_of

PLANES = 128  # along every axis, whose crossings tell which part of a volume lies inside of another
LOST_SHARE = 0.005  # of the reference's voxels, from which the part outside of the deformed scan is told


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
    require_one_grid(reference, deformed)
    known = np.isfinite(reference.values)
    if not (known & np.isfinite(deformed.values)).any():
        raise InputError("reference and deformed do not overlap: no voxel is known in both; check the transform that registered them")
    shift = float(np.mean(reference.values, dtype=np.float64, where=known))
    a, b = shifted_intensity(reference.values, shift, "reference"), shifted_intensity(deformed.values, shift, "deformed")
    for values, volume, name in ((a, reference, "reference"), (b, deformed, "deformed")):
        if np.nanmin(values) == np.nanmax(values):
            require_contrast(volume, name)
            raise InputError(
                f"the intensities of the reference and the deformed volume lie too far apart: less {shift:.3g}, the mean of the reference, "
                f"the {name} volume has no contrast left; repair damaged voxels"
            )
    return a, b


def require_one_grid(reference: Volume, deformed: Volume) -> None:
    """Refuse volumes on different grids; spacings that differ by a power of ten are told as what they are likely to be.

    Raises
    ------
    InputError
        Such volumes.
    """
    if different := reference.grid_difference(deformed):
        ratio = deformed.spacing_mm / reference.spacing_mm
        units = " Their spacings differ by a power of ten: was one stored in other units?" if _power_of_ten(ratio) else ""
        raise InputError(
            f"reference and deformed lie on different grids: {different}; resample one to the grid of the other (in Python by "
            f"naibu.imaging.resampled_to_grid).{units}"
        )


def on_reference_grid(reference: Volume, deformed: Volume) -> tuple[Volume, str]:
    """Return the deformed volume at the voxels of the reference, by the positions that both state, and a sentence that says so.

    Returns
    -------
    deformed : Volume
        NaN where a voxel lies outside of the deformed volume; itself where it is on the grid of the reference.
    told : str
        See `other_grid`.

    Raises
    ------
    InputError
        As `other_grid`.
    """
    told = other_grid(reference, deformed)
    return (on_voxels_of(deformed, reference) if told else deformed), told


def other_grid(reference: Volume, deformed: Volume) -> str:
    """Say what distinguishes the grid of the deformed volume from that of the reference, and what is done; nothing for one grid.

    Raises
    ------
    InputError
        As many voxels of another spacing, or spacings that differ by a power of ten, of which one is likely to be wrong.
        No overlap.
    """
    different = reference.grid_difference(deformed)
    if not different:
        return ""
    ratio = deformed.spacing_mm / reference.spacing_mm
    parallel = np.abs(reference.direction - deformed.direction).max() < NEARLY
    if parallel and reference.shape == deformed.shape and np.abs(ratio - 1.0).max() > NEARLY and not _power_of_ten(ratio):
        raise InputError(
            f"reference and deformed have as many voxels, but {different}: one of the files is likely to state a wrong spacing, or other "
            "units; correct it, give spacing_mm for both, or resample the deformed scan to the grid of the reference"
        )
    if _power_of_ten(ratio):
        require_one_grid(reference, deformed)
    outside = _outside(reference, deformed)
    if outside == 1.0:
        raise InputError("volume and grid do not overlap: no voxel of the grid lies inside the volume; check their origins and units")
    lost = f"; {100.0 * outside:.0f} % of its voxels lie outside of the deformed scan" if outside > LOST_SHARE else ""
    return (
        f"the deformed scan lies on another grid ({different}): it was resampled to the grid of the reference by the positions that both "
        f"files state{lost}. If one of them states a wrong position, all displacements are wrong by the same shift"
    )


def _outside(reference: Volume, deformed: Volume) -> float:
    """Return which part of the voxels of the reference, those of evenly spread planes, lies outside of the deformed volume."""
    count = np.minimum(reference.shape, PLANES)
    step = (np.array(reference.shape) - 1) / np.maximum(count - 1, 1)
    spread = Volume(np.broadcast_to(np.False_, count), reference.spacing_mm * step[::-1], reference.origin_mm, reference.direction)
    return 1.0 - float(covered(deformed, spread).mean())


def require_contrast(volume: Volume, name: str) -> None:
    """Refuse a volume of one intensity, or without a voxel that is known.

    Raises
    ------
    InputError
        Such a volume.
    """
    values = np.asarray(volume.values)
    if values.dtype.kind == "f" and np.isnan(values).all():
        raise InputError(f"the {name} volume shows nothing: every voxel is NaN; check the file")
    low, high = float(np.fmin.reduce(values, axis=None)), float(np.fmax.reduce(values, axis=None))
    if low == high:
        raise InputError(f"the {name} volume is constant (every voxel is {low:g}): there is nothing to match; check the file")


def require_known(volume: Volume, view: Box, name: str, every: int = 1) -> None:
    """Refuse a volume that shows nothing, or whose field of view has holes.

    Parameters
    ----------
    volume : Volume
        NaN where it was not measured.
    view : tuple of slice
        Its field of view (see `naibu.imaging.preprocessing.field_of_view`).
    name : str
        What messages call it.
    every : int
        Voxels along an edge of those whose means are given.

    Raises
    ------
    InputError
        No voxel that is known, one intensity, or voxels of the field of view that are NaN.
    """
    require_contrast(volume, name)
    values = np.asarray(volume.values)
    if values.dtype.kind == "f" and (holes := np.isnan(values[view])).any():
        bad = tuple(int(i + (s.start or 0)) * every for i, s in zip(np.argwhere(holes)[0], view, strict=True))
        which = "voxel" if every == 1 else "a voxel near"
        raise InputError(
            f"{which} {bad} (z, y, x) of the {name} volume is NaN; crop the volumes, or fill unknown voxels with the intensity of air"
        )


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
