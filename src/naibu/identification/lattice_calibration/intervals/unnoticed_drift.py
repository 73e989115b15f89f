"""A drift of force sensors that forces do not show: what one beyond those that are counted would do, and what counting them costs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from naibu.identification.lattice_calibration.estimate import LatticeEstimate
from naibu.identification.lattice_calibration.forward_model import Reproduced
from naibu.identification.lattice_calibration.intervals.sensor_diagnosis import at_estimate, fitted
from naibu.identification.lattice_calibration.studies.study_problem import StudyProblem

QUANTILE = 1.96


@dataclass(frozen=True, slots=True)
class UnnoticedDrift:
    """A drift that 95 % intervals of the drift itself hold beside none, and what it does.

    Attributes
    ----------
    body, axis : str
        Which indenter bears the sensor, and which component drifts.
    drift_mn_per_s : float
        mN/s.
    parameter : str
        What it moves farthest, in units of its interval.
    factor : float
        By how much that value is wrong then, above 1.
    """

    body: str
    axis: str
    drift_mn_per_s: float
    parameter: str
    factor: float


def unnoticed_drift(problem: StudyProblem, estimate: LatticeEstimate, found: Reproduced | None = None) -> UnnoticedDrift | None:
    """Return the drift that forces cannot exclude and that moves a value farthest beyond its interval; none where one is stated.

    Creep of a viscoelastic object looks alike: parameters take up a drift, no misfit is left, and nothing in the data tells that their
    intervals do not hold. None in contact, where derivatives are differences that take up anything. `found` is what `at_estimate`
    returns, if known.
    """
    forces, sought = problem.load_cases[0].forces, problem.sensor_errors
    if (sought.drift and sought.drift_sd is not None) or problem.roughness > 0.0 or not len(forces.force):
        return None
    drifting = replace(problem, sensor_errors=replace(sought, offset=True, drift=True, drift_sd=np.inf))
    found = found or at_estimate(problem, estimate)
    covariance, variance = fitted(drifting, found).covariance, max(estimate.noise_factor[1], 1.0) ** 2
    half = QUANTILE * np.sqrt(np.diag(estimate.covariance))
    worst, told = 1.0, None
    for body, own in drifting.of_bodies(forces, found).items():
        for axis in range(3):
            with_values = covariance @ own.explained_slopes[:, 1, axis]
            sd = float(np.sqrt(variance * own.explained_variance[1] + own.explained_slopes[:, 1, axis] @ with_values))
            moves = QUANTILE * np.abs(with_values) / sd
            k = int(np.argmax(moves / half))
            if moves[k] > worst * half[k]:
                worst, name = float(moves[k] / half[k]), problem.unknowns.names[k]
                told = UnnoticedDrift(problem.unknowns.study.bodies[body].name, "xyz"[axis], QUANTILE * sd, name, float(np.exp(moves[k])))
    return told


@dataclass(frozen=True, slots=True)
class CountedDrift:
    """What intervals that count a drift are wider by: by a factor, that of one parameter most."""

    parameter: str
    factor: float


def counted_drift(problem: StudyProblem, estimate: LatticeEstimate, found: Reproduced | None = None) -> CountedDrift | None:
    """Return by how much intervals are wider than if sensors were known not to drift, by derivatives; None where no drift is counted.

    Forces that cannot tell a drift from creep leave no other choice: intervals that hold whatever the drift are not shorter without one
    (:cite:t:`armstrong2018`). None in contact, as for `unnoticed_drift`.
    """
    errors = problem.sensor_errors
    if not errors.drift or problem.roughness > 0.0 or not len(problem.load_cases[0].forces.force):
        return None
    found = found or at_estimate(problem, estimate)
    without = replace(problem, sensor_errors=replace(errors, drift=False))
    factors = np.sqrt(np.diag(fitted(problem, found).covariance) / np.diag(fitted(without, found).covariance))
    k = int(np.argmax(factors))
    return CountedDrift(problem.unknowns.names[k], float(factors[k]))
