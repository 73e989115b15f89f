"""Chapter 3 reproduced: printed columns are the report's, ours follow from exact models, and figures can be drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure as Canvas

from naibu import datasets
from naibu.core.errors import InputError
from naibu.identification.equilibrium_gap.batch import batch_equilibrium_gap
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.mechanics.finite_elements.linear_simplices import simplices
from naibu.reproduction.chapter3.bodies import LAYERS, UNIFORM, PushedBody, Split, cube, shape_error_percent, split_hexahedra, square
from naibu.reproduction.chapter3.cubes import (
    identifiability_section,
    identify_cells,
    layer_section,
    mean_error_percent,
    most_frequent,
    uniform_section,
)
from naibu.reproduction.chapter3.experiment import EXPERIMENT, experiment_section, marker_lattice, printed_errors
from naibu.reproduction.chapter3.noise import noise_section, noise_study
from naibu.reproduction.chapter3.square import error_accumulation, square_section
from naibu.reproduction.chapter3.tables import chapter3
from naibu.viewer.chapters.chapter import Section
from naibu.viewer.chapters.chapter_page import write_chapter
from naibu.viewer.tables import Table

PAPER = {t["id"]: t["rows"] for t in datasets.paper_tables()["tables"]}


def row(table: Table, name: str) -> dict[str, object]:
    return next(dict(zip(table.columns, r, strict=True)) for r in table.rows if r[0] == name)


def drawn(section: Section) -> int:
    for figure in section.figures:
        canvas = Canvas(figsize=figure.size)
        figure.draw(canvas)
        assert canvas.axes
        canvas.draw_without_rendering()
    return len(section.figures)


@pytest.mark.parametrize("split", ["symmetric", "asymmetric"])
def test_splits_fill_the_cube_and_conform(split: Split) -> None:
    mesh = cube(split=split).mesh
    body = simplices(mesh)
    assert len(body.measures) == 6 * 64
    assert body.measures == pytest.approx(np.full(384, 1000.0 / 6.0))
    faces = np.sort(mesh.cells[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    _, count = np.unique(faces, axis=0, return_counts=True)
    assert count.max() == 2
    assert (count == 1).sum() == 6 * 16 * 2


@pytest.mark.parametrize(("split", "mirrored"), [("symmetric", True), ("asymmetric", False)])
def test_only_the_symmetric_mesh_is_its_own_mirror_image(split: Split, mirrored: bool) -> None:
    mesh = cube(split=split).mesh
    cells = {tuple(sorted(cell)) for cell in mesh.cells.tolist()}
    for axis in range(3):
        points = mesh.points.copy()
        points[:, axis] = 40.0 - points[:, axis]
        image = np.rint(points / 10.0).astype(int) @ [1, 5, 25]
        assert ({tuple(sorted(image[list(cell)].tolist())) for cell in cells} == cells) is mirrored


def test_a_mirrored_cube_bulges_alike_on_all_sides() -> None:
    body = cube()
    u = body.displacement((0.0, 0.0, -10.0))
    grid = u.reshape(5, 5, 5, 3)
    assert grid[:, :, ::-1, 0] == pytest.approx(-grid[..., 0], abs=1e-9)
    assert grid[..., 1] == pytest.approx(np.swapaxes(grid, 1, 2)[..., 0], abs=1e-9)


def test_triangles_are_numbered_as_in_the_report() -> None:
    """Node 13 has triangles 22, 21, 20, 13, 14, 15 and node 14 has 23, 22, 15 (equations 3.21, 3.26); node 5 has 0, 1, 8 (3.31)."""
    cells = square().mesh.cells
    around = {node: set(np.flatnonzero((cells == node).any(axis=1)).tolist()) for node in (5, 13, 14)}
    assert around == {5: {0, 1, 8}, 13: {13, 14, 15, 20, 21, 22}, 14: {15, 22, 23}}


def test_the_error_measure_is_that_of_equation_3_35() -> None:
    first = np.ones((2, 3))
    assert shape_error_percent(first, np.array([[4.0, 1.0, 5.0]] * 2), 40.0, 50.0) == pytest.approx(100.0 * 50.0 / 2000.0)


@pytest.fixture(scope="module")
def square_part() -> Section:
    return square_section(0, 8)


def test_counts_of_table_3_1_are_ours(square_part: Section) -> None:
    table = square_part.tables[0]
    assert [list(r[1:]) for r in table.rows[:2]] == [[v, v] for v in PAPER["3.1"][0]]
    assert row(table, "equations, two trials")["ours"] == 40
    assert drawn(square_part) == 1


def test_the_two_triangles_of_2007_come_back_exactly(square_part: Section) -> None:
    table = square_part.tables[1]
    for printed, found in zip(PAPER["3-2d"], table.rows, strict=True):
        assert [1e3 * float(v) for v in found[2:10:2]] == pytest.approx(printed[4:])  # type: ignore[arg-type]
        assert np.array(found[3:10:2], dtype=float) == pytest.approx([10.739, 1.7483, 10.739, 1.7483], rel=1e-4)
        assert 0.0 < float(found[10]) < 1.0  # type: ignore[arg-type]


def test_the_batch_method_errs_less_than_the_incremental_one() -> None:
    growth = error_accumulation(3, 12)
    assert [step.node for step in growth.steps] == list(range(14, 4, -1))
    assert growth.batch.mean() < growth.incremental.mean()


def test_table_3_2_is_nearly_the_printed_one() -> None:
    section = uniform_section()
    table = section.tables[0]
    printed, ours, other = (row(table, name) for name in ("paper, symmetric", "ours, symmetric", "ours, asymmetric"))
    assert [printed["E mean, Pa"], printed["nu mean"], printed["error (3.35), %"]] == PAPER["3.2"][0][2:]
    assert ours["E mean, Pa"] == pytest.approx(printed["E mean, Pa"], rel=0.02)
    assert ours["nu mean"] == pytest.approx(printed["nu mean"], abs=0.006)
    assert ours["E lowest, Pa"] == pytest.approx(printed["E lowest, Pa"], abs=15.0)
    assert set(str(printed["most frequent E, Pa"]).split(", ")) < set(str(ours["most frequent E, Pa"]).split(", "))
    assert str(ours["most frequent nu"]).startswith(str(printed["most frequent nu"]))
    assert float(ours["error (3.35), %"]) < 1e-20  # type: ignore[arg-type]
    assert float(ours["error (3.35) of a push from the side, %"]) > 1e-4  # type: ignore[arg-type]
    assert float(other["E lowest, Pa"]) < 0.0  # type: ignore[arg-type]
    assert drawn(section) == 4


def test_table_3_3_is_nearly_the_printed_one() -> None:
    section = layer_section()
    table = section.tables[0]
    for layer, printed, tolerance in zip(LAYERS, PAPER["3.3"], (0.07, 0.05), strict=True):
        paper, ours = row(table, f"{layer}, paper"), row(table, f"{layer}, ours, symmetric")
        assert [paper["E mean, Pa"], paper["nu mean"]] == printed[3:5]
        assert ours["E mean, Pa"] == pytest.approx(printed[3], rel=tolerance)
        assert ours["nu mean"] == pytest.approx(printed[4], abs=0.01)
    assert drawn(section) == 5


def test_an_identified_body_deforms_as_the_true_one_though_no_modulus_is_right() -> None:
    result = identify_cells(cube())
    moduli = result.zones.per_cell(result.estimate.lame_lambda, result.estimate.shear_modulus)
    assert result.again == pytest.approx(result.displacement, abs=1e-10)
    assert result.body.displacement((0.0, 0.0, -20.0), moduli) == pytest.approx(2.0 * result.displacement, abs=1e-9)
    assert (np.abs(result.estimate.young_modulus / UNIFORM[0] - 1.0) > 0.05).mean() > 0.8
    assert result.sideways > 1e18 * result.error


def test_most_frequent_values_are_the_fullest_bins() -> None:
    assert (
        most_frequent(np.array([431.0, 432.0, 439.9, 455.0, 456.0, 601.0, 700.0, 701.0, 702.0, 703.0]), 10.0) == "700-710, 430-440, 450-460"
    )


def test_the_printed_moduli_of_table_3_7_make_a_hundred_times_the_printed_error() -> None:
    table = printed_errors(marker_lattice(EXPERIMENT))
    gel = row(table, "Table 3.7, hardness 0")
    assert gel["printed error, %"] == PAPER["3.7"][1][6]
    assert float(gel["ours, %"]) / float(gel["printed error, %"]) == pytest.approx(100.0, rel=0.05)  # type: ignore[arg-type]
    assert mean_error_percent(cube(), {"lower half": UNIFORM}) == pytest.approx(0.0, abs=1e-20)


def test_markers_are_nodes_and_the_interface_lies_half_way() -> None:
    body = marker_lattice(EXPERIMENT)
    assert body.shape == (5, 5, 5)
    planes = body.mesh.points.reshape(5, 5, 5, 3)
    moved = body.source.displacement.reshape(5, 5, 5, 3)
    assert planes[2, ..., 2] == pytest.approx(30.0)
    fraction = ((30.0 - planes[1, ..., 2]) / (planes[3, ..., 2] - planes[1, ..., 2]))[..., None]
    assert fraction == pytest.approx(0.5, abs=0.06)
    assert moved[2] == pytest.approx((1.0 - fraction) * moved[1] + fraction * moved[3], abs=1e-9)
    assert simplices(body.mesh).measures.sum() == pytest.approx(40.0**3, rel=0.03)
    assert body.mesh.n_cells == 6 * 64
    inner, report = (body.trial(b).loaded.all(axis=1) for b in ("inner", "all but top and bottom"))  # type: ignore[arg-type]
    assert ((~inner).sum(), (~report).sum()) == (27, 75)


def test_noise_biases_least_squares_and_not_the_weighted_balance() -> None:
    study = noise_study(cube(LAYERS), 0.05, 7, 6)
    assert study.over_bound(study.weighted) < 1.5
    assert study.over_bound(study.plain) > 2.0 * study.over_bound(study.weighted)
    assert noise_study(cube(LAYERS), 0.1, 7, 2).bound == pytest.approx(2.0 * study.bound, rel=1e-6)


def test_the_sentence_on_the_bound_follows_from_its_table() -> None:
    section = noise_section(0, 2)
    assert drawn(section) == 1
    ratios = [float(str(row[8])) / float(str(row[4])) for row in section.tables[0].rows]
    assert section.tables[0].columns[4] == "bound" and section.tables[0].columns[7] == "weighted, mean"
    assert f"{min(ratios):.2f} to {max(ratios):.2f} times the Cramer-Rao bound" in section.paragraphs[1]


def test_the_square_has_no_law_for_finite_strain_and_layers_need_fitting_cells() -> None:
    body = square()
    with pytest.raises(InputError, match="solved on tetrahedra only"):
        PushedBody(body.name, body.mesh, body.truth, body.known, body.pushes, "neo_hookean").displacement((0.0, -1.0))
    with pytest.raises(InputError, match="divisions = 6 does not fit 2 layers"):
        cube(LAYERS, divisions=6)
    with pytest.raises(InputError, match="split 'kuhn' is not known"):
        split_hexahedra(np.arange(8)[None], np.zeros((1, 3), dtype=np.int64), "kuhn")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="at least 2"):
        chapter3(draws=1)


@pytest.mark.slow
def test_more_trials_do_not_determine_single_tetrahedra() -> None:
    rows = identifiability_section().tables[0].rows
    for split in ("symmetric", "asymmetric"):
        ranks = [r[4] for r in rows if r[0] == split]
        assert ranks[0] == 150
        assert ranks[2] == ranks[3] < 384  # type: ignore[operator]
    assert all(float(r[7]) < 1e-6 for r in rows if r[7] is not None)


@pytest.mark.slow
def test_the_chapter_is_written(tmp_path: Path) -> None:
    chapter = chapter3(1, draws=2)
    titles = {table.title for section in chapter.sections for table in section.tables}
    assert {"Table 3.1", "Table 2 (2007)", "Table 3.2", "Table 3.3", "Table 3.4", "Table 3.5", "Table 3.7"} <= titles
    page, numbers = write_chapter(chapter, tmp_path)
    assert page.stat().st_size > 100_000
    assert "Table 3.7" in numbers.read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_experiment_converges_at_inner_nodes_with_its_report_beside() -> None:
    section = experiment_section()
    table = section.tables[0]
    assert [row(table, "paper, Table 3.7")[c] for c in ("E, kPa", "nu")] == [155.0, 0.29]
    weighted = [r for r in table.rows if r[0] == "one pair, neo-hookean, weighted" and r[1] == "inner"]
    assert len(weighted) == 2
    assert all(float(r[7]) < 1.5 for r in weighted)  # type: ignore[arg-type]
    body = marker_lattice(EXPERIMENT)
    assert not batch_equilibrium_gap(
        body.mesh, [body.trial("inner")], Zones.of(body.mesh, known={"hardness 5": (222.0, 0.33)})
    ).admissible.all()
