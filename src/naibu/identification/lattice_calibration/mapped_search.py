"""Least squares where derivatives are differences of simulations: fine steps of time by way of long ones.

The search is done with long steps of time, which are several times cheaper. What residuals of fine steps differ from theirs changes little
as the parameters do: it is added as found where the last search ended, and the search goes on, until fine residuals tell nothing new
(output space mapping; :cite:t:`bandler2004`). Within it, steps are those of Gauss and Newton, damped as by Levenberg and Marquardt
(:cite:t:`nocedal2006`, chapter 10); derivatives are differences, improved by every step (a rank-one update;
:cite:p:`broyden1965`), and taken anew where a step does much less than it promised, and before the search ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint, Residual
from naibu.identification.lattice_calibration.inverse_problem import InverseProblem
from naibu.identification.lattice_calibration.least_squares import Evaluations, cost_at, next_step, noise_factors

POOR = 0.3  # of the promised decrease, below which derivatives are taken anew
FAILED = 4  # steps one after the other that bring little, before derivatives are taken anew, or the search ends
ENOUGH = 2e-3  # of the cost, before fine steps are simulated
CORRECTIONS = 6  # by fine steps, at most
ENDED = 2.0  # decrease of chi-squared of fine steps that is not worth another correction
PROMISED = 1.0  # decrease of chi-squared that is not worth a step: residuals jump by as much
TELLING = 6.0  # change of the residuals, in units of their noise, from which a step tells of derivatives: far more than they jump
WEIGHED = 0.05  # change of the noise as found, as a logarithm, that is
LEAST_DAMPING = 1e-4


@dataclass(slots=True)
class MappedSearch:
    """A search for the least chi-squared.

    Attributes
    ----------
    problem : InverseProblem
        With the noise as it is found.
    centre, prior_sd
        Of the weak prior.
    at : Evaluations
        Of residuals.
    first : ndarray, shape (p,)
        Where it begins.
    theta, residual : ndarray, tuple of ndarray
        Where it is, and residuals there: of long steps, corrected.
    offset : tuple of ndarray
        The correction: what residuals of fine steps differed from those of long ones.
    slopes : tuple of ndarray
        Derivatives.
    fresh : bool
        Whether derivatives are differences where it is.
    runs, iterations : int
        Simulations, and steps.
    settled : bool
        Whether the search came to rest.
    """

    problem: InverseProblem
    centre: FloatArray
    prior_sd: float
    at: Evaluations
    first: FloatArray
    theta: FloatArray = field(init=False)
    residual: Residual = field(init=False)
    offset: Residual = field(init=False)
    slopes: Residual = field(init=False)
    fresh: bool = False
    runs: int = 0
    iterations: int = 0
    settled: bool = False

    def __post_init__(self) -> None:
        self.theta = self.first.copy()
        self.residual = self._simulated([(self.theta, False)])[0]
        self.offset = (np.zeros_like(self.residual[0]), np.zeros_like(self.residual[1]))
        self._differences()

    @property
    def point(self) -> EvaluatedPoint:
        """Where it is."""
        return EvaluatedPoint(self.theta, self.residual, self.slopes)

    def run(self, max_iterations: int, *, reweigh: bool) -> None:
        """Search with long steps, then correct them by fine ones.

        Raises
        ------
        ConvergenceError
            It did not settle within `max_iterations` steps.
        """
        self._descend(max_iterations, ENOUGH)
        best, held = np.inf, self.theta
        for _ in range(CORRECTIONS):
            fine = self._simulated([(self.theta, True)])[0]
            cost = self._cost(self.theta, fine)
            if cost >= best and float(np.abs(self.theta - held).max()) > LEAST_DAMPING:
                self.theta = 0.5 * (self.theta + held)  # the correction changed more than the step told
                self.residual = self._corrected(self._simulated([(self.theta, False)])[0])
                continue
            self.offset = _sum(fine, _sum(self.residual, self.offset, -1.0), -1.0)
            self.residual = fine
            ended = best - cost < ENDED + self.problem.roughness * cost
            best, held = cost, self.theta
            if ended and not (reweigh and self._weigh()):
                self.settled = True
                return
            best = self._cost(self.theta, self.residual)
            self._descend(max_iterations)

    def _descend(self, max_iterations: int, enough: float = 0.0) -> None:
        """Take steps until the next promises little, or damped ones do not help.

        `enough` is a decrease, as a fraction of the cost, that is not worth a step either, nor derivatives anew.
        """
        cost, damping, failed, renewed = self._cost(self.theta, self.residual), 0.0, 0, False
        for _ in range(max_iterations):
            self.at.keep(self.problem, self.point)
            step, whole = next_step(self.point, self.centre, self.prior_sd, damping)
            little = max(PROMISED, enough * cost)
            if whole < little or failed >= FAILED:
                if self.fresh or enough or renewed:
                    return
                self._differences()
                failed, renewed = 0, failed >= FAILED
                continue
            self.iterations += 1
            trial = self._held(self.theta + step)
            promised = cost - self._cost(trial, self._linear(trial - self.theta))
            found = self._corrected(self._simulated([(trial, False)])[0])
            new = self._cost(trial, found)
            fresh, self.fresh = self.fresh, False
            self._update(trial - self.theta, found)
            poor, failed = cost - new < POOR * promised, failed + 1 if cost - new < little else 0
            if new < cost:
                self.theta, self.residual, cost = trial, found, new
                damping = max(damping, 1e-3) if poor else 0.2 * damping if damping > LEAST_DAMPING else 0.0
            else:
                damping = max(10.0 * damping, 1e-3)
            if poor and not fresh:
                self._differences()
        raise ConvergenceError(
            f"the calibration did not settle within {max_iterations} iterations (chi-squared {cost:.6g}); allow more (max_iterations), or "
            "start nearer: it is at "
            + ", ".join(f"{name} {value:.3g}" for name, value in zip(self.problem.unknowns.names, np.exp(self.theta), strict=True))
        )

    def _simulated(self, trials: Sequence[tuple[FloatArray, bool]]) -> list[Residual]:
        self.runs += len(trials)
        return self.at.many(self.problem, trials)

    def _corrected(self, found: Residual) -> Residual:
        return _sum(found, self.offset)

    def _linear(self, step: FloatArray) -> Residual:
        """Return the residuals that the derivatives promise after a step."""
        return self.residual[0] + self.slopes[0] @ step, self.residual[1] + self.slopes[1] @ step

    def _differences(self) -> None:
        """Take derivatives by differences of long steps: by the values, in which forces are nearly linear."""
        shifts = self.problem.shifts(np.exp(self.theta))
        assert shifts is not None
        base = _sum(self.residual, self.offset, -1.0)
        found = self._simulated([(self.theta + row, False) for row in np.diag(shifts)])
        points, forces = (
            np.stack([(own[k] - base[k]) / np.expm1(h) for own, h in zip(found, shifts, strict=True)], axis=1) for k in range(2)
        )
        self.slopes, self.fresh = (points, forces), True

    def _held(self, theta: FloatArray) -> FloatArray:
        return np.asarray(np.log(self.problem.unknowns.held(np.exp(theta))), dtype=np.float64)

    def _update(self, step: FloatArray, found: Residual) -> None:
        """Make the derivatives (count, p) tell what a step from theta, with the residuals that were found, did."""
        if sum(float(((new - old) ** 2).sum()) for new, old in zip(found, self.residual, strict=True)) < TELLING**2:
            return
        for slopes, new, old in zip(self.slopes, found, self.residual, strict=True):
            slopes += np.outer(new - old - slopes @ step, step) / float(step @ step)

    def _weigh(self) -> bool:
        """Take the noise as large as the misfit where that is more than stated, bring all to these units, and say whether it changed."""
        factors = noise_factors(self.problem, self.residual)
        excess = (max(factors[0], 1.0), max(factors[1], 1.0))
        points, forces = (old / new for old, new in zip(self.problem.excess, excess, strict=True))
        if max(abs(np.log(points)), abs(np.log(forces))) < WEIGHED:
            return False
        self.problem, self.fresh = self.problem.enlarged(excess), False
        self.residual, self.offset, self.slopes = (
            (pair[0] * points, pair[1] * forces) for pair in (self.residual, self.offset, self.slopes)
        )
        return True

    def _cost(self, theta: FloatArray, residual: Residual) -> float:
        return cost_at(residual, theta, self.centre, self.prior_sd)


def _sum(one: Residual, other: Residual, factor: float = 1.0) -> Residual:
    return one[0] + factor * other[0], one[1] + factor * other[1]
