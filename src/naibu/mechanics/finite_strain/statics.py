"""Quasi-static equilibrium at finite strain by incremental loading with adaptive load steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray, require_finite
from naibu.core.errors import ConvergenceError
from naibu.core.status import Status
from naibu.mechanics.finite_strain.newton import Newton
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.linear_algebra.protocols import LinearSolver

USUAL_ITERATIONS = 5.0  # Newton iterations of a load step of suitable length
WarmStart = tuple[float, FloatArray]  # a fraction of the load, and an initial guess of the displacement there (n, 3), mm


@dataclass(frozen=True, slots=True, eq=False)
class LoadState:
    """Equilibrium at one fraction of the load.

    Attributes
    ----------
    load : float
        Fraction of the load, in [0, 1].
    displacement : ndarray, shape (n, 3)
        mm.
    anchors : tuple of ndarray, shape (p, 3)
        Frictional anchors of the points of every contact, in the frame of its body, mm: history variables with which the next load step
        starts.
    """

    load: float
    displacement: FloatArray
    anchors: tuple[FloatArray, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Equilibrium states along the load path.

    Attributes
    ----------
    states : tuple of LoadState
        The reference configuration, then every converged step; the last one is at full load if `status` is converged.
    status : Status
        How the solve ended.
    reactions : dict
        Force (3,), mN, of every rigid body on the deformable one at the last state, and ``"prescribed"`` for the constrained nodes.
    iterations : int
        Newton iterations in all.
    residual : float
        Relative residual force of the last state.
    penetration_mm : float
        Deepest penetration of a rigid body at the last state.
    linear_solver : str
        The solver that was used.
    """

    states: tuple[LoadState, ...]
    status: Status
    reactions: dict[str, FloatArray]
    iterations: int
    residual: float
    penetration_mm: float
    linear_solver: str

    @property
    def displacement(self) -> FloatArray:
        """Displacement (n, 3), mm, of the last state."""
        return self.states[-1].displacement


def solve(
    problem: Problem,
    *,
    settings: SolverSettings | None = None,
    throw: bool = True,
    callback: Callable[[float], None] | None = None,
    solver: LinearSolver | None = None,
    warm_start: Sequence[WarmStart] = (),
    start: LoadState | None = None,
) -> Solution:
    """Solve for static equilibrium, following the load in steps from the reference configuration, or from a state.

    Parameters
    ----------
    problem : Problem
        Body, materials, supports.
    settings : SolverSettings, optional
        Steps and tolerances.
    throw : bool
        Whether to raise when the end is not reached, or to return what was reached with its status.
    callback : callable, optional
        Called with the fraction of the load after every step, for progress.
    solver : LinearSolver, optional
        A linear solver for the problem's pattern; chosen automatically by default.
    warm_start : sequence of (load, displacement)
        Displacements (n, 3), mm, of a similar problem at increasing loads up to 1: load steps then end at these loads and start from these
        displacements.
    start : LoadState, optional
        Equilibrium without load, with the history variables of its contacts; the reference configuration by default.

    Raises
    ------
    ConvergenceError
        The full load was not reached (only with `throw`).
    InputError
        External forces that are not finite.
    """
    chosen = settings or SolverSettings()
    require_finite("problem.external_force", problem.external_force)
    newton = Newton(problem, chosen, solver)
    rest = LoadState(0.0, np.zeros_like(problem.points), tuple(c.anchors_at_rest() for c in problem.contacts))
    first = rest if start is None else LoadState(0.0, start.displacement, start.anchors)
    states, residual = [first], 0.0
    step, ceiling = 1.0 if warm_start else chosen.first_step, 1.0 if warm_start else chosen.largest_step
    while states[-1].load < 1.0 - 1e-12:
        last = states[-1]
        passed = next((h for h in reversed(warm_start) if h[0] <= last.load + 1e-9), None)
        ahead = next((h for h in warm_start if h[0] > last.load + 1e-9), None)
        load = min(1.0 if ahead is None else ahead[0], last.load + step)
        found = None
        for guess in _guesses(states, load, passed, ahead):
            before = newton.iterations
            found = newton.solve(guess, last.anchors, load)
            if found is not None:
                break
        if found is None and load - last.load < chosen.first_step:
            found = newton.pseudo_transient(last.displacement, last.anchors, load)
        if found is None:
            step = 0.5 * (load - last.load)
            ceiling = 1.6 * step
            if step < chosen.smallest_step:
                return finished(newton, states, residual, Status.SINGULAR if newton.rigid_motion else Status.STEP_TOO_SMALL, throw)
            continue
        residual = found[1]
        states.append(advanced(problem, found[0], last.anchors, load))
        if warm_start:
            step = min(1.0, 2.0 * step)
        else:
            ceiling = min(chosen.largest_step, 1.25 * ceiling)
            step = min(ceiling, step * _growth(newton.iterations - before))
        if callback is not None:
            callback(load)
    return finished(newton, states, residual, Status.CONVERGED, throw)


def _growth(iterations: int) -> float:
    """Factor for the next load step after one that took this many Newton iterations: failed steps cost more than short ones."""
    return float(np.clip(np.sqrt(USUAL_ITERATIONS / max(iterations, 1)), 0.6, 1.5))


def _guesses(states: list[LoadState], load: float, before: WarmStart | None, ahead: WarmStart | None) -> list[FloatArray]:
    """Initial guesses at `load`: interpolated from the warm start, then extrapolated through the last states."""
    out, last = [], states[-1]
    if ahead is not None:
        correction = last.displacement - before[1] if before is not None and before[0] == last.load else 0.0
        fraction = (load - last.load) / (ahead[0] - last.load)
        out.append(ahead[1] + correction if fraction == 1.0 else last.displacement + fraction * (ahead[1] + correction - last.displacement))
    if len(states) > 2 or not out:
        known = states[-3:] if len(states) > 3 else states[-2:]
        guess = np.zeros_like(last.displacement)
        for state in known:
            others = [other.load for other in known if other is not state]
            guess += float(np.prod([(load - other) / (state.load - other) for other in others])) * state.displacement
        out.append(guess)
    return out


def advanced(problem: Problem, u: FloatArray, anchors: tuple[FloatArray, ...], load: float) -> LoadState:
    """Return the converged state with displacement `u` (n, 3), mm, and the anchors for the next load step."""
    moved = tuple(c.next_anchors(c.evaluate(u, a, load)) for c, a in zip(problem.contacts, anchors, strict=True))
    return LoadState(load, u, moved)


def finished(newton: Newton, states: list[LoadState], residual: float, status: Status, throw: bool) -> Solution:
    """Return the solution that ends with the last of `states`, with its reactions.

    Raises
    ------
    ConvergenceError
        `status` is not converged (only with `throw`).
    """
    if throw and not status.ok:
        raise ConvergenceError(f"stopped at {100 * states[-1].load:.1f} % of the load. {status.value}")
    problem, last = newton.problem, states[-1]
    reactions: dict[str, FloatArray] = {}
    penetration = 0.0
    contact = np.zeros_like(last.displacement)
    anchors = states[-2].anchors if len(states) > 1 else last.anchors
    for c, a in zip(problem.contacts, anchors, strict=True):
        response = c.evaluate(last.displacement, a, last.load)
        nodal = c.scattered(response.force, len(contact), response.orientation)
        contact += nodal
        reactions[c.name] = (response.force @ response.orientation.T).sum(axis=0)
        penetration = max(penetration, float(-response.gap.min()))
    internal = problem.assembler.forces(last.displacement)[1]
    constrained = problem.prescribed.constrained
    reactions["prescribed"] = np.where(constrained, internal - contact - problem.external_force, 0.0).sum(axis=0)
    name = newton.solver.name if newton.solver is not None else "none"
    return Solution(tuple(states), status, reactions, newton.iterations, residual, penetration, name)
