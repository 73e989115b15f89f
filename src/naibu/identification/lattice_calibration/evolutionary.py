"""Calibration of lattices by CMA-ES :cite:p:`hansen2001` and a genetic algorithm :cite:p:`goldberg1989`, in parallel.

Both need no derivatives and no start near the truth; both need hundreds to thousands of simulated pushings where `calibrate_lattice` needs
about a hundred.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.optional_packages import optional_package
from naibu.core.progress import Progress, report_progress
from naibu.identification.lattice_calibration.captured.shape_distance import closest_points, force_difference
from naibu.identification.lattice_calibration.evaluation import evaluated
from naibu.identification.lattice_calibration.forward_model import SAMPLE_S
from naibu.identification.lattice_calibration.gauss_newton import CalibrationProblem
from naibu.identification.lattice_calibration.inverse_problem import InverseProblem

Measure = Literal["chi-squared", "report"]
WORST = 1e30  # cost of parameters whose motion cannot be computed


@dataclass(frozen=True, slots=True, eq=False)
class Searched:
    """Result of an evolutionary search.

    Attributes
    ----------
    names : tuple of str
        Parameters.
    values : ndarray, shape (p,)
        The best ones, mN/mm and mN s/mm.
    cost : float
        Theirs.
    history : ndarray, shape (generations,)
        Best cost up to every generation.
    runs : int
        Sets of parameters that were simulated.
    finished : bool
        Whether the search came to its end; otherwise Ctrl-C left the best so far.
    """

    names: tuple[str, ...]
    values: FloatArray
    cost: float
    history: FloatArray
    runs: int
    finished: bool = True


def cost_of(problem: InverseProblem, theta: FloatArray, *, measure: Measure = "report") -> float:
    """Return the objective of a search, for logarithms theta (p,); coarse steps.

    ``"chi-squared"`` is that of `calibrate_lattice`; ``"report"`` is S_shape in units of the sensor's error, S_force too, or their sum.
    """
    if measure == "chi-squared":
        return float(sum((r**2).sum() for r in evaluated(problem, theta, derivatives=False, threads=1).residual))
    if not isinstance(problem, CalibrationProblem):
        raise InputError(f"measure is {measure!r}, which is that of pushed faces; studies are compared by 'chi-squared'")
    parameters, total = problem.unknowns.parameters(np.exp(theta)), 0.0
    for load_case in problem.load_cases:
        capture, found = load_case.capture, load_case.coarse.run(parameters)
        if problem.index != "force":
            for points, x in zip(capture.points, found.positions, strict=True):
                distance = np.abs(closest_points(points, load_case.coarse.hull, x).signed)
                total += float(distance[distance >= capture.point_sd_mm].sum()) / capture.point_sd_mm
        if problem.index != "shape":
            since = round(capture.pushing.push_s / SAMPLE_S) if problem.window == "keep" else 0
            force = np.repeat(found.force, round(problem.window_s / SAMPLE_S), axis=0)
            total += force_difference(capture.force[since:], force[since:])[0] / capture.force_sd_mn
    return total


def _safe_cost(problem: InverseProblem, measure: Measure, theta: FloatArray) -> float:
    try:
        cost = cost_of(problem, theta, measure=measure)
    except (InputError, ConvergenceError, FloatingPointError):
        return WORST
    return cost if np.isfinite(cost) else WORST


_shared: dict[str, Any] = {}  # of a worker process: the problem, sent once


def _prepare_worker(problem: InverseProblem, measure: Measure) -> None:
    _shared["cost"] = partial(_safe_cost, problem, measure)


def _worker_cost(theta: FloatArray) -> float:
    return float(_shared["cost"](theta))


@contextmanager
def evaluator(
    problem: InverseProblem, measure: Measure = "report", *, workers: int = 1, client: Any = None
) -> Iterator[Callable[[Sequence[FloatArray]], list[float]]]:
    """Provide a function from many theta to their costs, by this process, by several, or by the workers of a `dask.distributed.Client`.

    Parameters
    ----------
    problem, measure
        As for `cost_of`.
    workers : int
        Processes; one computes here. With more, the calling script needs ``if __name__ == "__main__":``.
    client : dask.distributed.Client
        A cluster; goes before `workers`.

    Raises
    ------
    InputError
        No worker.
    """
    if workers < 1:
        raise InputError(f"the number of worker processes must be positive, not {workers}")
    if client is not None:
        remote = client.scatter(problem, broadcast=True)
        yield lambda thetas: list(client.gather([client.submit(_safe_cost, remote, measure, t, pure=False) for t in thetas]))
    elif workers == 1:
        yield lambda thetas: [_safe_cost(problem, measure, t) for t in thetas]
    else:
        with ProcessPoolExecutor(workers, get_context("spawn"), _prepare_worker, (problem, measure)) as pool:
            yield lambda thetas: list(pool.map(_worker_cost, thetas))


def search_cma_es(
    problem: InverseProblem,
    start: ArrayLike | Mapping[str, float],
    *,
    seed: int,
    measure: Measure = "report",
    spread: float = 0.7,
    population: int | None = None,
    max_runs: int = 2000,
    workers: int = 1,
    client: Any = None,
    progress: Progress | None = None,
) -> Searched:
    """Search by CMA-ES (pycma) in the logarithms of the parameters.

    Parameters
    ----------
    problem : CalibrationProblem or StudyProblem
        What is sought; of a study, by the measure ``"chi-squared"``.
    start : array_like or mapping
        As for `calibrate_lattice`.
    seed : int
        Of the random numbers.
    measure : str
        See `cost_of`.
    spread : float
        Standard deviation of the logarithms in the first generation.
    population : int
        Sets in a generation; pycma's by default.
    max_runs : int
        Sets in all.
    workers, client
        See `evaluator`.
    progress : callable
        Called with a `ProgressReport` after every generation. Where it raises KeyboardInterrupt, the best so far is returned.

    Raises
    ------
    MissingDependencyError
        pycma is not installed.
    """
    cma = optional_package("cma", "calibration by CMA-ES", "naibu[calibrate]")
    begin = np.log(problem.unknowns.vector(start))
    options: dict[str, Any] = {
        "seed": seed + 1,
        "verbose": -9,
        "maxfevals": max_runs,
        "tolfun": 1e-3,
        "tolx": 1e-3,
    }  # seed 0 is the clock's
    if population is not None:
        options["popsize"] = population
    strategy, history, runs = cma.CMAEvolutionStrategy(begin, spread, options), [], 0
    best, least, finished = begin, np.inf, True
    with evaluator(problem, measure, workers=workers, client=client) as costs_of:
        while finished and not strategy.stop():
            thetas = strategy.ask()
            costs = costs_of(thetas)
            strategy.tell(thetas, costs)
            runs += len(thetas)
            if min(costs) < least:
                best, least = np.array(thetas[int(np.argmin(costs))]), float(min(costs))
            history.append(least)
            finished = _reported(progress, runs, max_runs, least)
    return Searched(problem.unknowns.names, np.exp(best), least, np.array(history), runs, finished)


def _reported(progress: Progress | None, runs: int, most: int, cost: float) -> bool:
    """Report progress; return whether the search is to go on."""
    try:
        report_progress(progress, "calibrate", done=runs, total=most, objective=cost)
    except KeyboardInterrupt:
        return False
    return True


def search_genetic(
    problem: InverseProblem,
    start: ArrayLike | Mapping[str, float],
    *,
    seed: int,
    measure: Measure = "report",
    reach: float = 10.0,
    population: int = 50,
    max_runs: int = 2000,
    workers: int = 1,
    client: Any = None,
    progress: Progress | None = None,
) -> Searched:
    """Search by a genetic algorithm (pymoo), as in the report, in the logarithms of the parameters.

    Parameters
    ----------
    problem, start, seed, measure, max_runs, workers, client, progress
        As for `search_cma_es`.
    reach : float
        Parameters are sought between the start divided and multiplied by this.
    population : int
        Sets in a generation.

    Raises
    ------
    MissingDependencyError
        pymoo is not installed.
    """
    needed = "calibration by a genetic algorithm"
    algorithms, core = (optional_package(f"pymoo.{n}", needed, "naibu[calibrate]") for n in ("algorithms.soo.nonconvex.ga", "core.problem"))
    centre = np.log(problem.unknowns.vector(start))
    half = np.log(reach)
    statement = core.Problem(n_var=len(centre), n_obj=1, xl=centre - half, xu=centre + half)
    algorithm = algorithms.GA(pop_size=population)
    algorithm.setup(statement, termination=("n_eval", max_runs), seed=seed, verbose=False)
    history, runs, best, least, finished = [], 0, centre, np.inf, True
    with evaluator(problem, measure, workers=workers, client=client) as costs_of:
        while finished and algorithm.has_next():
            group = algorithm.ask()
            thetas = list(group.get("X"))
            costs = np.array(costs_of(thetas))
            group.set("F", costs[:, None])
            for one in group:
                one.evaluated.add("F")
            algorithm.evaluator.n_eval += len(thetas)
            algorithm.tell(infills=group)
            runs += len(thetas)
            if costs.min() < least:
                best, least = thetas[int(np.argmin(costs))], float(costs.min())
            history.append(least)
            finished = _reported(progress, runs, max_runs, least)
    return Searched(problem.unknowns.names, np.exp(best), least, np.array(history), runs, finished)
