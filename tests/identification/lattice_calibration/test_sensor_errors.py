"""Errors of force sensors: against closed forms, and forces of a voxel that scipy integrates."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest
from lattice_studies import study_file
from scipy.integrate import solve_ivp

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.identification.lattice_calibration.captured.force_history import SampledMeans
from naibu.identification.lattice_calibration.captured.recorded_forces import RecordedForces
from naibu.identification.lattice_calibration.captured.sensor_errors import ANY_DRIFT, LITTLE_DRIFT, NO_ERRORS, SensorErrors
from naibu.identification.lattice_calibration.gauss_newton import calibrate_lattice
from naibu.identification.lattice_calibration.intervals.sensor_diagnosis import diagnosed, sensor_errors_found
from naibu.identification.lattice_calibration.intervals.unnoticed_drift import counted_drift, unnoticed_drift
from naibu.identification.lattice_calibration.studies.study_problem import StudyProblem
from naibu.identification.lattice_calibration.studies.study_unknowns import StudyUnknowns
from naibu.workflows.studies.lattice_study import prepared_study

SPACING, DEPTH, ENDS, NOISE_MN = 10.0, 2.0, 0.5, 5.0
TRUTH = np.array([60.0, 4.0, 50.0])
BOTH = SensorErrors(offset=True, delay=True)


def pressed(times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far the face is pressed down, mm, and its speed, mm/s: smoothly from 0.1 to 0.25 s."""
    u = np.clip((times - 0.1) / 0.15, 0.0, 1.0)
    return DEPTH * u**3 * (10.0 - 15.0 * u + 6.0 * u**2), DEPTH * 30.0 * (u * (1.0 - u)) ** 2 / 0.15


PATH = [[round(float(t), 3), 0.0, 0.0, -round(float(pressed(np.array(t))[0]), 6)] for t in np.arange(0.0, ENDS, 0.002)]
VOXEL = f"""
[object]
size_mm = [10, 10, 10]
mass_g = 1.0
[lattice]
spacing_mm = 10.0
[parameters]
K = 40.0
C1 = 6.0
C2 = 30.0
[simulation]
duration_s = {ENDS}
[floor]
[[indenter]]
name = "stamp"
shape = "box"
size_mm = [10, 10, 10]
centre_mm = [5.0, 5.0, 15.0]
contact = "tied"
path = {PATH}
[output]
every_s = 0.02
"""


def force_of_a_voxel(times: FloatArray) -> FloatArray:
    """Return the force (n, 3) on the upper face: springs and dashpots between corners that all move as they are told."""
    corners = [np.array(c) for c in product((0, 1), repeat=3)]
    across = [np.abs(b - a) for a, b in combinations(corners, 2) if a[2] != b[2]]
    flat = SPACING * np.array([np.hypot(d[0], d[1]) for d in across])
    k, c1, c2 = TRUTH

    def lengths(time: float) -> tuple[FloatArray, FloatArray]:
        height, speed = (float(v) for v in pressed(np.array(time)))
        length = np.hypot(flat, SPACING - height)
        return length, -speed * (SPACING - height) / length

    def rate(time: float, z: FloatArray) -> FloatArray:
        return np.asarray((c2 * lengths(time)[1] - k * z) / (c1 + c2))

    found = solve_ivp(rate, (0.0, ENDS), np.zeros(len(flat)), t_eval=times, rtol=1e-8, atol=1e-10, max_step=0.01)
    force = np.zeros((len(times), 3))
    for n, (time, z) in enumerate(zip(times, found.y.T, strict=True)):
        tension = k * z + c1 * rate(time, z)
        force[n, 2] = tension @ ((SPACING - float(pressed(np.array(time))[0])) / lengths(time)[0])
    return force


@pytest.fixture(scope="module")
def times() -> FloatArray:
    return np.asarray(np.arange(0.0006, ENDS, 0.001))


@pytest.fixture(scope="module")
def clean(times: FloatArray) -> FloatArray:
    fine = np.linspace(0.0, ENDS, 2001)
    force = force_of_a_voxel(fine)
    return np.stack([fine, force[:, 2]])


def problem(
    folder: Path,
    clean: FloatArray,
    times: FloatArray,
    seed: int,
    errors: SensorErrors,
    *,
    late_s: float = 0.0,
    offset: float = 0.0,
    drift: float = 0.0,
    text: str = VOXEL,
) -> StudyProblem:
    study = prepared_study(study_file(folder, text)).study
    force = np.zeros((len(times), 3))
    force[:, 2] = np.interp(times - late_s, *clean) + offset + drift * times
    force += NOISE_MN * np.random.default_rng(seed).standard_normal(force.shape)
    recorded = RecordedForces.of(study, [(1, times, force)], sd_mn=NOISE_MN)
    return StudyProblem.of(StudyUnknowns.of(study, groups="all"), [], recorded, point_sd_mm=0.5, sensor_errors=errors)


@pytest.mark.parametrize("delay", [0.0, 0.0037, -0.012])
def test_means_of_delayed_forces_are_integrals(delay: float) -> None:
    borders = np.concatenate([np.arange(0.0, 0.1, 0.002), np.arange(0.1, 0.401, 0.004)])
    force = (np.cos(20.0 * borders[:-1]) - np.cos(20.0 * borders[1:])) / (20.0 * np.diff(borders))
    shares = np.full(200, 0.1)
    means = SampledMeans.of(borders, force[:, None, None] * np.ones(3), shares, np.zeros(200), 10, 0.002)
    edges = 0.02 * np.arange(21) - delay
    found, rate = means(delay)
    expected = (np.cos(20.0 * edges[:-1]) - np.cos(20.0 * edges[1:])) / 0.4
    inside = slice(1, -1)
    np.testing.assert_allclose(found[inside, 0, 1], expected[inside], atol=1e-4)
    np.testing.assert_allclose(rate[inside, 0, 2], ((np.sin(20.0 * edges[:-1]) - np.sin(20.0 * edges[1:])) / 0.02)[inside], atol=0.05)


@pytest.mark.parametrize("phase", [0.0003, 0.0018])
def test_samples_count_when_they_are_taken(phase: float) -> None:
    """Of one sample in every step, 0.3 or 1.8 ms after its beginning, of a force that jumps between two of them."""
    step, borders = 0.002, 0.002 * np.arange(201)

    def forces(times: FloatArray) -> FloatArray:
        return np.asarray(np.sin(10.0 * times) + 5.0 * (times > 0.2) - 3.0 * (times > 0.31))

    inside = (np.arange(20) + 0.5) / 20.0 * step
    of_steps = forces(borders[:-1, None] + inside).mean(axis=1)
    means = SampledMeans.of(borders, of_steps[:, None, None] * np.ones(3), np.full(200, 0.1), np.full(200, phase - 0.5 * step), 10, step)
    expected = forces(borders[:-1] + phase).reshape(20, 10).mean(axis=1)
    np.testing.assert_allclose(means(0.0)[0][:, 0, 0], expected, atol=1e-3)
    assert np.abs(of_steps.reshape(20, 10).mean(axis=1) - expected).max() > 5e-3  # where they count as taken in the middle


@pytest.mark.parametrize(("late_s", "offset"), [(0.0, 0.0), (0.008, 0.0), (-0.02, 0.0), (0.0, 120.0), (0.008, -60.0)])
def test_intervals_hold_whatever_the_errors_of_the_sensor(
    tmp_path: Path, clean: FloatArray, times: FloatArray, late_s: float, offset: float
) -> None:
    deviations = []
    for seed in range(4):
        made = problem(tmp_path, clean, times, seed, BOTH, late_s=late_s, offset=offset)
        found = calibrate_lattice(made, made.unknowns.start, threads=1)
        assert found.noise_factor[1] < 1.3
        deviations.append(np.log(found.values / TRUTH) / np.sqrt(np.diag(found.covariance)))
        assert found.determined().all()
        told = {error.quantity: error for error in sensor_errors_found(made, found)}
        assert told["delay"].value == pytest.approx(late_s, abs=max(4.0 * told["delay"].sd, 0.00005))
        assert told["offset along z"].value == pytest.approx(offset, abs=4.0 * told["offset along z"].sd)
    assert np.abs(deviations).max() < 3.5  # once in two hundred such dozens
    assert (np.abs(deviations) < 1.96).sum() >= 9


@pytest.mark.parametrize("step_s", [0.001, 0.0005])
def test_a_delay_is_known_no_better_than_samples_follow_the_points_of_a_path(tmp_path: Path, clean: FloatArray, step_s: float) -> None:
    """The speed of the path jumps every 2 ms, and all samples are taken an eighth of a millisecond behind a jump."""
    text = VOXEL.replace("[simulation]", f"[simulation]\nstep_s = {step_s}")
    made = problem(tmp_path, clean, np.arange(0.000125, ENDS, 0.002), 0, BOTH, text=text)
    found = calibrate_lattice(made, made.unknowns.start, threads=1)
    told = {error.quantity: error for error in sensor_errors_found(made, found)}["delay"]
    assert abs(told.value) < 2.0 * told.sd < 0.003


@pytest.mark.parametrize(("late_s", "offset", "quantity"), [(0.008, 0.0, "delay"), (0.0, 120.0, "offset along z"), (-0.02, 0.0, "delay")])
def test_errors_that_were_not_sought_are_named_and_intervals_reach_the_truth(
    tmp_path: Path, clean: FloatArray, times: FloatArray, late_s: float, offset: float, quantity: str
) -> None:
    made = problem(tmp_path, clean, times, 0, NO_ERRORS, late_s=late_s, offset=offset)
    found = calibrate_lattice(made, made.unknowns.start, threads=1)
    assert found.noise_factor[1] > 2.0
    told = diagnosed(made, found)
    assert told is not None and quantity in {error.quantity for error in told.told}
    low, high = told.estimate.intervals().T
    assert (low < TRUTH).all() and (high > TRUTH).all()
    named = next(error for error in told.told if error.quantity == quantity)
    assert named.value == pytest.approx(late_s or offset, rel=0.2)
    assert told.factors[1] < 0.3 * told.factors[0]


def test_a_drift_that_was_not_sought_is_named_though_parameters_take_up_most_of_it(
    tmp_path: Path, clean: FloatArray, times: FloatArray
) -> None:
    """Creep resembles it: what is left is hardly more than noise, and C2 far outside of its interval."""
    for seed in range(3):
        made = problem(tmp_path, clean, times, seed, BOTH, drift=100.0)
        found = calibrate_lattice(made, made.unknowns.start, threads=1)
        low, high = found.intervals().T
        assert not ((low < TRUTH) & (high > TRUTH)).all()
        told = diagnosed(made, found)
        assert told is not None and told.errors == SensorErrors.named("drift and delay")
        named = {error.quantity: error for error in told.told}
        assert named["drift along z"].value == pytest.approx(100.0, abs=max(4.0 * named["drift along z"].sd, 40.0))
        low, high = told.estimate.intervals().T
        assert (low < TRUTH).all() and (high > TRUTH).all()


def test_a_drift_that_forces_cannot_exclude_is_told_with_what_it_does(tmp_path: Path, clean: FloatArray, times: FloatArray) -> None:
    """Against a record that has it: the same noise, and that drift added."""
    made = problem(tmp_path, clean, times, 2, BOTH)
    found = calibrate_lattice(made, made.unknowns.start, threads=1)
    told = unnoticed_drift(made, found)
    assert told is not None and told.body == "stamp" and told.axis == "z"
    other = problem(tmp_path, clean, times, 2, BOTH, drift=told.drift_mn_per_s)
    moved = calibrate_lattice(other, other.unknowns.start, threads=1)
    assert moved.noise_factor[1] < 1.2  # nothing that would be noticed
    k = found.unknowns.names.index(told.parameter)
    assert abs(np.log(moved.values[k] / found.values[k])) == pytest.approx(np.log(told.factor), rel=0.35)
    sought = replace(made, sensor_errors=SensorErrors.named("drift and delay"))
    assert unnoticed_drift(sought, found) is None


@pytest.mark.parametrize("late_s", [0.0, 0.0047])
def test_a_delay_is_told_beside_the_inertia_of_what_the_sensor_holds(
    tmp_path: Path, clean: FloatArray, times: FloatArray, late_s: float
) -> None:
    """Half of a voxel of 200 g is moved by the stamp: its force leads as if the clock were early, by many standard deviations."""
    heavy, deviations = VOXEL.replace("mass_g = 1.0", "mass_g = 200.0"), []
    fine, force = clean
    u = np.clip((fine - 0.1) / 0.15, 0.0, 1.0)
    inertia = -0.1 * DEPTH * (60.0 * u - 180.0 * u**2 + 120.0 * u**3) / 0.15**2  # kg mm/s2 = mN, along z
    for seed in range(5):
        for record, wrong in ((force + inertia, False), (force, True)):
            made = problem(tmp_path, np.stack([fine, record]), times, seed, BOTH, late_s=late_s, text=heavy)
            found = calibrate_lattice(made, made.unknowns.start, threads=1)
            told = {error.quantity: error for error in sensor_errors_found(made, found)}["delay"]
            if not wrong:
                deviations.append((told.value - late_s) / told.sd)
            elif seed == 0:
                assert abs(told.value - late_s) > 3.0 * told.sd
    assert np.abs(deviations).max() < 3.0 and (np.abs(deviations) < 2.0).sum() >= 4


@pytest.mark.parametrize("drift", [0.0, 50.0, 200.0, 500.0])
def test_intervals_hold_whatever_the_drift_that_nobody_sought(tmp_path: Path, clean: FloatArray, times: FloatArray, drift: float) -> None:
    deviations = []
    for seed in range(10, 14):
        made = problem(tmp_path, clean, times, seed, ANY_DRIFT, drift=drift)
        found = calibrate_lattice(made, made.unknowns.start, threads=1)
        deviations.append(np.log(found.values / TRUTH) / np.sqrt(np.diag(found.covariance)))
        assert found.determined().all()
        listed = {error.quantity: error for error in sensor_errors_found(made, found)}
        assert listed["drift along z"].value == pytest.approx(drift, abs=3.5 * listed["drift along z"].sd)
    assert np.abs(deviations).max() < 3.5
    assert (np.abs(deviations) < 1.96).sum() >= 10


def test_a_little_drift_of_which_nothing_is_stated_is_counted(tmp_path: Path, clean: FloatArray, times: FloatArray) -> None:
    """A standard deviation of half a per cent of the largest force a second, as if it were stated."""
    made = problem(tmp_path, clean, times, 4, LITTLE_DRIFT, drift=30.0)
    largest = float(np.nanmax(np.linalg.norm(made.load_cases[0].forces.force[:, 1], axis=1)))
    stated = replace(made, sensor_errors=SensorErrors(drift=True, drift_sd=0.005 * largest))
    found, same = (calibrate_lattice(each, each.unknowns.start, threads=1) for each in (made, stated))
    np.testing.assert_allclose(found.values, same.values, rtol=1e-9)
    deviations = np.log(found.values / TRUTH) / np.sqrt(np.diag(found.covariance))
    assert np.abs(deviations).max() < 2.5
    assert unnoticed_drift(stated, same) is None
    assert sensor_errors_found(made, found) == ()


def test_intervals_with_a_drift_are_those_of_least_squares_with_its_prior(tmp_path: Path, clean: FloatArray, times: FloatArray) -> None:
    """Covariance, drift and its standard deviation, against the normal equations of parameters and drift, the prior a row of its own."""
    sd = 60.0
    made = problem(tmp_path, clean, times, 3, SensorErrors(drift=True, drift_sd=sd), drift=80.0)
    values, case = made.unknowns.start, made.load_cases[0]
    found = case.fine.run(made.unknowns.parameters(values), made.unknowns.changes(values))
    _, (residual, slopes) = made.weighed(case, found, case.fine.long_step)
    own = made.of_bodies(case.forces, found)[1]
    _, (raw, raw_slopes) = replace(made, sensor_errors=NO_ERRORS).weighed(case, found, case.fine.long_step)
    windows = len(case.forces.force)
    middle = 0.02 * (np.arange(windows) + 0.5)
    column = np.sqrt(case.forces.samples[:, 1]) * middle / NOISE_MN
    columns = np.kron(column[:, None], np.eye(3))
    p, prior = len(values), np.diag([1.0, 1.0, 1.0, *(np.full(3, sd) ** -2.0)])  # a prior of the parameters, too: they need one there
    whole = np.hstack([raw_slopes, columns])
    inverse = np.linalg.inv(whole.T @ whole + prior)
    covariance = np.linalg.inv(slopes.T @ slopes + np.eye(p))
    np.testing.assert_allclose(covariance, inverse[:p, :p], rtol=1e-8, atol=1e-14)
    np.testing.assert_allclose(-covariance @ slopes.T @ residual, (-inverse @ whole.T @ raw)[:p], rtol=1e-6, atol=1e-12)
    at_values = np.linalg.inv(columns.T @ columns + np.eye(3) / sd**2)
    np.testing.assert_allclose(own.explained[0], -at_values @ columns.T @ raw, rtol=1e-8)
    np.testing.assert_allclose(own.explained_variance[0], at_values[2, 2], rtol=1e-8)
    np.testing.assert_allclose(own.explained_slopes[:, 0], -(at_values @ columns.T @ raw_slopes).T, rtol=1e-6, atol=1e-9)


def test_what_a_drift_costs_is_told(tmp_path: Path, clean: FloatArray, times: FloatArray) -> None:
    made, exact = (problem(tmp_path, clean, times, 4, errors) for errors in (ANY_DRIFT, NO_ERRORS))
    found, shorter = (calibrate_lattice(each, each.unknowns.start, threads=1) for each in (made, exact))
    told = counted_drift(made, found)
    assert told is not None and counted_drift(exact, shorter) is None
    k = made.unknowns.names.index(told.parameter)
    assert told.factor == pytest.approx(np.sqrt(found.covariance[k, k] / shorter.covariance[k, k]), rel=0.4)
    stated = problem(tmp_path, clean, times, 4, SensorErrors(drift=True, drift_sd=0.5))
    nearly = counted_drift(stated, found)
    assert nearly is not None and 1.0 < nearly.factor < 1.1


def test_forces_that_fit_are_not_diagnosed(tmp_path: Path, clean: FloatArray, times: FloatArray) -> None:
    made = problem(tmp_path, clean, times, 1, BOTH)
    assert diagnosed(made, calibrate_lattice(made, made.unknowns.start, threads=1)) is None


def test_a_record_too_short_for_errors_of_its_sensor_is_told(tmp_path: Path, clean: FloatArray) -> None:
    with pytest.raises(InputError, match="2 windows of time only"):
        problem(tmp_path, clean, np.arange(0.001, 0.04, 0.001), 0, BOTH)
    with pytest.raises(InputError, match="choose one of none, offset"):
        SensorErrors.named("gain")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="force_drift_mn_per_s is -1"):
        SensorErrors.named("none", -1.0)
    with pytest.raises(InputError, match="leave one of the two out"):
        SensorErrors.named("drift", 0.0)
    assert SensorErrors.named("none", 0.0) == replace(NO_ERRORS, drift_sd=0.0)
    assert SensorErrors.named("none") == LITTLE_DRIFT and SensorErrors.named("drift") == replace(ANY_DRIFT, offset=True)
