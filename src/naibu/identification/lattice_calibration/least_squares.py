"""What searches by least squares share: evaluations that are reported, the cost with its weak prior, steps, and the covariance."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from naibu.core.arrays import FloatArray
from naibu.core.progress import Progress, report_progress
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint, Residual, evaluated, residuals_at
from naibu.identification.lattice_calibration.inverse_problem import InverseProblem

LONGEST = 1.0  # change of a logarithm in one iteration
STRETCHES = 16  # of forces, in which what they lack is alike
SETTLED = 0.05  # decrease of chi-squared that is not worth another iteration


@dataclass(slots=True)
class Evaluations:
    """Evaluations that are reported, the best of which is kept for the case of an interruption."""

    threads: int
    executor: Executor | None
    progress: Progress | None
    count: int = 0
    runs: int = 0  # simulations; derivatives count as one for each parameter
    best: EvaluatedPoint | None = None
    problem: InverseProblem | None = None

    def __call__(self, problem: InverseProblem, theta: FloatArray, *, derivatives: bool = True, fine: bool = False) -> EvaluatedPoint:
        """Return residuals, and their derivatives, at theta (p,)."""
        point = evaluated(problem, theta, derivatives=derivatives, fine=fine, threads=self.threads, executor=self.executor)
        self.runs += 1 + (len(theta) if derivatives else 0)
        if derivatives:
            self.keep(problem, point)
        self._report(point.residual)
        return point

    def many(self, problem: InverseProblem, trials: Sequence[tuple[FloatArray, bool]]) -> list[Residual]:
        """Return residuals at several theta (p,), each with long or with fine steps, simulated side by side."""
        found = []
        for residual in residuals_at(problem, trials, threads=self.threads, executor=self.executor):
            found.append(residual)
            self.runs += 1
            self._report(residual)
        return found

    def keep(self, problem: InverseProblem, point: EvaluatedPoint) -> None:
        """Keep a point with derivatives if it is the best of its problem."""
        if self.best is None or self.problem is not problem or misfit(point.residual) <= misfit(self.best.residual):
            self.best, self.problem = point, problem

    def _report(self, residual: Residual) -> None:
        self.count += 1
        report_progress(self.progress, "calibrate", done=self.count, objective=misfit(residual) / max(sum(map(len, residual)), 1))


def misfit(residual: Residual) -> float:
    """Return chi-squared."""
    return float(sum((r**2).sum() for r in residual))


def cost_at(residual: Residual, theta: FloatArray, centre: FloatArray, prior_sd: float) -> float:
    """Return chi-squared with that of the weak prior of the logarithms theta (p,)."""
    return misfit(residual) + float((((theta - centre) / prior_sd) ** 2).sum())


def cost_of(point: EvaluatedPoint, centre: FloatArray, prior_sd: float) -> float:
    """Return chi-squared of a point with that of the weak prior."""
    return cost_at(point.residual, point.theta, centre, prior_sd)


def step_within(point: EvaluatedPoint, centre: FloatArray, prior_sd: float, reach: float) -> tuple[FloatArray, float]:
    """Return the change of theta that lowers the linearised cost most, none of its components longer than `reach`; and the decrease.

    Damping is the same for all logarithms: what the data determine well is not held back by what they do not.
    """
    hessian = point.information + np.eye(len(point.theta)) / prior_sd**2
    slope = point.gradient() + (point.theta - centre) / prior_sd**2
    values, vectors = np.linalg.eigh(hessian)
    part = vectors.T @ slope

    def step(damping: float) -> FloatArray:
        return np.asarray(-vectors @ (part / (values + damping)), dtype=np.float64)

    def excess(logarithm: float) -> float:
        return float(np.abs(step(np.exp(logarithm))).max()) - reach

    chosen = step(0.0)
    if float(np.abs(chosen).max()) > reach:
        most = np.log(float(np.linalg.norm(part)) / reach)  # no component is longer than the whole
        least = np.log(values[0]) - 30.0
        chosen = step(float(np.exp(scipy.optimize.brentq(excess, min(least, most - 1.0), most + 1e-9, xtol=1e-3))))
    return chosen, float(-2.0 * slope @ chosen - chosen @ hessian @ chosen)


def covariance_at(point: EvaluatedPoint, prior_sd: float) -> FloatArray:
    """Return the covariance (p, p) that the derivatives at a point give, with the prior."""
    return np.asarray(np.linalg.inv(point.information + np.eye(len(point.theta)) / prior_sd**2), dtype=np.float64)


def covariance_before_the_minimum(point: EvaluatedPoint, centre: FloatArray, prior_sd: float) -> FloatArray:
    """Return the covariance (p, p) about a point that need not be the minimum: second moments about it, of what the derivatives there say.

    Residuals count as noise, and the step to the minimum that derivatives promise as a deviation, as far as the prior reaches.
    """
    excess = max(misfit(point.residual) / max(sum(map(len, point.residual)), 1), 1.0)
    hessian = point.information / excess + np.eye(len(point.theta)) / prior_sd**2
    covariance = np.asarray(np.linalg.inv(hessian), dtype=np.float64)
    step = np.asarray(-covariance @ (point.gradient() / excess + (point.theta - centre) / prior_sd**2), dtype=np.float64)
    return about(covariance, step, unsettled_covariance(point.theta, centre, prior_sd))


def about(covariance: FloatArray, step: FloatArray, most: FloatArray) -> FloatArray:
    """Return second moments (p, p) about a point from which a mean lies by a step (p,), with variances of at most those of another one."""
    moments = covariance + np.outer(step, step)
    factor = np.minimum(np.sqrt(np.diag(most) / np.diag(moments)), 1.0)
    limited = moments * np.outer(factor, factor)
    return np.asarray(0.5 * (limited + limited.T))


def in_stretches(force: FloatArray) -> FloatArray:
    """Return residuals of forces (n,), in the order of time, one stretch of time a row (`STRETCHES`, n), zero elsewhere."""
    found = np.zeros((STRETCHES, len(force)))
    found[np.arange(len(force)) * STRETCHES // max(len(force), 1), np.arange(len(force))] = force
    return found


def noise_factors(problem: InverseProblem, residual: Residual) -> tuple[float, float]:
    """Return root mean squares of the residuals of points and forces in units of the stated noise; 0 of what there is none of."""
    rms = [float(np.sqrt((r**2).mean())) if len(r) else 0.0 for r in residual]
    return rms[0] * problem.excess[0], rms[1] * problem.excess[1]


def unsettled_covariance(theta: FloatArray, centre: FloatArray, prior_sd: float) -> FloatArray:
    """Return the covariance (p, p) of logarithms about a point that the data say nothing of: second moments of the prior about it.

    A search that did not come to rest may have ended far from the centre of the prior; intervals around where it ended must still hold what
    the prior holds.
    """
    return np.diag(prior_sd**2 + (theta - centre) ** 2)
