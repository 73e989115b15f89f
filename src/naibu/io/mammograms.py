"""Mammograms in DICOM files: pixels as they are hung, and what the tags tell of view, plates and spacing (PS3.3, C.8.11.3 and C.8.11.7)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.optional_packages import optional_package


@dataclass(frozen=True, slots=True, eq=False)
class Mammogram:
    """One mammogram.

    Attributes
    ----------
    pixels : ndarray, shape (rows, columns)
        Intensities, greater where more was absorbed or less, with the lateral (CC) or upper (MLO) side of the breast up.
    pixel_mm : float
        Size of a pixel in the breast: the detector's by the magnification, where the file states that.
    view : str
        ``"CC"`` or ``"MLO"``.
    laterality : str
        ``"L"`` or ``"R"``.
    thickness_mm, angle_deg : float or None
        Distance of the plates, and positioner angle, where the file states them.
    wall_at_right : bool or None
        On which side of the image the chest wall lies, where the file states that.
    """

    pixels: FloatArray
    pixel_mm: float
    view: str
    laterality: str
    thickness_mm: float | None
    angle_deg: float | None
    wall_at_right: bool | None


def read_mammogram(path: str | os.PathLike[str]) -> Mammogram:
    """Read a mammogram.

    Raises
    ------
    InputError
        No DICOM file, another image than a CC or MLO mammogram, or tags that are missing.
    """
    name = Path(path).name
    pydicom = optional_package("pydicom", f"{name}: reading DICOM files")
    try:
        data = pydicom.dcmread(path)
    except (pydicom.errors.InvalidDicomError, OSError) as error:
        raise InputError(f"{path}: is not readable as DICOM ({error}); check the path") from error
    view = str(data.get("ViewPosition") or "").upper()
    if not view:
        raise InputError(f"{path}: has no ViewPosition (0018,5101), so its view is unknown; give its mask or outline instead")
    if view not in ("CC", "MLO"):
        raise InputError(f"{path}: is a {view} view by its ViewPosition; CC and MLO are needed")
    laterality = str(data.get("ImageLaterality") or data.get("Laterality") or "").upper()
    if laterality not in ("L", "R"):
        raise InputError(f"{path}: has no ImageLaterality (0020,0062), so the side is unknown; give its mask or outline instead")
    orientation = [str(v).upper() for v in data.get("PatientOrientation") or ()]
    return Mammogram(
        _pixels(path, data, _upside_down(view, laterality, orientation)),
        _pixel_mm(path, data),
        view,
        laterality,
        _number(data, "BodyPartThickness"),
        _number(data, "PositionerPrimaryAngle"),
        None if not orientation else orientation[0].startswith("P"),
    )


def _pixels(path: str | os.PathLike[str], data: Any, upside_down: bool) -> FloatArray:
    try:
        stored = np.asarray(data.pixel_array, dtype=float)
    except Exception as error:  # pydicom raises what its decoders raise
        raise InputError(f"{path}: its pixels cannot be decoded ({error}); export it uncompressed") from error
    if stored.ndim != 2:
        raise InputError(f"{path}: has pixels of shape {stored.shape}; a mammogram has one plane of intensities")
    return stored[::-1] if upside_down else stored


def _pixel_mm(path: str | os.PathLike[str], data: Any) -> float:
    spacing = data.get("ImagerPixelSpacing") or data.get("PixelSpacing")
    if spacing is None:
        raise InputError(f"{path}: has no ImagerPixelSpacing (0018,1164), so its scale is unknown; give its mask with pixel_mm instead")
    down, across = (float(v) for v in spacing)
    if not (np.isfinite(down) and down > 0.0 and abs(down - across) <= 1e-3 * down):
        raise InputError(f"{path}: its pixels are {across:g} x {down:g} mm; they must be square")
    magnification = _number(data, "EstimatedRadiographicMagnificationFactor")
    return down / magnification if magnification and magnification >= 1.0 else down


def _upside_down(view: str, laterality: str, orientation: list[str]) -> bool:
    """Return whether the side that should be up lies below, by the direction of the columns."""
    if len(orientation) < 2:
        return False
    down = orientation[1]
    return down.startswith(laterality) if view == "CC" else down.startswith("H")


def _number(data: Any, tag: str) -> float | None:
    value = data.get(tag)
    if value is None or value == "":
        return None
    number = float(value)
    return number if np.isfinite(number) else None
