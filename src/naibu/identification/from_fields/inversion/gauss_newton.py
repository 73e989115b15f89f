"""Gauss-Newton search over moduli and displacements of loaded nodes, within bounds, with or without a penalty.

This is finite element model updating (FEMU, :cite:p:`kavanagh1971,avril2008`): the misfit between computed and measured displacement is
minimised, weighted by the covariance of the measurement.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.parameters import MAX_POISSON_RATIO
from naibu.core.progress import Progress, report_progress
from naibu.core.status import Status
from naibu.identification.from_fields.forward.loaded_components import ROUGH_TOLERANCE, KeptPreconditioners
from naibu.identification.from_fields.forward.sensitivities import Concentrated, FieldModel, Linearised, Point
from naibu.identification.from_fields.inversion.regularization import Regularization
from naibu.identification.from_fields.inversion.told_combinations import told

SMOOTHER = (10.0, 100.0)  # times as strong as it is: the prior on the motion of loaded nodes with which a body may follow a first one
LONGEST_STEP = 1.0  # of a logarithm of a modulus in one iteration
SHORTEST_FRACTION = 1e-3  # of a step, below which the search ends
NEGLIGIBLE = 1e-9  # by how much a step must promise to lower half of chi squared to be worth taking
AT_BOUND = 3.7  # standard deviation of ln(kappa / mu) where it is at its bound: half of the way down to that of a Poisson's ratio of 0
ANCHOR = 1e-9  # of the Hessian's largest diagonal entry, on every modulus: what neither data nor penalty determine stays where it is
SEARCHING = "searching moduli, iteration"


CANNOT_FOLLOW = (
    "no body of finite strain follows the motion of the surface that the measurement tells: errors of the measurement there are too large "
    "a part of the strain in an element. Use larger elements, leave doubtful measurements out, or end the object a little further inside."
)


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of the moduli of all zones.

    Attributes
    ----------
    shear_modulus : tuple of float
        Least and greatest shear modulus, kPa.
    poisson_ratio : tuple of float
        Least and greatest Poisson's ratio, within (-1, 0.4995].
    """

    shear_modulus: tuple[float, float] = (0.0, np.inf)
    poisson_ratio: tuple[float, float] = (-0.9, MAX_POISSON_RATIO)

    def __post_init__(self) -> None:
        (low, high), (least, most) = self.shear_modulus, self.poisson_ratio
        if not 0.0 <= low < high:
            raise InputError(f"bounds of the shear modulus must increase and not be negative, not {low:g} to {high:g} kPa")
        if not -1.0 < least < most <= MAX_POISSON_RATIO:
            raise InputError(f"bounds of Poisson's ratio must increase within (-1, {MAX_POISSON_RATIO}], not {least:g} to {most:g}")

    def box(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper bounds of theta (2 count,)."""
        with np.errstate(divide="ignore"):
            shear = np.log(np.array(self.shear_modulus))
        nu = np.array(self.poisson_ratio)
        ratio = np.log(2.0 * (1.0 + nu) / (3.0 * (1.0 - 2.0 * nu)))
        both = np.stack([np.repeat([shear[k], ratio[k]], count) for k in range(2)])
        return both[0], both[1]

    def doubt_at(self, theta: FloatArray) -> FloatArray:
        """Return standard deviations (2 count,) of logarithms at a bound, where derivatives say nothing of how far from it they may be."""
        k, (low, high) = len(theta) // 2, self.box(len(theta) // 2)
        doubt = np.where(theta >= high - 1e-9, AT_BOUND, 0.0)
        of_shear = np.flatnonzero((theta[:k] <= low[:k] + 1e-9) | (theta[:k] >= high[:k] - 1e-9))
        doubt[of_shear] = high[of_shear] - low[of_shear]
        return doubt


@dataclass(frozen=True, slots=True, eq=False)
class Objective:
    """Half of the misfit and the weak prior of the loaded nodes, plus `weight` times a penalty, within bounds."""

    penalty: Regularization | None = None
    weight: float = 0.0
    bounds: Bounds = field(default_factory=Bounds)

    def value(self, point: Point) -> float:
        """Return the objective at a point."""
        return 0.5 * (point.misfit + point.prior) + (0.0 if self.penalty is None else self.weight * self.penalty.value(point.theta))

    def slope(self, theta: FloatArray) -> FloatArray:
        """Return the gradient (2 count,) of the penalty."""
        return np.zeros_like(theta) if self.penalty is None else self.weight * self.penalty.gradient(theta)

    def curvature(self, theta: FloatArray) -> sp.csr_matrix:
        """Return the Hessian (2 count, 2 count) of the penalty."""
        return sp.csr_matrix((len(theta), len(theta))) if self.penalty is None else (self.weight * self.penalty.hessian(theta)).tocsr()

    def clipped(self, theta: FloatArray) -> FloatArray:
        """Return theta moved into the bounds."""
        low, high = self.bounds.box(len(theta) // 2)
        return np.clip(theta, low, high)

    def free(self, theta: FloatArray, gradient: FloatArray) -> BoolArray:
        """Return which logarithms are inside their bounds or lead back from them."""
        low, high = self.bounds.box(len(theta) // 2)
        return ~(((theta <= low) & (gradient > 0.0)) | ((theta >= high) & (gradient < 0.0)))


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """Stopping criteria of a search.

    Attributes
    ----------
    max_iterations : int
        Gauss-Newton iterations.
    tolerance : float
        The search ends when a step promises to lower the objective by less than this fraction of it, or lowers it by less.
    settled, nearly : float
        It also ends when moduli would move by fewer standard deviations than `settled`, and the objective would fall by a smaller part than
        `nearly`: surfaces of nearly incompressible bodies go on to move by what no modulus follows.
    furthest : float
        And where a logarithm of a modulus is further than this from its start, if nobody wants to know how much further it went.
    """

    max_iterations: int = 30
    tolerance: float = 1e-7
    settled: float = 0.02
    nearly: float = 1e-3
    furthest: float = np.inf

    def left(self, start: Point, point: Point) -> bool:
        """Whether a point is too far from the start."""
        return bool(np.abs(point.theta - start.theta).max() > self.furthest)

    def ended(self, step: Step, value: float) -> bool:
        """Whether a step promises too little, at a value of the objective."""
        settled = step.standard_deviations <= self.settled and step.promise <= self.nearly * value
        return settled or step.promise <= self.tolerance * value + NEGLIGIBLE


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A step of the search.

    Attributes
    ----------
    theta : ndarray, shape (2 count,)
        Of the logarithms of the moduli.
    loaded : list of ndarray, shape (n_b,)
        Of the loaded components of every load case, mm.
    promise : float
        By how much it should lower the objective.
    standard_deviations : float
        By how many of their own, together, it moves the moduli; infinite where that is not known.
    response : list of ndarray, shape (n_b, 2 count), or None
        By how much the loaded components follow each modulus, with a minus sign, mm; None where that was not found.
    renewed : callable or None
        Finds the step at the same place with a Hessian made there, where that of this one was made elsewhere.
    """

    theta: FloatArray
    loaded: list[FloatArray]
    promise: float
    standard_deviations: float = np.inf
    response: list[FloatArray] | None = None
    renewed: Callable[[Linearised, Objective], Step] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """End of a search: where, the objective there, how it ended, after how many iterations, and the response of `Step` near by."""

    point: Point
    objective: float
    status: Status
    iterations: int
    response: list[FloatArray] | None = None


StepRule = Callable[[Linearised, Objective, list[FloatArray] | None], Step]


def first_point(model: FieldModel, theta: FloatArray) -> Point:
    """Return the point at these moduli at which the loaded components suit the measurements, by small strain first.

    Where measurements are in error by more than their noise, and nothing was measured at the surface itself, the motion that suits them
    best at small strain may be one that no body of finite strain follows. Smoother ones are then the start (see `SMOOTHER`).

    Raises
    ------
    ConvergenceError
        The measured field does not fix how the loaded nodes move, or a body of finite strain cannot follow.
    """
    small = model if model.law.linear else model.with_law("linear")
    states = _at_small_strain(small, theta, once=small is not model)
    if model.law.linear:
        return model.evaluate(theta, states)
    point = _reached(model, theta, states) or _smoother(model, small, theta)
    if point is None:
        try:
            point = model.evaluate(theta, model.from_rest(theta, states))
        except ConvergenceError as error:
            raise ConvergenceError(f"{CANNOT_FOLLOW} ({str(error).partition('. ')[0]})") from error
    model.boundary.keep_all(small.boundary)  # of thousands of components one takes as long as several iterations of a search
    at = model.linearised(point)
    for t in range(len(model.observed)):
        at.boundary(t)  # after which it is known how many loaded components the measurements determine
    return point


def _at_small_strain(small: FieldModel, theta: FloatArray, *, once: bool) -> list[FloatArray]:
    """Return the displacement (n, d), mm, of every load case with which its loaded components suit the measurements, solved `once` only."""
    at = small.linearised(small.evaluate(theta, [np.zeros_like(small.points)] * len(small.observed)))
    right = [-g[:, None] for g in at.gradient()[1]]
    moved = at.forward(None, at.loaded_solved_once(right) if once else at.loaded_solved(right))
    return [u + du.reshape(u.shape) for u, du in zip(at.point.states, moved, strict=True)]


def _smoother(model: FieldModel, small: FieldModel, theta: FloatArray) -> Point | None:
    """Return the point that a smoother motion of the loaded components leads to; None if a body follows none of them."""
    for firmer in SMOOTHER:
        other = copy(small)
        other.observed = tuple(replace(o, prior=firmer**2 * o.prior) for o in small.observed)
        other.boundary = KeptPreconditioners.none(other.observed)
        point = _reached(model, theta, _at_small_strain(other, theta, once=True))
        if point is not None:
            return point
    return None


def _reached(model: FieldModel, theta: FloatArray, moved: list[FloatArray]) -> Point | None:
    """Return the point to which the loaded components move as in `moved` (n, d), mm; None where Newton's method fails on short steps."""
    try:
        return model.evaluate(theta, model.from_rest(theta, moved, at_length=False))
    except ConvergenceError:
        return None


def exact_step(at: Linearised, objective: Objective, near: list[FloatArray] | None = None) -> Step:
    """Return the Gauss-Newton step from the explicit Hessian of all moduli, the loaded components eliminated; `near` is a response."""
    return step_of(at, objective, at.concentrated(np.eye(len(at.point.theta)), ROUGH_TOLERANCE, near))


def step_of(at: Linearised, objective: Objective, data: Concentrated) -> Step:
    """Return the step that lowers the objective most if half the misfit is a quadratic in all moduli.

    Raises
    ------
    ConvergenceError
        The data do not determine some moduli.
    """
    theta = at.point.theta
    hessian = data.hessian + objective.curvature(theta).toarray()
    hessian[np.diag_indices_from(hessian)] += ANCHOR * float(np.diag(hessian).max())
    gradient = data.gradient + objective.slope(theta)
    free = objective.free(theta, gradient)
    step = np.zeros_like(theta)
    try:
        step[free] = _bounded(-sl.cho_solve(sl.cho_factor(hessian[np.ix_(free, free)]), gradient[free]), hessian[np.ix_(free, free)])
    except np.linalg.LinAlgError as error:
        raise ConvergenceError("the measured fields do not determine some moduli; measure more points, or join zones") from error
    promise = -float(gradient @ step + 0.5 * step @ hessian @ step)
    loaded = 0.5 * sum(float(r @ p) for r, p in zip(data.offset, at.gradient()[1], strict=True))
    return Step(step, data.loaded(step), promise + loaded, float(np.sqrt(max(step @ hessian @ step, 0.0))), data.response)


def _bounded(step: FloatArray, hessian: FloatArray) -> FloatArray:
    """Return a step (k,) no logarithm of which is longer than `LONGEST_STEP`, along combinations (see `told`) without bounds first.

    Shortened as a whole only, a step that is endless along these would be none along what the data do determine.
    """
    if not np.abs(step).max(initial=0.0) > LONGEST_STEP:
        return step
    kept = told(hessian)[1]
    determined = kept @ (kept.T @ step)
    rest = step - determined
    step = determined + rest * min(1.0, LONGEST_STEP / max(float(np.abs(rest).max()), 1e-300))
    return np.asarray(step * min(1.0, LONGEST_STEP / float(np.abs(step).max())))


def search(
    model: FieldModel,
    start: Point,
    objective: Objective,
    settings: SearchSettings | None = None,
    *,
    rule: StepRule = exact_step,
    near: list[FloatArray] | None = None,
    progress: Progress | None = None,
) -> Found:
    """Lower the objective from a start until steps promise little.

    Parameters
    ----------
    model : FieldModel
        Load cases and zones.
    start : Point
        Where to begin; it must be the model's last evaluation.
    objective : Objective
        What to lower.
    settings : SearchSettings, optional
        When to end.
    rule : callable
        Finds a step at a linearisation: `exact_step`, or for many zones
        `naibu.identification.from_fields.inversion.truncated_newton.truncated_step`.
    near : list of ndarray, shape (n_b, 2 count), optional
        By how much the loaded components follow each modulus at a point near the start, as `Step.response`.
    progress : callable, optional
        Gets a report before every iteration, which takes up to half a minute of thousands of cells.
    """
    chosen = settings or SearchSettings()
    point, value = start, objective.value(start)
    for iteration in range(chosen.max_iterations):
        report_progress(progress, SEARCHING, done=iteration + 1, objective=value)
        at = model.linearised(point)
        step = rule(at, objective, near)
        near = step.response
        if chosen.ended(step, value):
            return Found(point, value, Status.CONVERGED, iteration, near)
        found = _line_search(at, step, objective, value)
        if found is None and step.renewed is not None:
            at = model.linearised(model.evaluate(point.theta, point.states))
            step = step.renewed(at, objective)
            near, found = step.response, _line_search(at, step, objective, value)
        if found is None:
            return Found(model.evaluate(point.theta, point.states), value, Status.CONVERGED, iteration, near)
        before, (point, value) = value, found
        if before - value <= chosen.tolerance * before + NEGLIGIBLE:  # no more than a step that would not have been taken promises
            return Found(point, value, Status.CONVERGED, iteration + 1, near)
        if chosen.left(start, point):
            return Found(point, value, Status.ITERATION_LIMIT, iteration + 1, near)
    return Found(point, value, Status.ITERATION_LIMIT, chosen.max_iterations, near)


def _line_search(at: Linearised, step: Step, objective: Objective, value: float) -> tuple[Point, float] | None:
    """Return the first point along the step, halved again and again, at which the objective falls; None where it never does."""
    point = at.point
    moved = at.forward(step.theta[:, None], [b[:, None] for b in step.loaded])
    fraction = 1.0
    while fraction >= SHORTEST_FRACTION:
        guesses = [u + fraction * du.reshape(u.shape) for u, du in zip(point.states, moved, strict=True)]
        try:
            found = at.model.evaluate(objective.clipped(point.theta + fraction * step.theta), guesses)
        except ConvergenceError:  # moduli or motions that a body of finite strain cannot follow
            fraction *= 0.5
            continue
        new = objective.value(found)
        if new <= value - 1e-4 * fraction * step.promise:
            return found, new
        fraction *= 0.5
    return None


def fitted_near(model: FieldModel, theta: FloatArray, near: Sequence[FloatArray], bounds: Bounds) -> Point | None:
    """Return about the best fit from some moduli (2 count,) and a motion (n, d), mm, near by; None where no equilibrium is found."""
    try:
        try:
            start = model.evaluate(theta, near)
        except ConvergenceError:
            start = first_point(model, theta)
        roughly = SearchSettings(max_iterations=10, tolerance=1e-3)
        return search(model, start, Objective(bounds=bounds), roughly, progress=model.progress).point
    except ConvergenceError:
        return None
