"""The paper's matches on the phantom of a calf."""

from __future__ import annotations

from naibu.reproduction.chapter1.paper_matches import PRINTED, paper_section


def test_more_matches_are_good_after_relaxation_than_by_correlation_alone() -> None:
    table = paper_section(pixels=128, slices=(20,)).tables[0]
    rows = {str(r[0]): dict(zip(table.columns, r, strict=True)) for r in table.rows}
    paper = rows["paper"]
    assert (paper["points before"], paper["matches"], paper["good"]) == PRINTED
    alone, relaxed = rows["ours, correlation alone"], rows["ours, chen"]
    assert alone["voxels"] == "128 x 128 x 20"
    assert alone["points before"] == relaxed["points before"] == 500
    assert isinstance(alone["good"], int)
    assert isinstance(relaxed["good"], int)
    assert relaxed["good"] > alone["good"] > 0
    assert float(str(relaxed["good, %"])) > float(str(alone["good, %"]))
