"""Estimate and covariance where residuals jump: derivatives by regression over the interval itself, what they leave as error of the model.

In contact residuals jump, as points begin to slip, and bend sharply where they stick and slip by turns. A difference along one parameter
takes jumps for derivatives, and a search goes to the bottom of the nearest jump. Here the lattice is simulated at points all around the
estimate, as far away as its covariance reaches; a linear regression through all of them gives derivatives over that range
(:cite:t:`ralston1978`), in which jumps cancel. What it does not explain of the simulations is an error of the model that measurements
have as well, since the truth lies at one such point: it counts as noise, by which residuals are weighed, and whose effect on the estimate
is added to the covariance, with its correlations (:cite:t:`kennedy2001`). Differences between long and short steps of time are treated
alike, from a few points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg
from scipy.ndimage import uniform_filter1d

from naibu.core.arrays import FloatArray
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint, Residual
from naibu.identification.lattice_calibration.inverse_problem import InverseProblem
from naibu.identification.lattice_calibration.least_squares import Evaluations

FIRST = 0.03  # standard deviation of logarithms around the end of a search
SPREAD = (0.004, 0.12)  # of later ones, which follow the covariance
ROUNDS = 6
WIDER = 1.5  # standard deviations over those of the points, from which the regression does not reach as far as its interval
LONGEST = 0.4  # change of a logarithm in a round
CLOSE = 2.0  # standard deviations: a step within them ends the rounds
FINE = 3  # points with fine steps
MISFIT = 1.2  # mean square of residuals in units of noise and error of the model, from which both are taken as larger
LEAST = 0.02  # of the information of a combination, which is left at least where errors of the model explain the rest
NEIGHBOURS = (101, 15)  # of points and of forces, whose errors of the model are averaged


@dataclass(frozen=True, slots=True, eq=False)
class Regression:
    """What one regression tells.

    Attributes
    ----------
    step : ndarray, shape (p,)
        From its centre to the estimate.
    covariance : ndarray, shape (p, p)
        Of the estimate, errors of the model included.
    slopes : tuple of ndarray
        Derivatives.
    """

    step: FloatArray
    covariance: FloatArray
    slopes: Residual


def regression(
    theta: FloatArray,
    simulated: Sequence[Residual],
    middle: FloatArray,
    spread: FloatArray,
    centre: FloatArray,
    prior_sd: float,
    errors: Sequence[Residual] = (),
) -> Regression:
    """Return the estimate of a regression of residuals, its covariance and the derivatives.

    Parameters
    ----------
    theta : ndarray, shape (n, p)
        Logarithms that were simulated; the nearest ``3 p + 2`` count, less the farther away they are.
    simulated : sequence of tuple of ndarray
        Residuals of points and forces there, in units of their noise.
    middle, spread : ndarray, shape (p,), (p, p)
        Around which point, and how far, the regression holds.
    centre, prior_sd
        Of the weak prior.
    errors : sequence of tuple of ndarray
        Further errors of the model.
    """
    p, prior = len(middle), np.eye(len(middle)) / prior_sd**2
    away = (np.linalg.solve(np.linalg.cholesky(spread), (theta - middle).T) ** 2).sum(axis=0) / p
    near = np.argsort(away)[: 3 * p + 2]
    weight = 1.0 / (1.0 + (0.5 * away[near]) ** 2)
    units = np.concatenate([[1.0], np.sqrt(np.diag(spread))])
    design = np.column_stack([np.ones(len(near)), theta[near] - middle])
    count, rows = len(simulated[0][0]), np.stack([np.concatenate(simulated[k]) for k in near])
    root = np.sqrt(weight)[:, None]
    found = np.linalg.lstsq(root * design * units, root * rows, rcond=1e-8)[0] * units[:, None]
    free = max(len(near) - p - 1, 1) / len(near)
    left = (rows - design @ found) * root / np.sqrt(weight.mean() * free)
    level, slopes, mean_square = found[0], found[1:].T, (left**2).mean(axis=0)
    further = np.stack([np.concatenate(e) for e in errors]) if errors else np.zeros((0, len(level)))
    if len(further):
        mean_square = mean_square + (further**2).sum(axis=0) / max(len(further) - 1, 1)
    noise = np.ones(len(level))
    for part, size in zip((slice(count), slice(count, None)), NEIGHBOURS, strict=True):
        if len(level[part]):
            mean_square[part] = uniform_filter1d(mean_square[part], size)
            excess = float((level[part] ** 2 / (1.0 + mean_square[part])).mean())
            noise[part] = excess if excess > MISFIT else 1.0
    weights = 1.0 / (noise + mean_square)
    uncertain = np.linalg.inv((design * weight[:, None]).T @ design) * weight.mean()  # (1 + p, 1 + p), per variance of a residual
    jumps = float(weights @ (left**2).mean(axis=0))
    apparent = (slopes.T * weights) @ slopes
    hessian = _without(apparent, jumps * uncertain[1:, 1:]) + prior
    slope = slopes.T @ (weights * level) + prior @ (middle - centre)
    step = -np.linalg.solve(apparent + prior, slope)  # the shorter: what jumps make of it is too far
    gain = np.linalg.solve(apparent + prior, slopes.T * weights)
    covariance = np.linalg.inv(hessian)
    wider = np.sqrt(np.diag(covariance) / np.diag(np.linalg.inv(apparent + prior)))
    place = np.concatenate([[1.0], step])
    student = (len(near) - p - 1) / max(len(near) - p - 3, 1)  # variance of Student's distribution: errors are known from few simulations
    known = student * (1.0 + float(place @ uncertain @ place))
    for rest, share in ((left, known / len(left)), (further, (1.0 + 1.0 / max(len(further), 1)) / max(len(further) - 1, 1))):
        moved = (rest @ gain.T) * wider
        covariance = covariance + share * moved.T @ moved
    most = np.minimum(prior_sd / np.sqrt(np.diag(covariance)), 1.0)
    covariance = covariance * np.outer(most, most)
    damping = 1e-4 * np.trace(apparent) / p
    while np.abs(step).max() > LONGEST:
        step = -np.linalg.solve(apparent + prior + damping * np.eye(p), slope)
        damping *= 3.0
    return Regression(step, 0.5 * (covariance + covariance.T), (slopes[:count], slopes[count:]))


def _without(information: FloatArray, spurious: FloatArray) -> FloatArray:
    """Return an information (p, p) without what is spurious in it, but at least `LEAST` of it in any direction."""
    p = len(information)
    values, vectors = scipy.linalg.eigh(information - spurious, information + 1e-9 * np.trace(information) / p * np.eye(p))
    back = np.linalg.inv(vectors)
    return np.asarray(back.T @ (np.maximum(values, LEAST)[:, None] * back))


@dataclass(slots=True)
class LocalRegression:
    """Rounds of regression from the end of a search on.

    Attributes
    ----------
    problem : InverseProblem
        With the noise as it is stated.
    theta : ndarray, shape (p,)
        Where it is.
    centre, prior_sd
        Of the weak prior.
    at : Evaluations
        Of residuals.
    runs, rounds : int
        Simulations, and regressions.
    settled : bool
        Whether a last regression moved every value by less than its interval.
    """

    problem: InverseProblem
    theta: FloatArray
    centre: FloatArray
    prior_sd: float
    at: Evaluations
    runs: int = 0
    rounds: int = 0
    settled: bool = False
    _points: list[FloatArray] = field(default_factory=list)
    _found: list[Residual] = field(default_factory=list)

    def run(self) -> tuple[EvaluatedPoint, FloatArray]:
        """Return where it ended, with residuals of fine steps, and the covariance (p, p)."""
        p, rng = len(self.theta), np.random.default_rng(0)
        spread, corrected = FIRST**2 * np.eye(p), False
        (fine, long) = self._simulated([(self.theta, True), (self.theta, False)])
        offset, errors = _difference(fine, long), list[Residual]()
        while True:
            self._sample(spread, rng, both=self.rounds == 0)
            fit = regression(
                np.array(self._points), [_sum(r, offset) for r in self._found], self.theta, spread, self.centre, self.prior_sd, errors
            )
            self.rounds += 1
            sd = np.sqrt(np.diag(fit.covariance))
            near = bool((np.abs(fit.step) <= CLOSE * sd).all())
            self.theta = self._held(self.theta + fit.step)
            shown = np.clip(sd, *SPREAD)
            near = near and bool((shown < WIDER * np.sqrt(np.diag(spread))).all())
            spread = fit.covariance * np.outer(shown / sd, shown / sd)
            if self.rounds >= ROUNDS or (near and corrected):
                self.settled = near and corrected
                return EvaluatedPoint(self.theta, fine, fit.slopes), fit.covariance
            if near:
                fine, offset, errors = self._corrected(spread, rng)
                corrected = True

    def _sample(self, spread: FloatArray, rng: np.random.Generator, *, both: bool) -> None:
        """Simulate along random orthogonal directions, as far away as is typical of the covariance `spread`, and in the middle."""
        p = len(self.theta)
        away = np.sqrt(p) * np.linalg.cholesky(spread) @ np.linalg.qr(rng.standard_normal((p, p)))[0]
        sides = (1.0, -1.0) if both else (1.0,)
        points = [self.theta, *(self._held(self.theta + side * row) for side in sides for row in away.T)]
        self._found += self._simulated([(point, False) for point in points])
        self._points += points

    def _corrected(self, spread: FloatArray, rng: np.random.Generator) -> tuple[Residual, Residual, list[Residual]]:
        """Return residuals of fine steps here, what they differ from long ones in the mean of a few points, and how that varies."""
        root = np.linalg.cholesky(spread)
        points = [self.theta, *(self._held(self.theta + root @ rng.standard_normal(len(self.theta))) for _ in range(FINE - 1))]
        found = self._simulated([(point, step) for point in points for step in (True, False)])
        offsets = [_difference(fine, long) for fine, long in zip(found[::2], found[1::2], strict=True)]
        mean = (np.mean([o[0] for o in offsets], axis=0), np.mean([o[1] for o in offsets], axis=0))
        self._points += points
        self._found += found[1::2]
        return found[0], mean, [_difference(o, mean) for o in offsets]

    def _simulated(self, trials: Sequence[tuple[FloatArray, bool]]) -> list[Residual]:
        self.runs += len(trials)
        return self.at.many(self.problem, trials)

    def _held(self, theta: FloatArray) -> FloatArray:
        return np.asarray(np.log(self.problem.unknowns.held(np.exp(theta))), dtype=np.float64)


def _sum(one: Residual, other: Residual) -> Residual:
    return one[0] + other[0], one[1] + other[1]


def _difference(one: Residual, other: Residual) -> Residual:
    return one[0] - other[0], one[1] - other[1]
