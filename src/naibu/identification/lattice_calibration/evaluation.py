"""Residuals of a calibration, and their derivatives, computed in parallel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.identification.lattice_calibration.forward_model import Reproduced
from naibu.identification.lattice_calibration.inverse_problem import InverseProblem

Residual = tuple[FloatArray, FloatArray]  # of points and of forces


@dataclass(frozen=True, slots=True, eq=False)
class EvaluatedPoint:
    """Residuals of points and of forces in units of their noise, and derivatives by the logarithms theta (p,) of the parameters."""

    theta: FloatArray
    residual: Residual
    slopes: Residual

    @property
    def information(self) -> FloatArray:
        """Fisher information (p, p) of the data."""
        return np.asarray(sum(j.T @ j for j in self.slopes))

    def gradient(self) -> FloatArray:
        """Return half the gradient (p,) of chi-squared."""
        return np.asarray(sum(j.T @ r for j, r in zip(self.slopes, self.residual, strict=True)))


def evaluated(
    problem: InverseProblem,
    theta: FloatArray,
    *,
    derivatives: bool = True,
    fine: bool = False,
    threads: int = 2,
    executor: Executor | None = None,
) -> EvaluatedPoint:
    """Return residuals, and their derivatives by the logarithms theta (p,); directions are shared among threads, or what executes them."""
    values = np.exp(theta)
    parameters, changes = problem.unknowns.parameters(values), problem.unknowns.changes(values) if derivatives else ()
    parts = [changes[k::threads] for k in range(min(threads, len(changes)))] or [()]
    order = np.concatenate([np.arange(len(changes))[k::threads] for k in range(len(parts))]).astype(np.int64)
    rows: list[tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]] = []
    with ThreadPoolExecutor(threads) if executor is None else nullcontext(executor) as pool:
        runs = [[pool.submit((t.fine if fine else t.coarse).run, parameters, part) for part in parts] for t in problem.load_cases]
        for load_case, jobs in zip(problem.load_cases, runs, strict=True):
            found = _joined([job.result() for job in jobs], order)
            rows.append(problem.weighed(load_case, found, (load_case.fine if fine else load_case.coarse).long_step))
    residual = [np.concatenate([row[k][0] for row in rows]) for k in range(2)]
    slopes = [np.concatenate([row[k][1] for row in rows]) for k in range(2)]
    return EvaluatedPoint(theta, (residual[0], residual[1]), (slopes[0], slopes[1]))


def residuals_at(
    problem: InverseProblem, trials: Sequence[tuple[FloatArray, bool]], *, threads: int = 2, executor: Executor | None = None
) -> Iterator[Residual]:
    """Return residuals in units of their noise at logarithms theta (p,), each with long or (True) fine steps; trials run side by side."""
    with ThreadPoolExecutor(threads) if executor is None else nullcontext(executor) as pool:
        jobs = []
        for theta, fine in trials:
            parameters = problem.unknowns.parameters(np.exp(theta))
            jobs.append([pool.submit((case.fine if fine else case.coarse).run, parameters) for case in problem.load_cases])
        try:
            for (_, fine), parts in zip(trials, jobs, strict=True):
                rows = []
                for case, job in zip(problem.load_cases, parts, strict=True):
                    rows.append(problem.weighed(case, job.result(), (case.fine if fine else case.coarse).long_step))
                yield np.concatenate([row[0][0] for row in rows]), np.concatenate([row[1][0] for row in rows])
        finally:
            for job in (job for parts in jobs for job in parts):
                job.cancel()


def _joined(parts: list[Reproduced], order: IntArray) -> Reproduced:
    back = np.argsort(order)
    positions, forces = (np.concatenate([getattr(p, name) for p in parts])[back] for name in ("positions_change", "force_change"))
    histories = [p.history for p in parts if p.history is not None]
    history = replace(histories[0], change=np.concatenate([h.change for h in histories])[back]) if histories else None
    return replace(parts[0], positions_change=positions, force_change=forces, history=history)
