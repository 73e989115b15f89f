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
from naibu.core.progress import Progress
from naibu.identification.lattice_calibration.captured.shape_distance import closest_points
from naibu.identification.lattice_calibration.estimate import (
    IMPROVED,
    NOT_TOLD,
    LatticeEstimate,
    estimate_from,
    interrupted_estimate,
    without_intervals,
)
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint, Residual, evaluated
from naibu.identification.lattice_calibration.forward_model import SAMPLE_S, Capture, PushedLattice, PushMode, Reproduced, averaged
from naibu.identification.lattice_calibration.intervals.local_regression import LocalRegression
from naibu.identification.lattice_calibration.intervals.model_errors import with_errors_of_the_model
from naibu.identification.lattice_calibration.intervals.widened_covariance import widened_covariance
from naibu.identification.lattice_calibration.inverse_problem import InverseProblem
from naibu.identification.lattice_calibration.least_squares import (
    LONGEST,
    SETTLED,
    Evaluations,
    cost_of,
    covariance_at,
    covariance_before_the_minimum,
    noise_factors,
    step_within,
    unsettled_covariance,
)
from naibu.identification.lattice_calibration.secant_search import SecantSearch
from naibu.identification.lattice_calibration.simulated_points import SimulatedPoints
from naibu.identification.lattice_calibration.unknowns import LatticeUnknowns, identifiability
from naibu.mechanics.lattices.model.lattice import Lattice

Index = Literal["shape", "force", "joint"]
Window = Literal["keep", "contact"]

PRIOR_SD = 1.2  # of the logarithm of every parameter around its start: as wide as the report's ranges, a factor of 60 in all
CORRECTIONS = 6  # by fine steps, at most
TELLING = 0.05  # change of a logarithm from which on a step tells of derivatives
ENOUGH = 2e-3  # of the cost, while the noise is still taken as stated
FARTHEST = 3.0  # change of a logarithm in one iteration, after steps that did what they promised
POOR, WELL = 0.3, 0.75  # of the promised decrease, from which on steps become shorter, or may become longer
IDLE = 2  # steps one after the other that change next to nothing, before the search ends


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

    def shifts(self, values: FloatArray) -> FloatArray | None:
        """Return None: derivatives are integrated along with the motion."""
        return None

    def enlarged(self, excess: tuple[float, float]) -> CalibrationProblem:
        """Return the problem with other factors of the noise."""
        return replace(self, excess=excess)

    def with_half_steps(self) -> None:
        """Return None: steps are those of the samples, and virtual captures are made with them."""
        return

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


def calibrate_lattice(
    problem: InverseProblem,
    start: ArrayLike | Mapping[str, float],
    *,
    prior_sd: float = PRIOR_SD,
    max_iterations: int = 40,
    reweigh: bool = True,
    warm_start: ArrayLike | Mapping[str, float] | None = None,
    widen: bool = True,
    threads: int = 2,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> LatticeEstimate:
    """Identify lattice parameters from captures by least squares, with their covariance.

    Iterations take steps of time that are long but after changes of motion; then what residuals of fine steps throughout differ by is added
    to theirs, and the search goes on. Where the law does not reproduce points or forces to within their
    noise, the noise is taken as that much larger, each for itself, and the search goes on: neither then outweighs the other by being
    measured more precisely than the model can tell. Where derivatives are differences of simulations, as in contact, secants through
    what was simulated spare most of them (`SecantSearch`), and regressions around the end give the estimate, corrected by fine steps, its
    covariance, and by how much the noise is larger than stated (`LocalRegression`).

    Parameters
    ----------
    problem : CalibrationProblem or StudyProblem
        What is sought.
    start : array_like or mapping
        Rough guess: all values, or a mapping by name or by kind (``{"K": 50.0, "C1": 20.0, "C2": 50.0}``), mN/mm and mN s/mm.
    prior_sd : float
        Standard deviation of the logarithms around the start, so that what the data do not determine stays there.
    max_iterations : int
        Of the coarse iterations with one size of the noise; in contact of the steps of `SecantSearch`, after which regressions
        have a limit of their own.
    reweigh : bool
        Whether the noise is enlarged to the misfit. Not regarded in contact, where regressions always weigh residuals by noise
        and errors of the model.
    warm_start : array_like or mapping, optional
        Values from which the search begins, as the estimate of a similar problem; weak priors stay around `start`. By default `start`.
    widen : bool
        Whether the covariance is widened to where chi-squared itself rises, all others fitted again, which takes derivatives once
        more and, of nine parameters, some forty simulations of each load case. Otherwise derivatives are those that steps of the search
        improved, and `LatticeEstimate.remarks` says so. In contact, whether regressions around the end follow; otherwise intervals are
        as wide as the weak prior.
    threads : int
        Into how many parts the derivatives of every capture are shared; by default as many threads compute them.
    executor : concurrent.futures.Executor
        Computes the parts instead: a ``ProcessPoolExecutor``, or ``client.get_executor()`` of a `dask.distributed.Client`.
    progress : callable
        Called with a `ProgressReport` after every evaluation; the objective is chi-squared over the number of residuals. Where it raises
        KeyboardInterrupt, or Ctrl-C does, the best estimate so far is returned, with intervals that reach to where the search
        was going; in contact, as far as the weak prior does.

    Raises
    ------
    InputError
        A start that is not positive.
    ConvergenceError
        The iterations did not settle. In contact the estimate says so instead (`LatticeEstimate.settled`).
    KeyboardInterrupt
        An interruption before the first evaluation has ended.
    """
    centre = np.log(problem.unknowns.vector(start))
    first = centre.copy() if warm_start is None else np.log(problem.unknowns.vector(warm_start))
    at = Evaluations(threads, executor, progress)
    try:
        if problem.shifts(np.exp(centre)) is not None:
            return _searched_in_contact(problem, centre, first, prior_sd, max_iterations, at, widen=widen)
        return _searched(problem, centre, first, prior_sd, max_iterations, reweigh, widen, at)
    except KeyboardInterrupt:
        if at.best is None or at.problem is None:
            raise
        return interrupted_estimate(at.problem, at.best, centre, prior_sd, at)


def _searched(
    problem: InverseProblem, centre: FloatArray, first: FloatArray, prior_sd: float, most: int, reweigh: bool, widen: bool, at: Evaluations
) -> LatticeEstimate:
    prior, here, count = (centre, prior_sd), problem, 0
    point = at(here, first)
    for k in range(4 if reweigh else 1):
        # sizes of the noise that are about to change do not need the minimum
        point, used = _descend(here, point, prior, most, at, fresh=k != 1, enough=ENOUGH if reweigh and k == 0 else 0.0)
        count += used
        factors = noise_factors(here, point.residual)
        unchanged = max(abs(np.log(max(f, 1.0) / e)) for f, e in zip(factors, here.excess, strict=True)) < 0.05
        if not reweigh or (k and unchanged):
            break
        point = _in_other_units(point, here.excess, excess := (max(factors[0], 1.0), max(factors[1], 1.0)))
        here = here.enlarged(excess)
        at.keep(here, point)
    point, used = _corrected(here, point, prior, most, at)
    count += used
    if not widen:
        return replace(estimate_from(here, point, covariance_at(point, prior_sd), count, at.runs), remarks=(IMPROVED,))
    point = replace(point, slopes=at(here, point.theta).slopes)
    widened = widened_covariance(here, point, centre, prior_sd, at)
    covariance = with_errors_of_the_model(here, point, widened.covariance, centre, prior_sd, at)
    return replace(estimate_from(here, point, covariance, count, at.runs), remarks=widened.remarks(problem.unknowns.names))


def _in_other_units(point: EvaluatedPoint, old: tuple[float, float], new: tuple[float, float]) -> EvaluatedPoint:
    """Return a point whose residuals are in units of another noise."""
    points, forces = old[0] / new[0], old[1] / new[1]
    (shape, force), (shape_slopes, force_slopes) = point.residual, point.slopes
    return EvaluatedPoint(point.theta, (shape * points, force * forces), (shape_slopes * points, force_slopes * forces))


def _searched_in_contact(
    problem: InverseProblem, centre: FloatArray, first: FloatArray, prior_sd: float, most: int, at: Evaluations, *, widen: bool = True
) -> LatticeEstimate:
    points = SimulatedPoints(problem, at)
    search = SecantSearch(points, centre, prior_sd, first)
    search.run(most)
    if not widen:
        found = without_intervals(problem, search.point, centre, prior_sd, at)
        return replace(found, iterations=search.iterations, finished=True, remarks=(NOT_TOLD,))
    local = LocalRegression(points, search.theta, search.residual, centre, prior_sd, search.covariance())
    point, covariance = local.run()
    information = np.linalg.inv(covariance) - np.eye(len(centre)) / prior_sd**2
    if not local.settled:  # derivatives there say nothing of where the least misfit is
        covariance, information = unsettled_covariance(point.theta, centre, prior_sd), np.zeros_like(covariance)
    found = estimate_from(problem, point, covariance, search.iterations + local.rounds, at.runs)
    open_combinations = identifiability(problem.unknowns.names, information)
    return replace(found, information=information, undetermined=open_combinations, settled=local.settled)


def estimate_at(
    problem: InverseProblem, values: ArrayLike, *, prior_sd: float = PRIOR_SD, finished: bool = True, threads: int = 2
) -> LatticeEstimate:
    """Return values that were found by another search as an estimate, with the intervals that derivatives give there.

    Intervals reach to where derivatives say that the minimum is. In contact derivatives count jumps as information: there regressions
    around these values, as those of `calibrate_lattice`, give the estimate and its intervals, unless the search was interrupted.

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
    threads : int
        That simulate.

    Raises
    ------
    InputError
        Values that are not positive.
    """
    theta = np.log(problem.unknowns.vector(values))
    if problem.shifts(np.exp(theta)) is not None:
        at = Evaluations(threads, None, None)
        if not finished:
            point = at(problem, theta, derivatives=False, fine=True)
            slopes = (np.zeros((len(point.residual[0]), len(theta))), np.zeros((len(point.residual[1]), len(theta))))
            return interrupted_estimate(problem, replace(point, slopes=slopes), theta, prior_sd, at)
        return _searched_in_contact(problem, theta, theta, prior_sd, 0, at)
    factors = noise_factors(problem, evaluated(problem, theta, derivatives=False, fine=True).residual)
    here = problem.enlarged((max(factors[0], 1.0), max(factors[1], 1.0)))
    residual = evaluated(here, theta, derivatives=False, fine=True).residual
    point = replace(evaluated(here, theta), residual=residual)
    return estimate_from(here, point, covariance_before_the_minimum(point, theta, prior_sd), 0, 3 + len(theta), finished=finished)


def _corrected(
    problem: InverseProblem, point: EvaluatedPoint, prior: tuple[FloatArray, float], most: int, at: Evaluations
) -> tuple[EvaluatedPoint, int]:
    """Move on to the minimum of residuals of fine steps, and return it with the iterations.

    What they differ by from residuals of long steps is added to these, and the search goes on with them (output space mapping;
    :cite:t:`bandler2004`), until residuals of fine steps become no better.
    """
    coarse, best, count = point.residual, np.inf, 0
    for _ in range(CORRECTIONS):
        fine = at(problem, point.theta, derivatives=False, fine=True)
        cost = cost_of(fine, *prior)
        if cost > best:
            break
        ended = best - cost < SETTLED + 1e-5 * cost
        best, found = cost, replace(fine, slopes=point.slopes)
        if ended:
            break
        offset = (fine.residual[0] - coarse[0], fine.residual[1] - coarse[1])
        point, used = _descend(problem, found, prior, most, at, offset=offset)
        count += used
        if np.array_equal(point.theta, found.theta):
            break
        coarse = (point.residual[0] - offset[0], point.residual[1] - offset[1])
    return found, count


def _told(point: EvaluatedPoint, found: Residual, step: FloatArray) -> EvaluatedPoint:
    """Return a point whose derivatives tell what a step from there did (a rank-one update; :cite:p:`broyden1965`)."""
    slopes = [
        own + np.outer(new - old - own @ step, step) / float(step @ step)
        for own, new, old in zip(point.slopes, found, point.residual, strict=True)
    ]
    return replace(point, slopes=(slopes[0], slopes[1]))


def _descend(
    problem: InverseProblem,
    point: EvaluatedPoint,
    prior: tuple[FloatArray, float],
    most: int,
    at: Evaluations,
    *,
    offset: Residual | None = None,
    fresh: bool = True,
    enough: float = 0.0,
) -> tuple[EvaluatedPoint, int]:
    """Iterate by Gauss and Newton within a trust region (:cite:t:`nocedal2006`, chapters 4 and 10).

    An `offset` is added to all residuals. Derivatives are improved by every step, and taken anew where a step does much less than it
    promised, and before the search ends unless they are `fresh`. `enough` is a decrease, as a fraction of the cost, that is not worth a
    step. Returns the last point and the iterations.
    """
    cost, reach, idle, renewed = cost_of(point, *prior), LONGEST, 0, False
    for used in range(1, most):
        step, promised = step_within(point, *prior, reach)
        if promised < max(SETTLED, enough * cost) or idle >= IDLE:
            if fresh or enough or renewed:
                return point, used
            point, fresh, renewed, idle = replace(point, slopes=at(problem, point.theta).slopes), True, True, 0
            continue
        trial = at(problem, point.theta + step, derivatives=False)
        if offset is not None:
            trial = replace(trial, residual=(trial.residual[0] + offset[0], trial.residual[1] + offset[1]))
        decrease, size = cost - cost_of(trial, *prior), float(np.abs(step).max())
        idle = idle + 1 if abs(decrease) < SETTLED + max(1e-5, problem.roughness, enough) * cost else 0
        poor = decrease < POOR * promised
        if poor:
            reach = 0.3 * size
        elif decrease > WELL * promised and size > 0.9 * reach:
            reach = min(2.0 * reach, FARTHEST)
        if size > TELLING:
            point = _told(point, trial.residual, step)
        if decrease > 0.0:
            point, cost = replace(trial, slopes=point.slopes), cost - decrease
            at.keep(problem, point)
        if poor and not fresh:
            point = replace(point, slopes=at(problem, point.theta).slopes)
        fresh = poor and not fresh
    raise ConvergenceError(
        f"the calibration did not settle within {most} iterations (chi-squared {cost:.6g}); allow more (max_iterations), or start "
        "nearer: it is at "
        + ", ".join(f"{name} {value:.3g}" for name, value in zip(problem.unknowns.names, np.exp(point.theta), strict=True))
    )
