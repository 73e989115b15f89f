"""Chapter 4.3: counts of octrees by closed forms, printed cells as bundled, and what the patterns must show on the twin."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure as Canvas

from naibu import datasets
from naibu.identification.lattice_calibration.forward_model import Capture, PushedFace, PushedLattice
from naibu.identification.lattice_calibration.report_indices import ReportIndices
from naibu.reproduction.agreement.lattices import of_lattice
from naibu.reproduction.agreement.read_tables import Tables
from naibu.reproduction.chapter4.cube import TABLES, calibrated_cube, cube_section
from naibu.reproduction.chapter4.lattice import _drawn_sets, _one_set, _pattern_table, exact_section
from naibu.reproduction.chapter4.lattice_figures import FinalShape, ForceWave, final_shapes, force_waves
from naibu.reproduction.chapter4.octree import chapter4_octree, cost_section
from naibu.reproduction.chapter4.patterns import JOINT, PATTERNS, SEPARATE, PatternStudy, pattern_study
from naibu.validation.specimens.lattice_twin import CUBE_PUSHING, dough_lattice, dough_parameters
from naibu.viewer.chapters.chapter import Section
from naibu.viewer.tables import Table

PAPER = {t["id"]: t["rows"] for t in datasets.paper_tables()["tables"]}


def made_up(seed: int) -> ReportIndices:
    rng = np.random.default_rng(seed)
    shape, large = rng.uniform(1e3, 5e3, 5), rng.integers(10, 900, 5)
    return ReportIndices(tuple(shape.tolist()), (2800,) * 5, tuple(large.tolist()), float(rng.uniform(1e5, 1e6)), 1000)


@pytest.fixture(scope="module")
def made_up_study() -> PatternStudy:
    found = {p.letter: made_up(k) for k, p in enumerate((*PATTERNS, *JOINT, *SEPARATE))}
    return PatternStudy(dough_lattice(25.0, size_cm=(5, 5, 5)), (), {}, found)


def test_a_clock_that_sees_no_time_pass_gives_no_savings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where processor time comes in steps of 10 ms and more, a division by zero ended the chapter."""
    monkeypatch.setattr("time.process_time", lambda: 1.0)
    times, memory = cost_section(8).tables
    saves = times.columns.index("ours saves, %")
    assert all(row[saves] is None for row in times.rows) and any(row[saves] for row in memory.rows)


def cells(table: Table, key: object, what: str) -> list[object]:
    """Cells of the four lattices in the rows of one key."""
    return [r[table.columns.index(what)] for r in table.rows if r[0] == key]


def test_counts_of_classic_lattices_are_the_closed_form_and_of_octrees_the_printed_ones() -> None:
    nodes, elements = chapter4_octree(sizes=(8, 16)).sections[0].tables
    for n in (8, 16):
        m = n + 1
        assert cells(nodes, m, "ours")[0] == m**3
        assert cells(elements, m, "ours")[0] == 3 * n * m * m + 6 * n * n * m + 4 * n**3
        assert cells(nodes, m, "ours") == cells(nodes, m, "paper")
    assert cells(elements, 17, "ours") == cells(elements, 17, "paper")
    assert [a == b for a, b in zip(cells(elements, 9, "ours"), cells(elements, 9, "paper"), strict=True)] == [False, True, False, True]
    assert cells(elements, 9, "ours")[2] == 6497
    assert cells(nodes, 17, "ours saves, %") == pytest.approx(cells(nodes, 17, "paper saves, %"), abs=0.01, nan_ok=True)


def test_octrees_save_memory_and_print_the_papers_cells() -> None:
    time, memory = cost_section(8).tables
    assert [cells(time, r[0], "paper") for r in PAPER["4-VII"]] == [r[1:5] for r in PAPER["4-VII"]]
    assert [cells(memory, r[0], "paper") for r in PAPER["4-IX"]] == [r[1:5] for r in PAPER["4-IX"]]
    assert min(cells(time, "total", "ours")) > 0.0  # type: ignore[type-var, operator]
    # position, velocity, force, mass and its inverse: eleven numbers of 8 bytes a mass, and the padding to whole vectors
    assert cells(memory, "mass point", "ours")[0] == pytest.approx(729 * 11 * 8 / 1e3, rel=0.03)


@pytest.mark.parametrize(("number", "letters"), [("4-force-1", "abcd"), ("4-force-2", "efgh")])
def test_pattern_tables_print_the_papers_cells_beside_ours(made_up_study: PatternStudy, number: str, letters: str) -> None:
    table = _pattern_table(number, "first" if letters == "abcd" else "second", letters, ("joint 1",), made_up_study)
    assert [list(r[:6]) for r in table.rows[:-1]] == PAPER[number]
    ours = made_up_study.found[letters[0]]
    column = table.columns.index(f"ours ({letters[0]})")
    cells = {(r[0], r[1]): r[column] for r in table.rows}
    assert cells["sum", "total"] == pytest.approx(sum(ours.shape_mm) / 10.0)
    assert cells["per point", 2] == pytest.approx(ours.shape_mm[1] / 28000.0)
    assert cells["percentage", "total"] == pytest.approx(sum(ours.large) / 140.0)
    assert cells["S_force, N", "kept"] == pytest.approx(ours.force_mn / 1e3)


def test_ratios_of_the_joint_set(made_up_study: PatternStudy) -> None:
    row = _one_set(made_up_study).rows[0]
    assert row[4] == pytest.approx(sum(made_up_study.found["joint 1"].shape_mm) / sum(made_up_study.found["a"].shape_mm))
    assert row[8] == pytest.approx(made_up_study.found["joint 1"].force_mn / made_up_study.found["force 1"].force_mn)


def test_whether_two_sets_are_needed_follows_the_ratios(made_up_study: PatternStudy) -> None:
    tables = [_pattern_table(n, "first", k, ("joint 1",), made_up_study) for n, k in (("4-force-1", "abcd"), ("4-force-2", "efgh"))]
    one_set = _one_set(made_up_study)
    for factor, said in ((1.0, "differs"), (1.2, "agrees")):
        ratio = one_set.columns.index("joint / set for force")
        rows = tuple((*r[:4], factor, *r[5:ratio], factor) for r in one_set.rows)
        found = of_lattice(Tables((Section("s", (), (*tables, replace(one_set, rows=rows))),)))
        assert [c.verdict for c in found if c.what.startswith("Two sets")] == [said]


def column(table: Table, name: str) -> list[object]:
    return [r[table.columns.index(name)] for r in table.rows]


@pytest.mark.slow
def test_one_joint_set_is_as_good_as_the_set_for_shape_and_the_set_for_force() -> None:
    table = _one_set(pattern_study(seed=3))
    assert max(column(table, "joint / set for shape")) <= 1.05  # type: ignore[type-var, operator]
    assert max(column(table, "joint / set for force")) <= 1.05  # type: ignore[type-var, operator]
    assert min(column(table, "S_force, set for shape, N")) > 10.0 * max(column(table, "one joint set"))  # type: ignore[type-var, operator]


@pytest.mark.slow
def test_an_exact_twin_is_found_again() -> None:
    exact = exact_section(1, 2800).tables[0]
    assert column(exact, "truth inside").count("yes") >= 7


@pytest.mark.slow
def test_octrees_describe_the_cube_as_the_classic_lattice_does() -> None:
    coarse = calibrated_cube(8, 0, 1400)
    for cube in (coarse, calibrated_cube(16, 0, 1400, coarser=coarse)):
        parameters, shape = cube_section(cube).tables
        assert [list(r[:5]) for r in parameters.rows] == PAPER[TABLES[cube.n][0]]
        classic, *octrees = cells(shape, "sum", "ours, sum, m")
        for octree in octrees:  # about as well, or better
            assert 0.5 * classic < octree < 1.1 * classic  # type: ignore[operator]


def test_figures_show_the_last_shape_and_the_points_far_from_it() -> None:
    lattice = dough_lattice(25.0, size_cm=(5, 5, 5))
    pushing = replace(CUBE_PUSHING, faces=(PushedFace((0.0, 0.0, 25.0), (0.0, 50.0, 50.0), (10.0, 0.0, 0.0)),), push_s=0.1, keep_s=0.1)
    pushing = replace(pushing, free_s=0.1, capture_s=(0.0, 0.3))
    pushed = PushedLattice.of(lattice, pushing)
    motion = pushed.run(dough_parameters(lattice))
    off = np.array([0.0, 0.0, 3.0])
    tops = motion.positions[1][lattice.points[:, 2] == 50.0]
    capture = Capture.of(pushing, [tops, np.concatenate([tops, tops + off])], motion.force, lattice, point_sd_mm=0.5, force_sd_mn=1.0)
    shape, wave = FinalShape.of("(a)", capture, pushed, motion), ForceWave.of("(a)", capture, pushed, motion)
    assert (len(shape.far), shape.captured) == (9, 18)
    np.testing.assert_allclose(shape.far, tops + off)
    np.testing.assert_allclose(wave.measured, wave.computed)
    assert wave.times[[0, -1]] == pytest.approx([0.001, 0.199])
    for draw in (final_shapes([shape] * 3), force_waves([wave] * 4)):
        canvas = Canvas(layout="constrained")  # as pages have it
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # it would be shown to the user
            draw(canvas)
        assert len(canvas.axes) in (3, 4)


def test_draws_are_summed_up_by_mean_and_range(made_up_study: PatternStudy) -> None:
    table = _drawn_sets([made_up_study, made_up_study])
    once = _one_set(made_up_study).rows[0]
    assert table.rows[0][:2] == ("first load case", 2)
    assert table.rows[0][2] == f"{once[4]:.3g} ({once[4]:.3g} to {once[4]:.3g})"
