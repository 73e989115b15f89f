"""Relate two mammographic views: outlines in files to a page with both views, the epipolar curve, and the place of a lesion."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from naibu._version import __version__
from naibu.applications.mammography.breast_from_mr import ScannedBreast
from naibu.applications.mammography.breast_from_projections import ProjectedBreast
from naibu.applications.mammography.epipolar import (
    DEFAULT_UNCERTAINTY,
    EpipolarCurve,
    LesionPosition,
    MammographicPair,
    Model,
    ModelUncertainty,
    Projection,
)
from naibu.applications.mammography.geometric_model import CompressionParameters
from naibu.applications.mammography.mechanical_model import MechanicalParameters
from naibu.applications.mammography.pair_construction import mammographic_pair, pair_of_shape
from naibu.applications.mammography.view_order import may_be_swapped
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.io.files.atomic import write_atomically
from naibu.viewer.cards import Card
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.chapters.chapter_page import chapter_html
from naibu.viewer.notebook import WrittenResult
from naibu.viewer.tables import Cell, Table
from naibu.workflows.applications.mammogram_inputs import (
    place_in,
    plate_distances,
    positioner_angle,
    read_projections,
    read_scan,
    read_views,
)
from naibu.workflows.applications.mammography_figures import draw_breast, draw_views
from naibu.workflows.applications.mammography_motion import breast_page
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

NOTICE = "Research software, not a medical device: not for diagnosis, biopsy or treatment."
_SWAPPED = (
    "More of the breast lies laterally of the nipple in CC than above it in MLO, as where the views are swapped or hung upside down: check "
    "both files. The fit of the outlines does not tell: both orders fit alike."
)
_NAME = "mammography"
_BREAST = "breast.html"
_SHOWN = 9  # points of a curve in the 3-D view


@dataclass(frozen=True, slots=True, eq=False)
class MammographyRun(WrittenResult):
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

    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return one row a result: quantity, and value in words."""
        return tuple({"quantity": name, "value": value} for name, value in self.rows)


@no_empty_folders()
def relate_views(
    cc: str | os.PathLike[str] | None = None,
    mlo: str | os.PathLike[str] | None = None,
    *,
    out: str | os.PathLike[str],
    thickness_mm: Sequence[float] | None = None,
    angle_deg: float | None = None,
    point_cc: Sequence[float] | None = None,
    point_mlo: Sequence[float] | None = None,
    mr: str | os.PathLike[str] | None = None,
    side: str | None = None,
    mr_axial: str | os.PathLike[str] | None = None,
    mr_sagittal: str | os.PathLike[str] | None = None,
    point_mr: Sequence[float] | None = None,
    constrain_outlines: bool = False,
    pixel_mm: float | None = None,
    model: Model = "geometric",
    unresolved_mm: float = DEFAULT_UNCERTAINTY.unresolved_mm,
    draws: int = 100,
    seed: int = 0,
    overwrite: bool = False,
) -> MammographyRun:
    """Relate points of two views, or of a scan to both; write ``mammography.html``, ``mammography.json`` and ``breast.html``.

    Parameters
    ----------
    cc, mlo : path-like, optional
        Mammograms in DICOM files; outlines: tables of points in mm, perpendicular to the chest wall and along it (laterally in CC, upwards
        in MLO); or masks. Both, or with `mr` none.
    out : path-like
        Folder of the files.
    thickness_mm : sequence of float, optional
        Distance of the plates, or one for CC and one for MLO; by default that of the tags.
    angle_deg : float, optional
        Positioner angle of MLO against CC; by default that of the tags.
    point_cc, point_mlo : sequence of float, optional
        A point in each view, in the coordinates of the outlines; of images, from the lower left corner as they are hung.
    mr : path-like, optional
        Mask of the breast in a magnetic resonance volume: the unloaded shape, instead of that which the outlines imply.
    side : {"left", "right"}, optional
        Which breast the mask holds.
    mr_axial, mr_sagittal : path-like, optional
        Outlines, or masks, of the unloaded breast in maximum intensity projections of a scan, instead of `mr`: from above (perpendicular to
        the chest wall, then laterally) and from the side (then upwards).
    point_mr : sequence of float, optional
        A point to be shown in both views, mm: in the scan, LPS; or, of projections, in the coordinates of the axial outline and with the
        second one of the sagittal outline.
    constrain_outlines : bool
        Whether the mechanical model of a scan is brought onto the outlines of `cc` and `mlo`; see `naibu.applications.pair_of_shape`.
    pixel_mm : float, optional
        Size of a pixel of masks.
    model : {"geometric", "mechanical"}
        See `naibu.applications.mammographic_pair`.
    unresolved_mm : float
        See `naibu.applications.ModelUncertainty`.
    draws, seed : int
        Models drawn from the uncertainty, and the seed of the random numbers.
    overwrite : bool
        Whether results that the folder holds are replaced.

    Raises
    ------
    InputError
        No point, files that are no outlines, values or tags that are missing or cannot be, outlines or points that do not fit together, or
        a folder that cannot be written to or holds results.
    ConvergenceError
        The mechanical model found no equilibrium.
    """
    _require_scan(mr, side, mr_axial, mr_sagittal)
    _require_points(cc, mlo, mr or mr_axial, (point_cc, point_mlo, point_mr))
    folder = output_folder(out, [f"{_NAME}.html", f"{_NAME}.json", _BREAST], overwrite=overwrite)
    views = None if cc is None or mlo is None else read_views(cc, mlo, pixel_mm)
    plates, angle = plate_distances(views, thickness_mm), positioner_angle(views, angle_deg)
    uncertainty = ModelUncertainty(unresolved_mm=unresolved_mm)
    outlines = None if views is None else (views[0].outline, views[1].outline)
    scan: ScannedBreast | ProjectedBreast | None = None if mr is None else read_scan(mr, side, views)
    if mr_axial is not None and mr_sagittal is not None:
        scan = read_projections(mr_axial, mr_sagittal, pixel_mm)
    common: dict[str, Any] = {"model": model, "uncertainty": uncertainty, "draws": draws, "seed": seed}
    if constrain_outlines and (scan is None or outlines is None):
        raise InputError("constrain_outlines needs the shape of the breast in a scan, and cc and mlo")
    if scan is not None:
        pair = pair_of_shape(scan.shape, plates, angle, outlines=outlines, constrain_outlines=constrain_outlines, **common)
    else:
        if views is None:  # refused above
            raise InputError("`cc` and `mlo` are missing: give both views, or the mask of a scan")
        pair = mammographic_pair(views[0].outline, views[1].outline, plates, angle, **common)
    found = _found(pair, (point_cc, point_mlo), None if scan is None else _scanned_point(scan, point_mr))
    untold = views is not None and any(view.mammogram is None for view in views)  # no tag says which view a file shows
    warnings = _warnings(found) + ([_SWAPPED] if untold and may_be_swapped(*pair.outlines) else [])
    settings: dict[str, Cell] = {
        "CC": str(cc), "MLO": str(mlo), "MR": str(mr) if mr_axial is None else f"{mr_axial}, {mr_sagittal}", "model": model,
        "constrained to the outlines": "yes" if constrain_outlines else "no", "thickness_mm": ", ".join(f"{t:g}" for t in plates),
        "angle_deg": angle, "unresolved_mm": unresolved_mm, "draws": draws, "draws without a breast": pair.refused, "seed": seed,
    }  # fmt: skip
    chapter = Chapter(_NAME, "One point in two mammographic views", _sections(found, warnings, model, uncertainty), settings, _cards(found))
    numbers = {"naibu": __version__, "notice": NOTICE, "settings": settings, **_numbers(found, warnings)}
    page = write_atomically(folder / f"{_NAME}.html", chapter_html(chapter))
    table = write_atomically(folder / f"{_NAME}.json", json.dumps(numbers, indent=1, allow_nan=False) + "\n")
    breast = write_atomically(folder / _BREAST, breast_page(pair.nominal, angle, found.shown, NOTICE, dict(settings)))
    return MammographyRun((page, table, breast), tuple(_rows(found)), tuple(warnings))


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    pair: MammographicPair
    places: tuple[FloatArray | None, FloatArray | None]
    curves: tuple[EpipolarCurve | None, EpipolarCurve | None]
    lesion: LesionPosition | None
    scanned: FloatArray | None
    projection: Projection | None

    @property
    def shown(self) -> FloatArray:
        """Points (k, 3) of the unloaded breast for the 3-D view."""
        if self.scanned is not None:
            return self.scanned[None]
        if self.lesion is not None:
            return self.lesion.position[None]
        curve = self.curves[0] or self.curves[1]
        return np.zeros((0, 3)) if curve is None else curve.points[:: max(1, len(curve.points) // _SHOWN)]


def _require_scan(mr: object, side: str | None, axial: object, sagittal: object) -> None:
    if (axial is None) != (sagittal is None):
        raise InputError(f"{'mr_axial' if axial is None else 'mr_sagittal'} is missing: give both projections")
    if mr is not None and axial is not None:
        raise InputError("mr is given beside mr_axial and mr_sagittal: give the mask or the projections")
    if side is not None and mr is None:
        raise InputError(f"side is {side!r}, but there is no scan: give its mask as `mr`, or leave `side` out")


def _require_points(cc: object, mlo: object, mr: object, points: tuple[object, object, object]) -> None:
    if (cc is None) != (mlo is None):
        raise InputError(f"{'cc' if cc is None else 'mlo'} is missing: give both views")
    if cc is None and mr is None:
        raise InputError("`cc` and `mlo` are missing: give both views, or the mask of a scan")
    if all(point is None for point in points):
        raise InputError("point_cc is missing: give a point in CC, in MLO, in both, or in a scan")
    if points[2] is not None and mr is None:
        raise InputError("point_mr is given without `mr`: give the mask of the breast in the scan, or mr_axial and mr_sagittal")
    if cc is None and (points[0] is not None or points[1] is not None):
        raise InputError("point_cc or point_mlo is given without cc and mlo: give both views")


def _scanned_point(scan: ScannedBreast | ProjectedBreast, point: Sequence[float] | None) -> FloatArray | None:
    if point is None:
        return None
    if len(point) != 3 or not np.isfinite(point).all():
        raise InputError(f"point_mr is {tuple(point)}: needs three finite coordinates, mm")
    return scan.from_scan(point)


def _found(pair: MammographicPair, points: tuple[Sequence[float] | None, Sequence[float] | None], scanned: FloatArray | None) -> _Found:
    places = place_in(pair.outlines[0], "point_cc", points[0]), place_in(pair.outlines[1], "point_mlo", points[1])
    curves = tuple(
        None if place is None else pair.epipolar_curve(place, from_view=view) for view, place in zip(("CC", "MLO"), places, strict=True)
    )
    lesion = None if places[0] is None or places[1] is None else pair.lesion(places[0], places[1])
    return _Found(pair, places, (curves[0], curves[1]), lesion, scanned, None if scanned is None else pair.project(scanned))


def _rows(found: _Found) -> list[tuple[str, str]]:
    nominal = found.pair.nominal
    rows = [
        ("volume of the breast", f"{1e-3 * nominal.shape.volume_mm3:.0f} cm³"),
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
        for axis, value, low, high in zip(_AXES, found.lesion.position, found.lesion.low, found.lesion.high, strict=True):
            rows.append((f"lesion in the unloaded breast, {axis}", f"{value:.1f} mm ({low:.1f} to {high:.1f})"))
        rows.append(("distance of the MLO point from the curve", f"{found.lesion.mismatch_mm:.1f} mm"))
    if found.projection is not None:
        for name, outline, place in zip(("CC", "MLO"), found.pair.outlines, found.projection.places, strict=True):
            x, y = outline.to_image(place)
            rows.append((f"point of the scan in {name}", f"({x:.1f}, {y:.1f}) mm"))
    return rows


def _cards(found: _Found) -> tuple[Card, ...]:
    cards = []
    for k, other in enumerate(("MLO", "CC")):
        curve = found.curves[k]
        if curve is not None and found.lesion is None:
            depths = curve.curve[:, 0]
            half = 0.5 * float(np.median(np.hypot(*(curve.band[: len(curve.curve)] - curve.band[::-1][: len(curve.curve)]).T)))
            cards.append(
                Card(
                    f"Epipolar curve in {other}",
                    f"{depths.min():.0f} to {depths.max():.0f} mm",
                    f"from the chest wall; the 95 % band reaches {half:.0f} mm to either side",
                )
            )
    if found.lesion is not None:
        for axis, value, low, high in zip(_AXES, found.lesion.position, found.lesion.low, found.lesion.high, strict=True):
            cards.append(Card(f"Lesion, {axis}", f"{value:.0f} mm".replace("-", "−"), f"95 % interval {low:.0f} to {high:.0f} mm"))
        agrees = "inside the band: may be one lesion" if found.lesion.agrees else "outside the band: may not be one lesion"
        cards.append(Card("MLO point from the curve", f"{found.lesion.mismatch_mm:.1f} mm", agrees))
    if found.projection is not None:
        for name, outline, place in zip(("CC", "MLO"), found.pair.outlines, found.projection.places, strict=True):
            x, y = outline.to_image(place)
            cards.append(Card(f"Point of the scan in {name}", f"({x:.0f}, {y:.0f}) mm"))
    return (*cards, Card("Volume of the breast", f"{1e-3 * found.pair.nominal.shape.volume_mm3:.0f} cm³"))


def _warnings(found: _Found) -> list[str]:
    told = [NOTICE]
    if found.lesion is not None and not found.lesion.agrees:
        told.append("The MLO point lies outside of the band of the CC point: the points may not show one lesion; do not use the position.")
    if found.pair.refused:
        told.append(f"Models drawn that gave no breast with these outlines, and were left out: {found.pair.refused}.")
    return told


def _numbers(found: _Found, warnings: list[str]) -> dict[str, Any]:
    numbers: dict[str, Any] = {"results": dict(_rows(found)), "warnings": warnings}
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
    if found.projection is not None:
        for name, outline, place, region in zip(
            ("cc", "mlo"), found.pair.outlines, found.projection.places, found.projection.regions, strict=True
        ):
            numbers[f"point_of_scan_in_{name}_mm"] = outline.to_image(place).round(3).tolist()
            numbers[f"region_in_{name}_mm"] = outline.to_image(region).round(3).tolist()
    return numbers


def _sections(found: _Found, warnings: list[str], model: str, uncertainty: ModelUncertainty) -> tuple[Section, ...]:
    views = Figure(
        "Views",
        "Outlines, points, epipolar curves and the bands that hold the true place with 95 % probability, if the "
        "stated uncertainty is true.",
        lambda canvas: draw_views(canvas, found.pair.outlines, found.places, found.curves, found.projection),
        (9.0, 4.6),
    )
    curve = found.curves[0] or found.curves[1]
    lesion = found.scanned if found.lesion is None else found.lesion.position
    breast = Figure(
        "Unloaded breast",
        "From the front, from above and from the side, with the points that the curve stands for.",
        lambda canvas: draw_breast(canvas, found.pair.nominal.shape, curve, lesion),
        (9.0, 4.0),
    )
    results = Table("Results", ("quantity", "value"), tuple(_rows(found)), caption="Intervals are of 95 %.")
    return (
        Section("Notice", tuple(warnings)),
        Section(
            "Both views",
            ("The breast in 3-D, between the plates of both views: breast.html beside this page.",),
            (results,),
            (views, breast),
        ),
        Section("Assumptions", _ASSUMPTIONS[model], (_assumed(model, uncertainty),)),
    )


_COMMON = (
    "Sections of the unloaded breast parallel to the chest wall are ellipses; x-rays are parallel; the nipple is the deepest point "
    "of each outline and lies on the axis of rotation; the view in which the breast is deeper reaches the chest wall.",
    "Kinds of tissue are not told apart: heterogeneity and positioning are in the unresolved displacement.",
)
_AXES = ("laterally from the nipple", "upwards from the nipple", "from the chest wall")
_ASSUMPTIONS = {
    "geometric": (
        "Sections perpendicular to the chest wall deform in their plane and bend outwards; the outline of the compressed breast is scaled "
        "back so that the volume keeps its stated ratio. Gravity, skin and friction are not modelled.",
        *_COMMON,
    ),
    "mechanical": (
        "Equilibrium of a nearly incompressible neo-Hookean solid with skin and weight between rubbing plates; the chest wall lets tissue "
        "slide along it. The unloaded shape is the one whose equilibria have the outlines of both views. Bands and intervals come from the "
        "geometric model's spread.",
        *_COMMON,
    ),
}


def _assumed(model: str, sds: ModelUncertainty) -> Table:
    values, solid = CompressionParameters(), MechanicalParameters()
    rows: tuple[tuple[Cell, ...], ...] = (
        ("volume, compressed / unloaded", values.volume_ratio, sds.volume_ratio),
        ("part of the growth along the chest wall", values.along_share, sds.along_share),
        ("bending of the sections", values.bending, sds.bending),
        ("positioner angle, degrees", None, sds.angle_deg),
        ("distance of the plates, mm", None, sds.thickness_mm),
        ("unresolved displacement in each direction of a view, mm", 0.0, sds.unresolved_mm),
        ("each coordinate of tissue in the unloaded breast, by weight and roll, mm", 0.0, sds.unloaded_mm),
    )
    if model == "mechanical":
        rows += (
            ("Young's modulus of the tissue, kPa", solid.tissue_kpa, None),
            ("Poisson's ratio", solid.poisson_ratio, None),
            ("Young's modulus of the skin, kPa", solid.skin_kpa, None),
            ("thickness of the skin, mm", solid.skin_mm, None),
            ("friction coefficient of the plates", solid.friction, None),
            ("resistance of the chest wall to sliding, kPa/mm", solid.wall_kpa_per_mm, None),
            ("density, kg/mm³", solid.density, None),
        )
    return Table(
        "Parameters", ("parameter", "value", "standard deviation"), rows, caption="Stated, not fitted; drawn for each view by itself."
    )
