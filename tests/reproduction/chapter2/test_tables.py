"""Chapter 2: the studies against closed forms and static solutions, and the chapter's tables against the measurements they show."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure as Canvas

from naibu.core.errors import InputError
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.mechanics.small_strain.rheology import three_element
from naibu.reproduction.agreement.read_tables import Tables
from naibu.reproduction.chapter2.simulations import NAMES, SQUARES, agar_block, agar_block_3d, agar_under_bar, pushed_square, run
from naibu.reproduction.chapter2.tables import (
    COMPARED,
    REPORTED_ERROR_MM,
    chapter2,
    fitted_push,
    magnetic_resonance_measurement,
    marker_errors,
    ultrasound_trial,
)
from naibu.reproduction.chapters import AGREEMENT
from naibu.validation.analytic.viscoelastic import ramp_stress, released_strain, residual_strain
from naibu.viewer.chapters.chapter import Chapter
from naibu.viewer.tables import Table


@pytest.fixture(scope="module")
def chapter() -> Chapter:
    return chapter2(step_s=0.1, divisions=8, cell_mm=7.5)


def table(chapter: Chapter, name: str) -> Table:
    return next(t for s in chapter.sections for t in s.tables if t.title == name)


@pytest.mark.parametrize("name", SQUARES)
def test_squares_follow_the_closed_form(name: str) -> None:
    """Without inertia the pushed point, and the force in proportion, are the one-dimensional solid's; kept deformation included."""
    study = pushed_square(name, density=None, divisions=8)
    m, series = study.material, study.series
    elements = m.young_modulus, m.voigt_viscosity, m.series_viscosity
    expected = released_strain(elements, 0.2, 10.0, 10.0, series.times)
    calm = np.abs(series.times - 20.0) > 0.06  # without C1 the square snaps back in one step
    assert -series.displacement[calm, study.middle_top, 1] == pytest.approx(expected[calm], abs=2e-6)
    force, pushed = -series.force("indenter")[:, 1], (series.times > 0.0) & (series.times <= 20.0)
    stress = ramp_stress(elements, 1.0, 10.0, series.times[pushed])
    scale = force[pushed].max() / stress.max()
    assert force[pushed] == pytest.approx(scale * stress, abs=1e-5 * force.max())
    assert -series.displacement[-1, study.middle_top, 1] >= residual_strain(elements, 0.2, 10.0, 10.0) - 1e-9


def test_squares_differ_only_after_release() -> None:
    """Same shape until release; then the elastic one comes back, the viscoplastic one stays, the rheological one does a part."""
    studies = {name: pushed_square(name, step_s=0.1) for name in SQUARES}
    early = [s.series.displacement[s.series.times <= 20.0] for s in studies.values()]
    for other in early[1:]:
        assert np.abs(other - early[0]).max() < 0.02  # of a push of 0.2: what inertia makes of it
    end = {name: -s.series.displacement[s.series.times > 20.0, s.middle_top, 1] for name, s in studies.items()}
    assert abs(end["elastic square"].mean()) < 0.05 * 0.2
    assert end["viscoplastic square"] == pytest.approx(0.2, rel=1e-3)
    assert end["rheological square"][-1] == pytest.approx(0.1412, abs=2e-4)  # by the closed form of the test above
    energy = studies["elastic square"].series
    assert (np.diff(energy.dissipated) >= -1e-12).all()


def test_refining_steps_and_mesh_changes_little() -> None:
    coarse, fine = (pushed_square("rheological square", divisions=n, step_s=h) for n, h in ((10, 0.1), (20, 0.05)))
    at = [-s.series.displacement[-1, s.middle_top, 1] for s in (coarse, fine)]
    assert at[0] == pytest.approx(at[1], rel=2e-3)


def test_agar_shape_needs_no_moduli() -> None:
    """Under a prescribed push the shape at rest is the static elastic one, whatever E, C1 and C2: the report's cannot be tested by it."""
    study = agar_block(shifted_cells=1.0)
    mesh = study.mesh
    x, y = mesh.points.T
    top = np.flatnonzero((y == 30.0) & (np.abs(x + 2.5) <= 20.0 + 1e-9))
    assert len(top) == 17
    support = PrescribedDisplacement.none(mesh.n_points, 2).and_also(np.flatnonzero(y == 0.0), (0.0, 0.0)).and_also(top, (0.0, -7.5))
    static = LinearBody.of(mesh, thickness_mm=75.0).solve(*lame_parameters(10.0, 0.35), support)
    assert study.series.displacement[-1] == pytest.approx(static, abs=1e-4)
    other = agar_block(shifted_cells=1.0, material=three_element(55.0, 3.0, 900.0, 0.35))
    assert other.series.displacement[-1] == pytest.approx(static, abs=1e-4)
    assert other.series.force("weight")[-1, 1] < 2.0 * study.series.force("weight")[-1, 1] < 0.0


def test_printed_errors_are_those_of_such_a_simulation() -> None:
    """The report's error figures (trial 1, one mesh left) agree with ours within what supports and lattice points leave open."""
    errors = marker_errors(agar_block(shifted_cells=1.0), ultrasound_trial("trial1"))
    printed = np.array([REPORTED_ERROR_MM[marker] for marker in COMPARED])
    assert np.abs(errors - printed).max() < 0.5
    assert (errors[:, 0] > errors[:, 1]).all()  # "errors along x-axis is relatively large"
    assert np.sqrt((errors**2).mean()) < np.sqrt((printed**2).mean())


def test_symmetry_and_the_shift() -> None:
    """In the middle marker 3 goes straight down; one mesh left it goes to the right."""
    middle, left = (
        s.displacement_at([(0.0, 20.0), (-10.0, 20.0), (10.0, 20.0)], 6.0) for s in (agar_block(), agar_block(shifted_cells=1.0))
    )
    assert middle[0, 0] == pytest.approx(0.0, abs=1e-9) and middle[1] * [-1.0, 1.0] == pytest.approx(middle[2], abs=1e-9)
    assert left[0, 0] > 0.1


def test_three_dimensions_converge() -> None:
    at = [agar_block_3d(cell_mm=cell).displacement_at([(0.0, 0.0, 20.0)], 6.0)[0, 2] for cell in (5.0, 3.0)]
    assert at[0] == pytest.approx(at[1], rel=0.05)
    assert -7.5 < at[1] < 0.0


def test_readings_are_those_of_the_table() -> None:
    first, second = ultrasound_trial("trial1"), ultrasound_trial("trial2")
    assert first.displacement == pytest.approx(np.array([[-3.0, -4.0], [-1.5, -5.0], [2.0, -5.0], [3.5, -5.0], [2.0, -2.5]]))
    assert second.start[2] == pytest.approx([0.0, 17.0]) and second.displacement[4] == pytest.approx([3.5, -2.0])
    seen, trusted = magnetic_resonance_measurement()
    assert seen.ids[~trusted].tolist() == [2, 3]
    assert seen.displacement[4] == pytest.approx([0.0, -2.0])


def test_fitted_push_finds_the_push() -> None:
    """Displacements made with a push of 2.3 mm are recognised as such; doubtful markers have no say."""
    seen, trusted = magnetic_resonance_measurement()
    made = agar_under_bar(push_mm=2.3).displacement_at(seen.start, 1.0)
    made[~trusted] += 100.0
    push, simulated = fitted_push(agar_under_bar(), type(seen)(seen.ids, seen.start, made), trusted)
    assert push == pytest.approx(2.3) and simulated[trusted] == pytest.approx(made[trusted])


def test_tables_show_what_they_say(chapter: Chapter) -> None:
    titles = ["Three squares", "Agar under a weight", "What the ultrasound markers determine of the agar", "Agar under a bar"]
    titles += ["One cross-section every 0.6 s"]
    assert [s.title.split(",")[0] for s in chapter.sections] == titles
    for section in chapter.sections:
        for t in section.tables:
            assert all(len(row) == len(t.columns) for row in t.rows), t.title
            assert all(np.isfinite(c) or "time" in t.columns[i] for row in t.rows for i, c in enumerate(row) if isinstance(c, float)), (
                t.title
            )
    errors = table(chapter, "Errors against ultrasound")
    assert [row[1:3] for row in errors.rows] == [(1.0, 0.5), (1.8, 0.5), (2.8, 0.2)]
    ours = marker_errors(agar_block(shifted_cells=1.0), ultrasound_trial("trial1"))
    assert np.array([row[3:5] for row in errors.rows], dtype=float) == pytest.approx(ours)
    variants = {row[0]: row for row in table(chapter, "Variants").rows}
    assert variants["nu 0.49"][1] < variants["weight in the middle"][1]  # type: ignore[operator]
    squares = table(chapter, "Squares")
    assert [row[4] for row in squares.rows][1:] == pytest.approx([row[5] for row in squares.rows][1:], abs=0.2)
    assert len(table(chapter, "Table 2.1").rows) == 10 and len(table(chapter, "Table 2.2").rows) == 9


def test_figures_are_drawn(chapter: Chapter) -> None:
    for section in chapter.sections:
        for figure in section.figures:
            canvas = Canvas(figsize=figure.size)
            figure.draw(canvas)
            assert canvas.axes and all(a.get_xlabel() or a.get_label() == "<colorbar>" for a in canvas.axes), figure.name


def test_studies_have_names() -> None:
    assert run("agar under a bar").name in NAMES and run("rheological square").name in NAMES
    with pytest.raises(InputError, match="no study called 'dough'"):
        run("dough")
    with pytest.raises(InputError, match="no square called 'round'"):
        pushed_square("round")
    with pytest.raises(InputError, match="outside the body"):
        agar_under_bar().displacement_at([(0.0, 40.0)], 1.0)


def test_the_markers_tell_the_poisson_ratio_and_not_the_moduli(chapter: Chapter) -> None:
    """Agar keeps its volume; a prescribed push says nothing of E, C1 and C2, and the weight gives them one number together."""
    found = table(chapter, "Agar")
    for column in (1, 3):
        estimate = found.rows[0][column]
        assert isinstance(estimate, float) and 0.43 < estimate < 0.5
        low, high = (float(x) for x in str(found.rows[0][column + 1]).split(" to "))
        assert low < estimate < high
    text = " ".join(next(s for s in chapter.sections if found in s.tables).paragraphs)
    assert "C2" in text and "do not determine" in text and "series_viscosity" not in text


def test_statements_of_the_report_find_their_tables(chapter: Chapter) -> None:
    found = AGREEMENT["ch2"](Tables(chapter.sections))
    assert len(found) >= 4 and {"agrees"} <= {c.verdict for c in found}
