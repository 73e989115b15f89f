"""Calibration from several starts: independent searches, the best of them, and whether another set of values fits as well."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import chdtri

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError, WorkerLostError
from naibu.core.progress import Progress
from naibu.identification.lattice_calibration.captured.sensor_errors import NO_ERRORS
from naibu.identification.lattice_calibration.estimate import LatticeEstimate
from naibu.identification.lattice_calibration.evaluation import evaluated
from naibu.identification.lattice_calibration.evolutionary import search_cma_es, search_genetic
from naibu.identification.lattice_calibration.gauss_newton import PRIOR_SD, calibrate_lattice, estimate_at
from naibu.identification.lattice_calibration.studies.study_problem import StudyProblem
from naibu.identification.lattice_calibration.studies.study_unknowns import StudyUnknowns
from naibu.workflows.parallel.run_tasks import run_tasks
from naibu.workflows.parallel.task import Outcome, Task
from naibu.workflows.parallel.worker_count import HERE, Workers

Method = Literal["gauss-newton", "cma-es", "genetic"]
REACH = 10.0  # starts lie within this factor of the values that the study states
MEMORY_MB = 800.0  # of a process that searches
FAILURES = (ConvergenceError, InputError, FloatingPointError, WorkerLostError)  # which end one search only


@dataclass(frozen=True, slots=True, eq=False)
class StartedSearch:
    """A search from one start.

    Attributes
    ----------
    start : ndarray, shape (p,)
        Where it began.
    estimate : LatticeEstimate, optional
        Where it ended; None if it failed.
    misfit : float
        Chi-squared of fine steps in units of the stated noise, with the weak prior; infinite if it failed.
    error : str
        Why it failed.
    """

    start: FloatArray
    estimate: LatticeEstimate | None
    misfit: float
    error: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedFromStarts:
    """The best of several searches.

    Attributes
    ----------
    estimate : LatticeEstimate
        The best one. Its covariance reaches to other values that fit as well.
    searches : tuple of StartedSearch
        All that were finished, in the order of their starts.
    rivals : tuple of int
        Places in `searches` of those that ended elsewhere and fit as well.
    """

    estimate: LatticeEstimate
    searches: tuple[StartedSearch, ...]
    rivals: tuple[int, ...]


def starting_values(unknowns: StudyUnknowns, count: int, seed: int) -> FloatArray:
    """Return starts (count, p): the stated values, and a Latin hypercube :cite:p:`mckay1979` of logarithms within `REACH` around them.

    They stay within the bounds of the unknowns.
    """
    from scipy.stats import qmc  # slow to load, and not needed by workers

    stated = np.log(unknowns.start)
    unit = qmc.LatinHypercube(len(stated), seed=np.random.default_rng(seed)).random(count - 1) if count > 1 else np.zeros((0, len(stated)))
    low = np.maximum(stated - np.log(REACH), np.log(unknowns.bounds[:, 0]))
    high = np.minimum(stated + np.log(REACH), np.log(unknowns.bounds[:, 1]))
    return np.asarray(np.exp(np.vstack([stated, low + unit * (high - low)])))


def calibrate_from_starts(
    problem: StudyProblem,
    count: int,
    *,
    method: Method = "gauss-newton",
    seed: int = 0,
    max_runs: int = 2000,
    threads: int = 2,
    workers: Workers = HERE,
    progress: Progress | None = None,
) -> CalibratedFromStarts:
    """Search from several starts, each search a task of its own, and return the best.

    Values count as fitting as well if chi-squared, with noise enlarged to the misfit, is not above that of the best by more than its
    95 % quantile for as many unknowns (likelihood ratio), and as ending elsewhere if they lie outside the best one's joint 95 % region.
    The covariance is widened to reach each of them.

    Parameters
    ----------
    problem : StudyProblem
        What is sought; weak priors stay around the stated values whatever the start.
    count : int
        Number of starts.
    method, seed, max_runs, threads
        Of every search, as for `naibu.workflows.calibrate_study`; searches without derivatives take the seeds from `seed` on.
    workers : Workers
        Where the searches run.
    progress : callable, optional
        Called with a `ProgressReport`; KeyboardInterrupt from it keeps the searches that have ended.

    Raises
    ------
    ConvergenceError
        Every search failed.
    KeyboardInterrupt
        An interruption before the first search has ended.
    """
    starts = starting_values(problem.unknowns, count, seed)
    tasks = [
        Task(
            f"start {k + 1}",
            _search,
            {"problem": problem, "start": start, "method": method, "seed": seed + k, "max_runs": max_runs, "threads": threads},
        )
        for k, start in enumerate(starts)
    ]
    ended: dict[int, StartedSearch] = {}

    def finished(index: int, outcome: Outcome) -> None:
        ended[index] = outcome.result or StartedSearch(starts[index], None, np.inf, str(outcome.error))

    interrupted = False
    try:
        outcomes = run_tasks(tasks, workers=workers, memory_mb=MEMORY_MB, stage="calibrate", finished=finished, progress=progress)
        for k, outcome in enumerate(outcomes):
            if not isinstance(outcome.error, FAILURES) or (k == 0 and isinstance(outcome.error, InputError)):
                outcome.value()  # raises what is no failure of a search
    except KeyboardInterrupt:
        if not any(search.estimate for search in ended.values()):
            raise
        interrupted = True
    return best_of(problem, tuple(ended[k] for k in sorted(ended)), complete=not interrupted)


def _search(
    problem: StudyProblem, start: FloatArray, method: Method, seed: int, max_runs: int, threads: int, progress: Progress | None
) -> StartedSearch:
    found = searched(problem, start, method=method, seed=seed, max_runs=max_runs, threads=threads, progress=progress)
    theta = np.log(found.values)
    residual = evaluated(problem, theta, derivatives=False, fine=True, threads=threads).residual
    prior = float((((theta - np.log(problem.unknowns.start)) / PRIOR_SD) ** 2).sum())
    return StartedSearch(start, found, float(sum((r**2).sum() for r in residual)) + prior)


def searched(
    problem: StudyProblem, start: FloatArray, *, method: Method, seed: int, max_runs: int, threads: int, progress: Progress | None
) -> LatticeEstimate:
    """Search from one start (p,) by a method; weak priors stay around the values that the study states."""
    if method == "gauss-newton":
        if problem.sensor_errors.offset or problem.sensor_errors.delay:
            # far from the truth a delay and an offset together make up for wrong parameters: errors are sought from where these fit best
            exact = replace(problem, sensor_errors=NO_ERRORS)
            first = calibrate_lattice(exact, problem.unknowns.start, warm_start=start, widen=False, threads=threads, progress=progress)
            if not first.finished:
                return first
            start = first.values
        return calibrate_lattice(problem, problem.unknowns.start, warm_start=start, threads=threads, progress=progress)
    search = search_cma_es if method == "cma-es" else search_genetic
    found = search(problem, start, seed=seed, measure="chi-squared", max_runs=max_runs, progress=progress)
    return estimate_at(problem, found.values, finished=found.finished, threads=threads)


def best_of(problem: StudyProblem, searches: tuple[StartedSearch, ...], *, complete: bool) -> CalibratedFromStarts:
    """Return the search of the least misfit, and which others fit as well; see `calibrate_from_starts`."""
    order = sorted((k for k, s in enumerate(searches) if s.estimate is not None), key=lambda k: searches[k].misfit)
    if not order:
        raise ConvergenceError(f"no search of {len(searches)} came to its end; the first: {searches[0].error}")
    best = searches[order[0]]
    assert best.estimate is not None
    limit = float(chdtri(len(best.start), 0.05))
    noise = max(1.0, *(f**2 for f in best.estimate.noise_factor if np.isfinite(f)))
    allowed = max(limit * noise, problem.roughness * best.misfit)
    theta, covariance, rivals = np.log(best.estimate.values), best.estimate.covariance, []
    for k in order[1:]:
        other = searches[k].estimate
        assert other is not None
        apart = np.log(other.values) - theta
        if searches[k].misfit - best.misfit <= allowed and apart @ np.linalg.solve(covariance, apart) > limit:
            covariance = covariance + np.outer(apart, apart)
            rivals.append(k)
    estimate = replace(best.estimate, covariance=covariance, finished=best.estimate.finished and complete)
    return CalibratedFromStarts(estimate, searches, tuple(sorted(rivals)))
