"""Chapter 1 reproduced on the calf phantom: its motion is exact, printed columns are the report's, ours are near the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure as Canvas

from naibu import datasets
from naibu.imaging.displacement.accuracy import intensity_rms, moved_back
from naibu.imaging.preprocessing.rigid_registration import rigid_from_points
from naibu.reproduction.chapter1.calf_motion import FIBULA, FIBULA_REACH, TIBIA, TIBIA_REACH, CalfMotion, leg_pose
from naibu.reproduction.chapter1.calf_phantom import TISSUES, CalfCase, CalfPhantom, calf_case
from naibu.reproduction.chapter1.matching import (
    WAYS,
    Matched,
    candidates_of,
    check_points,
    continued,
    judged_slices,
    matched,
    picked_registration,
    under_noise,
)
from naibu.reproduction.chapter1.tables import chapter1
from naibu.viewer.chapters.chapter import Chapter
from naibu.viewer.chapters.chapter_page import chapter_numbers, write_chapter
from naibu.viewer.tables import Table

PAPER = {t["id"]: t["rows"] for t in datasets.paper_tables()["tables"]}
SIZES = {"pixels": 96, "slices": 15, "plane_points": (100, 120), "space_points": (300, 900), "draws": 1, "paper_slices": (15,)}
within_leg = st.tuples(*[st.floats(-38.0, 38.0)] * 2, st.floats(-28.0, 28.0))


def row(table: Table, name: str) -> dict[str, object]:
    return next(dict(zip(table.columns, r, strict=True)) for r in table.rows if r[0] == name)


def number(table: Table, name: str, column: str) -> float:
    value = row(table, name)[column]
    assert isinstance(value, float | int)
    return float(value)


@pytest.fixture(scope="module")
def image() -> CalfCase:
    return calf_case(0, pixels=192, slices=3).slices(2)


@pytest.fixture(scope="module")
def ways(image: CalfCase) -> dict[str, Matched]:
    pairs, _, _ = candidates_of(image.reference, image.deformed, (200, 240), picked_registration(image).transform)
    found = [matched(image, pairs, way) for way in (None, *WAYS)]
    return {each.name: each for each in found}


@pytest.fixture(scope="module")
def chapter() -> Chapter:
    return chapter1(0, **SIZES)  # type: ignore[arg-type]


def table(chapter: Chapter, name: str) -> Table:
    return next(t for s in chapter.sections for t in s.tables if t.title == name)


@given(within_leg, st.floats(2.0, 14.0))
@settings(max_examples=40, deadline=None)
def test_the_motion_keeps_volumes_and_goes_back(point: tuple[float, float, float], push: float) -> None:
    motion, p, h = CalfMotion(push), np.array([point]), 1e-3
    assert motion.to_material(motion.to_space(p)) == pytest.approx(p, abs=1e-4)
    slopes = [(motion.to_space(p + h * e) - motion.to_space(p - h * e))[0] / (2.0 * h) for e in np.eye(3)]
    assert np.linalg.det(np.array(slopes)) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize(("axis", "reach"), [(TIBIA, TIBIA_REACH), (FIBULA, FIBULA_REACH)])
def test_bones_move_rigidly(axis: tuple[float, float], reach: float) -> None:
    rng = np.random.default_rng(2)
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, 400), reach * np.sqrt(rng.uniform(0.0, 1.0, 400))
    p = np.column_stack([axis[0] + radius * np.cos(angle), axis[1] + radius * np.sin(angle), rng.uniform(-28.0, 28.0, 400)])
    fitted = rigid_from_points(p, CalfMotion().to_space(p))
    assert fitted.residuals_mm.max() < 1e-4
    if axis == TIBIA:
        assert CalfMotion().to_space(p) == pytest.approx(leg_pose().applied(p), abs=1e-9)
    else:
        assert abs(fitted.transform.angle_deg - leg_pose().angle_deg) > 0.5  # it turns against the tibia


def test_the_plate_pushes_up_and_the_sides_bulge() -> None:
    below, sides = np.array([[0.0, 50.0, 4.0]]), np.array([[-45.0, 15.0, 4.0], [45.0, 15.0, 4.0]])
    motion, rest = CalfMotion(12.0), leg_pose().inverse()
    up, out = rest.applied(motion.to_space(below)) - below, rest.applied(motion.to_space(sides)) - sides
    assert -12.0 < up[0, 1] < -9.0
    assert out[0, 0] < -2.0 < 2.0 < out[1, 0]
    assert CalfMotion(0.0).to_space(np.array([[0.0, 50.0, 4.0]]))[:, 1] != pytest.approx(motion.to_space(below)[:, 1], abs=5.0)


def test_the_volumes_show_the_motion() -> None:
    """Without noise the second scan warped back by the truth is the first one, but for blur; warped by none or half of it, it is not."""
    case = calf_case(1, pixels=128, slices=5, noise=0.0)
    inside = case.leg & np.isfinite(case.truth[..., 0])
    left = [
        intensity_rms(case.reference, case.deformed, fraction * case.truth, region=inside, frame="reference")
        for fraction in (0.0, 0.5, 1.0)
    ]
    assert left[2] < 0.25 * left[1] < 0.25 * left[0]
    back = intensity_rms(case.reference, case.deformed, np.where(case.leg[..., None], case.truth, np.nan), region=case.tissue_after)
    assert back < 0.25 * left[0]


def test_the_phantom_is_a_calf() -> None:
    phantom = CalfPhantom(0)
    at = {"air": (70.0, 0.0, 0.0), "bone": (*TIBIA, 0.0), "muscle": (10.0, 10.0, 0.0), "fat": (0.0, 49.0, 0.0)}
    kinds = phantom.tissue(np.array(list(at.values())))
    assert [TISSUES[k] for k in kinds] == list(at)
    around = np.column_stack([*(np.array(TIBIA)[:, None] + 11.0 * np.array([np.cos(t := np.linspace(0, 6, 40)), np.sin(t)])), 0.0 * t])
    assert phantom.intensity(around).max() < 60.0 < phantom.intensity(np.array([at["bone"]]))[0]  # dark rim, bright marrow
    assert (CalfPhantom(1).intensity(around + np.array([40.0, 20.0, 0.0])) != 4.0).any()
    assert judged_slices(calf_case(0, pixels=16, slices=29).reference) == slice(10, 51)


def test_most_matches_are_right_and_relaxation_adds_some(ways: dict[str, Matched]) -> None:
    alone = ways["correlation alone"]
    for name in WAYS:
        assert ways[name].right_percent >= 70.0, name
        assert ways[name].right_percent * len(ways[name].matches) > alone.right_percent * len(alone.matches), name
        assert len(ways[name].matches) > 72  # the report's
        energies = ways[name].matches.energies
        assert (np.diff(energies) >= 0.0).all()
    # alpha from 0 to 10 by tenths is what made the report's 101 iterations
    assert {name: len(ways[name].matches.energies) for name in ("chen", "direction26")} == {"chen": 101, "direction26": 101}


def test_check_points_come_back(image: CalfCase, ways: dict[str, Matched]) -> None:
    points = check_points(image)
    assert points.reference_mm.shape == (10, 3)
    assert np.linalg.norm(points.deformed_mm - points.reference_mm, axis=1).mean() > 3.0
    for name in WAYS:
        assert points.errors_mm(ways[name].moved_back(points.deformed_mm, image.reference)).mean() < 2.0, name
    truth = continued(np.where(image.leg[..., None], image.truth, np.nan), image.reference)
    assert points.errors_mm(moved_back(truth, image.reference, points.deformed_mm)).max() < 0.1


def test_the_bone_is_registered_by_picked_points(image: CalfCase) -> None:
    found = picked_registration(image)
    axis = np.array([[*TIBIA, image.reference.origin_mm[2]]])
    assert found.transform.applied(axis)[:, :2] == pytest.approx(leg_pose().applied(axis)[:, :2], abs=1.0)


def test_noise_costs_matches(image: CalfCase) -> None:
    rows = under_noise(image, (200, 240), (0.0, 25.0), 1, 0)
    right = {(r.noise, r.registered, r.way): r.right for r in rows}
    for way in WAYS:
        assert right[25.0, True, way] < right[0.0, True, way]
        assert right[0.0, False, way] > right[0.0, False, "correlation alone"]


def test_printed_rows_are_the_report_s(chapter: Chapter) -> None:
    first, second, third = (table(chapter, f"Table 1.{i}") for i in (1, 2, 3))
    for printed in PAPER["1.1"]:
        ours = row(first, f"paper, {printed[0]}")
        assert [ours[c] for c in ("points before", "points after", "matches", "iterations")] == [*printed[1:3], *printed[4:6]]
    for printed in PAPER["1.2"]:
        ours = row(second, f"paper, {printed[0]}")
        assert [ours[f"EP{i}, cm"] for i in range(10)] == printed[1:11]
        assert ours["printed RMSE, cm"] == printed[11]
        assert ours["root of mean"] == pytest.approx(printed[11], abs=1e-3)
        assert float(ours["RMS, cm"]) < 0.6 * printed[11]  # type: ignore[arg-type]
    for printed in PAPER["1.3"]:
        ours = row(third, f"paper, {printed[0]}")
        shown = ("points before", "points after", "matches", "tetrahedra", "RMS (1.29), intensity levels")
        assert [ours[c] for c in shown] == printed[1:6]


def test_our_rows_are_in_order_of_merit(chapter: Chapter) -> None:
    third = table(chapter, "Table 1.3")
    rms, mean = "RMS (1.29), intensity levels", "field: mean error, mm"
    still, bone = "ours, nothing moved", "ours, bone's motion alone"
    for way in WAYS:
        assert number(third, f"ours, {way}", mean) < number(third, bone, mean) < number(third, still, mean)
        assert number(third, f"ours, {way}", rms) < number(third, bone, rms)
        assert number(third, "ours, naibu's default", mean) < 0.3 * number(third, f"ours, {way}", mean)
    assert number(third, "true displacement", mean) == 0.0
    assert number(third, "ours, naibu's default", rms) < 1.3 * number(third, "true displacement", rms)


def test_flow_of_section_3_5(chapter: Chapter) -> None:
    """What the page says: on one grid Horn-Schunck fails most in the skin, blocks are often lost, coarse to fine is better."""
    image, volume = table(chapter, "Section 3.5, image"), table(chapter, "Section 3.5, volume")
    assert len(image.rows) == 8 and len(volume.rows) == 6
    mean, median, skin, muscle = image.columns[3], image.columns[2], image.columns[5], image.columns[6]
    reported, fine = "Horn-Schunck, as the report", "Horn-Schunck, coarse to fine"
    assert number(image, reported, skin) > number(image, reported, muscle)
    blocks = str(image.rows[0][0])
    assert number(image, blocks, mean) > 2.0 * number(image, blocks, median)
    assert number(image, blocks, median) < number(image, reported, median)
    for other in (str(r[0]) for r in image.rows if "report" in str(r[0])):
        assert number(image, fine, mean) < 0.5 * number(image, other, mean), other
    assert number(volume, "naibu's default", mean) == min(float(r[3]) for r in volume.rows)  # type: ignore[arg-type]


def test_the_same_seed_gives_the_same_scans_and_matches(image: CalfCase, ways: dict[str, Matched]) -> None:
    again = calf_case(0, pixels=192, slices=3).slices(2)
    assert np.array_equal(again.deformed.values, image.deformed.values)
    pairs, _, _ = candidates_of(again.reference, again.deformed, (200, 240), picked_registration(again).transform)
    found = matched(again, pairs, "direction26")
    assert np.array_equal(found.matches.pairs, ways["direction26"].matches.pairs)
    other = calf_case(1, pixels=48, slices=2)
    assert not np.array_equal(calf_case(2, pixels=48, slices=2).reference.values, other.reference.values)


@pytest.mark.slow
def test_pages_are_the_same_every_time(chapter: Chapter, tmp_path: Path) -> None:
    again = chapter1(0, **SIZES)  # type: ignore[arg-type]
    assert chapter_numbers(again) == chapter_numbers(chapter)
    page, numbers = write_chapter(chapter, tmp_path)
    assert page.stat().st_size > 200_000 and "Table 1.3" in numbers.read_text(encoding="utf-8")


def test_tables_fit_and_figures_are_labelled(chapter: Chapter) -> None:
    for section in chapter.sections:
        for each in section.tables:
            assert all(len(r) == len(each.columns) for r in each.rows), each.title
        for figure in section.figures:
            canvas = Canvas(figsize=figure.size)
            figure.draw(canvas)
            assert canvas.axes, figure.name
            outer = [a for a in canvas.axes if a.get_subplotspec() is not None and a.axison and a.get_subplotspec().is_last_row()]
            assert all(a.get_xlabel() for a in outer), figure.name
