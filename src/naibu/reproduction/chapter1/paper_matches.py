"""Matches of the paper of chapter 1 of the 2008 report :cite:p:`hirai2008`: 500 points, 330 matches, 297 of them good."""

from __future__ import annotations

import numpy as np

from naibu.reproduction.chapter1.calf_phantom import CalfCase, calf_case
from naibu.reproduction.chapter1.matching import RIGHT_MM, candidates_of, match_errors, picked_registration, potential_matches
from naibu.viewer.chapters.chapter import Section
from naibu.viewer.tables import Cell, Table

PRINTED = (500, 330, 297)
HALF_BOXES = (4, 4, 2), (8, 8, 3)  # 9 x 9 x 5 voxels are matched, 17 x 17 x 7 searched
OTHERS_PER_POINT = 5  # points of the deformed volume, of which the paper states no number: as in Table 1.3 of the report
PAPER_SLICES = (40, 57)  # with the interpolated ones: of the paper, and of the report


def paper_section(seed: int = 0, *, pixels: int = 256, slices: tuple[int, ...] = PAPER_SLICES) -> Section:
    """Return how many of 500 points are matched, and how many matches are right, in volumes as large as the report's."""
    rows: list[tuple[Cell, ...]] = [("paper", None, PRINTED[0], None, None, PRINTED[1], PRINTED[2], 100.0 * PRINTED[2] / PRINTED[1])]
    for count in slices:
        rows += _rows(calf_case(seed, pixels=pixels, slices=count // 2 + 1).slices(0, count - 1))
    columns = ("way", "voxels", "points before", "points after", "candidate pairs", "matches", "good", "good, %")
    text = (
        "The paper matches 500 points of the initial volume with boxes of 9 x 9 x 5 voxels, searched in 17 x 17 x 7: 330 matches, of which "
        f"297 are good, it does not say by what measure. Ours are good where they lie within {RIGHT_MM:g} mm of the truth. The search box "
        "begins at the motion of the bone, and grows with the distance from the centre as in the tables above.",
    )
    note = "40 slices are those of the paper, here the first of 41 from 21 that are scanned; 57, from 29, is the report's number."
    return Section("The paper's matches in volumes", text, (Table("500 points", columns, tuple(rows), caption="Matches.", note=note),))


def _rows(case: CalfCase) -> list[tuple[Cell, ...]]:
    counts = PRINTED[0], OTHERS_PER_POINT * PRINTED[0]
    rigid = picked_registration(case).transform
    pairs, before, after = candidates_of(case.reference, case.deformed, counts, rigid, boxes=HALF_BOXES)
    nz, ny, nx = case.reference.shape
    rows: list[tuple[Cell, ...]] = []
    for name, way in (("correlation alone", None), ("direction26", "direction26"), ("chen", "chen")):
        found = potential_matches(pairs, way)  # type: ignore[arg-type]
        good = int(np.sum(match_errors(case, found) < RIGHT_MM))
        size = f"{nx} x {ny} x {nz}"
        rows.append((f"ours, {name}", size, len(before), len(after), len(pairs), len(found), good, 100.0 * good / max(len(found), 1)))
    return rows
