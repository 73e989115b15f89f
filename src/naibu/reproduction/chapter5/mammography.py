"""Chapter 5.4 of the 2008 report :cite:p:`hirai2008`: compression in mammography, on a phantom with markers and on virtual breasts."""

from __future__ import annotations

import numpy as np

from naibu.applications.mammography.geometric_model import CompressionParameters, compressed
from naibu.core.arrays import BoolArray, FloatArray
from naibu.reproduction.chapter5 import mammography_figures as figures
from naibu.reproduction.chapter5.half_ellipsoid import (
    DISTANCE_MM,
    TESTED_KPA,
    distances_mm,
    hardness_modulus,
    mechanical_model,
    phantom_markers,
    phantom_shape,
)
from naibu.reproduction.chapter5.marker_cells import marker_cells, size_ratio
from naibu.reproduction.chapter5.scanned_breasts import (
    CONSTRAINED,
    EQUILIBRIUM,
    GEOMETRIC,
    IN_SCAN,
    SEEDS,
    ScannedBreastStudy,
    scanned_breast_study,
)
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

OBSERVED, SCANNED, CURVE = "Observations of section IV", "Points of a scan", "Distance from the curve"
SOFT = "equilibrium at finite strain, modulus by hardness 0"
_EDGE = 0.2  # of elements in a half ball of radius 1: markers on the table move by 0.2 mm with finer ones
_NEIGHBOURS_MM = 22.0  # markers are 10 mm apart, layers 10
_LAYER_MM = 5.0  # half the distance of the layers
_PRESSED_MM = 20.0  # across the compression: the plates touch there


def phantom_section() -> Section:
    """Return the section on the phantom: what the report observes, and what models without a marker give."""
    before, after = phantom_markers()
    shape = phantom_shape()
    literature = compressed(shape, 0.0, DISTANCE_MM, CompressionParameters(bending=0.0))
    predicted = {
        "sections stay plane, base held (approximations 1 and 2, volume kept)": literature.compress(before),
        "sections bend, base free to arch": compressed(shape, 0.0, DISTANCE_MM, free_base=True).compress(before),
        SOFT: mechanical_model(hardness_modulus(0.0), edge=_EDGE)(before),
        "equilibrium at finite strain, modulus by compression test": mechanical_model(TESTED_KPA[0], edge=_EDGE)(before),
    }
    rows: list[tuple[Cell, ...]] = [("markers where they were", None, distances_mm(before, after)[0], None)]
    for name, points in predicted.items():
        rigid, _, on_table = distances_mm(points, after)
        rows.append((name, None, rigid, on_table))
    phantom = Table(
        "Interior markers at 100 mm",
        ("model", "paper, mm", "ours, rigid motion removed, mm", "ours, on the table, mm"),
        tuple(rows),
        caption=f"Root mean square distances of {len(before)} markers in 3-D; outlines and plate distance are known, no displacement.",
        note="The paper shows the displacements (Fig. 8) and compares no model with them. Its half ellipsoid is 70 mm high, that of the "
        "table of markers 49 mm; 21 mm of straight part make both true. The gel is one of two, not stated which: "
        f"{hardness_modulus(0.0):.0f} kPa is the modulus of hardness 0 on the durometer scale C, {TESTED_KPA[0]:.0f} kPa that of the "
        "report's compression test. A stiffer body arches farther off its table. Elements are coarse here: with finer ones the last two "
        "distances on the table grow by 0.2 to 0.3 mm (benchmarks/mammography.py).",
    )
    draw = figures.moved_markers(before, after, predicted[SOFT], _lowest(before))
    figure = Figure("Fig. 8", "Markers inside of the phantom, without load and between the plates.", draw, (10.0, 4.2))
    return Section(
        "Mammography: markers inside of a phantom", ("Research software, not a medical device.",),
        (phantom, observations(before, after, predicted[SOFT])), (figure,),
    )  # fmt: skip


def observations(before: FloatArray, after: FloatArray, predicted: FloatArray) -> Table:
    """Return what the paper's section IV observes, in numbers: measured, and predicted by the equilibrium.

    Parameters
    ----------
    before, after, predicted : ndarray, shape (n, 3)
        Markers at rest, measured and predicted between the plates, mm.
    """
    lowest = np.flatnonzero(_lowest(before))
    triangles, cells = marker_cells(before[lowest, :2], _NEIGHBOURS_MM), marker_cells(before, _NEIGHBOURS_MM)
    areas = [before[lowest][triangles].mean(axis=1), before[cells].mean(axis=1)]
    inside, within = (np.abs(centres[:, 0]) < _PRESSED_MM for centres in areas)
    regions = {"half-way between the plates": np.abs(after[:, 1]) < 15.0, "near the plates": np.abs(after[:, 1]) > 30.0}
    rows: list[tuple[Cell, ...]] = []
    for where, chosen in regions.items():
        outward = [float((np.abs(p[:, 0]) - np.abs(before[:, 0]))[chosen].mean()) for p in (after, predicted)]
        rows.append(("moves outward, mm", where, *outward))
    for where, chosen in regions.items():
        rows.append(("rises, mm", where, *(float((p[:, 2] - before[:, 2])[chosen].mean()) for p in (after, predicted))))
    for where, chosen in (("between the plates", inside), ("beside them", ~inside)):
        flat = [size_ratio(before[lowest, :2], p[lowest, :2], triangles, chosen) for p in (after, predicted)]
        rows.append(("area of the lowest layer, over that at rest", where, *flat))
    for where, chosen in (("between the plates", within), ("beside them", ~within)):
        rows.append(("volume, over that at rest", where, *(size_ratio(before, p, cells, chosen) for p in (after, predicted))))
    return Table(
        OBSERVED, ("quantity", "where", "measured", "equilibrium"), tuple(rows),
        caption="Means over markers, and sums over the triangles and tetrahedra between them.",
        note=f"Between the plates: at most {_PRESSED_MM:g} mm from the middle across the compression. The markers of a layer come closer "
        "together, most where the plates press, as the paper sees; but the layer rises and arches, and the volume between the "
        "markers stays: what is seen in a plane is no reason to give up the conservation of volume.",
    )  # fmt: skip


def _lowest(before: FloatArray) -> BoolArray:
    return np.asarray(before[:, 2] < before[:, 2].min() + _LAYER_MM)


def scans_section() -> Section:
    """Return the section on points of a scan in both views, on virtual breasts."""
    studies = [scanned_breast_study(seed) for seed in SEEDS]
    rows: list[tuple[Cell, ...]] = [("true", None, None, *_wider(studies, "true"))]
    for name in (IN_SCAN, GEOMETRIC, EQUILIBRIUM, CONSTRAINED):
        distance = np.mean([study.distances(name).mean(axis=1) for study in studies], axis=0)
        rows.append((name, *(float(d) for d in distance), *_wider(studies, name)))
    table = Table(
        SCANNED, ("where a point is predicted", "CC, mm", "MLO, mm", "CC wider by, %", "MLO wider by, %"), tuple(rows),
        caption=f"Mean distance from the true place of {sum(s.truth.shape[1] for s in studies)} points in {len(studies)} virtual "
        "breasts, and growth of the outlines along the chest wall.",
        note="The unloaded shape is that of two projections of the breast. The paper looks at one lesion of one patient in CC (Fig. 7) and "
        "forces the equilibrium onto the outline, because it does not grow along the chest wall as the mammogram does (Figs. 5 and 6).",
    )  # fmt: skip
    curve = Table(
        CURVE, ("known", "mean, mm", "largest, mm"),
        (("outlines, distances and angle", *_curve(studies)),),
        caption="Distance of the true place in MLO from the epipolar curve of a point in CC, by the closed form, on the same breasts.",
        note="The paper: 7 mm on 50 patients, radiologists 10 mm; others 2.2 mm with the patient's scan. Virtual breasts are positioned "
        "better than patients. More of them: benchmarks/mammography_population.py.",
    )  # fmt: skip
    draw = figures.scanned_points(studies[0], (IN_SCAN, EQUILIBRIUM, CONSTRAINED))
    figure = Figure("Fig. 7", "Points of a scan in CC: lines lead from the true to the predicted places.", draw, (10.0, 4.6))
    text = "No scans of patients are here; virtual breasts stand for them, pressed by another mesh and law than those that predict."
    return Section("Mammography: points of a scan in the mammograms", (text,), (table, curve), (figure,))


def _wider(studies: list[ScannedBreastStudy], name: str) -> tuple[float, float]:
    cc, mlo = 100.0 * (np.mean([study.wider[name] for study in studies], axis=0) - 1.0)
    return float(cc), float(mlo)


def _curve(studies: list[ScannedBreastStudy]) -> tuple[float, float]:
    distances = np.concatenate([study.curve_mm for study in studies])
    return float(distances.mean()), float(distances.max())
