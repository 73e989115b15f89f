"""Chapter 5.4 of the 2008 report :cite:p:`hirai2008`: compression in mammography, on the half ellipsoid with markers inside."""

from __future__ import annotations

import numpy as np

from naibu.applications.mammography.geometric_model import CompressionParameters, compressed
from naibu.reproduction.chapter5.half_ellipsoid import (
    DISTANCE_MM,
    TESTED_KPA,
    distances_mm,
    hardness_modulus,
    mechanical_model,
    phantom_markers,
    phantom_shape,
)
from naibu.viewer.chapters.chapter import Section
from naibu.viewer.tables import Cell, Table

_EDGE = 0.2  # of elements in a half ball of radius 1: markers on the table move by 0.2 mm with finer ones


def mammography_section() -> Section:
    """Return the section on mammography: what the report states, and what models without a marker give."""
    before, after = phantom_markers()
    shape = phantom_shape()
    literature = compressed(shape, 0.0, DISTANCE_MM, CompressionParameters(bending=0.0))
    predicted = {
        "sections stay plane, base held (approximations 1 and 2, volume kept)": literature.compress(before),
        "sections bend, base free to arch": compressed(shape, 0.0, DISTANCE_MM, free_base=True).compress(before),
        "equilibrium at finite strain, modulus by hardness 0": mechanical_model(hardness_modulus(0.0), edge=_EDGE)(before),
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
