"""Covariance of lattice parameters, widened to where chi-squared itself rises :cite:p:`venzon1988`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint
from naibu.identification.lattice_calibration.inverse_problem import InverseProblem
from naibu.identification.lattice_calibration.least_squares import SETTLED, Evaluations, cost_at, cost_of

FARTHEST = 0.7  # change of a logarithm to where chi-squared is looked at
PROFILED = 4  # combinations along which it is
FITTED_AGAIN = 4  # simulations at each end, at most
WIDEST = 3.0  # factor of standard deviations


@dataclass(slots=True)
class _End:
    """An end of the interval of a combination: where chi-squared is looked at, the least that was found, and what may still move."""

    variance: float
    reach: float
    others: FloatArray
    theta: FloatArray
    lowest: float
    at: FloatArray
    fitting: bool = True


def widened_covariance(
    problem: InverseProblem,
    point: EvaluatedPoint,
    centre: FloatArray,
    prior_sd: float,
    at: Evaluations,
) -> tuple[FloatArray, int]:
    """Return the covariance at a point, widened along its least determined combinations to where chi-squared says; and the runs.

    Combinations of classes are determined by what is nonlinear, and what the data tell of them changes by a factor within their own
    interval. Each is moved to the ends of its interval, all others are fitted again, and the increase of the cost there tells how far one
    standard deviation reaches. Derivatives are those of the point; residuals are those of long steps, corrected by what fine steps
    differ from them at the point.

    Parameters
    ----------
    problem : InverseProblem
        With the noise as it was found.
    point : EvaluatedPoint
        Where the search ended, with residuals of fine steps.
    centre, prior_sd
        Of the weak prior.
    at : Evaluations
        Of residuals.
    """
    covariance = np.asarray(np.linalg.inv(point.information + np.eye(len(point.theta)) / prior_sd**2))
    values, vectors = np.linalg.eigh(covariance)
    coarse, runs, fine = at.many(problem, [(point.theta, False)])[0], 1, point.residual
    least, hessian = cost_of(point, centre, prior_sd), np.linalg.inv(covariance)
    ends = []
    for value, vector in list(zip(values, vectors.T, strict=True))[::-1][:PROFILED]:
        others = np.linalg.svd(vector[None])[2][1:].T
        reach = min(1.96 * float(np.sqrt(value)), FARTHEST)
        ends += [_End(float(value), reach, others, point.theta + side * reach * vector, np.inf, point.theta) for side in (-1.0, 1.0)]
    for _ in range(FITTED_AGAIN):
        moving = [end for end in ends if end.fitting]
        for end, found in zip(moving, at.many(problem, [(end.theta, False) for end in moving]), strict=True):
            runs += 1
            corrected = (found[0] + fine[0] - coarse[0], found[1] + fine[1] - coarse[1])
            cost = cost_at(corrected, end.theta, centre, prior_sd)
            end.fitting = cost < end.lowest - SETTLED
            if cost < end.lowest:
                end.lowest, end.at = cost, end.theta
            if end.fitting:
                slope = replace(point, residual=corrected).gradient() + (end.theta - centre) / prior_sd**2
                end.theta = end.theta - end.others @ np.linalg.solve(end.others.T @ hessian @ end.others, end.others.T @ slope)
    widened = covariance.copy()
    for end in ends:
        deviation = (end.at - point.theta) / np.sqrt(max(end.lowest - least, end.reach**2 / end.variance / WIDEST**2))
        ratio = float(deviation @ hessian @ deviation)
        if ratio > 1.0:
            wider = covariance + (1.0 - 1.0 / ratio) * np.outer(deviation, deviation)
            factor = np.sqrt(np.maximum(np.diag(wider) / np.diag(widened), 1.0))
            widened = widened * np.outer(factor, factor)
    return widened, runs
