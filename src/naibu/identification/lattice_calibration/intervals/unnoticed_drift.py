"""A drift of a force sensor that forces do not show, and that moves the parameters beyond their intervals, where none was sought."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from naibu.identification.lattice_calibration.estimate import LatticeEstimate
from naibu.identification.lattice_calibration.intervals.sensor_diagnosis import at_estimate, fitted
from naibu.identification.lattice_calibration.study_problem import StudyProblem

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


def unnoticed_drift(problem: StudyProblem, estimate: LatticeEstimate) -> UnnoticedDrift | None:
    """Return the drift, not sought, that forces cannot exclude and that moves a value farthest beyond its interval; None if none does.

    Creep of a viscoelastic object looks alike: parameters take up a drift, no misfit is left, and nothing in the data tells that their
    intervals do not hold. None in contact, where derivatives are differences that take up anything.
    """
    forces, sought = problem.load_cases[0].forces, problem.sensor_errors
    if sought.drift or problem.roughness > 0.0 or not len(forces.force):
        return None
    drifting = replace(problem, sensor_errors=replace(sought, offset=True, drift=True))
    found = at_estimate(problem, estimate)
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
