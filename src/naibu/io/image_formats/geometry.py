"""Helpers of the image readers: volume geometry from axes and spacings, units of length, checks of array dimensions."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import AnyArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.volume import NEARLY, Volume

MM_PER_UNIT = {"m": 1e3, "cm": 10.0, "mm": 1.0, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "nm": 1e-6, "inch": 25.4, "in": 25.4}
_LONG_NAMES = {
    "meter": "m",
    "metre": "m",
    "centimeter": "cm",
    "centimetre": "cm",
    "millimeter": "mm",
    "millimetre": "mm",
    "micron": "um",
    "micrometer": "um",
    "micrometre": "um",
    "nanometer": "nm",
    "nanometre": "nm",
}
# x and y increase towards left and posterior in LPS, towards right and anterior in RAS
FLIP_RAS = np.diag([-1.0, -1.0, 1.0])


class ReadOptions(NamedTuple):
    """Options of the reader, given by the user.

    Attributes
    ----------
    unit_mm : float or None
        Length of the file's unit, mm; None takes the unit that the file states, else mm.
    spacing_mm : ndarray, shape (3,), or None
        Voxel spacing along x, y, z, mm, for files that do not state it.
    series : str or None
        UID or description of the series to read from a DICOM folder.
    rescaled : bool
        Whether to apply the rescale slope and intercept of the file.
    """

    unit_mm: float | None = None
    spacing_mm: FloatArray | None = None
    series: str | None = None
    rescaled: bool = False


def unit_length(source: str, name: str) -> float:
    """Return the length of a unit, mm, by any of its usual names.

    Raises
    ------
    InputError
        The name is not a known unit of length.
    """
    short = name.strip().strip('"').lower()
    singular = short[:-1] if short.endswith("s") and len(short) > 2 else short
    key = _LONG_NAMES.get(singular, singular)
    if key not in MM_PER_UNIT:
        raise InputError(f"{source}: states its lengths in {name!r}, which is not a known unit; give unit_mm, its length in mm")
    return MM_PER_UNIT[key]


def volume_with_axes(source: str, values: ArrayLike, origin: ArrayLike, axes: ArrayLike, unit_mm: float = 1.0) -> Volume:
    """Return a volume from its values, of which some may be NaN, the centre of the first voxel and the voxel axes.

    Parameters
    ----------
    source : str
        Name of the file, for errors.
    values : array_like, shape (nz, ny, nx)
        Intensities.
    origin : array_like, shape (3,)
        Centre of the first voxel, LPS, in the file's unit.
    axes : array_like, shape (3, 3)
        Columns are the offsets to the next voxel along x, y, z, LPS, in the file's unit.
    unit_mm : float
        Length of the file's unit, mm.

    Raises
    ------
    InputError
        Axes of zero length, sheared axes (slices that are not orthogonal), or values that do not form a volume.
    """
    steps = np.asarray(axes, dtype=float)
    spacing = np.linalg.norm(steps, axis=0)
    if not (np.isfinite(steps).all() and (spacing > 0.0).all()):
        raise InputError(f"{source}: the voxel spacing is {spacing.tolist()} along x, y, z; the geometry stored in the file is damaged")
    direction = steps / spacing
    skew = np.abs(direction.T @ direction - np.eye(3))
    if skew.max() > NEARLY:
        degrees = np.degrees(np.arcsin(min(float(skew.max()), 1.0)))
        raise InputError(
            f"{source}: the angle between its axes is {90.0 - degrees:.2f} degrees instead of 90 (slices that are not orthogonal, as with "
            "a tilted gantry); resample it to orthogonal slices first"
        )
    try:
        return Volume.from_array(
            values, spacing_mm=spacing * unit_mm, origin_mm=np.asarray(origin, dtype=float) * unit_mm,
            direction=nearest_rotation(direction), missing=True,
        )  # fmt: skip
    except InputError as error:
        raise InputError(f"{source}: {error}") from error


def nearest_rotation(direction: FloatArray) -> FloatArray:
    """Return the orthonormal axes (3, 3) nearest to axes that a file stores rounded; exact ones are unchanged."""
    if np.abs(direction.T @ direction - np.eye(3)).max() < 1e-12:
        return direction
    u, _, vt = np.linalg.svd(direction)
    return np.asarray(u @ vt)


def three_axes(source: str, values: AnyArray) -> AnyArray:
    """Return values of shape (nz, ny, nx); leading axes of length one are removed, a plane becomes one slice.

    Raises
    ------
    InputError
        Several time points, echoes or channels.
    """
    v = values
    while v.ndim > 3 and v.shape[0] == 1:
        v = v[0]
    if v.ndim == 2:
        v = v[None]
    if v.ndim != 3:
        raise InputError(
            f"{source}: has {values.ndim} axes with {values.shape[::-1]} samples (several time points, echoes or channels); "
            "save one of them as a volume of its own"
        )
    return v


def no_colours(source: str, samples: int, what: str = "colour samples per voxel") -> None:
    """Raise an error for more than one sample per voxel.

    Raises
    ------
    InputError
        `samples` is not one.
    """
    if samples != 1:
        raise InputError(f"{source}: has {samples} {what} (RGB or vectors), not one intensity; convert it to greyscale first")


def without_header(path: Path) -> InputError:
    """Return the error of a file of values without a header, which says what header to write."""
    return InputError(
        f"{path.name}: holds values without a header; write a text file {path.stem}.mhd beside it with the lines NDims = 3, "
        "DimSize = nx ny nz, ElementSpacing = dx dy dz (mm), ElementType = MET_SHORT (or MET_USHORT, MET_UCHAR, MET_FLOAT), "
        f"ElementByteOrderMSB = False, ElementDataFile = {path.name}, and read that"
    )
