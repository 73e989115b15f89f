"""Chapter 5.4 of the 2008 report :cite:p:`hirai2008`: compression in mammography, on the half ellipsoid with markers inside."""

from __future__ import annotations

import numpy as np

from naibu import datasets
from naibu.applications.mammography.breast_shape import BreastShape, half_ellipsoid_shape
from naibu.applications.mammography.geometric_model import CompressionParameters, compressed
from naibu.applications.mammography.mechanical_model import MechanicalParameters, mechanically_compressed
from naibu.core.arrays import FloatArray
from naibu.viewer.chapter import Section
from naibu.viewer.tables import Cell, Table

SIZE_MM, STRAIGHT_MM, DISTANCE_MM = (110.0, 130.0, 50.0), 20.0, 100.0
FIRST_LAYER_MM = 27.0  # of markers, above the base: 7 mm above that of the half ellipsoid
PIXEL_SCALE = np.array([1.01024, 1.01024, 1.0])  # probable error of the printed x, y
GEL = MechanicalParameters(tissue_kpa=125.0, poisson_ratio=0.49, skin_kpa=0.0, friction=0.5, density=1e-6)


def mammography_section() -> Section:
    """Return the section on mammography: what the report states, and what models without a marker give."""
    before, after = phantom_markers()
    shape = phantom_shape()
    literature = compressed(shape, 0.0, DISTANCE_MM, CompressionParameters(bending=0.0))
    predicted = {
        "sections stay plane, base held (approximations 1 and 2, volume kept)": literature.compress(before),
        "sections bend, base free to arch": compressed(shape, 0.0, DISTANCE_MM, free_base=True).compress(before),
        "equilibrium at finite strain, on a table": mechanically_compressed(shape, 0.0, DISTANCE_MM, GEL, free_base=True).compress(before),
    }
    rows: list[tuple[Cell, ...]] = [("markers where they were", None, _rms(_aligned(before, after) - after), None)]
    for name, points in predicted.items():
        rows.append((name, None, _rms(_aligned(points, after) - after), _rms(_on_table(points, after) - after)))
    phantom = Table(
        "Interior markers at 100 mm",
        ("model", "paper, mm", "ours, rigid motion removed, mm", "ours, on the table, mm"),
        tuple(rows),
        caption=f"Root mean square distances of {len(before)} markers in 3-D; outlines and plate distance are known, no displacement.",
        note="The paper shows the displacements (Fig. 8) and compares no model with them. Its half ellipsoid is 70 mm high, that of the "
        "table of markers 50 mm; 20 mm of straight part make both true.",
    )
    middle = np.abs(after[:, 1]) < 15.0
    ends = np.abs(after[:, 1]) > 30.0
    rise = after[:, 2] - before[:, 2]
    spread = np.abs(after[:, 0]) - np.abs(before[:, 0])
    seen = Table(
        "Observations of section IV",
        ("statement of the paper", "measured here"),
        (
            (
                "cross-sections bend outward, most at the mid-plane",
                f"outward by {spread[middle].mean():.2f} mm at the middle, {spread[ends].mean():.2f} mm near the plates",
            ),
            ("displacements in the mid-plane should be considered", f"markers of the middle rise by {rise[middle].mean():.2f} mm"),
            (
                "7 mm mean distance to the curve (50 patients); radiologists 10 mm; with MR 2.2 mm (6 patients)",
                "no mammograms of patients here",
            ),
        ),
        note="Distances to the curve on virtual breasts: benchmarks/mammography_population.py.",
    )
    return Section("Mammography", ("Research software, not a medical device.",), (phantom, seen))


def phantom_shape() -> BreastShape:
    """Return the half ellipsoid on a straight part, which makes up the printed height of 70 mm."""
    cap = half_ellipsoid_shape(SIZE_MM)
    straight = np.linspace(0.0, STRAIGHT_MM, 20)[:-1]
    return BreastShape(
        np.append(straight, STRAIGHT_MM + cap.depths),
        np.zeros((len(straight) + len(cap.depths), 2)),
        np.vstack([np.repeat(cap.squares[:1], len(straight), axis=0), cap.squares]),
    )


def phantom_markers() -> tuple[FloatArray, FloatArray]:
    """Return markers (n, 3), mm, without load and at 100 mm, across and along the compression and above the base."""
    experiment = datasets.load("ct_half_ellipsoid")
    tables = [markers for name in ("initial", "width_100") if (markers := experiment.state(name).markers) is not None]
    before, after = (PIXEL_SCALE * table.points for table in tables)
    known = np.isfinite(before).all(axis=1)
    middle = before[known].mean(axis=0)
    _, _, axes = np.linalg.svd(before[known, :2] - middle[:2], full_matrices=False)
    long = axes[0] * np.sign(axes[0, 1])
    frame = np.array([[long[1], -long[0], 0.0], [long[0], long[1], 0.0], [0.0, 0.0, 1.0]])
    base = before[known, 2].min() - FIRST_LAYER_MM
    both = known & np.isfinite(after).all(axis=1) & tables[0].trusted & tables[1].trusted
    moved = (after[both] - [0.0, 0.0, base]) @ frame.T
    centre = moved[:, :2].mean(axis=0) - ((before[both] - [middle[0], middle[1], base]) @ frame.T)[:, :2].mean(axis=0)
    return (before[both] - [middle[0], middle[1], base]) @ frame.T, moved - [*centre, 0.0]


def _on_table(points: FloatArray, onto: FloatArray) -> FloatArray:
    return np.column_stack([_aligned(points[:, :2], onto[:, :2]), points[:, 2]])


def _aligned(points: FloatArray, onto: FloatArray) -> FloatArray:
    """Return the points (n, d) after the rotation and translation that bring them nearest to others."""
    a, b = points - points.mean(axis=0), onto - onto.mean(axis=0)
    u, _, v = np.linalg.svd(a.T @ b)
    sign = np.ones(len(v))
    sign[-1] = np.sign(np.linalg.det(u @ v))
    return np.asarray(a @ (u * sign) @ v + onto.mean(axis=0))


def _rms(residuals: FloatArray) -> float:
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))
