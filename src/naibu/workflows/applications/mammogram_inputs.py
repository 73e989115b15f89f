"""Inputs of ``naibu mammography``: outlines, masks or DICOM mammograms of both views, and what their tags tell."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from naibu.applications.mammography.breast_from_mr import ScannedBreast, breast_in_scan
from naibu.applications.mammography.breast_from_projections import ProjectedBreast, breast_in_projections
from naibu.applications.mammography.breast_outline import BreastOutline, breast_outline, mask_outline
from naibu.applications.mammography.breast_segmentation import breast_mask
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.io.image_formats.dicom import is_dicom
from naibu.io.images import read_volume
from naibu.io.mammograms import Mammogram, read_mammogram
from naibu.io.tables.number_table import read_numbers

_WITHOUT_SIZE = (".png", ".tif", ".tiff")
_MASKS = (*_WITHOUT_SIZE, ".mha", ".nrrd", ".nii")
_DICOM = (".dcm", ".dicom", ".ima")
PathLike = str | os.PathLike[str]


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One view as it was given.

    Attributes
    ----------
    source : Path
        The file.
    outline : BreastOutline
        Of the breast in it.
    mammogram : Mammogram or None
        The image and its tags, where the file is a mammogram.
    """

    source: Path
    outline: BreastOutline
    mammogram: Mammogram | None


def read_views(cc: PathLike, mlo: PathLike, pixel_mm: float | None) -> tuple[View, View]:
    """Read both views, and check that mammograms show what they are given as, of one breast.

    Raises
    ------
    InputError
        Files that are no outlines, views that are swapped, or two sides.
    """
    views = _view(cc, "CC", pixel_mm), _view(mlo, "MLO", pixel_mm)
    sides = {v.mammogram.laterality for v in views if v.mammogram is not None}
    if len(sides) > 1:
        raise InputError(
            f"{views[0].source} and {views[1].source} show the left and the right breast by their ImageLaterality; give one breast"
        )
    return views


def plate_distances(views: tuple[View, View] | None, given: Sequence[float] | None) -> tuple[float, float]:
    """Return the distances of the plates, mm, as given, else from the tags.

    Raises
    ------
    InputError
        Another number of values than one or two, or none and no tags.
    """
    if given is not None:
        if len(given) not in (1, 2):
            raise InputError(f"thickness_mm has {len(given)} values: needs one, or one for CC and one for MLO")
        return float(given[0]), float(given[-1])
    found = []
    for view in views or ():
        stated = None if view.mammogram is None else view.mammogram.thickness_mm
        if stated is None:
            raise InputError(
                f"thickness_mm is missing, and {view.source} has no BodyPartThickness (0018,11A0): give the distance of the plates"
            )
        found.append(stated)
    if not found:
        raise InputError("thickness_mm is missing: give the distance of the plates")
    return found[0], found[1]


def positioner_angle(views: tuple[View, View] | None, given: float | None) -> float:
    """Return the angle of MLO against CC, degrees, as given, else from the tags.

    Tags state the angle of each view; where CC has none, it is taken as 0. Signs and whole turns differ between makers: 315 is -45.

    Raises
    ------
    InputError
        None is given, and there are no tags.
    """
    if given is not None:
        return given
    stated = None if views is None or views[1].mammogram is None else views[1].mammogram.angle_deg
    if stated is None:
        where = "" if views is None else f", and {views[1].source} has no PositionerPrimaryAngle (0018,1510)"
        raise InputError(f"angle_deg is missing{where}: give the positioner angle of MLO against CC")
    of_cc = 0.0 if views is None or views[0].mammogram is None else views[0].mammogram.angle_deg or 0.0
    return abs((stated - of_cc + 180.0) % 360.0 - 180.0)


def read_scan(mask: PathLike, side: str | None, views: tuple[View, View] | None) -> ScannedBreast:
    """Read the mask of a breast in a magnetic resonance volume.

    Raises
    ------
    InputError
        No side and no tags that tell it, another word than left or right, or no breast in the mask.
    """
    told = None if views is None else next((v.mammogram.laterality for v in views if v.mammogram is not None), None)
    wanted = side or {"L": "left", "R": "right"}.get(told or "")
    if wanted not in ("left", "right"):
        raise InputError(f"side is {side!r}: must be 'left' or 'right', as the mask of a scan does not tell it")
    if told is not None and wanted != {"L": "left", "R": "right"}[told]:
        raise InputError(f"side is {side!r}, and the mammograms show the other breast by their ImageLaterality")
    return breast_in_scan(read_volume(mask), left=wanted == "left", what=str(mask))


def read_projections(axial: PathLike, sagittal: PathLike, pixel_mm: float | None) -> ProjectedBreast:
    """Read the outlines of a breast in the axial and the sagittal projection of a magnetic resonance volume.

    Raises
    ------
    InputError
        Files that are no outlines, or outlines that do not fit together.
    """
    return breast_in_projections(_outline(Path(axial), pixel_mm), _outline(Path(sagittal), pixel_mm))


def place_in(outline: BreastOutline, name: str, point: Sequence[float] | None) -> FloatArray | None:
    """Return a point of an image as depth and position along the chest wall, mm.

    Raises
    ------
    InputError
        Not two finite coordinates.
    """
    if point is None:
        return None
    if len(point) != 2 or not np.isfinite(point).all():
        raise InputError(f"{name} is {tuple(point)}: needs two finite coordinates, mm")
    return outline.from_image(point)


def _view(source: PathLike, name: str, pixel_mm: float | None) -> View:
    path = Path(source)
    other = "MLO" if name == "CC" else "CC"
    words = set(re.split("[^A-Z]+", path.stem.upper()))
    if words & {other, f"L{other}", f"R{other}"} and not words & {name, f"L{name}", f"R{name}"}:
        raise InputError(f"{path}: is named as a view {other}, given as {name}: are the views swapped? If they are not, rename the file")
    if path.suffix.lower() in _DICOM or is_dicom(path):
        mammogram = read_mammogram(path)
        if mammogram.view != name:
            raise InputError(f"{path}: is a {mammogram.view} view by its ViewPosition, given as {name}: are the views swapped?")
        mask = breast_mask(mammogram.pixels, mammogram.pixel_mm, wall_at_right=mammogram.wall_at_right, what=str(path))
        return View(path, mask_outline(mask, mammogram.pixel_mm, what=str(path)), mammogram)
    return View(path, _outline(path, pixel_mm), None)


def _outline(path: Path, pixel_mm: float | None) -> BreastOutline:
    if path.suffix.lower() not in _MASKS:
        return breast_outline(read_numbers(path, ("mm perpendicular to the chest wall", "mm along it")), what=str(path))
    if pixel_mm is not None and not (np.isfinite(pixel_mm) and pixel_mm > 0.0):
        raise InputError(f"pixel_mm is {pixel_mm:g}: must be greater than 0, the size of a pixel in mm")
    if pixel_mm is None and path.suffix.lower() in _WITHOUT_SIZE:
        raise InputError(f"pixel_mm is missing: {path} is a mask without a stated size of a pixel in mm")
    volume = read_volume(path, spacing_mm=None if pixel_mm is None else (pixel_mm, pixel_mm, 1.0))
    if len(volume.values) != 1:
        raise InputError(f"{path}: has {len(volume.values)} slices; a mask of a view has one")
    x_mm, y_mm = (float(s) for s in volume.spacing_mm[:2])
    if abs(x_mm - y_mm) > 1e-3 * x_mm:
        raise InputError(f"{path}: its pixels are {x_mm:g} x {y_mm:g} mm; they must be square")
    return mask_outline(volume.values[0], x_mm, what=str(path))
