"""Implicit time integration of linear viscoelastic bodies, with one factorization for each step size.

Every implicit method integrates the internal strain exactly for a constant strain rate (an exponential, see
`naibu.mechanics.small_strain.rheology`), which leaves ``(M / h + K) v = ...`` with one stiffness K for all steps of one length: it is
factorized once, and a step is a pass over the cells and a back-substitution for each stage.

``"sdirk2"``, the default
    Singly diagonally implicit Runge-Kutta method of two stages of length ``g h``, ``g = 1 - 1/sqrt(2)`` :cite:p:`alexander1977`. Second
    order and L-stable: energy does not grow at any step length, and modes that the steps do not resolve are damped. (For internal strains
    advanced by the method's own rational function this is von Neumann's theorem on A-stable methods; for the exponential it is tested on
    random mixtures.)
``"backward_euler"``
    First order; the same stability, more damping.
``"generalized_alpha"``
    Second order with adjustable numerical dissipation :cite:p:`chung1993`; stable, but energy overshoots after a start or a jump that the
    steps do not resolve. Needs inertia.
``"rk4"`` and ``"rkf45"``
    The explicit methods of :cite:t:`hirai2008` (chapters 2 and 5): the classical Runge-Kutta method with the given step, and
    Runge-Kutta-Fehlberg with step size control :cite:p:`fehlberg1969`. Their steps are limited by the stiffest cell
    (`naibu.mechanics.small_strain.dynamics.explicit_step_limit`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.mechanics.finite_elements.linear_simplices import Simplices
from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows
from naibu.mechanics.linear_algebra.direct import direct_solver
from naibu.mechanics.linear_algebra.protocols import Factorization
from naibu.mechanics.linear_algebra.solver_selection import DIRECT_LIMIT, choose_solver
from naibu.mechanics.small_strain._rheology_kernels import advanced, stage_forces
from naibu.mechanics.small_strain.constraint_stabilization import Stabilization
from naibu.mechanics.small_strain.linear_elasticity import LinearBody, require_constrained
from naibu.mechanics.small_strain.mass_matrix import Mass
from naibu.mechanics.small_strain.rheology import CellRheology, FlowCoefficients, StepCoefficients
from naibu.mechanics.small_strain.supports import ActiveSupports

STAGE = 1.0 - np.sqrt(0.5)
INSTANT = 1e-8  # of a step: duration of a jump of a body without inertia
KEPT = 8  # factorizations in the cache


@dataclass(frozen=True, slots=True, eq=False)
class MotionState:
    """State of a body in motion: displacement, velocity and internal strain, with reactions and work.

    Attributes
    ----------
    time : float
        s.
    displacement, velocity : ndarray, shape (n, d)
        mm and mm/s.
    trace, strain : ndarray, shape (m,) and (m, d, d)
        Internal strain, that of the Voigt parts: trace for the lambda part, tensor for the mu part.
    reaction : ndarray, shape (n, d)
        Forces of the supports on the body, mN.
    work : float
        Work of supports and loads so far, mN mm.
    """

    time: float
    displacement: FloatArray
    velocity: FloatArray
    trace: FloatArray
    strain: FloatArray
    reaction: FloatArray
    work: float

    @classmethod
    def at_rest(cls, body: Simplices, time: float = 0.0) -> MotionState:
        """Return the reference configuration at rest."""
        zero, d = np.zeros((body.n_points, body.dimension)), body.dimension
        return cls(time, zero, zero, np.zeros(body.n_cells), np.zeros((body.n_cells, d, d)), zero, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Phase:
    """The equations of motion while the same supports are active.

    Attributes
    ----------
    body : LinearBody
        Geometry.
    law : CellRheology
        Materials.
    flow : FlowCoefficients
        Rate equations of their internal strain.
    mass : Mass or None
        Mass matrix; None for a quasi-static body.
    load : callable
        From a time, s, to the forces on the nodes (n, d), mN.
    supports : ActiveSupports
        Constrained components and their prescribed motion.
    stabilization : Stabilization or None
        How supports are enforced; None: exactly, by elimination of the constrained components.
    """

    body: LinearBody
    law: CellRheology
    flow: FlowCoefficients
    mass: Mass | None
    load: Callable[[float], FloatArray]
    supports: ActiveSupports
    stabilization: Stabilization | None

    def momentum(self, velocity: FloatArray) -> FloatArray:
        """Return the momentum (n, d), zero where there is no inertia."""
        return np.zeros_like(velocity) if self.mass is None else self.mass.apply(velocity)

    def constrained_acceleration(self, time: float, side: int, displacement: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return the acceleration (n, d), mm/s^2, of the constrained components; meaningless elsewhere."""
        second = self.supports.acceleration(time)
        if self.stabilization is None:
            return second
        gap, gap_rate = displacement - self.supports.displacement(time), velocity - self.supports.velocity(time, side)
        return self.stabilization.acceleration(gap, gap_rate, second)


class Factorizations:
    """Cache of factorized step matrices, by constrained components and step length.

    Attributes
    ----------
    made : int
        Number of factorizations so far.
    """

    def __init__(self) -> None:
        self.made = 0
        self._kept: OrderedDict[tuple[bytes, str], Factorization] = OrderedDict()
        self._steps: OrderedDict[str, StepCoefficients] = OrderedDict()

    def over(self, law: CellRheology, step_s: float) -> StepCoefficients:
        """Return the step coefficients of the internal strain; computed once for steps of one length."""
        key = f"{step_s:.10g}"
        if key not in self._steps:
            self._steps[key] = law.over(step_s)
            if len(self._steps) > 3 * KEPT:
                self._steps.popitem(last=False)
        return self._steps[key]

    def of(self, phase: Phase, name: str, moduli: FloatArray, mass_factor: float) -> Factorization:
        """Return the factorization of ``K(moduli) + mass_factor M`` with the constrained components eliminated.

        Raises
        ------
        InputError
            A body without inertia whose rigid-body motions are not constrained.
        """
        constrained = phase.supports.constrained
        key = constrained.tobytes(), name
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        matrix = phase.body.stiffness(moduli[:, 0], moduli[:, 1])
        if phase.mass is None:
            require_constrained(phase.body.points, constrained)
        else:
            phase.mass.add_to(matrix, mass_factor)
        matrix = with_dirichlet_rows(matrix, constrained)
        if matrix.shape[0] > DIRECT_LIMIT and phase.body.points.shape[1] == 3:
            solver = choose_solver(matrix, phase.body.points, constrained, symmetric=True)
        else:
            solver = direct_solver(matrix, symmetric=True)
        self.made += 1
        self._kept[key] = solver.factorize(matrix)
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return self._kept[key]


class Integrator(ABC):
    """A time integration method; `begin` is called where supports or loads change abruptly, then `step` as often as needed."""

    name = ""
    needs_inertia = False

    def __init__(self) -> None:
        self.factorizations = Factorizations()
        self.steps = 0

    def begin(self, phase: Phase, state: MotionState, step_s: float, changed: bool) -> MotionState:
        """Return the state just after an event.

        Constrained nodes take on the velocity of their supports by an impulse. `changed` is true where supports or loads changed, not only
        a velocity.
        """
        if phase.mass is None or phase.stabilization is not None:
            return state
        constrained = phase.supports.constrained
        change = np.where(constrained, phase.supports.velocity(state.time, 1) - state.velocity, 0.0)
        if not change.any():
            return state
        velocity = state.velocity + phase.mass.accelerations(np.zeros_like(change), constrained, change)
        before, after = (0.5 * float((v * phase.mass.apply(v)).sum()) for v in (state.velocity, velocity))
        return replace(state, velocity=velocity, work=state.work + after - before)

    def record(self, state: MotionState) -> None:  # noqa: B027 - most methods have nothing to record
        """Record a state at an output time."""

    @abstractmethod
    def step(self, phase: Phase, state: MotionState, until: float) -> MotionState:
        """Return the state at the time `until`, s."""


class Staged(Integrator):
    """Base of the methods with backward-Euler stages."""

    def begin(self, phase: Phase, state: MotionState, step_s: float, changed: bool) -> MotionState:
        """Return the state just after an event; a body without inertia whose supports or loads changed jumps to its new equilibrium."""
        if phase.mass is not None or not changed:
            return super().begin(phase, state, step_s, changed)
        instant, constrained, load = INSTANT * step_s, phase.supports.constrained, phase.load(state.time)
        known = (phase.supports.displacement(state.time) - state.displacement) / instant
        if not (known[constrained].any() or state.reaction.any() or load.any() or state.strain.any()):
            return state
        start = state.displacement, np.zeros_like(state.velocity), state.trace, state.strain
        self._expect(phase, instant)
        velocity, trace, strain, reaction, _ = self._stage(phase, start, instant, state.time, known)
        moved = instant * velocity
        mean = np.where(constrained, 0.5 * (state.reaction + reaction), 0.0) + load
        work = state.work + float((moved * mean).sum())
        return _ended(phase, state.time, state.displacement + moved, state.velocity, trace, strain, reaction, work)

    def _expect(self, phase: Phase, span: float) -> None:
        """Prepare for stages after which constrained components are back on their prescribed motion, within this time, s."""

    def _stage(
        self,
        phase: Phase,
        start: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
        h: float,
        until: float,
        known: FloatArray,
        ahead: StepCoefficients | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]:
        """Return velocity, internal strain (over `ahead`, if given, instead of h), reaction and power of a stage."""
        _, before, trace, strain = start
        constrained, over = phase.supports.constrained, self.factorizations.over(phase.law, h)
        body, load = phase.body.simplices, phase.load(until)
        guess = np.where(constrained, known, before)
        residual = phase.momentum(guess - before) / h + stage_forces(body, over, guess, trace, strain) - load
        residual[constrained] = 0.0
        velocity = guess - self._factor(phase, h).solve(residual.ravel()).reshape(guess.shape)
        force, new_trace, new_strain = advanced(body, over, velocity, trace, strain, ahead)
        acceleration = (velocity - before) / h
        reaction = np.where(constrained, phase.momentum(acceleration) + force - load, 0.0)
        power = float((velocity * (reaction + load)).sum())
        if ahead is None and phase.stabilization is None and phase.mass is not None:
            reaction = np.where(constrained, phase.mass.apply(_on_path(phase, until, acceleration)) + force - load, 0.0)
        return velocity, new_trace, new_strain, reaction, power

    def _factor(self, phase: Phase, h: float) -> Factorization:
        return self.factorizations.of(phase, f"stage {h:.8g}", self.factorizations.over(phase.law, h).effective, 1.0 / h)


class BackwardEuler(Staged):
    """Backward Euler method: one stage a step."""

    name = "backward_euler"

    def step(self, phase: Phase, state: MotionState, until: float) -> MotionState:
        """Return the state at `until`."""
        h = until - state.time
        start = state.displacement, state.velocity, state.trace, state.strain
        if phase.stabilization is None:
            known = (phase.supports.displacement(until) - state.displacement) / h
        else:
            known = _stabilized(phase, phase.stabilization, start, h, until)
        self._expect(phase, h)
        velocity, trace, strain, reaction, power = self._stage(phase, start, h, until, known)
        self.steps += 1
        return _ended(phase, until, state.displacement + h * velocity, velocity, trace, strain, reaction, state.work + h * power)


class Sdirk2(Staged):
    """SDIRK2 method: two backward-Euler stages a step."""

    name = "sdirk2"

    def step(self, phase: Phase, state: MotionState, until: float) -> MotionState:
        """Return the state at `until`."""
        h, exact = until - state.time, phase.stabilization is None
        first, rest, middle = STAGE * h, (1.0 - STAGE) * h, state.time + STAGE * h
        start = state.displacement, state.velocity, state.trace, state.strain
        known = second = np.zeros_like(state.displacement)
        if exact:  # stage velocities whose quadrature is the prescribed motion, exact for constant acceleration
            mean = (phase.supports.displacement(until) - state.displacement) / h
            change = phase.supports.velocity(until, -1) - phase.supports.velocity(state.time, 1)
            known, second = mean + (STAGE - 0.5) * change, mean + 0.5 * change
        elif phase.stabilization is not None:
            known = _stabilized(phase, phase.stabilization, start, first, middle)
        ahead = self.factorizations.over(phase.law, rest)
        self._expect(phase, h)
        velocity, trace, strain, _, power = self._stage(phase, start, first, middle, known, ahead)
        extrapolated = state.velocity + rest / first * (velocity - state.velocity)
        work = state.work + rest * power
        start = state.displacement + rest * velocity, extrapolated, trace, strain
        if phase.stabilization is not None:
            second = _stabilized(phase, phase.stabilization, start, first, until)
        velocity, trace, strain, reaction, power = self._stage(phase, start, first, until, second)
        self.steps += 1
        return _ended(phase, until, start[0] + first * velocity, velocity, trace, strain, reaction, work + first * power)


def _stabilized(phase: Phase, rule: Stabilization, start: tuple[FloatArray, ...], h: float, until: float) -> FloatArray:
    supports = phase.supports
    path = supports.displacement(until), supports.velocity(until, -1), supports.acceleration(until)
    return rule.stage_velocity((start[0], start[1]), h, path)


def _on_path(phase: Phase, time: float, acceleration: FloatArray) -> FloatArray:
    """Return accelerations (n, d) with those of constrained nodes replaced by the prescribed ones, and the free ones corrected accordingly.

    Stage velocities of a prescribed motion are second-order accurate, their difference quotients are not.
    """
    constrained = phase.supports.constrained
    wrong = np.where(constrained, phase.supports.acceleration(time) - acceleration, 0.0)
    if phase.mass is None or not wrong.any():
        return acceleration
    return acceleration + phase.mass.accelerations(np.zeros_like(wrong), constrained, wrong)


def _ended(
    phase: Phase,
    time: float,
    displacement: FloatArray,
    velocity: FloatArray,
    trace: FloatArray,
    strain: FloatArray,
    reaction: FloatArray,
    work: float,
) -> MotionState:
    if phase.stabilization is None:  # no drift by rounding
        displacement = np.where(phase.supports.constrained, phase.supports.displacement(time), displacement)
    return MotionState(time, displacement, velocity, trace, strain, reaction, work)
