"""Simulations with long steps of time that a search has made, and linear models through them.

Positions relative to one of them are relative changes of the values, not of their logarithms: forces of a lattice are nearly linear in K,
C1 and friction, and combinations of parameters that compensate each other do so in the values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.lattice_calibration.evaluation import Residual
from naibu.identification.lattice_calibration.inverse_problem import InverseProblem
from naibu.identification.lattice_calibration.least_squares import Evaluations

LEAST_FACTOR = 0.3  # by which a change makes a value smaller, at most
FARTHEST = 3.0  # change of a logarithm that is told apart
NEAR = 0.02  # relative change of values within which secants count alike


@dataclass(slots=True)
class SimulatedPoints:
    """What was simulated.

    Attributes
    ----------
    problem : InverseProblem
        With the noise as it is stated.
    at : Evaluations
        Of residuals.
    theta : list of ndarray, shape (p,)
        Logarithms that were simulated with long steps of time.
    found : list of ndarray, shape (n,)
        Residuals of points and forces there, in units of their noise.
    points : int
        How many of them are of points.
    """

    problem: InverseProblem
    at: Evaluations
    theta: list[FloatArray] = field(default_factory=list)
    found: list[FloatArray] = field(default_factory=list)
    points: int = 0

    def simulated(self, trials: Sequence[tuple[FloatArray, bool]]) -> list[FloatArray]:
        """Return residuals (n,) of logarithms (p,) with long or (True) fine steps, side by side; those of long ones are kept."""
        found = self.at.many(self.problem, trials)
        self.points = len(found[0][0])
        residuals = [np.concatenate(r) for r in found]
        for (theta, fine), residual in zip(trials, residuals, strict=True):
            if not fine:
                self.theta.append(theta)
                self.found.append(residual)
        return residuals

    def changes(self, theta: FloatArray) -> FloatArray:
        """Return where all of them lie, as relative changes (m, p) of the values at theta (p,)."""
        return np.asarray(np.expm1(np.clip(np.array(self.theta) - theta, -FARTHEST, FARTHEST)), dtype=np.float64)

    def moved(self, theta: FloatArray, change: FloatArray) -> FloatArray:
        """Return logarithms (p,) after a relative change (p,) of the values, as far as these are held."""
        return self.held(theta + np.log1p(np.maximum(change, LEAST_FACTOR - 1.0)))

    def held(self, theta: FloatArray) -> FloatArray:
        """Return logarithms (p,) of values within their ranges."""
        return np.asarray(np.log(self.problem.unknowns.held(np.exp(theta))), dtype=np.float64)

    def slopes(self, theta: FloatArray, residual: FloatArray) -> FloatArray:
        """Return derivatives (n, p) by relative changes of the values: secants through a point, the nearer the closer followed."""
        change = self.changes(theta)
        square = (change**2).sum(axis=1)
        others = square > 1e-16
        weight = 1.0 / (square[others] + NEAR**2)
        rise = np.array(self.found)[others] - residual
        found = np.linalg.lstsq(change[others] * weight[:, None], rise * weight[:, None], rcond=1e-10)[0]
        return np.asarray(found.T, dtype=np.float64)

    def parts(self, values: FloatArray) -> Residual:
        """Return what belongs to points and what to forces."""
        return values[: self.points], values[self.points :]
