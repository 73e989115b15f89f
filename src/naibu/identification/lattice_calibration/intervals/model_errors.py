"""How far an estimate may be off by what the model lacks: what forces are off by for a while, and what steps of time leave."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint
from naibu.identification.lattice_calibration.inverse_problem import InverseProblem
from naibu.identification.lattice_calibration.least_squares import Evaluations, about, covariance_at, in_stretches, unsettled_covariance

MISFIT = 1.2  # mean square of residuals of forces in units of their noise, from which they lack something


def with_errors_of_the_model(
    problem: InverseProblem, point: EvaluatedPoint, covariance: FloatArray, centre: FloatArray, prior_sd: float, at: Evaluations
) -> FloatArray:
    """Return second moments (p, p) about a point, with how far what the model lacks may move the estimate.

    Where forces are off by more than their noise, what they lack is alike for a while: its stretches of time count as independent (after
    :cite:t:`newey1987`). Errors of implicit steps fall with their length, and half steps take away half of them
    (:cite:t:`richardson1911`): as far as the estimate would move if steps were endlessly short, it may be off.
    """
    gain = -covariance_at(point, prior_sd)
    if problem.excess[1] ** 2 > MISFIT:
        moved = in_stretches(point.residual[1]) @ point.slopes[1] @ gain
        covariance = covariance + moved.T @ moved
    most, step = unsettled_covariance(point.theta, centre, prior_sd), np.zeros(len(centre))
    if (halved := problem.with_half_steps()) is not None:
        finer = at(halved, point.theta, derivatives=False, fine=True).residual
        for own, other, slopes in zip(finer, point.residual, point.slopes, strict=True):
            step = step + gain @ slopes.T @ (2.0 * (own - other))
    return about(covariance, step, most)
