"""Regularization weight: discrepancy principle (:cite:p:`morozov1966`), corner of the L-curve (:cite:p:`hansen1993`), or a given value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from naibu.core.errors import InputError
from naibu.identification.from_fields.inversion.gauss_newton import Found

WeightRule = Literal["discrepancy", "l_curve"]
SLACK = 1.05  # of the discrepancy principle: noise is hardly ever known better than that, and models are never exact
FACTOR = 3.0  # between one weight and the next
MOST_WEIGHTS = 24
CLOSE = 0.1  # relative distance of the misfit from the target that needs no further weight
UNCHANGED = 1e-4  # relative rise of the misfit from one weight to the next above which greater weights are worth trying
FLAT = 0.02  # relative fall of the misfit from one weight to the next below which smaller weights only fit noise
L_CURVE_WEIGHTS = 9


@dataclass(frozen=True, slots=True, eq=False)
class WeightTrial:
    """One weight that was tried.

    Attributes
    ----------
    weight : float
        Of the penalty.
    found : Found
        End of the search at this weight.
    misfit : float
        Chi squared of the measurements there.
    penalty : float
        The penalty there, without the weight.
    """

    weight: float
    found: Found
    misfit: float
    penalty: float


@dataclass(frozen=True, slots=True, eq=False)
class WeightChoice:
    """The weights that were tried, from great to small, the misfit aimed at, which was taken, and why.

    Attributes
    ----------
    trials : tuple of WeightTrial
        From the greatest weight to the least.
    chosen : int
        Index into `trials`.
    target : float
        Misfit that noise alone leaves.
    reason : str
        Why, in a sentence.
    """

    trials: tuple[WeightTrial, ...]
    chosen: int
    target: float
    reason: str

    @property
    def met(self) -> bool:
        """Whether noise alone could leave the misfit that was taken."""
        return self.taken.misfit <= (1.0 + CLOSE) * SLACK * self.target

    @property
    def taken(self) -> WeightTrial:
        """The trial that was taken."""
        return self.trials[self.chosen]


Solve = Callable[[float, Found | None], WeightTrial]


def choose_weight(
    solve: Solve, first: float, target: float, rule: WeightRule | float, uniform: Callable[[], WeightTrial] | None = None
) -> WeightChoice:
    """Try weights and take one.

    Parameters
    ----------
    solve : callable
        ``solve(weight, start)`` searches at a weight, from the end of an earlier search or from the beginning.
    first : float
        Where to begin.
    target : float
        Misfit that noise alone leaves: the number of measurements less that of nuisances.
    rule : {"discrepancy", "l_curve"} or float
        The greatest weight whose misfit is not above `SLACK` times the target, else the corner of the L-curve; the corner; or a weight.
    uniform : callable, optional
        Finds the best field without any jump, that of an infinite weight. Where it leaves no more than noise would, no weight is too
        great, and it is taken: at great weights a search advances so little at a time that it took hours to come near.

    Raises
    ------
    InputError
        A rule that is unknown, or a weight that is not positive.
    """
    if isinstance(rule, int | float):
        if not rule > 0.0:
            raise InputError(f"the weight of a penalty must be positive, not {rule:g}")
        return WeightChoice((solve(float(rule), None),), 0, target, f"weight {rule:g} as given")
    if rule == "discrepancy":
        without = None if uniform is None else uniform()
        if without is not None and without.misfit <= SLACK * target:
            why = f"without any jump the misfit is {without.misfit:.4g} against {target:.4g} of noise alone: no weight is too great"
            return WeightChoice((without,), 0, target, why)
        return _by_discrepancy(solve, first, target)
    if rule == "l_curve":
        trials = [solve(first, None)]
        while len(trials) < L_CURVE_WEIGHTS:
            trials.append(solve(trials[-1].weight / FACTOR, trials[-1].found))
        return WeightChoice(tuple(trials), corner(trials), target, "corner of the L-curve of misfit and penalty")
    raise InputError(f"the weight must be 'discrepancy', 'l_curve' or a positive number, not {rule!r}")


def _by_discrepancy(solve: Solve, first: float, target: float) -> WeightChoice:
    limit = SLACK * target
    trials = [solve(first, None)]
    while trials[0].misfit < limit / (1.0 + CLOSE) and len(trials) < MOST_WEIGHTS:
        trials.insert(0, solve(trials[0].weight * FACTOR, trials[0].found))
        flat_field = trials[0].weight * trials[0].penalty < UNCHANGED * trials[0].misfit
        if flat_field and trials[0].misfit < (1.0 + UNCHANGED) * trials[1].misfit:  # greater weights change nothing
            break
    flat = 0
    while trials[-1].misfit > limit and len(trials) < MOST_WEIGHTS and flat < 2:
        trials.append(solve(trials[-1].weight / FACTOR, trials[-1].found))
        flat = flat + 1 if trials[-1].misfit > (1.0 - FLAT) * trials[-2].misfit else 0
    if trials[-1].misfit > limit:
        excess = trials[-1].misfit / target
        why = f"no weight brings the misfit down to the noise (it stays {excess:.2f} times above): corner of the L-curve instead"
        return WeightChoice(tuple(trials), corner(trials), target, why)
    met = next(i for i, t in enumerate(trials) if t.misfit <= limit)
    if met and trials[met].misfit < limit / (1.0 + CLOSE):
        above, below = trials[met - 1], trials[met]
        fraction = np.log(limit / below.misfit) / np.log(above.misfit / below.misfit)
        weight = float(np.exp((1.0 - fraction) * np.log(below.weight) + fraction * np.log(above.weight)))
        trials.insert(met, solve(weight, below.found))
        met = next(i for i, t in enumerate(trials) if t.misfit <= (1.0 + CLOSE) * limit)
    return WeightChoice(
        tuple(trials), met, target, f"discrepancy principle: misfit {trials[met].misfit:.4g} against {target:.4g} of noise alone"
    )


def corner(trials: list[WeightTrial]) -> int:
    """Return the index of the corner of the L-curve: where the turn of (ln misfit, ln penalty) from steep to flat is sharpest."""
    if len(trials) < 3:
        return len(trials) - 1
    x = np.log([max(t.misfit, 1e-300) for t in trials])
    y = np.log([max(t.penalty, 1e-300) for t in trials])
    points = np.stack([(x - x.min()) / max(float(np.ptp(x)), 1e-300), (y - y.min()) / max(float(np.ptp(y)), 1e-300)], axis=1)
    before, after = points[1:-1] - points[:-2], points[2:] - points[1:-1]
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    lengths = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1) * np.linalg.norm(points[2:] - points[:-2], axis=1)
    curvature = -2.0 * cross / np.maximum(lengths, 1e-300)  # positive where the curve turns towards the origin
    return int(np.argmax(curvature)) + 1
