"""Least squares where derivatives are differences of simulations: Gauss-Newton steps with Broyden's updates :cite:p:`broyden1965`.

A difference by every unknown costs as many simulations as there are unknowns. They are taken at the start and where the search has
settled; in between every simulation improves the derivatives along the way it went (a rank-one update; :cite:t:`nocedal2006`, chapter 11),
and they are taken anew only where steps do much less than they promised. The search takes long steps of time first, then goes on with the
residuals of fine ones; differences are always those of long steps.
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

NEAR = 0.1  # change of a logarithm since derivatives were taken, up to which they hold with their updates
POOR = 0.25  # of the promised decrease, below which a step has failed
FAILED = 2  # steps one after the other from which on derivatives are not trusted
ENOUGH = 2e-3  # of the cost, before fine steps are simulated
RENEWALS = 5  # of derivatives with fine steps, at most
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
    theta, residual : ndarray, tuple of ndarray
        Where it is, and residuals there: of long steps, or of fine ones.
    fine : bool
        Which.
    slopes : tuple of ndarray
        Derivatives.
    fresh : bool
        Whether these are differences at theta.
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
    residual: Residual = field(init=False)
    slopes: Residual = field(init=False)
    fine: bool = False
    fresh: bool = False
    runs: int = 0
    iterations: int = 0
    settled: bool = False

    def __post_init__(self) -> None:
        self.theta = self.centre.copy()
        self.residual = self._differences()[0]

    @property
    def point(self) -> EvaluatedPoint:
        """Where it is."""
        return EvaluatedPoint(self.theta, self.residual, self.slopes)

    def run(self, max_iterations: int, *, reweigh: bool) -> None:
        """Search with long steps, then with fine ones.

        Raises
        ------
        ConvergenceError
            It did not settle within `max_iterations` steps.
        """
        while not self._settle(max_iterations, ENOUGH) and not self.fresh:
            self.residual = self._differences()[0]
        self.fine = True
        for _ in range(RENEWALS):
            before = self.theta
            self.residual = self._differences((self.theta, True))[1]
            self.settled = self._settle(max_iterations)
            if reweigh and self.settled:
                self._weigh()
                self.settled = self._settle(max_iterations)
            if self.fresh or (self.settled and float(np.abs(self.theta - before).max()) < NEAR):
                return

    def _settle(self, max_iterations: int, enough: float = 0.0) -> bool:
        """Take steps until the next promises little, and return True; or until the derivatives no longer tell what steps do.

        `enough` is a decrease, as a fraction of the cost, that is not worth a step either.
        """
        cost, damping, failed = self._cost(self.theta, self.residual), 0.0, 0
        for _ in range(max_iterations):
            self.at.keep(self.problem, self.point)
            dampings = (damping, max(10.0 * damping, BESIDE))
            steps = [next_step(self.point, self.centre, self.prior_sd, d) for d in dampings]
            promised = steps[0][1]
            if promised < SETTLED + max(self.problem.roughness, enough) * cost:
                return True
            self.iterations += 1
            trials = [np.log(self.problem.unknowns.held(np.exp(self.theta + step))) for step, _ in steps]
            tried = self._simulated([(theta, self.fine) for theta in trials])
            costs = [self._cost(theta, found) for theta, found in zip(trials, tried, strict=True)]
            order = [int(k) for k in np.argsort(costs)[::-1]]  # the best last: what it tells stays
            for k in order:
                self._update(trials[k] - self.theta, tried[k])
            best = order[-1]
            failed = failed + 1 if cost - costs[best] < POOR * promised else 0
            if costs[best] < cost:
                self.theta, self.residual, cost, self.fresh = trials[best], tried[best], costs[best], False
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

    def _differences(self, *others: tuple[FloatArray, bool]) -> list[Residual]:
        """Take derivatives by differences of long steps: by the values, in which forces are nearly linear.

        Returns residuals of long steps at theta, and those of other simulations that are made beside.
        """
        shifts = self.problem.shifts(np.exp(self.theta))
        assert shifts is not None
        shifted = [(self.theta + row, False) for row in np.diag(shifts)]
        found = self._simulated([*others, (self.theta, False), *shifted])
        base, moved = found[len(others)], found[len(others) + 1 :]
        points, forces = (
            np.stack([(own[k] - base[k]) / np.expm1(h) for own, h in zip(moved, shifts, strict=True)], axis=1) for k in range(2)
        )
        self.slopes, self.fresh = (points, forces), True
        return [base, *found[: len(others)]]

    def _update(self, step: FloatArray, found: Residual) -> None:
        """Make the derivatives (count, p) tell what a step from theta, with the residuals that were found, did."""
        if not step.any():
            return
        for slopes, new, old in zip(self.slopes, found, self.residual, strict=True):
            slopes += np.outer(new - old - slopes @ step, step) / float(step @ step)

    def _weigh(self) -> None:
        """Take the noise as large as the misfit where that is more than stated, and bring all to these units."""
        factors = noise_factors(self.problem, self.point.residual)
        excess = (max(factors[0], 1.0), max(factors[1], 1.0))
        points, forces = (old / new for old, new in zip(self.problem.excess, excess, strict=True))
        self.problem = self.problem.enlarged(excess)
        self.residual, self.slopes = ((pair[0] * points, pair[1] * forces) for pair in (self.residual, self.slopes))

    def _cost(self, theta: FloatArray, residual: Residual) -> float:
        return cost_at(residual, theta, self.centre, self.prior_sd)
