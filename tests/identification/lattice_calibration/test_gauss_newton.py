"""Calibration of lattices on virtual twins: derivatives against differences, truth within its intervals, what cannot be told is named."""

from __future__ import annotations

import pickle
import re
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from naibu.core import optional_packages
from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError, MissingDependencyError
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint, evaluated
from naibu.identification.lattice_calibration.evolutionary import cost_of, evaluator, search_cma_es, search_genetic
from naibu.identification.lattice_calibration.forward_model import (
    SAMPLE_S,
    Capture,
    PushedFace,
    PushedLattice,
    Pushing,
    tributary_fractions,
)
from naibu.identification.lattice_calibration.gauss_newton import CalibrationProblem, Index, calibrate_lattice
from naibu.identification.lattice_calibration.least_squares import step_within
from naibu.identification.lattice_calibration.report_indices import indices
from naibu.identification.lattice_calibration.unknowns import FRACTION_NOTE, LatticeUnknowns, identifiability
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters
from naibu.validation.specimens.lattice_twin import TRUTH, dough_lattice, dough_parameters, dough_twin, virtual_capture

BOX_CM = (10, 5, 7.5)
SQUEEZE = Pushing(
    "squeeze",
    (PushedFace((0.0, 0.0, 25.0), (0.0, 50.0, 50.0), (20.0, 0.0, 0.0)),
     PushedFace((100.0, 0.0, 25.0), (100.0, 50.0, 50.0), (-20.0, 0.0, 0.0))),
    0.4, 0.4, 0.4, (0.0, 0.2, 0.4, 0.8, 1.2),
)  # fmt: skip
THREE = {"K": 100.0, "C1": 50.0, "C2": 150.0}
START = {"K": 50.0, "C1": 100.0, "C2": 80.0}


@pytest.fixture(scope="module")
def lattice() -> Lattice:
    return dough_lattice(25.0, size_cm=BOX_CM)


@pytest.fixture(scope="module")
def unknowns(lattice: Lattice) -> LatticeUnknowns:
    return LatticeUnknowns.of(lattice, classes=False)


@pytest.fixture(scope="module")
def truth(unknowns: LatticeUnknowns) -> LatticeParameters:
    return unknowns.parameters(unknowns.vector(THREE))


@pytest.fixture(scope="module")
def capture(lattice: Lattice, truth: LatticeParameters) -> Capture:
    return virtual_capture(lattice, truth, SQUEEZE, seed=0, points=300)


@pytest.mark.parametrize("index", ["shape", "force"])
def test_derivatives_of_residuals_are_finite_differences(
    lattice: Lattice, capture: Capture, unknowns: LatticeUnknowns, index: Index
) -> None:
    problem = CalibrationProblem.of(lattice, [capture], unknowns, index=index)
    theta = np.log([80.0, 60.0, 120.0])
    point, h = evaluated(problem, theta), 1e-3
    which = int(index == "force")
    for k in range(3):
        step = h * np.eye(3)[k]
        ahead, behind = (evaluated(problem, theta + s * step, derivatives=False).residual[which] for s in (1.0, -1.0))
        expected = (ahead - behind) / (2.0 * h)
        # points whose closest triangle changes between the two are few; the solver's tolerance of 1e-2 is felt in forces
        assert np.linalg.norm(point.slopes[which][:, k] - expected) < 1e-2 * np.linalg.norm(expected)


@pytest.mark.parametrize("index", ["shape", "force", "joint"])
def test_the_truth_lies_within_the_intervals(lattice: Lattice, capture: Capture, unknowns: LatticeUnknowns, index: Index) -> None:
    """95 % intervals widened to 99.9 %, so that this fails once in a thousand draws of noise."""
    found = calibrate_lattice(CalibrationProblem.of(lattice, [capture], unknowns, index=index), START)
    z = np.log(found.values / np.array(list(THREE.values()))) / np.sqrt(np.diag(found.covariance))
    assert np.abs(z).max() < 3.3
    for factor in (f for f in found.noise_factor if np.isfinite(f)):
        assert 0.9 < factor < 1.1
    assert found.runs < 100
    if index != "shape":
        assert np.sqrt(np.diag(found.covariance)).max() < 0.05


def test_intervals_come_from_derivatives_at_the_estimate(lattice: Lattice, capture: Capture, unknowns: LatticeUnknowns) -> None:
    """Not from those that steps of the search improved, 2 % off here; relative to their trace, as the noise may be taken as larger."""
    problem = CalibrationProblem.of(lattice, [capture], unknowns, index="shape")
    found = calibrate_lattice(problem, {"K": 20.0, "C1": 100.0, "C2": 400.0})
    expected = evaluated(problem, np.log(found.values)).information
    np.testing.assert_allclose(found.information / np.trace(found.information), expected / np.trace(expected), rtol=1e-6)


def test_a_search_from_values_near_by_ends_where_the_long_one_does(lattice: Lattice, capture: Capture, unknowns: LatticeUnknowns) -> None:
    problem = CalibrationProblem.of(lattice, [capture], unknowns)
    far = calibrate_lattice(problem, START)
    near = calibrate_lattice(problem, START, warm_start=1.05 * far.values, widen=False)
    deviation = np.sqrt(np.diag(far.covariance))
    assert (np.abs(np.log(near.values / far.values)) < 0.1 * deviation).all()
    assert near.runs < 0.5 * far.runs
    assert (np.sqrt(np.diag(near.covariance)) < 1.01 * deviation).all()  # not widened
    with pytest.raises(InputError, match="K must be positive"):
        calibrate_lattice(problem, START, warm_start=[-1.0, 1.0, 1.0])


@pytest.mark.parametrize("reach", [100.0, 1.0, 0.01])
def test_steps_within_a_reach_are_minima_of_the_linearised_cost(reach: float) -> None:
    """Where the step is held back, what is left of the gradient points along it: the condition of Karush, Kuhn and Tucker."""
    rng = np.random.default_rng(3)
    slopes = rng.standard_normal((30, 4)) * [30.0, 5.0, 1.0, 1e-3]
    point = EvaluatedPoint(
        np.array([1.0, 2.0, 3.0, 9.0]), (30.0 * rng.standard_normal(20), rng.standard_normal(10)), (slopes[:20], slopes[20:])
    )
    centre = np.zeros(4)
    step, decrease = step_within(point, centre, 1.2, reach)

    def cost(change: FloatArray) -> float:
        residual = np.concatenate(point.residual) + slopes @ change
        return float(residual @ residual + (((point.theta + change - centre) / 1.2) ** 2).sum())

    assert decrease == pytest.approx(cost(np.zeros(4)) - cost(step), rel=1e-9)
    left = np.array([cost(step - h) - cost(step + h) for h in 1e-4 * np.eye(4)]) / 4e-4  # minus half the gradient
    if reach == 100.0:
        assert np.abs(left).max() < 1e-5
    else:
        assert np.abs(step).max() == pytest.approx(reach, rel=1e-2)
        assert left @ step == pytest.approx(np.linalg.norm(left) * np.linalg.norm(step), rel=1e-5)


def test_forces_add_what_shapes_alone_do_not_tell(lattice: Lattice, capture: Capture, unknowns: LatticeUnknowns) -> None:
    """Displacement-driven shapes depend on ratios only, but for inertia: K, C1 and C2 together are not determined without force."""
    found = calibrate_lattice(CalibrationProblem.of(lattice, [capture], unknowns, index="shape"), START)
    _, vectors = np.linalg.eigh(found.information)
    assert np.abs(vectors[:, 0]) == pytest.approx(np.full(3, 3**-0.5), abs=0.1)
    assert any(s.startswith("the common scale of all 3") and "not determine this combination" in s for s in found.undetermined)
    assert found.undetermined[-1] == FRACTION_NOTE


def test_force_pushed_forces_tell_next_to_nothing(lattice: Lattice, capture: Capture, unknowns: LatticeUnknowns) -> None:
    """Whatever the parameters, the lattice answers a force with the same force, less the inertia of the nodes that it acts on."""
    by_force, by_displacement = (
        evaluated(CalibrationProblem.of(lattice, [capture], unknowns, index="force", mode=mode), np.log(list(THREE.values()))).information
        for mode in ("force", "displacement")
    )
    assert np.trace(by_force) < 1e-2 * np.trace(by_displacement)


def test_noise_is_enlarged_where_the_law_does_not_fit(lattice: Lattice, truth: LatticeParameters, unknowns: LatticeUnknowns) -> None:
    stiff_skin = LatticeUnknowns.of(lattice, classes=False, zones=True)
    skin = {n: THREE[n.split()[0]] * (1.5 if n.startswith("K surface") else 1.0) for n in stiff_skin.names}
    other = LatticeParameters(
        truth.stiffness * np.where(lattice.element_class == 0, 2.0, 1.0), truth.voigt_damping, truth.series_damping, truth.voigt_fraction
    )
    assert set(skin) == set(stiff_skin.names)
    capture = virtual_capture(lattice, other, SQUEEZE, seed=1, points=300, force_sd_mn=2.0)
    found = calibrate_lattice(CalibrationProblem.of(lattice, [capture], unknowns), START)
    assert found.noise_factor[1] > 2.0
    plain = calibrate_lattice(CalibrationProblem.of(lattice, [capture], unknowns), START, reweigh=False)
    assert np.diag(found.covariance).min() > np.diag(plain.covariance).min()


def test_indices_of_the_truth_are_those_of_the_noise(lattice: Lattice, truth: LatticeParameters, capture: Capture) -> None:
    found = indices(capture, PushedLattice.of(lattice, SQUEEZE), truth)
    sd = capture.point_sd_mm
    expected = 300 * sd * np.sqrt(2.0 / np.pi) * np.exp(-0.5)  # of |x| over |x| >= sd, x normal
    assert np.array(found.shape_mm) == pytest.approx(np.full(5, expected), rel=0.25)
    assert found.samples == 200
    mean = capture.force_sd_mn * np.sqrt(8.0 / np.pi)  # length of a normal vector of three components
    assert found.force_mn == pytest.approx(2 * 200 * mean, rel=0.1)


def test_bilinear_shares_of_a_patch(lattice: Lattice) -> None:
    nodes = np.flatnonzero(lattice.points[:, 0] == 0.0)
    fractions = tributary_fractions(lattice, nodes)
    y, z = lattice.points[nodes, 1], lattice.points[nodes, 2]
    at_edge = (np.isin(y, (0.0, 50.0)).astype(int)) + np.isin(z, (0.0, 75.0))
    np.testing.assert_allclose(fractions, 0.5**at_edge / (0.5**at_edge).sum())


def test_unknowns_by_class_and_zone() -> None:
    lattice = dough_lattice(12.5, size_cm=(5, 5, 5))
    both = LatticeUnknowns.of(lattice, zones=True)
    assert len(both.names) == 18 and "C2 long core" in both.names
    assert (both.members.sum(axis=0) == 3).all()
    values = both.vector({"K": 2.0, "C1": 3.0, "C2": 4.0})
    table = both.parameters(values)
    assert np.unique(table.stiffness).tolist() == [2.0] and np.unique(table.series_damping).tolist() == [4.0]
    slopes = both.changes(values)
    np.testing.assert_allclose(sum(s.stiffness for s in slopes), table.stiffness)
    nine = LatticeUnknowns.of(lattice)
    assert nine.names == tuple(TRUTH)


def test_undetermined_combinations_are_named() -> None:
    way = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
    information = 1e4 * (np.eye(3) - np.outer(way, way))
    said = identifiability(("K", "C1", "C2"), information)
    assert len(said) == 2
    assert {"K", "C1"} == set(re.findall(r"K|C1|C2", said[0].split(":")[0])) and "at all" in said[0]


def test_searches_find_the_minimum_by_any_way_of_computing(lattice: Lattice, capture: Capture, unknowns: LatticeUnknowns) -> None:
    pytest.importorskip("cma")
    problem = CalibrationProblem.of(lattice, [capture], unknowns)
    best = calibrate_lattice(problem, START)
    least = cost_of(problem, np.log(best.values), measure="chi-squared")
    found = search_cma_es(problem, START, seed=1, measure="chi-squared", max_runs=250)
    assert found.cost < least + 10.0
    assert found.values == pytest.approx(best.values, rel=0.05)
    assert (np.diff(found.history) <= 0.0).all() and found.runs <= 260


def test_the_genetic_algorithm_improves(lattice: Lattice, capture: Capture, unknowns: LatticeUnknowns) -> None:
    pytest.importorskip("pymoo")
    problem = CalibrationProblem.of(lattice, [capture], unknowns)
    found = search_genetic(problem, START, seed=1, population=20, max_runs=120)
    assert found.cost < 0.5 * cost_of(problem, np.log(unknowns.vector(START)))
    again = search_genetic(problem, START, seed=1, population=20, max_runs=120)
    np.testing.assert_array_equal(found.values, again.values)


class Immediate:
    """What of a `dask.distributed.Client` is used, computing at once."""

    def scatter(self, what: Any, broadcast: bool = False) -> Any:
        return what

    def submit(self, function: Any, *arguments: Any, pure: bool = True) -> Any:
        return function(*arguments)

    def gather(self, futures: Sequence[Any]) -> list[Any]:
        return list(futures)


def test_costs_are_the_same_here_and_on_a_client(lattice: Lattice, capture: Capture, unknowns: LatticeUnknowns) -> None:
    problem = CalibrationProblem.of(lattice, [capture], unknowns)
    thetas = [np.log(unknowns.vector(START)), np.log(unknowns.vector(THREE))]
    with evaluator(problem) as here, evaluator(problem, client=Immediate()) as there:
        assert here(thetas) == there(thetas)
    with pytest.raises(InputError, match="must be positive, not 0"), evaluator(problem, workers=0):
        pass


@pytest.mark.slow
def test_costs_are_the_same_in_processes_and_on_a_cluster(lattice: Lattice, capture: Capture, unknowns: LatticeUnknowns) -> None:
    distributed = pytest.importorskip("distributed")
    problem = CalibrationProblem.of(lattice, [capture], unknowns)
    thetas = [np.log(unknowns.vector(START)), np.log(unknowns.vector(THREE))]
    with evaluator(problem) as here, evaluator(problem, workers=2) as apart:
        expected = here(thetas)
        assert apart(thetas) == expected
    options = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client, evaluator(problem, client=client) as remote:
        assert remote(thetas) == expected


class Copying(Executor):
    """An executor that gives the work away as bytes, as one of other processes does, and computes it at once."""

    def submit(self, function: Any, /, *arguments: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        function, arguments = pickle.loads(pickle.dumps((function, arguments)))
        future.set_result(pickle.loads(pickle.dumps(function(*arguments, **named))))
        return future


def test_derivatives_are_the_same_by_any_executor(lattice: Lattice, capture: Capture, unknowns: LatticeUnknowns) -> None:
    problem = CalibrationProblem.of(lattice, [capture], unknowns)
    here, there = (calibrate_lattice(problem, START, executor=executor) for executor in (None, Copying()))
    np.testing.assert_array_equal(here.values, there.values)
    np.testing.assert_array_equal(here.covariance, there.covariance)


@pytest.mark.slow
def test_a_calibration_on_a_cluster_is_the_same(lattice: Lattice, capture: Capture, unknowns: LatticeUnknowns) -> None:
    distributed = pytest.importorskip("distributed")
    problem = CalibrationProblem.of(lattice, [capture], unknowns)
    here = calibrate_lattice(problem, START)
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
        there = calibrate_lattice(problem, START, executor=client.get_executor())
    np.testing.assert_allclose(there.values, here.values, rtol=1e-12)


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch, lattice: Lattice, capture: Capture, unknowns: LatticeUnknowns) -> None:
    def missing(name: str) -> Any:
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(optional_packages.importlib, "import_module", missing)
    problem = CalibrationProblem.of(lattice, [capture], unknowns)
    with pytest.raises(MissingDependencyError, match=r'calibration by CMA-ES needs cma .*pip install "naibu\[calibrate\]"'):
        search_cma_es(problem, START, seed=0)
    with pytest.raises(MissingDependencyError, match="calibration by a genetic algorithm needs pymoo"):
        search_genetic(problem, START, seed=0)


def test_wrong_captures_are_told(lattice: Lattice, capture: Capture) -> None:
    def made(points: Any = capture.points, force: Any = capture.force, sd: float = 0.5) -> Capture:
        return Capture.of(SQUEEZE, points, force, lattice, point_sd_mm=sd, force_sd_mn=50.0)

    far = (capture.points[0] + np.array([500.0, 0.0, 0.0]), *capture.points[1:])
    with pytest.raises(InputError, match=r"300 of 300 captured points at 0 s lie up to .* check the unit"):
        made(points=far)
    with pytest.raises(InputError, match="4 sets of points for 5 times of capture"):
        made(points=capture.points[:4])
    with pytest.raises(InputError, match=r"0.8 s of contact are 400 samples of 2 ms.*resample"):
        made(force=capture.force[::2])
    broken = capture.force.copy()
    broken[7, 0, 1] = np.nan
    with pytest.raises(InputError, match=r"1 force samples hold NaN, the first at 0.014 s"):
        made(force=broken)
    lost = (np.full((3, 3), np.nan), *capture.points[1:])
    with pytest.raises(InputError, match="3 of 3 points of capture 0 of squeeze hold NaN"):
        made(points=lost)
    with pytest.raises(InputError, match="standard deviation of points must be positive"):
        made(sd=0.0)


def test_wrong_problems_are_told(lattice: Lattice, capture: Capture, unknowns: LatticeUnknowns) -> None:
    with pytest.raises(InputError, match="no capture"):
        CalibrationProblem.of(lattice, [])
    with pytest.raises(InputError, match="'shape', 'force' or 'joint'"):
        CalibrationProblem.of(lattice, [capture], index="colour")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"0\.4 s is no whole number of steps of 0\.03 s"):
        CalibrationProblem.of(lattice, [capture], window_s=0.03)
    with pytest.raises(InputError, match="there is no parameter 'K3'"):
        unknowns.vector({"K": 1.0, "C1": 1.0, "C2": 1.0, "K3": 1.0})
    with pytest.raises(InputError, match="no value is given for C2"):
        unknowns.vector({"K": 1.0, "C1": 1.0})
    with pytest.raises(InputError, match="K must be positive"):
        unknowns.vector({"K": 0.0, "C1": 1.0, "C2": 1.0})
    with pytest.raises(ConvergenceError, match="did not settle within 2 iterations"):
        calibrate_lattice(CalibrationProblem.of(lattice, [capture], unknowns), START, max_iterations=2)
    with pytest.raises(InputError, match="pushing by force needs the measured forces"):
        PushedLattice.of(lattice, SQUEEZE, "force")
    inside = replace(SQUEEZE, faces=(PushedFace((25.0, 25.0, 25.0), (25.0, 25.0, 25.0), (1.0, 0.0, 0.0)),))
    with pytest.raises(InputError, match="starts inside of the object"):
        PushedLattice.of(lattice, inside)
    beside = replace(SQUEEZE, faces=(PushedFace((-9.0, 0.0, 0.0), (-8.0, 50.0, 50.0), (1.0, 0.0, 0.0)),))
    with pytest.raises(InputError, match="touches no node"):
        PushedLattice.of(lattice, beside)
    with pytest.raises(InputError, match="laws are"):
        dough_twin(law="other")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="does not divide"):
        dough_lattice(30.0)


def test_cameras_see_about_the_wanted_points_on_the_surface(lattice: Lattice, truth: LatticeParameters) -> None:
    exact = virtual_capture(lattice, truth, SQUEEZE, seed=3, points=400, point_sd_mm=1e-9, force_sd_mn=1e-9)
    moved = PushedLattice.of(lattice, SQUEEZE)
    found = indices(replace(exact, point_sd_mm=1e-4), moved, truth)
    assert found.points == (400,) * 5
    assert sum(found.shape_mm) < 5.0  # the twin is computed to a tighter tolerance than `indices`: micrometres
    assert all((p[:, 2] > 1e-3).mean() > 0.98 for p in exact.points)  # nothing of the floor
    assert exact.force.shape == (round(0.8 / SAMPLE_S), 2, 3)


@pytest.mark.slow
def test_nine_parameters_of_the_dough_lie_within_their_intervals() -> None:
    twin = dough_twin(seed=5)
    lattice = dough_lattice()
    found = calibrate_lattice(CalibrationProblem.of(lattice, twin.captures), {"K": 30.0, "C1": 30.0, "C2": 30.0})
    truth = np.array([TRUTH[n] for n in found.unknowns.names])
    z = np.log(found.values / truth) / np.sqrt(np.diag(found.covariance))
    assert np.abs(z).max() < 3.5
    np.testing.assert_allclose(dough_parameters(lattice).stiffness, found.unknowns.parameters(truth).stiffness)
