"""Finite-strain viscoelasticity: a generalized Maxwell model with a hyperelastic law, for quasi-static problems in time.

The second Piola-Kirchhoff stress S_e of the law relaxes as a linear viscoelastic stress does,

    S(t) = S_rest(t) + g_inf S_e(t) + sum_i h_i(t),    h_i' + h_i / tau_i = g_i S_e',    g_inf = 1 - sum_i g_i,

with S_e the isochoric part of the law and S_rest the volumetric one, or S_e the whole of it :cite:p:`simo1987,holzapfel1996`. As tensors
of the reference configuration, S and h_i are objective. The law given is that of the instantaneous response. Over a step in which S_e
changes linearly in time the branches are integrated exactly :cite:p:`taylor1970`:

    h_i(t + dt) = e_i h_i(t) + g_i a_i (S_e(t + dt) - S_e(t)),    e_i = exp(-dt / tau_i),    a_i = tau_i (1 - e_i) / dt.

Within a step the stress is hence that of the law with scaled parameters, plus a stress known from the step before
(`naibu.mechanics.finite_elements.stress_history`), and Newton's method has its consistent tangent. A step of zero duration is a jump:
a_i = e_i = 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.status import Status
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.hyperelasticity import LAWS, LINEAR_ELASTIC
from naibu.mechanics.finite_elements.stress_history import HistoryAssembler, second_piola
from naibu.mechanics.finite_strain.newton import Newton
from naibu.mechanics.finite_strain.penalties import with_suited_penalties
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import LoadState, Solution, advanced, finished, without_penetration
from naibu.mechanics.linear_algebra.protocols import LinearSolver

Relaxing = Literal["isochoric", "all"]
SMALLEST_PART = 1.0 / 64.0  # of a time step: the solve stops below it
PSEUDO_TRANSIENT_PART = 1.0 / 8.0  # of a time step: from here on pseudo-transient continuation is tried where Newton's method fails


@dataclass(frozen=True, slots=True)
class PronySeries:
    """Prony series of the stress relaxation at constant strain, ``g(t) = 1 - sum_i g_i (1 - exp(-t / tau_i))``.

    Attributes
    ----------
    weights : tuple of float
        g_i, fractions of the instantaneous stress that relax; not negative, their sum below 1.
    times : tuple of float
        tau_i, relaxation times, s.
    """

    weights: tuple[float, ...]
    times: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.weights) != len(self.times):
            raise InputError(f"a Prony series needs one time for each weight; got {len(self.weights)} weights and {len(self.times)} times")
        if not all(0.0 <= g < 1.0 for g in self.weights) or not sum(self.weights) < 1.0:
            raise InputError(f"the weights of a Prony series must be >= 0 with a sum below 1, not {self.weights}: some stress must remain")
        if not all(0.0 < tau < np.inf for tau in self.times):
            raise InputError(f"the relaxation times of a Prony series must be positive, s, not {self.times}")

    @property
    def long_term(self) -> float:
        """Fraction of the stress that never relaxes, g_inf."""
        return 1.0 - sum(self.weights)

    def relaxation(self, time: ArrayLike) -> FloatArray:
        """Return g(t) (...,) at times (...,), s, after a jump of strain."""
        t = np.asarray(time, dtype=float)
        return np.asarray(1.0 + sum(g * np.expm1(-t / tau) for g, tau in zip(self.weights, self.times, strict=True)))


ELASTIC = PronySeries((), ())


@dataclass(frozen=True, slots=True, eq=False)
class HistoryVariables:
    """History variables (internal variables) of a viscoelastic body.

    Attributes
    ----------
    elastic : ndarray, shape (m, q, 3, 3)
        Stress S_e of the relaxing part at the end of the last step, kPa.
    branches : ndarray, shape (terms, m, q, 3, 3)
        Stresses h_i of the Maxwell branches, kPa.
    """

    elastic: FloatArray
    branches: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ViscoelasticBody:
    """An assembler with viscoelastic laws; `step` and `updated` advance it through a history of displacements.

    Attributes
    ----------
    assembler : HistoryAssembler
        Elements and instantaneous laws, without history.
    weights, times : ndarray, shape (terms, m)
        Prony series of every cell, the shorter ones padded with weights of 0; times in s.
    relaxing : ndarray, shape (m, 4), bool
        Which parameters of the cells' laws belong to the stress that relaxes.
    """

    assembler: HistoryAssembler
    weights: FloatArray
    times: FloatArray
    relaxing: BoolArray

    @classmethod
    def of(
        cls,
        assembler: Assembler,
        series: PronySeries | Sequence[PronySeries],
        regions: IntArray | None = None,
        *,
        relaxing: Relaxing = "isochoric",
    ) -> ViscoelasticBody:
        """Make the cells of `assembler` viscoelastic.

        Parameters
        ----------
        assembler : Assembler
            Elements and instantaneous laws.
        series : PronySeries or sequence of PronySeries
            One for all cells, or one for each region (`ELASTIC` for a region without relaxation).
        regions : ndarray, shape (m,), int64, optional
            Region of every cell, for several series.
        relaxing : {"isochoric", "all"}
            Whether only the isochoric stress relaxes, which needs a law that is split into isochoric and volumetric parts and suits nearly
            incompressible solids, or the whole stress, with which Poisson's ratio does not change.

        Raises
        ------
        InputError
            An unknown option, a law that cannot relax so, or regions without a series.
        """
        if relaxing not in get_args(Relaxing):
            raise InputError(f"relaxing={relaxing!r} is not known; use one of {', '.join(get_args(Relaxing))}")
        mask = _relaxing_parameters(assembler, relaxing)
        each = [series] if isinstance(series, PronySeries) else list(series)
        of_cell = np.zeros(len(mask), dtype=np.int64) if isinstance(series, PronySeries) else regions
        if of_cell is None or of_cell.shape != (len(mask),) or of_cell.min() < 0 or of_cell.max() >= len(each):
            raise InputError(
                f"{len(each)} Prony series need the region of each of the {len(mask)} cells, numbered from 0 to {len(each) - 1}"
            )
        count = max(len(s.weights) for s in each)
        weights, times = np.zeros((count, len(each))), np.ones((count, len(each)))
        for k, s in enumerate(each):
            weights[: len(s.weights), k], times[: len(s.times), k] = s.weights, s.times
        blank = HistoryAssembler.of(assembler, np.zeros((*assembler.elements.weights.shape, 3, 3)))
        return cls(blank, weights[:, of_cell], times[:, of_cell], mask)

    def at_rest(self) -> HistoryVariables:
        """Return the history variables of a body that was never loaded: zeros."""
        shape = (*self.assembler.elements.weights.shape, 3, 3)
        return HistoryVariables(np.zeros(shape), np.zeros((len(self.weights), *shape)))

    def step(self, past: HistoryVariables, duration: float) -> HistoryAssembler:
        """Return the assembler of forces and tangents at the end of a step of `duration`, s, that starts from `past`."""
        decay, average = self._factors(duration)
        parameters = self.assembler.parameters
        factor = 1.0 - self.weights.sum(axis=0) + (self.weights * average).sum(axis=0)
        scaled = np.where(self.relaxing, parameters * factor[:, None], parameters)
        history = self._at_points(decay, past.branches) - self._at_points(self.weights * average, past.elastic[None])
        return HistoryAssembler.of(self.assembler, history, scaled)

    def updated(self, past: HistoryVariables, displacement: FloatArray, duration: float) -> HistoryVariables:
        """Return the history variables after a step of `duration`, s, from `past` to the displacement (n, 3), mm."""
        decay, average = self._factors(duration)
        elastic = second_piola(self.assembler, np.where(self.relaxing, self.assembler.parameters, 0.0), displacement)
        cells = self.assembler.elements.cell_of_point
        gain = (self.weights * average)[:, cells, None, None]
        return HistoryVariables(elastic, decay[:, cells, None, None] * past.branches + gain * (elastic - past.elastic))

    def _factors(self, duration: float) -> tuple[FloatArray, FloatArray]:
        """``exp(-dt / tau)`` and its mean over the step (terms, m)."""
        x = duration / self.times
        return np.exp(-x), np.divide(-np.expm1(-x), x, out=np.ones_like(x), where=x > 0.0)

    def _at_points(self, factor: FloatArray, stress: FloatArray) -> FloatArray:
        """Sum over the terms of factors (terms, m) of the cells times stresses (terms or 1, m, q, 3, 3)."""
        cells = self.assembler.elements.cell_of_point
        return np.asarray((factor[:, cells, None, None] * stress).sum(axis=0))


def _relaxing_parameters(assembler: Assembler, relaxing: Relaxing) -> BoolArray:
    """Which parameters (m, 4) of the cells belong to the relaxing stress."""
    mask = np.ones(assembler.parameters.shape, dtype=bool)
    for law in LAWS.values():
        cells = assembler.law_codes == law.code
        if not cells.any():
            continue
        if law.code == LINEAR_ELASTIC:
            raise InputError("law 'linear_elastic' is not objective and cannot relax at finite strain; use 'neo_hookean' or another law")
        if relaxing == "isochoric":
            if law.volumetric != "bulk_modulus":
                split = ", ".join(other.name for other in LAWS.values() if other.volumetric == "bulk_modulus")
                raise InputError(
                    f"law {law.name!r} is not split into isochoric and volumetric parts; use one of {split}, or relaxing='all' to let its "
                    "whole stress relax"
                )
            mask[cells, law.parameter_names.index(law.volumetric)] = False
    return mask


@dataclass(frozen=True, slots=True, eq=False)
class TimeStep:
    """Equilibrium at one time.

    Attributes
    ----------
    time : float
        s.
    solution : Solution
        Displacement, reactions, residual; its states are those before and after the step.
    internal_force : ndarray, shape (n, 3)
        Internal force at the nodes, mN: at constrained nodes it is the reaction less the other loads.
    """

    time: float
    solution: Solution
    internal_force: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ViscoelasticSolution:
    """Equilibrium at all requested times, or at those before the simulation stopped.

    Attributes
    ----------
    steps : tuple of TimeStep
        In order of time.
    status : Status
        How the simulation ended.
    history : HistoryVariables
        Internal stresses at the last time.
    """

    steps: tuple[TimeStep, ...]
    status: Status
    history: HistoryVariables

    @property
    def times(self) -> FloatArray:
        """Times (k,), s."""
        return np.array([s.time for s in self.steps])

    @property
    def displacement(self) -> FloatArray:
        """Displacement (k, n, 3), mm."""
        return np.array([s.solution.displacement for s in self.steps])

    def reaction(self, name: str) -> FloatArray:
        """Return the force (k, 3), mN, of the rigid body called `name`, or of the ``"prescribed"`` nodes, on the body.

        Raises
        ------
        InputError
            There is no such body; the message lists the names.
        """
        known = self.steps[0].solution.reactions
        if name not in known:
            raise InputError(f"no reaction is called {name!r}; there are {', '.join(known)}")
        return np.array([s.solution.reactions[name] for s in self.steps])


def simulate_viscoelastic(
    problem: Problem,
    series: PronySeries | Sequence[PronySeries],
    *,
    times: ArrayLike,
    loads: ArrayLike,
    force_factors: ArrayLike | None = None,
    regions: IntArray | None = None,
    relaxing: Relaxing = "isochoric",
    settings: SolverSettings | None = None,
    throw: bool = True,
    callback: Callable[[float], None] | None = None,
    solver: LinearSolver | None = None,
) -> ViscoelasticSolution:
    """Simulate a quasi-static viscoelastic problem in time, implicitly and to second order in the time step.

    The body is at rest before the first time, at which it is loaded at once; two equal times make a jump. A step for which Newton's method
    fails is halved.

    Parameters
    ----------
    problem : Problem
        Body with its instantaneous laws, boundary conditions and contacts. Inertia is neglected.
    series, regions, relaxing
        How the stress relaxes, as for `ViscoelasticBody.of`.
    times : array_like, shape (k,)
        Times, s, not decreasing.
    loads : array_like, shape (k,)
        Load factor of the prescribed displacements and of the rigid bodies' paths at these times; linear in between.
    force_factors : array_like, shape (k,), optional
        Factors of ``problem.external_force`` at these times; by default 1 from the first time on.
    settings : SolverSettings, optional
        Tolerances.
    throw : bool
        Whether to raise when the end is not reached, or to return what was reached with its status.
    callback : callable, optional
        Called with every time reached, for progress.
    solver : LinearSolver, optional
        A linear solver for the problem's pattern; chosen automatically by default.

    Raises
    ------
    InputError
        Times that decrease, arrays that do not fit, or what `ViscoelasticBody.of` refuses.
    ConvergenceError
        The end was not reached (only with `throw`).
    """
    path = _path(times, loads, force_factors)
    body = ViscoelasticBody.of(problem.assembler, series, regions, relaxing=relaxing)
    newton = Newton(with_suited_penalties(problem), settings or SolverSettings(), solver)
    rest = LoadState(0.0, np.zeros_like(problem.points), tuple(c.anchors_at_rest() for c in problem.contacts))
    at, history = rest, body.at_rest()
    steps: list[TimeStep] = []
    previous = np.array([path[0, 0], 0.0, 0.0])
    for target in path:
        newton.iterations = 0
        found = _advance(newton, problem, body, (at, history), previous, target)
        if found is None:
            if throw:
                raise ConvergenceError(f"stopped between {previous[0]:g} and {target[0]:g} s. {Status.STEP_TOO_SMALL.value}")
            return ViscoelasticSolution(tuple(steps), Status.STEP_TOO_SMALL, history)
        before, (at, history), residual = found
        solution = finished(newton, [before, at], residual, Status.CONVERGED, throw)
        steps.append(TimeStep(float(target[0]), solution, newton.problem.assembler.forces(at.displacement)[1]))
        previous = target
        if callback is not None:
            callback(float(target[0]))
    return ViscoelasticSolution(tuple(steps), Status.CONVERGED, history)


_Point = tuple[LoadState, HistoryVariables]


def _advance(
    newton: Newton, problem: Problem, body: ViscoelasticBody, start: _Point, previous: FloatArray, target: FloatArray
) -> tuple[LoadState, _Point, float] | None:
    """Go from `previous` to `target` (time, load, force factor) in as few parts as possible.

    Returns the state before the last part, the point reached, and its residual; None where a part would become too short.
    """
    (at, history), done, part, residual = start, 0.0, 1.0, 0.0
    before = at
    while done < 1.0:
        now = previous + (done + part) * (target - previous) if done + part < 1.0 else target
        duration = part * float(target[0] - previous[0])
        newton.problem = replace(newton.problem, assembler=body.step(history, duration), external_force=now[2] * problem.external_force)
        found = newton.solve(at.displacement, at.anchors, float(now[1]))
        if found is None and part <= PSEUDO_TRANSIENT_PART:
            found = newton.pseudo_transient(at.displacement, at.anchors, float(now[1]))
        if found is not None:
            found = without_penetration(newton, found, at.anchors, float(now[1]))
        if found is None:
            part *= 0.5
            if part < SMALLEST_PART:
                return None
            continue
        u, residual = found
        before = at
        at, history = advanced(newton.problem, u, at.anchors, float(now[1])), body.updated(history, u, duration)
        done += part
        part = min(2.0 * part, 1.0 - done)
    return before, (at, history), residual


def _path(times: ArrayLike, loads: ArrayLike, force_factors: ArrayLike | None) -> FloatArray:
    """Times, loads and force factors (k, 3), checked."""
    t, load = np.asarray(times, dtype=float), np.asarray(loads, dtype=float)
    factor = np.ones_like(t) if force_factors is None else np.asarray(force_factors, dtype=float)
    if t.ndim != 1 or len(t) == 0 or load.shape != t.shape or factor.shape != t.shape:
        raise InputError(f"times, loads and force_factors must have one shape (k,), not {t.shape}, {load.shape} and {factor.shape}")
    path = np.stack([t, load, factor], axis=1)
    if not np.isfinite(path).all():
        raise InputError("times, loads and force_factors must be finite numbers")
    if (np.diff(t) < 0.0).any():
        k = int(np.argmax(np.diff(t) < 0.0))
        raise InputError(f"times must not decrease, but {t[k + 1]:g} s follows {t[k]:g} s; repeat a time for a jump")
    return path
