"""Gauss-Newton identification of lattice parameters from captured shapes and forces :cite:p:`nocedal2006`.

The residuals are the signed distances of captured points from the computed surface, and computed minus measured forces, both in units of
their noise: their sum of squares is chi-squared, and what the report weighs by hand, shape against force, needs no weight. The report's own
indices S_shape and S_force are sums of absolute values; `indices` returns them, and `lattice_search` minimises them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.progress import Progress, report_progress
from naibu.identification.lattice_calibration.estimate import LatticeEstimate
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint, evaluated
from naibu.identification.lattice_calibration.forward_model import SAMPLE_S, Capture, PushedLattice, PushMode, Reproduced, averaged
from naibu.identification.lattice_calibration.inverse_problem import InverseProblem
from naibu.identification.lattice_calibration.shape_distance import closest_points
from naibu.identification.lattice_calibration.unknowns import LatticeUnknowns, identifiability
from naibu.mechanics.lattices.model.lattice import Lattice

Index = Literal["shape", "force", "joint"]
Window = Literal["keep", "contact"]

PRIOR_SD = 1.2  # of the logarithm of every parameter around its start: as wide as the report's ranges, a factor of 60 in all
LONGEST = 1.0  # change of a logarithm in one iteration
FARTHEST = 0.7  # change of a logarithm to where chi-squared is looked at
PROFILED = 4  # combinations along which it is
FITTED_AGAIN = 4  # simulations at each end, at most
WIDEST = 3.0  # factor of standard deviations
POLISHING = 9  # fine runs, at most
FINE_ITERATIONS = 8  # with derivatives of fine steps, at most; they start next to the minimum, and take what is left of it
RENEWED = 0.05  # change of a logarithm from which on coarse derivatives are computed anew beside fine residuals
SETTLED = 0.05  # decrease of chi-squared that is not worth another iteration


@dataclass(frozen=True, slots=True, eq=False)
class LatticeLoadCase:
    """A load case: a capture and the lattice that models it, with coarse and with fine steps."""

    capture: Capture
    coarse: PushedLattice
    fine: PushedLattice


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationProblem:
    """Inverse problem of lattice calibration: load cases and unknowns.

    Attributes
    ----------
    unknowns : LatticeUnknowns
        Parameters.
    load_cases : tuple of LatticeLoadCase
        Captured pushings.
    index : str
        ``"shape"``, ``"force"`` or ``"joint"``: what counts.
    window : str
        Forces that count: all of the ``"contact"``, or those while the indenters ``"keep"`` still, as in the report's S_force.
    window_s : float
        Forces are averaged over this time, s, which is also the coarse step.
    excess : tuple of float
        Factors of the noise of points and forces, for laws that do not fit to within it.
    """

    unknowns: LatticeUnknowns
    load_cases: tuple[LatticeLoadCase, ...]
    index: Index
    window: Window
    window_s: float
    excess: tuple[float, float] = (1.0, 1.0)

    @classmethod
    def of(
        cls,
        lattice: Lattice,
        captures: Sequence[Capture],
        unknowns: LatticeUnknowns | None = None,
        *,
        index: Index = "joint",
        mode: PushMode = "displacement",
        window: Window = "contact",
        step: float = SAMPLE_S,
        window_s: float = 10 * SAMPLE_S,
    ) -> CalibrationProblem:
        """Set up the calibration of a lattice.

        Parameters
        ----------
        lattice : Lattice
            The model of the object at rest.
        captures : sequence of Capture
            One or more.
        unknowns : LatticeUnknowns
            By default K, C1 and C2 of every class: nine.
        index, mode, window
            What counts, how the virtual object is pushed, and which forces count.
        step, window_s : float
            Fine step, and coarse step over which forces are averaged, s.

        Raises
        ------
        InputError
            No capture, an unknown index or window, or steps that do not divide the times.
        """
        if not captures:
            raise InputError("there is no capture to calibrate on; give at least one")
        if index not in ("shape", "force", "joint") or window not in ("keep", "contact"):
            raise InputError(f"the index is 'shape', 'force' or 'joint', the window 'keep' or 'contact', not {index!r} and {window!r}")
        made = []
        for capture in captures:
            coarse, fine = (
                PushedLattice.of(lattice, capture.pushing, mode, step=step, long_step=s, force=capture.force) for s in (window_s, step)
            )
            made.append(LatticeLoadCase(capture, coarse, fine))
        return cls(unknowns or LatticeUnknowns.of(lattice), tuple(made), index, window, float(window_s))

    @property
    def roughness(self) -> float:
        """How far chi-squared jumps as the parameters change, as a fraction of it: not at all."""
        return 0.0

    def enlarged(self, excess: tuple[float, float]) -> CalibrationProblem:
        """Return the problem with other factors of the noise."""
        return replace(self, excess=excess)

    def weighed(
        self, load_case: LatticeLoadCase, found: Reproduced, step: float
    ) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
        """Return residuals and derivatives (count,), (count, p) of points and of forces in units of their noise, none that do not count."""
        return self._shape_rows(load_case, found), self._force_rows(load_case, found, step)

    def _shape_rows(self, load_case: LatticeLoadCase, found: Reproduced) -> tuple[FloatArray, FloatArray]:
        p = len(found.positions_change)
        if self.index == "force":
            return np.zeros(0), np.zeros((0, p))
        sd, hull = load_case.capture.point_sd_mm * self.excess[0], load_case.coarse.hull
        rows, slopes = [], []
        for k, points in enumerate(load_case.capture.points):
            near = closest_points(points, hull, found.positions[k])
            rows.append(near.signed / sd)
            corners = hull.triangles[near.triangle]
            moved = (found.positions_change[:, k][:, corners] * near.weights[:, :, None]).sum(axis=2)
            slopes.append(-(moved * near.direction).sum(axis=2).T / sd)
        return np.concatenate(rows), np.concatenate(slopes)

    def _force_rows(self, load_case: LatticeLoadCase, found: Reproduced, step: float) -> tuple[FloatArray, FloatArray]:
        p = len(found.force_change)
        if self.index == "shape":
            return np.zeros(0), np.zeros((0, p))
        count, each = round(self.window_s / SAMPLE_S), round(self.window_s / step)
        sd = load_case.capture.force_sd_mn * self.excess[1] / np.sqrt(count)
        since = round(load_case.capture.pushing.push_s / self.window_s) if self.window == "keep" else 0
        lack = averaged(found.force, each) - averaged(load_case.capture.force, count)
        slopes = np.stack([averaged(f, each) for f in found.force_change]) if p else np.zeros((0, *lack.shape))
        return lack[since:].ravel() / sd, slopes[:, since:].reshape(p, lack[since:].size).T / sd


@dataclass(slots=True)
class _Watched:
    """Evaluations that are reported, the best of which is kept for the case of an interruption."""

    threads: int
    executor: Executor | None
    progress: Progress | None
    count: int = 0
    best: EvaluatedPoint | None = None
    problem: InverseProblem | None = None

    def __call__(self, problem: InverseProblem, theta: FloatArray, *, derivatives: bool = True, fine: bool = False) -> EvaluatedPoint:
        point = evaluated(problem, theta, derivatives=derivatives, fine=fine, threads=self.threads, executor=self.executor)
        misfit = _misfit(point)
        if derivatives and (self.best is None or self.problem is not problem or misfit <= _misfit(self.best)):
            self.best, self.problem = point, problem
        self.count += 1
        report_progress(self.progress, "calibrate", done=self.count, objective=misfit / max(sum(map(len, point.residual)), 1))
        return point


def _misfit(point: EvaluatedPoint) -> float:
    return float(sum((r**2).sum() for r in point.residual))


def calibrate_lattice(
    problem: InverseProblem,
    start: ArrayLike | Mapping[str, float],
    *,
    prior_sd: float = PRIOR_SD,
    max_iterations: int = 40,
    reweigh: bool = True,
    threads: int = 2,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> LatticeEstimate:
    """Identify lattice parameters from captures by least squares, with their covariance.

    Iterations take steps that are long but after changes of motion; then residuals of fine steps throughout are brought to their minimum,
    by the same derivatives, or by those of fine steps where that fails. Where the law does not reproduce points or forces to within their
    noise, the noise is taken as that much larger, each for itself, and the search goes on: neither then outweighs the other by being
    measured more precisely than the model can tell.

    Parameters
    ----------
    problem : CalibrationProblem or StudyProblem
        What is sought.
    start : array_like or mapping
        Rough guess: all values, or a mapping by name or by kind (``{"K": 50.0, "C1": 20.0, "C2": 50.0}``), mN/mm and mN s/mm.
    prior_sd : float
        Standard deviation of the logarithms around the start, so that what the data do not determine stays there.
    max_iterations : int
        Of the coarse iterations with one size of the noise.
    reweigh : bool
        Whether the noise is enlarged to the misfit.
    threads : int
        Into how many parts the derivatives of every capture are shared; by default as many threads compute them.
    executor : concurrent.futures.Executor
        Computes the parts instead: a ``ProcessPoolExecutor``, or ``client.get_executor()`` of a `dask.distributed.Client`.
    progress : callable
        Called with a `ProgressReport` after every evaluation; the objective is chi-squared over the number of residuals. Where it raises
        KeyboardInterrupt, or Ctrl-C does, the best estimate so far is returned, with the intervals that belong there.

    Raises
    ------
    InputError
        A start that is not positive.
    ConvergenceError
        The iterations did not settle.
    KeyboardInterrupt
        An interruption before the first evaluation has ended.
    """
    centre = np.log(problem.unknowns.vector(start))
    at = _Watched(threads, executor, progress)
    try:
        return _searched(problem, centre, prior_sd, max_iterations, reweigh, at)
    except KeyboardInterrupt:
        if at.best is None or at.problem is None:
            raise
        return _estimate(at.problem, at.best, _covariance(at.best, prior_sd), at.count, at.count * (1 + len(centre)), finished=False)


def _searched(
    problem: InverseProblem, centre: FloatArray, prior_sd: float, max_iterations: int, reweigh: bool, at: _Watched
) -> LatticeEstimate:
    theta, runs, count = centre.copy(), 0, 0
    here, used = problem, 0
    for _ in range(3 if reweigh else 1):
        point, used = _descend(here, theta, centre, prior_sd, max_iterations, at)
        count, theta = count + used, point.theta
        factors = _noise_factors(here, point)
        if not reweigh or max(abs(np.log(max(f, 1.0) / e)) for f, e in zip(factors, here.excess, strict=True)) < 0.05:
            break
        here = here.enlarged((max(factors[0], 1.0), max(factors[1], 1.0)))
    runs, each = count * (1 + len(theta)), 1 + len(theta)
    point, polished, settled = _polished(here, point, centre, prior_sd, at)
    runs += polished + (polished - 1) * each
    if not settled:  # coarse derivatives do not lead there
        point, used = _descend(here, point.theta, centre, prior_sd, FINE_ITERATIONS, at, fine=True)
        count, runs = count + used, runs + used * each
    point = replace(point, slopes=at(here, point.theta).slopes)
    runs += each
    covariance, extra = _profiled(here, point, centre, prior_sd, at)
    return _estimate(here, point, covariance, count, runs + extra)


def _estimate(
    problem: InverseProblem, point: EvaluatedPoint, covariance: FloatArray, iterations: int, runs: int, *, finished: bool = True
) -> LatticeEstimate:
    factors = _noise_factors(problem, point)
    shown = tuple(f if len(r) else np.nan for f, r in zip(factors, point.residual, strict=True))
    return LatticeEstimate(
        problem.unknowns, np.exp(point.theta), covariance, point.information, (shown[0], shown[1]), iterations,
        runs * len(problem.load_cases), identifiability(problem.unknowns.names, point.information), finished,
    )  # fmt: skip


def estimate_at(problem: InverseProblem, values: ArrayLike, *, prior_sd: float = PRIOR_SD, finished: bool = True) -> LatticeEstimate:
    """Return values that were found by another search as an estimate, with the intervals that derivatives give there.

    Parameters
    ----------
    problem : CalibrationProblem or StudyProblem
        What was sought.
    values : array_like
        As for `calibrate_lattice`; weak priors are centred there.
    prior_sd : float
        Standard deviation of the logarithms.
    finished : bool
        Whether the search came to its end.

    Raises
    ------
    InputError
        Values that are not positive.
    """
    theta = np.log(problem.unknowns.vector(values))
    factors = _noise_factors(problem, evaluated(problem, theta, derivatives=False, fine=True))
    here = problem.enlarged((max(factors[0], 1.0), max(factors[1], 1.0)))
    residual = evaluated(here, theta, derivatives=False, fine=True).residual
    point = replace(evaluated(here, theta), residual=residual)
    return _estimate(here, point, _covariance(point, prior_sd), 0, 3 + len(theta), finished=finished)


def _covariance(point: EvaluatedPoint, prior_sd: float) -> FloatArray:
    return np.asarray(np.linalg.inv(point.information + np.eye(len(point.theta)) / prior_sd**2), dtype=np.float64)


def _profiled(problem: InverseProblem, point: EvaluatedPoint, centre: FloatArray, prior_sd: float, at: _Watched) -> tuple[FloatArray, int]:
    """Return the covariance at a point, widened along its least determined combinations to where chi-squared says; and the runs.

    Combinations of classes are determined by what is nonlinear, and what the data tell of them changes by a factor within their own
    interval. Each is moved to the ends of its interval, all others are fitted again, and the increase of the cost there tells how far one
    standard deviation reaches :cite:p:`venzon1988`. Derivatives are those of the point.
    """
    covariance = _covariance(point, prior_sd)
    values, vectors = np.linalg.eigh(covariance)
    here = at(problem, point.theta, derivatives=False)
    least, hessian, runs, widened = _cost(here, centre, prior_sd), np.linalg.inv(covariance), 1, covariance.copy()
    for value, vector in list(zip(values, vectors.T, strict=True))[::-1][:PROFILED]:
        others = np.linalg.svd(vector[None])[2][1:].T
        reach = min(1.96 * float(np.sqrt(value)), FARTHEST)
        for side in (-1.0, 1.0):
            theta, best, end = point.theta + side * reach * vector, np.inf, point.theta
            for _ in range(FITTED_AGAIN):
                trial = replace(at(problem, theta, derivatives=False), slopes=point.slopes)
                runs += 1
                if (cost := _cost(trial, centre, prior_sd)) >= best:
                    break
                best, end = cost, theta
                slope = trial.gradient() + (theta - centre) / prior_sd**2
                theta = theta - others @ np.linalg.solve(others.T @ hessian @ others, others.T @ slope)
            expected = reach**2 / float(value)
            deviation = (end - point.theta) / np.sqrt(max(best - least, expected / WIDEST**2))
            ratio = float(deviation @ hessian @ deviation)
            if ratio > 1.0:
                wider = covariance + (1.0 - 1.0 / ratio) * np.outer(deviation, deviation)
                factor = np.sqrt(np.maximum(np.diag(wider) / np.diag(widened), 1.0))
                widened = widened * np.outer(factor, factor)
    return widened, runs


def _noise_factors(problem: InverseProblem, point: EvaluatedPoint) -> tuple[float, float]:
    rms = [float(np.sqrt((r**2).mean())) if len(r) else 0.0 for r in point.residual]
    return rms[0] * problem.excess[0], rms[1] * problem.excess[1]


def _cost(point: EvaluatedPoint, centre: FloatArray, prior_sd: float) -> float:
    return _misfit(point) + float((((point.theta - centre) / prior_sd) ** 2).sum())


def _descend(
    problem: InverseProblem, theta: FloatArray, centre: FloatArray, prior_sd: float, most: int, at: _Watched, *, fine: bool = False
) -> tuple[EvaluatedPoint, int]:
    """Iterate by Gauss and Newton; a step that does not help is shortened. Returns the last point and the iterations."""
    point, damping = at(problem, theta, fine=fine), 0.0
    cost, used = _cost(point, centre, prior_sd), 1
    while used < most:
        step, promised = _step(point, centre, prior_sd, damping)
        if promised < SETTLED:
            return point, used
        trial = at(problem, point.theta + step, derivatives=False, fine=fine)
        used += 1
        if (new := _cost(trial, centre, prior_sd)) < cost:
            settled = cost - new < SETTLED + max(1e-6 if fine else 1e-5, problem.roughness) * cost
            if settled and np.abs(step).max() < RENEWED:
                return replace(trial, slopes=point.slopes), used
            if settled:
                return at(problem, trial.theta, fine=fine), used
            point, cost, damping = at(problem, trial.theta, fine=fine), new, 0.3 * damping if damping > 1e-4 else 0.0
        else:
            damping = max(10.0 * damping, 1e-3)
            if damping > 1e6 or promised < problem.roughness * cost:
                return point, used
    if fine:
        return point, used
    raise ConvergenceError(
        f"the calibration did not settle within {used} iterations (chi-squared {cost:.6g}); allow more (max_iterations), or start "
        "nearer: it is at "
        + ", ".join(f"{name} {value:.3g}" for name, value in zip(problem.unknowns.names, np.exp(point.theta), strict=True))
    )


def _step(point: EvaluatedPoint, centre: FloatArray, prior_sd: float, damping: float) -> tuple[FloatArray, float]:
    """Return the next change of theta, and the decrease of the cost that an undamped one promises."""
    hessian = point.information + np.eye(len(point.theta)) / prior_sd**2
    slope = point.gradient() + (point.theta - centre) / prior_sd**2
    step = -np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), slope)
    limited = step * min(1.0, LONGEST / max(float(np.abs(step).max()), 1e-300))
    return np.asarray(limited, dtype=np.float64), float(-slope @ step)


def _polished(
    problem: InverseProblem, point: EvaluatedPoint, centre: FloatArray, prior_sd: float, at: _Watched
) -> tuple[EvaluatedPoint, int, bool]:
    """Move on to the minimum of residuals of fine steps by derivatives of coarse ones; return it, the runs, and whether it settled."""

    def fine(theta: FloatArray) -> EvaluatedPoint:
        return at(problem, theta, derivatives=False, fine=True)

    best, damping, coarse = replace(fine(point.theta), slopes=point.slopes), 0.0, point.theta
    cost = _cost(best, centre, prior_sd)
    for count in range(1, POLISHING):
        step, promised = _step(best, centre, prior_sd, damping)
        if promised < SETTLED:
            return best, count, True
        trial = fine(best.theta + step)
        if (new := _cost(trial, centre, prior_sd)) < cost:
            slopes = best.slopes
            if np.abs(trial.theta - coarse).max() > RENEWED:
                slopes, coarse = at(problem, trial.theta).slopes, trial.theta
            best, cost, damping = replace(trial, slopes=slopes), new, 0.3 * damping
        else:
            if promised < problem.roughness * cost:
                return best, count, True
            damping = max(10.0 * damping, 1e-3)
    return best, POLISHING, False
