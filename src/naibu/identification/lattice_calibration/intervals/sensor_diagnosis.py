"""What errors of force sensors were found, and which others would explain what a calibrated lattice does not reproduce."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from naibu.core.arrays import FloatArray
from naibu.identification.lattice_calibration.captured.sensor_errors import BodyResiduals, SensorErrors
from naibu.identification.lattice_calibration.estimate import LatticeEstimate
from naibu.identification.lattice_calibration.forward_model import Reproduced
from naibu.identification.lattice_calibration.gauss_newton import PRIOR_SD
from naibu.identification.lattice_calibration.intervals.model_errors import MISFIT
from naibu.identification.lattice_calibration.least_squares import about, unsettled_covariance
from naibu.identification.lattice_calibration.studies.study_problem import StudyProblem

CANDIDATES = tuple(
    SensorErrors(bool(offset), bool(drift), bool(delay), np.inf)
    for offset, drift, delay in ((1, 0, 0), (0, 0, 1), (1, 0, 1), (1, 1, 0), (0, 1, 1), (1, 1, 1))
)
CHANCE = 0.05  # of an F-test, below which errors are told
MOVES = 0.5  # standard deviations by which an estimate must move, or its standard deviation grow, for errors to be told
EXPLAINED = 0.25  # of what the mean square of residuals is above that of noise, from which on errors are told
# fewer errors are preferred that leave no more than that many times the sum of squares that the best ones leave, and of what there was
AS_WELL, NEGLIGIBLE = 1.1, 0.005
TOLD = 3.0  # standard deviations from which on an error is named


@dataclass(frozen=True, slots=True)
class SensorError:
    """An error of a force sensor.

    Attributes
    ----------
    body : str
        Which indenter bears the sensor.
    quantity : str
        ``"offset along x"`` (in the middle of the record, where it drifts), ``"drift along x"``, or ``"delay"``, by which it is late.
    value, sd : float
        In its unit.
    unit : str
        mN, mN/s or s.
    """

    body: str
    quantity: str
    value: float
    sd: float
    unit: str

    def __str__(self) -> str:
        scale, unit = (1e3, "ms") if self.quantity == "delay" else (1e-3, self.unit.replace("mN", "N"))
        named = "delay" if self.quantity == "delay" else self.quantity.split()[0]
        where = "" if self.quantity == "delay" else f" on {self.quantity[-1]}"
        return f"a {named} of {scale * self.value:.3g} {unit}{where}".replace("a offset", "an offset")


@dataclass(frozen=True, slots=True, eq=False)
class SensorDiagnosis:
    """Errors of sensors that would explain what a calibration does not.

    Attributes
    ----------
    errors : SensorErrors
        To be estimated along.
    told : tuple of SensorError
        How large they are.
    factors : tuple of float
        Root mean square of the residuals of forces in units of their noise, without and with them.
    estimate : LatticeEstimate
        With a covariance that reaches to where they would move it.
    """

    errors: SensorErrors
    told: tuple[SensorError, ...]
    factors: tuple[float, float]
    estimate: LatticeEstimate


def sensor_errors_found(problem: StudyProblem, estimate: LatticeEstimate, found: Reproduced | None = None) -> tuple[SensorError, ...]:
    """Return the errors of all sensors at the values of an estimate, as far as the problem seeks them.

    Standard deviations count as well what steps of time leave: twice what errors differ by with half steps (:cite:t:`richardson1911`).
    A drift alone is not listed of which nothing is stated, or in contact, where derivatives take a simulation each. `found` is what
    `at_estimate` returns, if known.
    """
    errors = problem.sensor_errors
    asked = errors.offset or errors.delay or (errors.drift and errors.drift_sd is not None and problem.roughness == 0.0)
    if not asked or not len(problem.load_cases[0].forces.force):
        return ()
    listed = _listed(problem, found or at_estimate(problem, estimate), estimate.covariance, max(estimate.noise_factor[1], 1.0) ** 2)
    if (halved := problem.with_half_steps()) is None:
        return listed
    finer = halved.load_cases[0].fine.run(problem.unknowns.parameters(estimate.values))
    others = _listed(halved, finer, np.zeros((0, 0)), 1.0)
    return tuple(
        replace(own, sd=float(np.hypot(own.sd, 2.0 * (own.value - other.value)))) for own, other in zip(listed, others, strict=True)
    )


def diagnosed(problem: StudyProblem, estimate: LatticeEstimate, found: Reproduced | None = None) -> SensorDiagnosis | None:
    """Return which errors of the sensors, beyond those that were sought, would explain what the forces lack; None if none would.

    Residuals of all candidates come from one simulation with derivatives at the estimate; the parameters move along linearly. Those
    that explain less than a quarter, or what chance would (F-test), do not count; of others the fewest that leave hardly more than the
    best. A law that lacks something may look alike: nothing is corrected by them, but intervals reach to where they would move the
    estimate, and are as wide as beside them. In contact, where differences of simulations make up for anything, forces must be off by more
    than their noise. `found` is what `at_estimate` returns, if known.
    """
    if problem.roughness > 0.0 and not estimate.noise_factor[1] ** 2 > MISFIT:
        return None
    found = found or at_estimate(problem, estimate)
    before, count = fitted(problem, found), int(np.isfinite(problem.load_cases[0].forces.force).sum())
    if not count:
        return None
    fits = []
    for errors in CANDIDATES:
        errors = _beside(problem.sensor_errors, errors)
        after = fitted(replace(problem, sensor_errors=errors), found)
        more, free = after.unknowns - before.unknowns, max(count - after.unknowns, 1)
        if more > 0 and errors.holds(problem.sensor_errors):
            ratio = (before.left - after.left) / more / (after.left / free)
            share = (before.left - after.left) / max(before.left - count, 1e-300)
            if float(fdtrc(more, free, ratio)) < CHANCE and share > EXPLAINED:
                fits.append((errors, after))
    if not fits:
        return None
    least = min(after.left for _, after in fits)
    errors, after = next(fit for fit in fits if fit[1].left <= AS_WELL * least + NEGLIGIBLE * before.left)
    variance = max(after.left / count, 1.0)
    more_unsure = variance * (after.covariance - before.covariance)
    if (after.step**2 + np.diag(more_unsure) < MOVES**2 * np.diag(estimate.covariance)).all():
        return None
    theta = np.log(estimate.values)
    most = unsettled_covariance(theta, np.log(problem.unknowns.start), PRIOR_SD)
    most = np.maximum(most, np.diag(np.diag(estimate.covariance)))
    moved = replace(estimate, covariance=about(estimate.covariance + more_unsure, after.step, most))
    listed = _listed(replace(problem, sensor_errors=errors), found, after.covariance, variance, after.step)
    told = tuple(error for error in listed if abs(error.value) > TOLD * error.sd)
    return SensorDiagnosis(errors, told, (float(np.sqrt(before.left / count)), float(np.sqrt(after.left / count))), moved)


@dataclass(frozen=True, slots=True, eq=False)
class LinearFit:
    """What forces lack after a step (p,) of all parameters, a sum of squares, with the covariance (p, p) and the number of unknowns."""

    left: float
    step: FloatArray
    covariance: FloatArray
    unknowns: int


def _beside(sought: SensorErrors, errors: SensorErrors) -> SensorErrors:
    """Return errors with what is known of a drift that is counted in any case; of one of which nothing is stated, any is tried."""
    if not sought.drift or (errors.drift and sought.drift_sd is None):
        return errors
    return replace(errors, drift=errors.drift or sought.drift_sd is None, drift_sd=sought.drift_sd)


def at_estimate(problem: StudyProblem, estimate: LatticeEstimate) -> Reproduced:
    """Return shapes and forces at an estimate, of fine steps, with derivatives."""
    unknowns = problem.unknowns
    return problem.load_cases[0].fine.run(unknowns.parameters(estimate.values), unknowns.changes(estimate.values))


def fitted(problem: StudyProblem, found: Reproduced) -> LinearFit:
    """Return where derivatives say that the parameters fit best, errors of the sensors as the problem seeks them."""
    case = problem.load_cases[0]
    (points, of_points), (forces, of_forces) = problem.weighed(case, found, case.fine.long_step)
    factor = max(float(np.sqrt((points**2).mean())), 1.0) if len(points) else 1.0
    slopes = np.vstack([of_points / factor, of_forces, np.eye(of_forces.shape[1]) / PRIOR_SD])
    covariance = np.asarray(np.linalg.inv(slopes.T @ slopes))
    step = -covariance @ (of_points.T @ points / factor**2 + of_forces.T @ forces)
    bodies, errors = int(np.isfinite(case.forces.force).any(axis=(0, 2)).sum()), problem.sensor_errors
    unknowns = len(step) + bodies * (3 * errors.unknowns + int(errors.delay))
    return LinearFit(float(((forces + of_forces @ step) ** 2).sum()), step, covariance, unknowns)


def _listed(
    problem: StudyProblem, found: Reproduced, covariance: FloatArray, variance: float, step: FloatArray | None = None
) -> tuple[SensorError, ...]:
    """Return the errors of all sensors after a step (p,) of the parameters, with a covariance (p, p) and a variance of residuals."""
    names = [body.name for body in problem.unknowns.study.bodies]
    listed: list[SensorError] = []
    for body, own in problem.of_bodies(problem.load_cases[0].forces, found).items():
        moved = np.zeros(len(covariance)) if step is None else step
        listed += _of_body(names[body], own, covariance, variance, moved, problem.sensor_errors)
    return tuple(listed)


def _of_body(
    name: str, own: BodyResiduals, covariance: FloatArray, variance: float, step: FloatArray, errors: SensorErrors
) -> Sequence[SensorError]:
    def error(quantity: str, value: float, known: float, slopes: FloatArray, unit: str) -> SensorError:
        spread = variance * known + slopes @ covariance @ slopes
        return SensorError(name, quantity, float(value + slopes @ step), float(np.sqrt(spread)), unit)

    steady = [named for named, sought in ((("offset", "mN"), errors.offset), (("drift", "mN/s"), errors.drift)) if sought]
    listed = [
        error(f"{what} along {axis}", own.explained[k, a], own.explained_variance[k], own.explained_slopes[:, k, a], unit)
        for k, (what, unit) in enumerate(steady)
        for a, axis in enumerate("xyz")
    ]
    return [*listed, error("delay", own.delay, own.delay_variance, own.delay_slopes, "s")] if errors.delay else listed
