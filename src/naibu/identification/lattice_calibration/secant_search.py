"""Least squares where derivatives are differences of simulations: Gauss-Newton steps with Broyden's updates :cite:p:`broyden1965`.

A difference by every unknown costs as many simulations as there are unknowns. They are taken at the start and where the search has
settled; in between every simulation improves the derivatives along the way it went (a rank-one update; :cite:t:`nocedal2006`, chapter 11),
and they are taken anew only where a step does much less than it promised. Long steps of time carry the search; what fine steps differ from
them is simulated where it settles, and added to the residuals from then on, until that no longer moves the minimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint, Residual
from naibu.identification.lattice_calibration.inverse_problem import InverseProblem
from naibu.identification.lattice_calibration.least_squares import SETTLED, Evaluations, cost_at, next_step, noise_factors

POOR = 0.25  # of the promised decrease, below which a step has failed
FAILED = 2  # steps one after the other from which on derivatives are not trusted
ENOUGH = (2e-3, 3e-4, 0.0)  # of the cost, before fine steps are simulated, then once, and then again
NEAR = 0.1  # change of a logarithm since fine steps were simulated, up to which their correction holds
CLOSE = 0.2  # change of a logarithm since differences were taken, up to which they hold with their updates
FINE_RUNS = 8  # at most
BESIDE = 0.1  # least damping of the second step that is tried beside the first
LEAST_DAMPING = 1e-3


@dataclass(slots=True)
class SecantSearch:
    """A search from the start of the weak prior on.

    Attributes
    ----------
    problem : InverseProblem
        With the noise as it is found.
    centre, prior_sd
        Of the weak prior.
    at : Evaluations
        Of residuals.
    theta, coarse : ndarray, tuple of ndarray
        Where it is, and residuals of long steps there.
    correction : tuple of ndarray
        What residuals of fine steps differ from these.
    slopes : tuple of ndarray
        Derivatives.
    differenced : ndarray
        Where differences were taken last.
    fresh : bool
        Whether that is theta.
    runs, iterations : int
        Simulations, and steps.
    settled : bool
        Whether the search came to rest.
    """

    problem: InverseProblem
    centre: FloatArray
    prior_sd: float
    at: Evaluations
    theta: FloatArray = field(init=False)
    coarse: Residual = field(init=False)
    correction: Residual = field(init=False)
    slopes: Residual = field(init=False)
    differenced: FloatArray = field(init=False)
    fresh: bool = False
    runs: int = 0
    iterations: int = 0
    settled: bool = False

    def __post_init__(self) -> None:
        self.theta = self.centre.copy()
        self.coarse, *shifted = self._simulated([(self.theta, False), *self._shifted()])
        self.correction = (np.zeros_like(self.coarse[0]), np.zeros_like(self.coarse[1]))
        self._take_differences(shifted)

    @property
    def point(self) -> EvaluatedPoint:
        """Where it is, with residuals of fine steps as far as they are known."""
        return EvaluatedPoint(self.theta, self._corrected(self.coarse), self.slopes)

    def run(self, max_iterations: int, *, reweigh: bool) -> None:
        """Search until fine steps no longer move the minimum.

        Raises
        ------
        ConvergenceError
            It did not settle within `max_iterations` steps.
        """
        settled = self._settle(max_iterations, ENOUGH[0])
        while not settled and not self.fresh:
            self._take_differences(self._simulated(self._shifted()))
            settled = self._settle(max_iterations, ENOUGH[0])
        for k in range(FINE_RUNS):
            enough = ENOUGH[min(k + 1, 2)]
            checked = self.theta
            known = self.fresh or (settled and float(np.abs(self.theta - self.differenced).max()) < CLOSE)
            fine, *shifted = self._simulated([(self.theta, True), *([] if known else self._shifted())])
            if shifted:
                self._take_differences(shifted)
            self.correction = (fine[0] - self.coarse[0], fine[1] - self.coarse[1])
            if reweigh and k:  # the first correction does not belong to the minimum
                self._weigh()
            settled = self._settle(max_iterations, enough)
            moved = float(np.abs(self.theta - checked).max())
            self.settled = settled and moved < NEAR
            if self.settled or moved == 0.0:
                return

    def _settle(self, max_iterations: int, enough: float = 0.0) -> bool:
        """Take steps until the next promises little, and return True; or until the derivatives no longer tell what steps do.

        `enough` is a decrease, as a fraction of the cost, that is not worth a step either.
        """
        cost, damping, failed = self._cost(self.theta, self.coarse), 0.0, 0
        for _ in range(max_iterations):
            self.at.keep(self.problem, self.point)
            dampings = (damping, max(10.0 * damping, BESIDE))
            steps = [next_step(self.point, self.centre, self.prior_sd, d) for d in dampings]
            promised = steps[0][1]
            if promised < SETTLED + max(self.problem.roughness, enough) * cost:
                return True
            self.iterations += 1
            trials = [np.log(self.problem.unknowns.held(np.exp(self.theta + step))) for step, _ in steps]
            tried = self._simulated([(theta, False) for theta in trials])
            costs = [self._cost(theta, found) for theta, found in zip(trials, tried, strict=True)]
            order = [int(k) for k in np.argsort(costs)[::-1]]  # the best last: what it tells stays
            for k in order:
                self._update(trials[k] - self.theta, tried[k])
            best = order[-1]
            failed = failed + 1 if cost - costs[best] < POOR * promised else 0
            if costs[best] < cost:
                self.theta, self.coarse, cost, self.fresh = trials[best], tried[best], costs[best], False
                damping = 0.3 * dampings[best] if dampings[best] > LEAST_DAMPING else 0.0
            else:
                damping = max(10.0 * damping, BESIDE)
            if failed == FAILED:
                return False
        raise ConvergenceError(
            f"the calibration did not settle within {max_iterations} iterations (chi-squared {cost:.6g}); allow more (max_iterations), or "
            "start nearer: it is at "
            + ", ".join(f"{name} {value:.3g}" for name, value in zip(self.problem.unknowns.names, np.exp(self.theta), strict=True))
        )

    def _simulated(self, trials: Sequence[tuple[FloatArray, bool]]) -> list[Residual]:
        self.runs += len(trials)
        return self.at.many(self.problem, trials)

    def _shifted(self) -> list[tuple[FloatArray, bool]]:
        return [(self.theta + row, False) for row in np.diag(self._shifts())]

    def _shifts(self) -> FloatArray:
        shifts = self.problem.shifts(np.exp(self.theta))
        assert shifts is not None
        return shifts

    def _take_differences(self, shifted: Sequence[Residual]) -> None:
        """Take derivatives from residuals at shifted parameters."""
        points, forces = (
            np.stack([(found[k] - self.coarse[k]) / h for found, h in zip(shifted, self._shifts(), strict=True)], axis=1) for k in range(2)
        )
        self.slopes, self.fresh, self.differenced = (points, forces), True, self.theta

    def _update(self, step: FloatArray, found: Residual) -> None:
        """Make the derivatives (count, p) tell what a step from theta, with the residuals of long steps that were found, did."""
        if not step.any():
            return
        for slopes, new, old in zip(self.slopes, found, self.coarse, strict=True):
            slopes += np.outer(new - old - slopes @ step, step) / float(step @ step)

    def _weigh(self) -> None:
        """Take the noise as large as the misfit where that is more than stated, and bring all to these units."""
        factors = noise_factors(self.problem, self.point.residual)
        excess = (max(factors[0], 1.0), max(factors[1], 1.0))
        points, forces = (old / new for old, new in zip(self.problem.excess, excess, strict=True))
        self.problem = self.problem.enlarged(excess)
        self.coarse, self.correction, self.slopes = (
            (pair[0] * points, pair[1] * forces) for pair in (self.coarse, self.correction, self.slopes)
        )

    def _corrected(self, coarse: Residual) -> Residual:
        return coarse[0] + self.correction[0], coarse[1] + self.correction[1]

    def _cost(self, theta: FloatArray, coarse: Residual) -> float:
        return cost_at(self._corrected(coarse), theta, self.centre, self.prior_sd)
