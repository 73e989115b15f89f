"""Quasi-static equilibrium at finite strain by incremental loading with adaptive load steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray, require_finite
from naibu.core.errors import ConvergenceError
from naibu.core.status import Status
from naibu.mechanics.finite_strain.failure_reasons import failure_reason
from naibu.mechanics.finite_strain.lip_assembly import going_on, lips_of, with_unyielding_lips
from naibu.mechanics.finite_strain.newton import Newton
from naibu.mechanics.finite_strain.penalties import (
    relative_penetrations,
    stiffened,
    with_normal_stiffness,
    with_softer_sticking,
    with_suited_penalties,
)
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.linear_algebra.protocols import LinearSolver

USUAL_ITERATIONS = 5.0  # Newton iterations of a load step of suitable length
MOST_RAISES = 8  # of the penalties of contact at a load
PSEUDO_TRANSIENT_STEP = 0.3  # first load steps; longer ones are halved before pseudo-transient continuation is tried
JUMP = 4.0  # times the displacement that was to be expected
PSEUDO_FAILURES = 4  # of pseudo-transient continuation, each much longer than Newton's method, before no equilibrium is sought further
AHEAD = 0.3  # of the load: a path near a known one, with limited iterations, may not spend those of more than this before it is there
PATIENCE = 2  # load steps for which Newton's method fails, before frictional points on soft elements stick more softly
TURNS = 8  # equilibria whose normals of sides of cuts are those of the one before
CALMING = 0.5  # of what is out of balance after a turn, that the next may leave
SETTLED = 1e-4  # out-of-balance force, of all forces, that the last turn of these normals may leave
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
    normal_stiffness : tuple of ndarray, shape (p,)
        Penalties of the points of every contact with which the state was found, kPa/mm; empty where it was not solved.
    lips : ndarray, shape (p, 3), optional
        Frictional anchors of the pairs of the sides of cuts, mm, with which the next load step starts.
    """

    load: float
    displacement: FloatArray
    anchors: tuple[FloatArray, ...]
    normal_stiffness: tuple[FloatArray, ...] = ()
    lips: FloatArray | None = None


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
    relative_penetration : float
        The same as a fraction of the edge of the element that is penetrated, where that is largest.
    continued : int
        How often pseudo-transient continuation was needed.
    linear_solver : str
        The solver that was used.
    problem : Problem
        What was solved: the problem given, with contact as stiff as it had to be at the last state.
    """

    states: tuple[LoadState, ...]
    status: Status
    reactions: dict[str, FloatArray]
    iterations: int
    residual: float
    penetration_mm: float
    relative_penetration: float
    continued: int
    linear_solver: str
    problem: Problem

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
    stiffness: Mapping[float, tuple[FloatArray, ...]] | None = None,
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
    stiffness : mapping, optional
        Penalties of the points (p,) of every contact, kPa/mm, with which the states of the warm start were found, by their loads.
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
    stiff = problem.with_changes(assembler=with_unyielding_lips(problem.assembler)) if lips_of(problem.assembler) else problem
    newton = Newton(with_suited_penalties(stiff), chosen, solver)
    rest = LoadState(0.0, np.zeros_like(problem.points), tuple(c.anchors_at_rest() for c in problem.contacts))
    first = rest if start is None else LoadState(0.0, start.displacement, start.anchors, lips=start.lips)
    newton.problem = _from_state(newton.problem, first)
    path = _LoadPath(newton, [first], warm_start, *((1.0, 1.0) if warm_start else (chosen.first_step, chosen.largest_step)))
    path.stiffness = stiffness or {}
    softer = path.follow(callback)
    if softer is not None:
        newton.problem, known = _from_state(softer, first), [(state.load, state.displacement) for state in path.states[1:]]
        path = _LoadPath(newton, [first], known, chosen.first_step, chosen.largest_step, may_soften=False)
        path.follow(callback)
    return finished(newton, path.states, path.residual, path.status, throw, path.seen)


@dataclass(slots=True, eq=False)
class _LoadPath:
    """States that follow the load; `follow` extends them."""

    newton: Newton
    states: list[LoadState]
    warm_start: Sequence[WarmStart]
    step: float
    ceiling: float
    may_soften: bool = True
    residual: float = 0.0
    status: Status = Status.CONVERGED
    seen: str = ""
    rejected: int = 0
    pseudo_failed: int = 0
    stiffness: Mapping[float, tuple[FloatArray, ...]] = field(default_factory=dict)
    smooth_from: int = 0  # the first state after the last jump: nothing is extrapolated across it

    def follow(self, callback: Callable[[float], None] | None) -> Problem | None:
        """Follow the load; return the problem with softer sticking where it must be followed again with that, else None."""
        settings, states = self.newton.settings, self.states
        while states[-1].load < 1.0 - 1e-12:
            last, penalties = states[-1], self.newton.problem
            passed = next((h for h in reversed(self.warm_start) if h[0] <= last.load + 1e-9), None)
            ahead = next((h for h in self.warm_start if h[0] > last.load + 1e-9), None)
            if ahead is not None:
                self.newton.problem = with_normal_stiffness(penalties, self.stiffness.get(ahead[0], ()))
            most = settings.max_total_iterations
            if most is not None and self.newton.iterations >= most * (min(1.0, last.load + AHEAD) if self.warm_start else 1.0):
                self.status = Status.ITERATION_LIMIT
                return None
            load = min(1.0, last.load + min(self.step, self.ceiling)) if ahead is None else min(ahead[0], last.load + self.step)
            found, iterations = self._solved(load, passed, ahead)
            penetrated = found is not None and (found := without_penetration(self.newton, found, last.anchors, load)) is None
            if found is None:
                self.rejected += 1
                self.newton.problem = penalties
                if self.may_soften and self.rejected == PATIENCE and (softer := with_softer_sticking(penalties)) is not None:
                    return softer
                self.step = 0.5 * (load - last.load)
                self.ceiling = 1.6 * self.step
                if self.step < settings.smallest_step or self.pseudo_failed >= PSEUDO_FAILURES:
                    self.status, self.seen = failure_reason(self.newton, last.displacement, last.anchors, load, penetrated=penetrated)
                    return None
                continue
            self.residual = found[1]
            states.append(advanced(self.newton.problem, found[0], last.anchors, load))
            self.newton.problem = _from_state(self.newton.problem, states[-1])
            if ahead is not None:
                self.step = min(1.0, 2.0 * self.step)
            else:
                self.ceiling = min(settings.largest_step, 1.25 * self.ceiling)
                self.step = min(self.ceiling, self.step * _growth(iterations))
            if callback is not None:
                callback(load)
        return None

    def _solved(self, load: float, passed: WarmStart | None, ahead: WarmStart | None) -> tuple[tuple[FloatArray, float] | None, int]:
        """Return equilibrium at `load` and its residual, None where there is none, and the iterations of the last guess."""
        newton, last, found, before = self.newton, self.states[-1], None, 0
        guesses = _guesses(self.states[self.smooth_from :], load, passed, ahead)
        if len(guesses) > 1:  # states of a similar problem may penetrate bodies
            guesses.sort(key=lambda guess: newton.unbalanced(guess, last.anchors, load))
        for guess in guesses:
            before = newton.iterations
            found = newton.solve(guess, last.anchors, load)
            if found is not None:
                break
        if found is None and lips_of(newton.problem.assembler):
            found = with_kept_normals(newton, guesses[0], last, load)
        if found is None and load - last.load < PSEUDO_TRANSIENT_STEP * newton.settings.first_step:
            found = newton.pseudo_transient(last.displacement, last.anchors, load)
            if found is None:
                self.pseudo_failed += 1
            elif _jumped(self.states, found[0], load):
                self.smooth_from = len(self.states)
                return found, int(USUAL_ITERATIONS)
        return found, newton.iterations - before


def with_kept_normals(newton: Newton, guess: FloatArray, last: LoadState, load: float) -> tuple[FloatArray, float] | None:
    """Return equilibrium, and its residual, of a body whose sides of cuts keep their normals while it is sought; None where there is none.

    The tangent of sides in contact leaves out that their normals turn. Where they press with more than the shear modulus, as in nearly
    incompressible bodies between walls, Newton's method with it does not converge. Here the normals are those of the last state, then those
    of the equilibrium found with them, until it does not change.
    """
    turning, found, least = newton.problem, None, np.inf
    for _ in range(TURNS):
        before = last.displacement if found is None else found[0]
        newton.problem = turning.with_changes(assembler=turning.assembler.in_step(before, last.lips))
        found = newton.solve(guess if found is None else found[0], last.anchors, load)
        newton.problem = turning
        if found is None:
            return None
        left = newton.unbalanced(found[0], last.anchors, load)
        if left <= max(SETTLED, newton.settings.tolerance_at(load)):
            return found[0], left
        if left > CALMING * least:
            return None
        least = left
    return None


def _from_state(problem: Problem, state: LoadState) -> Problem:
    """Return the problem with which one goes on from a state: the sides of cuts that rub on each other know how they slipped."""
    assembler = going_on(problem.assembler, state.lips)
    return problem if assembler is problem.assembler else problem.with_changes(assembler=assembler)


def _jumped(states: list[LoadState], u: FloatArray, load: float) -> bool:
    """Tell whether the way from the last state to `u` (n, 3), mm, at `load` is much longer than that before lets expect."""
    last = states[-1]
    if len(states) < 2:
        return False
    rate = float(np.abs(last.displacement - states[-2].displacement).max()) / (last.load - states[-2].load)
    return float(np.abs(u - last.displacement).max()) > JUMP * rate * (load - last.load)


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


def without_penetration(
    newton: Newton, found: tuple[FloatArray, float], anchors: tuple[FloatArray, ...], load: float
) -> tuple[FloatArray, float] | None:
    """Raise the penalties of contact until no body penetrates too deeply; return equilibrium and its residual, None where there is none.

    Parameters
    ----------
    newton : Newton
        Solver, whose problem gets the raised penalties.
    found : tuple
        Equilibrium (n, 3), mm, with the present penalties, and its residual.
    anchors : tuple of ndarray, shape (p, 3)
        Frictional anchors of the points of every contact, mm.
    load : float
        Fraction of the load.
    """
    allowed, now = newton.settings.penetration, found
    for _ in range(MOST_RAISES):
        depths = relative_penetrations(newton.problem.contacts, now[0], load)
        if max((float(d.max()) for d in depths), default=0.0) <= allowed:
            return now
        newton.problem = stiffened(newton.problem, depths, allowed)
        again = newton.solve(now[0], anchors, load) or newton.pseudo_transient(now[0], anchors, load)
        if again is None:
            return None
        now = again
    return None


def advanced(problem: Problem, u: FloatArray, anchors: tuple[FloatArray, ...], load: float) -> LoadState:
    """Return the converged state with displacement `u` (n, 3), mm, and the anchors for the next load step."""
    moved = tuple(c.next_anchors(c.evaluate(u, a, load)) for c, a in zip(problem.contacts, anchors, strict=True))
    lips = next((some.anchors_behind(u) for some in lips_of(problem.assembler) if some.friction > 0.0), None)
    return LoadState(load, u, moved, tuple(c.normal_stiffness for c in problem.contacts), lips)


def finished(newton: Newton, states: list[LoadState], residual: float, status: Status, throw: bool, seen: str = "") -> Solution:
    """Return the solution that ends with the last of `states`, with its reactions; `seen` is what the message tells beside the status.

    Raises
    ------
    ConvergenceError
        `status` is not converged (only with `throw`).
    """
    if throw and not status.ok:
        raise ConvergenceError(f"stopped at {100 * states[-1].load:.1f} % of the load. {status.value} {seen}".rstrip())
    problem, last = newton.problem, states[-1]
    reactions: dict[str, FloatArray] = {}
    penetration, relative = 0.0, 0.0
    contact = np.zeros_like(last.displacement)
    anchors = states[-2].anchors if len(states) > 1 else last.anchors
    for c, a in zip(problem.contacts, anchors, strict=True):
        response = c.evaluate(last.displacement, a, last.load)
        nodal = c.scattered(response.force, len(contact), response.orientation)
        contact += nodal
        reactions[c.name] = (response.force @ response.orientation.T).sum(axis=0)
        penetration = max(penetration, float(-response.gap.min()))
        relative = max(relative, float((-response.gap / c.element_size).max()))
    internal = problem.assembler.forces(last.displacement)[1]
    constrained = problem.prescribed.constrained
    reactions["prescribed"] = np.where(constrained, internal - contact - problem.external_force, 0.0).sum(axis=0)
    name = newton.solver.name if newton.solver is not None else "none"
    return Solution(tuple(states), status, reactions, newton.iterations, residual, penetration, relative, newton.continued, name, problem)
