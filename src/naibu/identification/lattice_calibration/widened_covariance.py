"""Covariance of lattice parameters, widened to where chi-squared itself rises :cite:p:`venzon1988`, and without what jumps tell.

In contact residuals jump, as points begin to slip. The shorter a difference, the more of it is jumps, which count as information that the
data do not have. There differences are central and about one standard deviation long, and the part of their squares that jumps explain is
taken away: were residuals to jump at random by a variance v, the second difference over the length h, ``(r(+h) - 2 r(0) + r(-h)) / h``,
would have the variance ``6 v / h^2`` and the slope ``(r(+h) - r(-h)) / 2 h`` that of ``v / 2 h^2``, a twelfth of it. Curvature, which is in
second differences as well, makes the information smaller than it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from naibu.core.arrays import FloatArray
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint
from naibu.identification.lattice_calibration.inverse_problem import InverseProblem
from naibu.identification.lattice_calibration.least_squares import SETTLED, Evaluations, cost_at, cost_of, covariance_at

FARTHEST = 0.7  # change of a logarithm to where chi-squared is looked at
PROFILED = 4  # combinations along which it is
FITTED_AGAIN = 4  # simulations at each end, at most
WIDEST = 3.0  # factor of standard deviations
LONGEST_DIFFERENCE = 0.1  # of a logarithm
ROUNDS = 2  # the second with the standard deviations that the first one found
JUMPS = 12.0
LEAST = 0.02  # of the information of a combination, which is left at least


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
    information: FloatArray | None = None,
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
    information : ndarray, shape (p, p), optional
        Fisher information of the data; by default, what the derivatives of the point make of it.
    """
    told = point.information if information is None else information
    covariance = np.asarray(np.linalg.inv(told + np.eye(len(told)) / prior_sd**2))
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


def smoothed_information(
    problem: InverseProblem, point: EvaluatedPoint, shortest: float, prior_sd: float, at: Evaluations
) -> tuple[FloatArray, int]:
    """Return the Fisher information (p, p) at a point by long differences of long steps of time, without that of jumps; and the runs.

    Parameters
    ----------
    problem : InverseProblem
        With the noise as it was found.
    point : EvaluatedPoint
        Where the search ended, with the derivatives of the search.
    shortest : float
        Length of the differences of the search, of a logarithm.
    prior_sd : float
        Standard deviation of the weak prior.
    at : Evaluations
        Of residuals.
    """
    theta, p = point.theta, len(point.theta)
    base, runs = np.concatenate(at.many(problem, [(theta, False)])[0]), 1
    deviation, information = np.sqrt(np.diag(covariance_at(point, prior_sd))), point.information
    for _ in range(ROUNDS):
        length = np.clip(deviation, shortest, LONGEST_DIFFERENCE)
        ends = [np.log(problem.unknowns.held(np.exp(theta + s * row))) for row in np.diag(length) for s in (1.0, -1.0)]
        found = np.array([np.concatenate(r) for r in at.many(problem, [(end, False) for end in ends])])
        runs += len(ends)
        slopes, spurious = np.empty((p, len(base))), np.zeros(p)
        for k in range(p):
            up, down = ends[2 * k][k] - theta[k], theta[k] - ends[2 * k + 1][k]  # shorter at a bound
            slopes[k] = (found[2 * k] - found[2 * k + 1]) / max(up + down, 1e-12)
            if min(up, down) > 0.1 * length[k]:
                bend = (found[2 * k] - base) / up - (base - found[2 * k + 1]) / down
                spurious[k] = float(bend @ bend) / JUMPS
        whole = slopes @ slopes.T
        values, vectors = scipy.linalg.eigh(whole - np.diag(spurious), whole + 1e-9 * np.diag(np.diag(whole)) + 1e-9 * np.eye(p))
        back = np.linalg.inv(vectors)
        information = back.T @ (np.maximum(values, LEAST)[:, None] * back)
        deviation = np.sqrt(np.diag(np.linalg.inv(information + np.eye(p) / prior_sd**2)))
    return np.asarray(information), runs
