"""Relate two mammographic views: outlines in files to a page with both views, the epipolar curve, and the place of a lesion."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from naibu._version import __version__
from naibu.applications.mammography.breast_outline import BreastOutline, breast_outline, mask_outline
from naibu.applications.mammography.epipolar import EpipolarCurve, LesionPosition, MammographicPair, ModelUncertainty, mammographic_pair
from naibu.applications.mammography.geometric_model import CompressionParameters
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.io.files.atomic import write_atomically
from naibu.io.images import read_volume
from naibu.io.number_table import read_numbers
from naibu.viewer.chapter import Chapter, Figure, Section
from naibu.viewer.chapter_page import chapter_html
from naibu.viewer.tables import Cell, Table
from naibu.workflows.applications.mammography_figures import draw_breast, draw_views
from naibu.workflows.output_folder import output_folder

NOTICE = "Research software, not a medical device: not for diagnosis, biopsy or treatment."
_NAME = "mammography"
_MASKS = (".tif", ".tiff", ".mha", ".nrrd", ".nii")


@dataclass(frozen=True, slots=True, eq=False)
class MammographyRun:
    """What was found and written.

    Attributes
    ----------
    files : tuple of Path
        Page and numbers.
    rows : tuple of (str, str)
        The results in words.
    warnings : tuple of str
        What a reader must know.
    """

    files: tuple[Path, ...]
    rows: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]


def relate_views(
    cc: str | os.PathLike[str],
    mlo: str | os.PathLike[str],
    *,
    thickness_mm: Sequence[float],
    angle_deg: float,
    out: str | os.PathLike[str],
    point_cc: Sequence[float] | None = None,
    point_mlo: Sequence[float] | None = None,
    pixel_mm: float | None = None,
    draws: int = 100,
    seed: int = 0,
    overwrite: bool = False,
) -> MammographyRun:
    """Relate points of two views; write ``mammography.html`` and ``mammography.json``.

    Parameters
    ----------
    cc, mlo : path-like
        Outlines: tables of points in mm, perpendicular to the chest wall and along it (laterally in CC, upwards in MLO), or masks.
    thickness_mm : sequence of float
        Distance of the plates, or one for CC and one for MLO.
    angle_deg : float
        Positioner angle of MLO against CC.
    out : path-like
        Folder of the files.
    point_cc, point_mlo : sequence of float, optional
        A point in each view, in the coordinates of the outlines: at least one.
    pixel_mm : float, optional
        Size of a pixel of masks.
    draws, seed : int
        Models drawn from the uncertainty, and the seed of the random numbers.
    overwrite : bool
        Whether results that the folder holds are replaced.

    Raises
    ------
    InputError
        No point, files that are no outlines, values that cannot be, outlines or points that do not fit together, or a folder that cannot be
        written to or holds results.
    """
    if point_cc is None and point_mlo is None:
        raise InputError("point_cc is missing: give a point in CC, in MLO, or in both")
    if len(thickness_mm) not in (1, 2):
        raise InputError(f"thickness_mm has {len(thickness_mm)} values: needs one, or one for CC and one for MLO")
    folder = output_folder(out, [f"{_NAME}.html", f"{_NAME}.json"], overwrite=overwrite)
    outlines = _outline(cc, pixel_mm), _outline(mlo, pixel_mm)
    plates = float(thickness_mm[0]), float(thickness_mm[-1])
    pair = mammographic_pair(*outlines, plates, angle_deg, draws=draws, seed=seed)
    places = _place(outlines[0], "point_cc", point_cc), _place(outlines[1], "point_mlo", point_mlo)
    curves = tuple(
        None if place is None else pair.epipolar_curve(place, from_view=view) for view, place in zip(("CC", "MLO"), places, strict=True)
    )
    lesion = None if places[0] is None or places[1] is None else pair.lesion(places[0], places[1])
    found = _Found(pair, places, (curves[0], curves[1]), lesion)
    settings: dict[str, Cell] = {
        "CC": os.fspath(cc), "MLO": os.fspath(mlo), "thickness_mm": ", ".join(f"{t:g}" for t in plates), "angle_deg": angle_deg,
        "draws": draws, "draws without a breast": pair.refused, "seed": seed,
    }  # fmt: skip
    chapter = Chapter(_NAME, "One point in two mammographic views", _sections(found), settings)
    numbers = {"naibu": __version__, "notice": NOTICE, "settings": settings, **_numbers(found)}
    page = write_atomically(folder / f"{_NAME}.html", chapter_html(chapter))
    table = write_atomically(folder / f"{_NAME}.json", json.dumps(numbers, indent=1, allow_nan=False) + "\n")
    return MammographyRun((page, table), tuple(_rows(found)), tuple(_warnings(found)))


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    pair: MammographicPair
    places: tuple[FloatArray | None, FloatArray | None]
    curves: tuple[EpipolarCurve | None, EpipolarCurve | None]
    lesion: LesionPosition | None


def _outline(source: str | os.PathLike[str], pixel_mm: float | None) -> BreastOutline:
    path = Path(source)
    if path.suffix.lower() == ".png":
        raise InputError(f"{path}: PNG files are not read; save the mask as TIFF, or the outline as CSV in mm")
    if path.suffix.lower() not in _MASKS:
        return breast_outline(read_numbers(path, ("mm perpendicular to the chest wall", "mm along it")), what=str(path))
    if pixel_mm is not None and not (np.isfinite(pixel_mm) and pixel_mm > 0.0):
        raise InputError(f"pixel_mm is {pixel_mm:g}: must be greater than 0, the size of a pixel in mm")
    if pixel_mm is None and path.suffix.lower() in _MASKS[:2]:
        raise InputError(f"pixel_mm is missing: {path} is a TIFF mask, so its size of a pixel in mm is needed")
    volume = read_volume(path, spacing_mm=None if pixel_mm is None else (pixel_mm, pixel_mm, 1.0))
    if len(volume.values) != 1:
        raise InputError(f"{path}: has {len(volume.values)} slices; a mask of a view has one")
    x_mm, y_mm = (float(s) for s in volume.spacing_mm[:2])
    if abs(x_mm - y_mm) > 1e-3 * x_mm:
        raise InputError(f"{path}: its pixels are {x_mm:g} x {y_mm:g} mm; they must be square")
    return mask_outline(volume.values[0], x_mm, what=str(path))


def _place(outline: BreastOutline, name: str, point: Sequence[float] | None) -> FloatArray | None:
    if point is None:
        return None
    if len(point) != 2 or not np.isfinite(point).all():
        raise InputError(f"{name} is {tuple(point)}: needs two finite coordinates, mm")
    return outline.from_image(point)


def _rows(found: _Found) -> list[tuple[str, str]]:
    nominal = found.pair.nominal
    rows = [
        ("volume of the breast", f"{1e-3 * nominal.shape.volume_mm3:.0f} cm^3"),
        *((f"stretch of the outline in {name}, along the chest wall and away from it", f"{s.silhouette[0]:.3f}, {s.silhouette[1]:.3f}")
          for name, s in (("CC", nominal.cc), ("MLO", nominal.mlo))),
    ]  # fmt: skip
    for k, other in enumerate(("MLO", "CC")):
        curve = found.curves[k]
        if curve is not None:
            ends = found.pair.outlines[1 - k].to_image(curve.curve[[0, -1]])
            told = " to ".join(f"({e[0]:.1f}, {e[1]:.1f})" for e in ends)
            rows.append((f"epipolar curve in {other}", f"from {told} mm"))
    if found.lesion is not None:
        axes = ("laterally from the nipple", "upwards from the nipple", "from the chest wall")
        for axis, value, low, high in zip(axes, found.lesion.position, found.lesion.low, found.lesion.high, strict=True):
            rows.append((f"lesion in the unloaded breast, {axis}", f"{value:.1f} mm ({low:.1f} to {high:.1f})"))
        rows.append(("distance of the MLO point from the curve", f"{found.lesion.mismatch_mm:.1f} mm"))
    return rows


def _warnings(found: _Found) -> list[str]:
    told = [NOTICE]
    if found.lesion is not None and not found.lesion.agrees:
        told.append("The MLO point lies outside of the band of the CC point: the points may not show one lesion; do not use the position.")
    if found.pair.refused:
        told.append(f"{found.pair.refused} of the models drawn gave no breast with these outlines and were left out.")
    return told


def _numbers(found: _Found) -> dict[str, Any]:
    numbers: dict[str, Any] = {"results": dict(_rows(found)), "warnings": _warnings(found)}
    for k, other in enumerate(("mlo", "cc")):
        curve, outline = found.curves[k], found.pair.outlines[1 - k]
        if curve is not None:
            numbers[f"curve_in_{other}_mm"] = outline.to_image(curve.curve).round(3).tolist()
            numbers[f"band_in_{other}_mm"] = outline.to_image(curve.band).round(3).tolist()
            numbers[f"unloaded_points_of_curve_in_{other}_mm"] = curve.points.round(3).tolist()
    if found.lesion is not None:
        numbers["lesion"] = {
            "position_mm": found.lesion.position.tolist(),
            "low_mm": found.lesion.low.tolist(),
            "high_mm": found.lesion.high.tolist(),
            "mismatch_mm": found.lesion.mismatch_mm,
            "agrees": found.lesion.agrees,
        }
    return numbers


def _sections(found: _Found) -> tuple[Section, ...]:
    views = Figure(
        "Views",
        "Outlines, points, epipolar curves and the bands that hold the true place with 95 % probability, if the "
        "stated uncertainty is true.",
        lambda canvas: draw_views(canvas, found.pair.outlines, found.places, found.curves),
        (9.0, 4.6),
    )
    curve = found.curves[0] or found.curves[1]
    lesion = None if found.lesion is None else found.lesion.position
    breast = Figure(
        "Unloaded breast",
        "From the front and from the side, with the points that the curve stands for.",
        lambda canvas: draw_breast(canvas, found.pair.nominal.shape, curve, lesion),
        (9.0, 4.0),
    )
    results = Table("Results", ("quantity", "value"), tuple(_rows(found)), caption="Intervals are of 95 %.")
    return (
        Section("Notice", tuple(_warnings(found))),
        Section("Both views", (), (results,), (views, breast)),
        Section("Assumptions", _ASSUMPTIONS, (_assumed(),)),
    )


_ASSUMPTIONS = (
    "Sections perpendicular to the chest wall deform in their plane and bend outwards; the outline of the "
    "compressed breast is scaled back so "
    "that the volume keeps its stated ratio; sections of the unloaded breast parallel to the chest wall are "
    "ellipses; x-rays are parallel; the "
    "nipple is the deepest point of each outline and lies on the axis of rotation.",
    "Tissue is not told apart: heterogeneity, gravity and positioning are in the unresolved displacement.",
)


def _assumed() -> Table:
    values, sds = CompressionParameters(), ModelUncertainty()
    rows: tuple[tuple[Cell, ...], ...] = (
        ("volume, compressed / unloaded", values.volume_ratio, sds.volume_ratio),
        ("part of the growth along the chest wall", values.along_share, sds.along_share),
        ("bending of the sections", values.bending, sds.bending),
        ("positioner angle, degrees", None, sds.angle_deg),
        ("distance of the plates, mm", None, sds.thickness_mm),
        ("unresolved displacement in each direction of a view, mm", 0.0, sds.unresolved_mm),
    )
    return Table(
        "Parameters", ("parameter", "value", "standard deviation"), rows, caption="Stated, not fitted; drawn for each view by itself."
    )
