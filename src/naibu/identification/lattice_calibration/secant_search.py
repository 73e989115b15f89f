"""Least squares where derivatives are differences of simulations: from a rough guess to the neighbourhood of the minimum.

Steps are those of Gauss and Newton within a trust region (:cite:t:`nocedal2006`, chapters 4 and 10), with long steps of time. Derivatives
are differences at the start only; from then on they are secants through all that was simulated (:cite:t:`ralston1978`), by relative
changes of the values. A step and its half are simulated side by side; where they bring less than promised, so are corrections of second
order, which follow a curved valley (:cite:t:`transtrum2012`). How exact an estimate is, and the minimum of fine steps, are left to
`LocalRegression`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint
from naibu.identification.lattice_calibration.least_squares import cost_at, step_within
from naibu.identification.lattice_calibration.simulated_points import SimulatedPoints

DIFFERENCE = 0.05  # of a logarithm, at the start: above what residuals jump by
REACH = 1.0  # relative change of a value in one step, at most
SHORTEST = 0.05
ENOUGH = 2e-3  # of the cost, which is not worth a step with long steps of time
CORRECTED, POOR = 0.5, 0.3  # of the promised decrease, below which a step is corrected, and counts as poor
FAILED = 2  # poor steps that end the search


@dataclass(slots=True)
class SecantSearch:
    """A search for the least chi-squared.

    Attributes
    ----------
    points : SimulatedPoints
        Filled by the search.
    centre, prior_sd
        Of the weak prior.
    theta, residual : ndarray, shape (p,), (n,)
        Where it is, and residuals of long steps there.
    slopes : ndarray, shape (n, p)
        Derivatives by relative changes of the values.
    iterations : int
        Steps.
    """

    points: SimulatedPoints
    centre: FloatArray
    prior_sd: float
    theta: FloatArray
    residual: FloatArray = field(init=False)
    slopes: FloatArray = field(init=False)
    iterations: int = 0

    def __post_init__(self) -> None:
        shifts = self.points.problem.shifts(np.exp(self.theta))
        assert shifts is not None
        trials = [self.theta, *(self.theta + row for row in np.diag(np.sign(shifts) * DIFFERENCE))]
        self.residual = self.points.simulated([(self.points.held(theta), False) for theta in trials])[0]
        self._learn()

    @property
    def point(self) -> EvaluatedPoint:
        """Where it is."""
        return EvaluatedPoint(self.theta, self.points.parts(self.residual), self.points.parts(self.slopes))

    def run(self, max_iterations: int) -> None:
        """Take steps until the next promises little, or several brought much less than they promised."""
        cost, reach, poor = self._cost(self.theta, self.residual), REACH, 0
        while self.iterations < max_iterations and poor < FAILED:
            self.points.at.keep(self.points.problem, self.point)
            if self._step(np.inf)[1] < max(ENOUGH * cost, len(self.theta)):
                return
            self.iterations += 1
            change, promised = self._step(reach)
            theta, residual, new = self._best(change, reach, cost - CORRECTED * promised)
            if cost - new < POOR * promised:
                poor, reach = poor + 1, max(0.5 * float(np.abs(change).max()), SHORTEST)
            if new < cost:
                self.theta, self.residual, cost = theta, residual, new
            self._learn()

    def covariance(self) -> FloatArray:
        """Return the covariance (p, p) of relative changes of the values that the derivatives give, larger by the way to the minimum."""
        excess = max(float((self.residual**2).mean()), 1.0)
        information = self.slopes.T @ self.slopes / excess + np.eye(len(self.theta)) / self.prior_sd**2
        return np.asarray(np.linalg.inv(information) * (1.0 + self._step(np.inf)[1] / excess / len(self.theta)), dtype=np.float64)

    def _best(self, change: FloatArray, reach: float, wanted: float) -> tuple[FloatArray, FloatArray, float]:
        """Return the best of a step and its half, and of corrections of both where neither reaches the cost that is `wanted`."""
        trials = [self.points.moved(self.theta, part * change) for part in (1.0, 0.5)]
        found = self._tried(trials)
        if min(cost for _, _, cost in found) > wanted:
            corrected = []
            for (
                theta,
                residual,
                _,
            ) in found:  # forces are linear in the values: their derivatives do not change, those by relative changes do
                again, _ = self._step(reach, theta, residual, self.slopes * np.exp(theta - self.theta))
                corrected.append(self.points.moved(theta, again))
            found += self._tried(corrected)
        return min(found, key=lambda one: one[2])

    def _tried(self, trials: list[FloatArray]) -> list[tuple[FloatArray, FloatArray, float]]:
        found = self.points.simulated([(theta, False) for theta in trials])
        return [(theta, residual, self._cost(theta, residual)) for theta, residual in zip(trials, found, strict=True)]

    def _step(
        self, reach: float, theta: FloatArray | None = None, residual: FloatArray | None = None, slopes: FloatArray | None = None
    ) -> tuple[FloatArray, float]:
        """Return the relative change of the values within reach, here by default, and the decrease of chi-squared that it promises."""
        theta, residual, slopes = (
            self.theta if theta is None else theta,
            self.residual if residual is None else residual,
            self.slopes if slopes is None else slopes,
        )
        point = EvaluatedPoint(theta, self.points.parts(residual), self.points.parts(slopes))
        return step_within(point, self.centre, self.prior_sd, reach)

    def _learn(self) -> None:
        self.slopes = self.points.slopes(self.theta, self.residual)

    def _cost(self, theta: FloatArray, residual: FloatArray) -> float:
        return cost_at(self.points.parts(residual), theta, self.centre, self.prior_sd)
