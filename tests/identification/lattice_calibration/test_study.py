"""Calibration by studies: against the simulation, differences, the closed form of a block that is pushed over a floor, and known truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lattice_studies import study_file

from naibu.core.errors import InputError
from naibu.core.progress import ProgressReport
from naibu.identification.lattice_calibration.captured.recorded_forces import RecordedForces
from naibu.identification.lattice_calibration.evaluation import evaluated
from naibu.identification.lattice_calibration.gauss_newton import PRIOR_SD, calibrate_lattice, estimate_at
from naibu.identification.lattice_calibration.studies.study_model import StudyModel
from naibu.identification.lattice_calibration.studies.study_problem import StudyProblem
from naibu.identification.lattice_calibration.studies.study_unknowns import StudyUnknowns
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.simulation.loading_history import LatticeStudy, run_study
from naibu.workflows.studies.lattice_study import prepared_study

SQUEEZED = """
[object]
size_mm = [30, 20, 20]
mass_g = 12.0
[lattice]
spacing_mm = 10.0
[parameters]
K = 40.0
C1 = 10.0
C2 = 100.0
[simulation]
duration_s = 0.4
gravity_mm_per_s2 = 9810
[floor]
[[indenter]]
name = "stamp"
shape = "box"
size_mm = [10, 20, 10]
centre_mm = [-5.0, 10.0, 15.0]
contact = "tied"
until_s = 0.3
path = [[0.0, 0, 0, 0], [0.1, 3, 0, 0], [0.2, 3, 0, 0], [0.25, 1, 0, 0]]
[output]
every_s = 0.02
"""
PUSHED = """
[object]
size_mm = [40, 20, 20]
mass_g = 200.0
[lattice]
spacing_mm = 10.0
[parameters]
K = 400.0
C1 = 40.0
C2 = inf
[simulation]
duration_s = 0.4
gravity_mm_per_s2 = 9810
[floor]
contact = "friction"
static_friction = 0.6
kinetic_friction = 0.45
[[indenter]]
name = "slider"
shape = "box"
size_mm = [10, 10, 10]
centre_mm = [-5.0, 10.0, 5.0]
path = [[0.0, 0, 0, 0], [0.4, 12, 0, 0]]
[output]
every_s = 0.02
"""
PRESSED = """
[object]
size_mm = [30, 30, 30]
mass_g = 32.4
[lattice]
spacing_mm = 10.0
[parameters]
K = { short = 60.0, normal = 40.0, long = 25.0 }
C1 = { short = 30.0, normal = 18.0, long = 12.0 }
C2 = { short = 900.0, normal = 700.0, long = 500.0 }
[simulation]
duration_s = 1.2
gravity_mm_per_s2 = 9810
[floor]
contact = "friction"
static_friction = 0.5
kinetic_friction = 0.4
[[indenter]]
name = "plate"
shape = "box"
size_mm = [90, 90, 10.0]
centre_mm = [15.0, 15.0, 35.0]
static_friction = 0.5
kinetic_friction = 0.4
path = [[0.0, 0, 0, 0], [1.0, 0, 0, -3.6], [1.2, 3.6, 0, -3.6]]
"""

FLOOR, MU = "kinetic friction of floor", 0.3


@pytest.fixture
def squeezed(tmp_path: Path) -> LatticeStudy:
    return prepared_study(study_file(tmp_path, SQUEEZED)).study


@pytest.fixture
def pushed(tmp_path: Path) -> LatticeStudy:
    return prepared_study(study_file(tmp_path, PUSHED)).study


@pytest.mark.parametrize("text", [SQUEEZED, PUSHED], ids=["tied", "touching"])
def test_the_forward_model_is_the_simulation(tmp_path: Path, text: str) -> None:
    study = prepared_study(study_file(tmp_path, text)).study
    unknowns = StudyUnknowns.of(study)
    frames = list(run_study(study))
    model = StudyModel.of(study, [0.2, 0.4], 20, 10, coarse=False)
    found = model.run(unknowns.parameters(unknowns.start))
    for position, frame in zip(found.positions, (frames[10], frames[20]), strict=True):
        assert np.abs(position - frame.state.lattice.position).max() < 2e-3
    force = np.array([frame.force.mean(axis=0) for frame in frames[1:]])
    assert np.abs(found.force - force).max() < 5e-3 * np.abs(force).max()


def test_forces_in_contact_change_little_where_a_parameter_changes_by_a_millionth(tmp_path: Path) -> None:
    """Force and shape are continuous in the parameters but for points that begin to slip, which what the solver leaves may decide."""
    unknowns = StudyUnknowns.of(prepared_study(study_file(tmp_path, PRESSED)).study)
    model = StudyModel.of(unknowns.study, [1.2], 60, 10, coarse=False)
    found = [model.run(unknowns.parameters(unknowns.start * (1.0 + h * (np.arange(9) == k)))) for h, k in ((0.0, 0), (1e-6, 0), (1e-6, 3))]
    for other in found[1:]:
        assert np.abs(other.force - found[0].force).max() < 7e-3 * np.abs(found[0].force).max()
        assert np.abs(other.positions - found[0].positions).max() < 0.05


def test_derivatives_of_a_tied_study_are_differences(squeezed: LatticeStudy) -> None:
    unknowns = StudyUnknowns.of(replace(squeezed, tolerance=1e-8), groups="all")
    model = StudyModel.of(unknowns.study, [0.1, 0.4], 20, 10, coarse=False)
    found, h = model.run(unknowns.parameters(unknowns.start), unknowns.changes(unknowns.start)), 1e-4
    for k in range(3):
        ahead, behind = (model.run(unknowns.parameters(unknowns.start * np.exp(s * h * np.eye(3)[k]))) for s in (1.0, -1.0))
        for slope, name in ((found.positions_change[k], "positions"), (found.force_change[k], "force")):
            expected = (getattr(ahead, name) - getattr(behind, name)) / (2.0 * h)
            assert np.linalg.norm(slope - expected) < 1e-2 * np.linalg.norm(expected)


def test_shares_of_samples_weigh_the_steps_alike(squeezed: LatticeStudy) -> None:
    """A record of samples of single steps is met by the parameters that made it, without any noise, however sparse it is."""
    unknowns = StudyUnknowns.of(squeezed)
    fine = StudyModel.of(squeezed, [], 200, 1, coarse=False).run(unknowns.parameters(unknowns.start)).force[:, 1]
    steps = np.arange(1, 200, 3)
    recorded = RecordedForces.of(squeezed, [(1, squeezed.step_s * (steps + 0.5), fine[steps])], sd_mn=1.0)
    problem = StudyProblem.of(unknowns, [], recorded, point_sd_mm=0.5)
    residual = evaluated(problem, np.log(unknowns.start), derivatives=False, fine=True).residual[1]
    assert len(residual) == 3 * 20
    assert np.abs(residual).max() < 1e-3 * np.abs(fine).max()


def steadily_pushed(study: LatticeStudy) -> StudyProblem:
    """Return the search for friction of a block that slides steadily: pushed by mu_k m g, by that law alone, not by a simulation."""
    times, weight = np.arange(0.2, 0.4, 0.001), 200e-3 * 9810.0
    force = np.column_stack([np.full(len(times), MU * weight), np.zeros((len(times), 2))])
    noisy = force + 5.0 * np.random.default_rng(0).standard_normal(force.shape)
    recorded = RecordedForces.of(study, [(1, times, noisy)], sd_mn=5.0)
    return StudyProblem.of(StudyUnknowns.of(study, groups="given", friction="each"), [], recorded, point_sd_mm=0.5)


def test_without_regressions_intervals_in_contact_are_those_of_the_prior(pushed: LatticeStudy) -> None:
    made = steadily_pushed(pushed)
    found = calibrate_lattice(made, made.unknowns.start, widen=False, threads=1)
    assert found.finished and not found.settled and "weak prior" in found.remarks[0]
    assert (np.diag(found.covariance) >= PRIOR_SD**2).all()


def test_friction_of_a_pushed_block_is_force_over_weight(pushed: LatticeStudy) -> None:
    problem = steadily_pushed(pushed)
    found = calibrate_lattice(problem, problem.unknowns.start)
    place = problem.unknowns.names.index(FLOOR)
    assert found.values[place] == pytest.approx(MU, rel=0.01)
    low, high = found.intervals()[place]
    assert low < MU < high and high - low < 0.05
    assert any("static friction of floor" in sentence for sentence in found.undetermined)


def test_truth_of_a_squeezed_block_lies_within_its_intervals(squeezed: LatticeStudy) -> None:
    unknowns, rng = StudyUnknowns.of(squeezed, groups="all"), np.random.default_rng(1)
    truth = unknowns.start * [1.6, 0.6, 1.4]
    model = StudyModel.of(squeezed, [0.1, 0.4], 200, 1, coarse=False)
    made = model.run(unknowns.parameters(truth))
    nodes = np.flatnonzero(squeezed.lattice.surface_node & (squeezed.lattice.points[:, 2] > 0.0))
    clouds = [(t, x[nodes] + 0.05 * rng.standard_normal((len(nodes), 3))) for t, x in zip((0.1, 0.4), made.positions, strict=True)]
    noisy = made.force[:, 1] + 10.0 * rng.standard_normal((200, 3))
    recorded = RecordedForces.of(squeezed, [(1, squeezed.step_s * (np.arange(200) + 0.5), noisy)])
    assert recorded.sd_mn[1] == pytest.approx(10.0, rel=0.2)
    reports: list[ProgressReport] = []
    found = calibrate_lattice(StudyProblem.of(unknowns, clouds, recorded, point_sd_mm=0.05), unknowns.start, progress=reports.append)
    z = np.log(found.values / truth) / np.sqrt(np.diag(found.covariance))
    assert np.abs(z).max() < 3.3  # once in a thousand draws
    assert np.sqrt(np.diag(found.covariance)).max() < 0.2
    assert reports[-1].done == len(reports) and found.finished


@pytest.mark.parametrize("after", [1, 2, 3, 4, 6])
def test_an_interruption_keeps_the_best_so_far(squeezed: LatticeStudy, after: int) -> None:
    """With intervals that reach the truth, however far it still was from there."""
    unknowns = StudyUnknowns.of(squeezed, groups="all")
    truth = 2.0 * unknowns.start
    force = StudyModel.of(squeezed, [], 200, 1, coarse=False).run(unknowns.parameters(truth)).force[:, 1]
    recorded = RecordedForces.of(squeezed, [(1, squeezed.step_s * (np.arange(200) + 0.5), force)], sd_mn=10.0)
    problem = StudyProblem.of(unknowns, [], recorded, point_sd_mm=0.5)

    def stop(report: ProgressReport) -> None:
        if report.done == after:
            raise KeyboardInterrupt

    found = calibrate_lattice(problem, unknowns.start, progress=stop)
    points = [evaluated(problem, np.log(values), derivatives=False) for values in (unknowns.start, found.values)]
    costs = [sum((r**2).sum() for r in point.residual) for point in points]
    assert not found.finished and "few percent off" in found.remarks[0]
    assert costs[1] <= costs[0]
    assert after < 4 or costs[1] < costs[0]
    assert (np.abs(np.log(found.values / truth)) < 1.96 * np.sqrt(np.diag(found.covariance))).all()


def test_an_interruption_in_contact_leaves_what_the_prior_holds(pushed: LatticeStudy) -> None:
    """Differences of simulations count jumps as information, and nothing has told them apart yet."""
    problem = steadily_pushed(pushed)

    def stop(report: ProgressReport) -> None:
        if report.done == 7:
            raise KeyboardInterrupt

    found = calibrate_lattice(problem, problem.unknowns.start, progress=stop)
    assert not found.finished and not found.settled and "interrupted" in found.remarks[0]
    assert (np.sqrt(np.diag(found.covariance)) >= PRIOR_SD).all()
    assert not found.determined().any()


def test_values_of_another_search_get_intervals_of_regressions_in_contact(pushed: LatticeStudy) -> None:
    problem = steadily_pushed(pushed)
    searched = calibrate_lattice(problem, problem.unknowns.start)
    found = estimate_at(problem, 1.02 * searched.values)
    place = problem.unknowns.names.index(FLOOR)
    low, high = found.intervals()[place]
    assert found.settled
    assert low < MU < high and high - low < 0.05
    assert not found.determined()[problem.unknowns.names.index("static friction of floor")]
    interrupted = estimate_at(problem, searched.values, finished=False)
    assert interrupted.runs == 1 and not interrupted.finished
    assert not interrupted.determined().any()


def test_masses_of_the_surface_keep_the_total() -> None:
    with pytest.raises(InputError, match="all nodes of the lattice are at its surface"):
        StudyUnknowns.of(still_box((2, 2, 1)), surface_mass=True)
    unknowns = StudyUnknowns.of(still_box((2, 2, 2)), groups="given", surface_mass=True)
    lattice, mass = unknowns.study.lattice, unknowns.parameters(np.array([0.5])).node_mass
    assert mass.sum() == pytest.approx(0.01)
    assert mass[lattice.surface_node].mean() == pytest.approx(0.5 * mass[~lattice.surface_node].mean())


def still_box(cells: tuple[int, int, int]) -> LatticeStudy:
    lattice = classic_lattice(box_mask(cells), 10.0, total_mass_kg=0.01)
    return LatticeStudy(lattice, lattice_parameters(lattice, 40.0, 10.0, 100.0), (), 0.002, 1)
