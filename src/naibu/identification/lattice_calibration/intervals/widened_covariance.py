"""Covariance of lattice parameters, widened to the ends of their profile likelihood :cite:p:`venzon1988`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint, Residual
from naibu.identification.lattice_calibration.intervals.residual_model import RISE, ResidualModel
from naibu.identification.lattice_calibration.inverse_problem import InverseProblem
from naibu.identification.lattice_calibration.least_squares import Evaluations, cost_at, cost_of

FARTHEST = 0.7  # change of a logarithm to where chi-squared is followed
WEAK = 4  # combinations along which residuals curve
NEAR = 0.3  # relative change of values at which that is looked at, at most
LEAST_FACTOR = 0.3  # by which it makes a value smaller, at most
ROUNDS = 4  # simulations of an end, at most
MET = 0.03  # of RISE, within which a simulation must confirm it
BRANCHES = 2  # times that ends are sought beyond other values that fit as well
STARTS, SPREAD = 8, 2.0  # random values, and standard deviations over those of the estimate, from which others are sought that fit as well
WIDEST = 3.0  # times farther than what was simulated, at most
QUANTILE = 1.96


@dataclass(slots=True)
class _End:
    """An end of the interval of parameter k: where it is sought, and what residuals there differ by from those of the model.

    The way to it begins at the minimum, or at other values that fit as well, `begin` (p,).
    """

    k: int
    reach: float
    at: FloatArray
    begin: FloatArray | None = None
    offset: FloatArray | None = None
    rise: float = 0.0

    @property
    def met(self) -> bool:
        return abs(self.rise - RISE) < MET * RISE

    def distance(self, theta: FloatArray) -> float:
        """Return how far the logarithm goes from theta (p,), as chi-squared rose; no less than sought, unless a simulation confirms it."""
        further = np.sqrt(RISE / max(self.rise, RISE / WIDEST**2))
        return float(abs(self.at[self.k] - theta[self.k]) * (further if self.met else max(further, 1.0)))


@dataclass(frozen=True, slots=True, eq=False)
class WidenedCovariance:
    """Covariance that reaches to the ends of profile likelihoods.

    Attributes
    ----------
    covariance : ndarray, shape (p, p)
        Of logarithms.
    unconfirmed : tuple of int
        Parameters of which no simulation confirmed that chi-squared has risen at an end by its 95 % quantile.
    lower : float
        By how much chi-squared was lower at an end than where the search ended, at most; 0 if nowhere.
    """

    covariance: FloatArray
    unconfirmed: tuple[int, ...]
    lower: float

    def remarks(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return in words what was not confirmed, of parameters with these names."""
        found = []
        if self.unconfirmed:
            found.append(
                "No simulation confirmed the ends of the intervals of "
                + ", ".join(names[k] for k in self.unconfirmed)
                + ": they are extrapolated from how chi-squared rises nearer by."
            )
        if self.lower > RISE:
            found.append(
                f"Chi-squared is lower by {self.lower:.3g} at an end of an interval than where the search ended: there is a better fit. "
                "Search from several starts."
            )
        return tuple(found)


def widened_covariance(
    problem: InverseProblem, point: EvaluatedPoint, centre: FloatArray, prior_sd: float, at: Evaluations
) -> WidenedCovariance:
    """Return the covariance at a point, widened to where chi-squared rises by its 95 % quantile, all others fitted again.

    Values that compensate each other lie along a curved valley of chi-squared, which derivatives at its bottom do not tell. How residuals
    curve along the least determined combinations is told by simulations around the point (`ResidualModel`). The ends of all intervals,
    along the valley, are sought with that model and simulated; what residuals there differ by is added to those of the model, and the end
    is sought again, until the simulation confirms it (output space mapping; :cite:t:`bandler2004`). Valleys may be several: beyond every
    end all other values are fitted anew, from those of the other ends and from random ones, and where chi-squared is within its quantile
    there, the end behind is sought as well. Standard deviations reach the farthest end. They are never less than derivatives say. Where
    no simulation confirms an end, it is not drawn in, but moved out by the square root of what chi-squared lacks there, up to `WIDEST`
    times.

    Parameters
    ----------
    problem : InverseProblem
        With the noise as it was found.
    point : EvaluatedPoint
        Where the search ended, with residuals of fine steps, and derivatives of that very point: those that were improved by steps are
        off by a percent or two, and along the valley that is too much.
    centre, prior_sd
        Of the weak prior.
    at : Evaluations
        Of residuals.
    """
    covariance = np.asarray(np.linalg.inv(point.information + np.eye(len(point.theta)) / prior_sd**2))
    coarse = at.many(problem, [(point.theta, False)])[0]
    values, vectors = np.linalg.eigh(covariance)
    weak = vectors[:, ::-1][:, :WEAK]
    model = ResidualModel(point, weak, centre, prior_sd)
    split, lowest = len(coarse[0]), cost_of(point, centre, prior_sd)
    fine_less_coarse = np.concatenate(point.residual) - np.concatenate(coarse)

    def simulated(places: list[FloatArray]) -> list[Residual]:
        found = [np.concatenate(r) + fine_less_coarse for r in at.many(problem, [(place, False) for place in places])]
        for place, residual in zip(places, found, strict=True):
            model.learn(place, residual)
        model.fit()
        return [(r[:split], r[split:]) for r in found]

    simulated(_around(point.theta, weak * np.minimum(np.sqrt(values[::-1][:WEAK]), NEAR)))
    reached = QUANTILE * np.sqrt(np.diag(covariance))
    ends = [_End(k, side * float(reach), point.theta) for k, reach in enumerate(reached) for side in (-1.0, 1.0)]
    ends = _confirmed(ends, model, lowest, simulated)
    for _ in range(BRANCHES):
        others = _confirmed(_others(ends, model, lowest, covariance), model, lowest, simulated)
        if not others:
            break
        ends += others
    for end in ends:
        reached[end.k] = max(reached[end.k], end.distance(point.theta))
    factor = reached / (QUANTILE * np.sqrt(np.diag(covariance)))
    unconfirmed = tuple(sorted({end.k for end in ends if not end.met}))
    return WidenedCovariance(covariance * np.outer(factor, factor), unconfirmed, max(0.0, -min(end.rise for end in ends)))


def _confirmed(
    ends: list[_End], model: ResidualModel, lowest: float, simulated: Callable[[list[FloatArray]], list[Residual]]
) -> list[_End]:
    """Return ends that are sought with a model and simulated in turns, without those at values that turn out to fit no longer."""
    centre, sd, every = model.centre, model.prior_sd, np.arange(len(model.centre), dtype=np.int64)
    for _ in range(ROUNDS):
        ends = [end for end in ends if end.begin is None or end.met or _fits(end, model, lowest)]
        if not (moving := [end for end in ends if not end.met]):
            break
        bottom, _ = model.cost().fitted(model.point.theta, every)
        for end in moving:
            begin = bottom if end.begin is None else end.begin
            end.at = model.cost(end.offset).end(begin, lowest, end.k, end.reach, FARTHEST)
        for end, residual in zip(moving, simulated([end.at for end in moving]), strict=True):
            end.rise = cost_at(residual, end.at, centre, sd) - lowest
            end.offset = np.concatenate(residual) - model.predicted(end.at)
    return ends


def _fits(end: _End, model: ResidualModel, lowest: float) -> bool:
    """Return whether the values where an end begins, all but its own fitted again, fit as well by what was simulated since."""
    assert end.begin is not None
    end.begin, cost = model.cost().fitted(end.begin, np.delete(np.arange(len(end.begin), dtype=np.int64), end.k))
    return cost < lowest + RISE


def _others(ends: list[_End], model: ResidualModel, lowest: float, covariance: FloatArray) -> list[_End]:
    """Return ends, not yet simulated, beyond the farthest ones: behind values that fit less well are others that do."""
    rng, theta, cost = np.random.default_rng(0), model.point.theta, model.cost()
    root = SPREAD * np.linalg.cholesky(covariance)
    starts = [end.at for end in ends] + [theta + root @ rng.standard_normal(len(theta)) for _ in range(STARTS)]
    found = []
    for k in range(len(theta)):
        for side in (-1.0, 1.0):
            last = max((end for end in ends if end.k == k and side * end.reach > 0.0), key=lambda end: side * end.at[end.k])
            reach = float(last.at[k] - theta[k])
            if side * reach > 0.0 and (begin := cost.beyond(last.at, starts, lowest, k, reach, FARTHEST)) is not None:
                found.append(_End(k, reach, begin, begin))
    return found


def _around(theta: FloatArray, directions: FloatArray) -> list[FloatArray]:
    """Return logarithms after relative changes of the values: both ways along every direction (p, m), and along every two together."""
    count = directions.shape[1]
    steps = [side * d for d in directions.T for side in (-1.0, 1.0)]
    steps += [np.sqrt(0.5) * (directions[:, i] + directions[:, j]) for i in range(count) for j in range(i)]
    return [theta + np.log1p(np.maximum(step, LEAST_FACTOR - 1.0)) for step in steps]
