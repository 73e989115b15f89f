"""Estimate and covariance where residuals jump: derivatives by regression over the interval itself, what they leave as error of the model.

In contact residuals jump, as points begin to slip, and bend sharply where they stick and slip by turns. A difference along one
parameter takes jumps for derivatives, and a search goes to the bottom of the nearest jump. Here the lattice is simulated in pairs on
both sides of the estimate, as far away as its covariance reaches; a linear regression through half their differences, which are free
of curvature, gives derivatives over that range (:cite:t:`ralston1978`), in which jumps cancel. What it does not explain of the
simulations is an error of the model that measurements have as well, since the truth lies at one such point: it counts as noise, by
which residuals are weighed, and whose effect on the estimate is added to the covariance, with its correlations
(:cite:t:`kennedy2001`). So do the curvature and differences between long and short steps of time, from a few points. Information that
jumps alone may pretend is taken away: how much that is, is told by exchanging what the regression leaves among its rows (a permutation
test; :cite:t:`good2005`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
from scipy.ndimage import uniform_filter1d
from scipy.special import ndtri, stdtrit

from naibu.core.arrays import FloatArray
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint
from naibu.identification.lattice_calibration.least_squares import STRETCHES, about, in_stretches, unsettled_covariance
from naibu.identification.lattice_calibration.simulated_points import FARTHEST, SimulatedPoints

NARROWEST = 0.004  # standard deviation of relative changes of the values around the estimate, along principal axes
SPREAD = 2.0  # of these deviations over those of the estimate: what jumps pretend falls with the square
EXCHANGES = 100
WIDEST = (0.01, 0.06, 0.24)  # largest one: at least, at first, and at most
# by how much less a regression must leave of the simulations where these are half as far away: what they left then was curvature
PAYS = 4.0
ROUNDS = 8
REACHES = 2.0  # of these deviations, how far a step follows a regression
PARTS, POOR = (1.0, 0.3), 0.3  # of a step, tried one after the other as long as less than that share of what was promised comes of it
WORTH = 3.0  # decrease of chi-squared for each parameter that is worth another round
TOO_FAR = 8.0  # squared, mean over the parameters: points that do not count
WIDER = 2.0  # standard deviations over those of the points, from which the regression does not reach as far as its interval
LONGEST = 0.4  # relative change of a value in a round
CLOSE = 2.0  # standard deviations: a step within them ends the rounds
FINE = 3  # points with fine steps
MISFIT = 1.2  # mean square of residuals in units of noise and error of the model, from which both are taken as larger
NEIGHBOURS = (101, 15)  # of points and of forces, whose errors of the model are averaged


@dataclass(frozen=True, slots=True, eq=False)
class Regression:
    """What one regression tells.

    Attributes
    ----------
    steps : tuple of ndarray, shape (p,)
        From its centre to the estimate, without and with what jumps may pretend, as far as the regression may be followed.
    way : ndarray, shape (p,)
        All of the first step, in logarithms: where data say nothing, to the centre of the prior.
    covariance : ndarray, shape (p, p)
        Of the estimate, errors of the model included.
    slopes : ndarray, shape (n, p)
        Derivatives.
    weights : ndarray, shape (n,)
        Of residuals: one over their variance, noise and errors of the model, in units of the stated noise.
    jumps : float
        What the regression leaves of the simulations: a sum of squares, in units of noise and error of the model.
    free : int
        By how many points more than unknowns there are.
    """

    steps: tuple[FloatArray, FloatArray]
    way: FloatArray
    covariance: FloatArray
    slopes: FloatArray
    weights: FloatArray
    jumps: float
    free: int


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Simulations on both sides of a point: half their difference is free of curvature.

    Attributes
    ----------
    theta : ndarray, shape (2, p)
        Logarithms that were simulated.
    rise, even : ndarray, shape (n,)
        Half the difference of the residuals, and what their mean differs by from residuals in the middle.
    """

    theta: FloatArray
    rise: FloatArray
    even: FloatArray

    def change(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return half the difference (p,) and the mean (p,) of both relative changes of the values at theta (p,)."""
        first, second = np.expm1(np.clip(self.theta - theta, -FARTHEST, FARTHEST))
        return 0.5 * (first - second), 0.5 * (first + second)


def regression(
    pairs: Sequence[Pair],
    theta: FloatArray,
    level: FloatArray,
    points: int,
    spread: FloatArray,
    centre: FloatArray,
    prior_sd: float,
    errors: Sequence[FloatArray] = (),
) -> Regression:
    """Return the estimate of a regression of residuals, its covariance and the derivatives.

    Parameters
    ----------
    pairs : sequence of Pair
        What was simulated; the nearest ``2 p + 2`` count, less the farther away they are.
    theta, level : ndarray, shape (p,), (n,)
        Logarithms in the middle, and residuals there in units of their noise.
    points : int
        How many of them are of points.
    spread : ndarray, shape (p, p)
        Covariance of relative changes of the values over which the regression holds.
    centre, prior_sd
        Of the weak prior.
    errors : sequence of ndarray, shape (n,)
        Further errors of the model.
    """
    p, prior, root_spread = len(theta), np.eye(len(theta)) / prior_sd**2, np.asarray(np.linalg.cholesky(spread), np.float64)
    changes, away = _places(pairs, theta, root_spread)
    near = np.argsort(away, kind="stable")[: 2 * p + 2]
    near = near[: max(int((away[near] < TOO_FAR).sum()), p)]
    weight, rows = 1.0 / (1.0 + (0.5 * away[near]) ** 2), np.stack([pairs[k].rise for k in near])
    design, units, root = changes[near], np.sqrt(np.diag(spread)), np.sqrt(weight)[:, None]
    slopes = (np.linalg.lstsq(root * design * units, root * rows, rcond=1e-8)[0] * units[:, None]).T
    free = len(near) - p
    left = (rows - design @ slopes.T) * root / np.sqrt(weight.mean() * max(free, 1) / len(near))
    further = np.stack(errors) if errors else np.zeros((0, len(level)))
    parts = [
        (left, 2.0 * max(free, 1) / max(free - 2, 1) / len(near)),  # of half differences; variance of Student's distribution: they are few
        (np.stack([pairs[k].even for k in near]), 1.0 / len(near)),
        (further, 1.0 / max(len(further) - 1, 1)),
    ]
    mean_square = sum(share * (rest**2).sum(axis=0) for rest, share in parts)
    noise = _noise(level, mean_square, points)
    weights = np.asarray(1.0 / (noise + mean_square), dtype=np.float64)
    uncertain = np.linalg.inv((design * weight[:, None]).T @ design) * weight.mean()  # (p, p), per variance of half a difference
    jumps = float(weights @ (left**2).mean(axis=0))
    told, apparent = np.eye(p), (slopes.T * weights) @ slopes
    if free > 0:
        spurious = _spurious(root * design, (left * weights) @ left.T * weight.mean(), jumps * uncertain)
        told = _told(apparent, spurious)
    information = told @ apparent
    hessian = 0.5 * (information + information.T) + prior
    covariance = np.linalg.inv(hessian)
    slope = told @ slopes.T @ (weights * level) + prior @ (theta - centre)
    gain = covariance @ told @ (slopes.T * weights)
    steps = _limited(hessian, slope), _limited(apparent + prior, slopes.T @ (weights * level) + prior @ (theta - centre))
    for rest, share in (*parts, (further, _of_another(len(further))), (_lacking(level, noise, points), 1.0)):
        moved = rest @ gain.T
        covariance = covariance + share * moved.T @ moved
    limited = about(covariance, np.zeros(p), unsettled_covariance(theta, centre, prior_sd))
    return Regression(steps, -np.linalg.solve(hessian, slope), limited, slopes, weights, jumps, free)


def _places(pairs: Sequence[Pair], theta: FloatArray, root: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return half the differences (m, p) of pairs, and how far they are away, (m,), in units of the variance with that `root`."""
    changes, middles = (np.array(part) for part in zip(*(pair.change(theta) for pair in pairs), strict=True))
    size, away = ((np.linalg.solve(root, part.T) ** 2).mean(axis=0) for part in (changes, middles))
    return changes, away + np.maximum(size - 1.0, 0.0)


def _limited(hessian: FloatArray, slope: FloatArray) -> FloatArray:
    """Return the step of Gauss and Newton, damped where it is longer than `LONGEST`."""
    step, damping = -np.linalg.solve(hessian, slope), 1e-4 * np.trace(hessian) / len(slope)
    while np.abs(step).max() > LONGEST:
        step = -np.linalg.solve(hessian + damping * np.eye(len(slope)), slope)
        damping *= 3.0
    return np.asarray(step, dtype=np.float64)


def _noise(level: FloatArray, mean_square: FloatArray, points: int) -> FloatArray:
    """Return variances of noise (n,), as large as the misfit where that is more; mean squares of model errors are smoothed in place."""
    noise = np.ones(len(level))
    for part, size in zip((slice(points), slice(points, None)), NEIGHBOURS, strict=True):
        if len(level[part]):
            mean_square[part] = uniform_filter1d(mean_square[part], size)
            excess = float((level[part] ** 2 / (1.0 + mean_square[part])).mean())
            noise[part] = excess if excess > MISFIT else 1.0
    return noise


def _lacking(level: FloatArray, noise: FloatArray, points: int) -> FloatArray:
    """Return what forces lack (m, n), stretch by stretch of time, where it is more than the stated noise and errors of the model.

    It is alike in neighbouring windows, and moves the estimate by more than as much independent noise does: its stretches are taken for
    independent instead (after :cite:t:`newey1987`).
    """
    count = len(level) - points
    found = np.hstack([np.zeros((STRETCHES, points)), in_stretches(level[points:])])
    return found if count and noise[-1] > 1.0 else found[:0]


def _of_another(count: int) -> float:
    """Return what the sum of squares about the mean of so few errors of the model tells of another one, beside its mean square.

    What was measured has an error of its own, which that mean does not tell; and how much errors vary is known from few of them. The
    variance is such that its 95 % interval is that of Student's distribution.
    """
    if count < 2:
        return 0.0
    quantile = float(stdtrit(count - 1, 0.975) / ndtri(0.975))
    return ((1.0 + 1.0 / count) * quantile**2 - 1.0) / (count - 1)


def _spurious(design: FloatArray, products: FloatArray, mean: FloatArray) -> FloatArray:
    """Return the information (p, p) that what a regression leaves may pretend: its `mean`, larger by what chance makes of it.

    The rows that the regression leaves, with `products` (m, m), are exchanged among the rows of its design (m, p) again and again: where
    few kinds of jumps make them, some combination of parameters appears to be known much better than in the mean (:cite:t:`good2005`).
    """
    rng, root, reach = np.random.default_rng(0), np.linalg.cholesky(mean + 1e-300 * np.eye(len(mean))), np.linalg.pinv(design)
    largest = []
    for _ in range(EXCHANGES):
        order = rng.permutation(len(products))
        pretended = np.linalg.solve(root, reach @ products[np.ix_(order, order)] @ reach.T)
        largest.append(np.linalg.eigvalsh(np.linalg.solve(root, pretended.T)).max())
    return np.asarray(mean * max(float(np.quantile(largest, 0.95)), 1.0))


def _told(information: FloatArray, spurious: FloatArray) -> FloatArray:
    """Return what an apparent information (p, p), or a gradient, is multiplied by so that it is without what is spurious in it.

    Along combinations in which the spurious part explains all of it, nothing is left: there the weak prior holds.
    """
    p = len(information)
    values, vectors = scipy.linalg.eigh(information, spurious + 1e-12 * np.trace(information) / p * np.eye(p))
    share = np.maximum(1.0 - 1.0 / np.maximum(values, 1e-300), 0.0)
    return np.asarray(np.linalg.solve(vectors.T, share[:, None] * vectors.T))


@dataclass(slots=True)
class LocalRegression:
    """Rounds of regression from the end of a search on.

    In every round the lattice is simulated on both sides along random orthogonal directions, as far away as is typical of the covariance,
    but no farther than the linear model holds. Both steps of the regression are simulated, the better one is taken. Once steps stay within
    the covariance and chi-squared falls no longer, fine steps of time at a few points tell what to add to residuals of long ones, again
    where it moved on after that. The last regression has half as many points to spare as there are values. What is left of the way that it
    points is a deviation: a search may have ended far away along what the data do not tell.

    Attributes
    ----------
    points : SimulatedPoints
        What was simulated, among it where it is.
    theta, long : ndarray, shape (p,), (n,)
        Where it is, and residuals of long steps there.
    centre, prior_sd
        Of the weak prior.
    covariance : ndarray, shape (p, p)
        As far as it is known.
    rounds : int
        Regressions.
    settled : bool
        Whether a last regression moved every value by less than its interval.
    """

    points: SimulatedPoints
    theta: FloatArray
    long: FloatArray
    centre: FloatArray
    prior_sd: float
    covariance: FloatArray
    rounds: int = 0
    settled: bool = False
    _offset: FloatArray = field(init=False)  # (n,), of fine steps from long ones
    _pairs: list[Pair] = field(default_factory=list)
    _errors: list[FloatArray] = field(default_factory=list)  # how that varies
    _widest: float = WIDEST[1]
    _shrinks: bool = True
    _left: float = np.inf  # what the last regression left
    _rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def run(self) -> tuple[EvaluatedPoint, FloatArray]:
        """Return where it ended, with residuals as of fine steps, and second moments (p, p) about it."""
        p, corrected, due = len(self.theta), False, False
        while True:
            spread = _within(SPREAD**2 * self.covariance, self._widest)
            self._simulate(spread, p if self.rounds == 0 else (p + 1) // 2, first=self.rounds == 0, several=due)
            corrected, self.rounds = corrected or due, self.rounds + 1
            fit = self._fit(spread)
            sd = np.sqrt(np.diag(fit.covariance))
            still = bool((np.abs(fit.steps) <= CLOSE * sd).all()) and fit.free > 0  # else what it leaves is not known
            still = still and np.trace(np.linalg.solve(spread, _within(SPREAD**2 * fit.covariance, self._widest))) < WIDER**2 * p
            end = self.theta + fit.way
            still = self._move(fit, spread) < WORTH * p and still
            near, corrected = still and fit.free >= p // 2, still and corrected
            self.covariance = fit.covariance
            if self.rounds >= ROUNDS or (near and corrected):
                self.settled = near and corrected
                residual = self.points.parts(self.long + self._offset)
                most = unsettled_covariance(self.theta, self.centre, self.prior_sd)
                covariance = about(fit.covariance, end - self.theta, most)
                return EvaluatedPoint(self.theta, residual, self.points.parts(fit.slopes)), covariance
            due = still and not corrected  # even where the regression lacks points: the next one has more
            self._adapt(fit.jumps)

    def _adapt(self, jumps: float) -> None:
        """Simulate nearer as long as the regression leaves much less there, curvature; else farther away, where jumps count less."""
        least, _, most = WIDEST
        if self._shrinks and jumps * PAYS > self._left:
            self._shrinks, self._widest = False, min(2.0 * self._widest, most)
        elif self._shrinks and jumps > 1.0:
            self._left, self._widest = jumps, max(0.5 * self._widest, least)

    def _simulate(self, spread: FloatArray, count: int, *, first: bool, several: bool) -> None:
        """Simulate on both sides in random orthogonal directions, with fine steps here at `first`, at `several` points where due."""
        root, p = np.linalg.cholesky(spread), len(self.theta)
        directions = np.sqrt(p) * (root @ np.linalg.qr(self._rng.standard_normal((p, p)))[0]).T[:count]
        around = [self.points.moved(self.theta, side * row) for row in directions for side in (1.0, -1.0)]
        others = [self.points.moved(self.theta, root @ self._rng.standard_normal(p) / SPREAD) for _ in range(FINE - 1)] if several else []
        fine = [self.theta, *others] if first or several else []
        found = self.points.simulated([*((theta, True) for theta in fine), *((theta, False) for theta in (*others, *around))])
        if fine:
            long = [self.long, *found[len(fine) : len(fine) + len(others)]]
            offsets = np.array([own - other for own, other in zip(found, long, strict=False)])
            self._offset = offsets.mean(axis=0)
            self._errors = list(offsets - self._offset) if several else []
        inverse = np.linalg.inv(self.covariance)
        for k in range(len(fine) + len(others), len(found), 2):
            theta, (one, other) = np.array(around[k - len(fine) - len(others) :][:2]), found[k : k + 2]
            pair = Pair(theta, 0.5 * (one - other), 0.5 * (one + other) - self.long)
            change = pair.change(self.theta)[0]
            farther = max(float(change @ inverse @ change) / p, 1.0)  # curvature grows with the square
            self._pairs.append(replace(pair, even=pair.even / farther))

    def _fit(self, spread: FloatArray) -> Regression:
        level = self.long + self._offset
        return regression(self._pairs, self.theta, level, self.points.points, spread, self.centre, self.prior_sd, self._errors)

    def _move(self, fit: Regression, spread: FloatArray) -> float:
        """Move by the better step of a regression, as far as the regression reaches, if residuals as it weighs them get less.

        Where steps bring much less than they promise, shorter ones are tried. Returns the decrease of chi-squared, errors of the model
        not regarded, or `POOR` of what was promised if that is more: while it goes on falling, or should, they are not what is left. A
        search that finds no way down is not at its end.
        """
        steps = []
        for step in fit.steps:
            away = np.sqrt(float(step @ np.linalg.solve(spread, step)) / len(step))
            steps.append(step * min(1.0, REACHES / max(away, 1e-300)))
        here, before = self._cost(fit, self.theta, self.long), float(((self.long + self._offset) ** 2).sum())
        promised = here - min(self._cost(fit, self.points.moved(self.theta, s), self.long + fit.slopes @ s) for s in steps)
        places = [(self.theta, self.long)]
        for part in PARTS:
            trials = [self.points.moved(self.theta, part * step) for step in steps]
            places += zip(trials, self.points.simulated([(theta, False) for theta in trials]), strict=True)
            theta, long = min(places, key=lambda place: self._cost(fit, *place))
            if here - self._cost(fit, theta, long) > POOR * promised or promised < WORTH * len(theta):
                break
        self.theta, self.long = theta, long
        return max(before - float(((long + self._offset) ** 2).sum()), POOR * promised)

    def _cost(self, fit: Regression, theta: FloatArray, long: FloatArray) -> float:
        return float(fit.weights @ (long + self._offset) ** 2 + (((theta - self.centre) / self.prior_sd) ** 2).sum())


def _within(covariance: FloatArray, most: float) -> FloatArray:
    """Return a covariance (p, p) with standard deviations of at most `most` along its principal axes."""
    variance, axes = np.linalg.eigh(covariance)
    return np.asarray((axes * np.clip(variance, NARROWEST**2, most**2)) @ axes.T)
