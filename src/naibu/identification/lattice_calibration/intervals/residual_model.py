"""Residuals as a quadratic function of the values, and how far chi-squared lets a parameter go, all others fitted again.

Chi-squared of a lattice is no quadratic function of the logarithms: sums of values that compensate each other are determined a hundred
times better than the values, so that a straight line through logarithms leaves the valley of chi-squared. Residuals are nearly quadratic in
the values, and what curves along the least determined combinations can be told from a few simulations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint

RISE = 3.84  # of chi-squared, 95 % of one degree of freedom
BOX = 1.5  # change of any logarithm, at most
DAMPING = (0.0, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0)  # shares of the diagonal, tried one after the other
REFITS = 30  # steps of a fit
FITTED = 1e-4  # decrease of chi-squared that ends it
CLOSE = 0.005  # to its root
FARTHER = (0.3, 0.8, 1.6, 3.0)  # of the way to an end, at which other values are looked for that fit as well


@dataclass(slots=True)
class ResidualModel:
    """Residuals r(x) = r + J x + sum of q_ij (u_i . x) (u_j . x), x relative changes of the values.

    Attributes
    ----------
    point : EvaluatedPoint
        Where x is zero, with r and J.
    weak : ndarray, shape (p, m)
        Unit vectors u_i along which residuals curve.
    centre, prior_sd : ndarray of shape (p,), float
        Of the weak prior of the logarithms.
    curvature : ndarray, shape (n, m (m + 1) / 2)
        q_ij.
    """

    point: EvaluatedPoint
    weak: FloatArray
    centre: FloatArray
    prior_sd: float
    curvature: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    _terms: list[FloatArray] = field(default_factory=list)
    _left: list[FloatArray] = field(default_factory=list)

    def coefficients(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return 1, x and the products (1 + p + q,) at logarithms theta (p,), and their derivatives (1 + p + q, p) by these."""
        x, (first, second) = np.expm1(theta - self.point.theta), np.triu_indices(self.weak.shape[1])
        along = self.weak.T @ x
        products = along[first] * along[second]
        slopes = along[first, None] * self.weak.T[second] + along[second, None] * self.weak.T[first]
        derivatives = np.vstack([np.zeros(len(x)), np.eye(len(x)), slopes])
        return np.concatenate([[1.0], x, products]), derivatives * (1.0 + x)

    def learn(self, theta: FloatArray, residual: FloatArray) -> None:
        """Take in residuals (n,) that were simulated at theta (p,)."""
        p, (found, _) = len(theta), self.coefficients(theta)
        self._terms.append(found[1 + p :])
        self._left.append(residual - np.concatenate(self.point.residual) - np.vstack(self.point.slopes) @ found[1 : 1 + p])

    def fit(self) -> None:
        """Fit the curvature to all that was simulated, what lies far away less closely."""
        terms = np.array(self._terms)
        weight = 1.0 / np.sqrt(np.maximum(np.linalg.norm(terms, axis=1), 1e-9))[:, None]
        self.curvature = np.linalg.lstsq(terms * weight, np.array(self._left) * weight, rcond=1e-8)[0].T

    def columns(self) -> FloatArray:
        """Return what the coefficients multiply (n, 1 + p + q)."""
        return np.column_stack([np.concatenate(self.point.residual), np.vstack(self.point.slopes), self.curvature])

    def predicted(self, theta: FloatArray) -> FloatArray:
        """Return residuals (n,) at theta (p,)."""
        return np.asarray(self.columns() @ self.coefficients(theta)[0])

    def cost(self, offset: FloatArray | None = None) -> ModelledCost:
        """Return chi-squared with the prior as a function, an offset (n,) added to all residuals."""
        columns = self.columns()
        if offset is not None:
            columns[:, 0] += offset
        return ModelledCost(self, columns.T @ columns)


@dataclass(frozen=True, slots=True)
class ModelledCost:
    """Chi-squared of modelled residuals with that of the weak prior, from the products (1 + p + q, 1 + p + q) of their columns."""

    model: ResidualModel
    gram: FloatArray

    def __call__(self, theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Return it at theta (p,), half its gradient (p,), and half the Hessian (p, p) of Gauss and Newton."""
        found, slopes = self.model.coefficients(theta)
        apart, sd = (theta - self.model.centre) / self.model.prior_sd, self.model.prior_sd
        product = self.gram @ found
        hessian = slopes.T @ self.gram @ slopes + np.eye(len(theta)) / sd**2
        return float(found @ product + apart @ apart), slopes.T @ product + apart / sd, hessian

    def fitted(self, theta: FloatArray, free: IntArray) -> tuple[FloatArray, float]:
        """Return the minimum over the logarithms that are `free` (k,), and chi-squared there (:cite:t:`nocedal2006`, chapter 10)."""
        cost, slope, hessian = self(theta)
        for _ in range(REFITS):
            part = hessian[np.ix_(free, free)]
            for damping in DAMPING:
                trial = theta.copy()
                trial[free] -= np.linalg.solve(part + damping * np.diag(np.diag(part)), slope[free])
                found = self(trial) if np.abs(trial - self.model.point.theta).max() < BOX else (np.inf, slope, hessian)
                if found[0] < cost:
                    break
            else:
                break
            decrease, (cost, slope, hessian), theta = cost - found[0], found, trial
            if decrease < FITTED:
                break
        return theta, cost

    def end(self, theta: FloatArray, lowest: float, k: int, reach: float, farthest: float) -> FloatArray:
        """Return where chi-squared, all others fitted again, has risen by `RISE` as parameter k goes to one side.

        It is followed from a minimum (p,), or other values within it, along its valley, in steps that grow.

        Parameters
        ----------
        theta, lowest
            Where it begins, and chi-squared at the minimum.
        k : int
            Number of the parameter.
        reach : float
            Where that is by derivatives: change of its logarithm, with the sign of the side.
        farthest : float
            Change at which it ends even where chi-squared has risen by less, or earlier where no logarithm may change any more.
        """
        free, side = np.delete(np.arange(len(theta), dtype=np.int64), k), float(np.sign(reach))
        here, low, step = theta, self(theta)[0], 0.25 * abs(reach)
        last = self._held(theta + side * farthest * np.eye(len(theta))[k])[k]
        while (left := side * (last - here[k])) > 1e-9:
            tangent = np.linalg.solve(self(here)[2], np.eye(len(theta))[k])
            ahead = side * min(step, left) / tangent[k] * tangent
            there, high = self.fitted(self._held(here + ahead), free)
            if high >= lowest + RISE:
                return self._between(here, ahead, free, (low - lowest, high - lowest))
            here, low, step = there, high, 1.4 * step
        return here

    def beyond(
        self, end: FloatArray, starts: Sequence[FloatArray], lowest: float, k: int, reach: float, farthest: float
    ) -> FloatArray | None:
        """Return where, farther out than an end (p,), chi-squared is within `RISE` again; None if nowhere that is found.

        Where values compensate each other in several ways, what the others are fitted to from the end on is the nearest of several
        minima. They are fitted anew from all of `starts`.

        Parameters
        ----------
        end : ndarray, shape (p,)
            Where chi-squared has risen on the way from the minimum.
        starts : sequence of ndarray, shape (p,)
            Other logarithms.
        lowest, k, farthest
            As for `end`.
        reach : float
            Change of the logarithm of parameter k at the end, with the sign of the side.
        """
        free, last = np.delete(np.arange(len(end), dtype=np.int64), k), self.model.point.theta[k] + np.sign(reach) * farthest
        for part in FARTHER:
            place = end[k] + part * reach
            if np.sign(reach) * (last - place) <= 0.0:
                break
            for start in starts:
                moved = self._held(start)
                moved[k] = place
                there, cost = self.fitted(moved, free)
                if cost < lowest + RISE:
                    return there
        return None

    def _between(self, here: FloatArray, ahead: FloatArray, free: IntArray, rises: tuple[float, float]) -> FloatArray:
        """Return where it has risen by `RISE` on the way ahead; the root of what rises is nearly linear."""
        near, far, wanted, there = 0.0, 1.0, np.sqrt(RISE), here
        low, high = np.sqrt(max(rises[0], 0.0)), np.sqrt(rises[1])
        lowest = self(here)[0] - rises[0]
        for _ in range(20):
            part = near + (far - near) * float(np.clip((wanted - low) / max(high - low, 1e-12), 0.05, 0.95))
            there, found = self.fitted(self._held(here + part * ahead), free)
            root = np.sqrt(max(found - lowest, 0.0))
            if abs(root - wanted) < CLOSE * wanted:
                break
            if root > wanted:
                far, high = part, root
            else:
                near, low = part, root
        return there

    def _held(self, theta: FloatArray) -> FloatArray:
        origin = self.model.point.theta
        return np.clip(theta, origin - 0.99 * BOX, origin + 0.99 * BOX)
