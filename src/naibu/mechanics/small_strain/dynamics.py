"""Dynamics of linear viscoelastic bodies under time-dependent supports and loads :cite:p:`hirai2008` (chapter 2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.finite_elements.linear_simplices import connection_matrices, per_cell
from naibu.mechanics.small_strain._rheology_kernels import elastic_energy
from naibu.mechanics.small_strain.constraint_stabilization import Stabilization
from naibu.mechanics.small_strain.generalized_alpha import GeneralizedAlpha
from naibu.mechanics.small_strain.implicit_integrators import BackwardEuler, Integrator, MotionState, Phase, Sdirk2
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.mechanics.small_strain.mass_matrix import Mass, mass_of
from naibu.mechanics.small_strain.rheology import CellRheology, Rheology
from naibu.mechanics.small_strain.runge_kutta import RungeKutta4, RungeKuttaFehlberg
from naibu.mechanics.small_strain.supports import ActiveSupports, Support

METHODS = ("sdirk2", "backward_euler", "generalized_alpha", "rk4", "rkf45")
Load = Callable[[float], FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Time series of a motion.

    Attributes
    ----------
    times : ndarray, shape (k,)
        s.
    displacement, velocity : ndarray, shape (k, n, d)
        mm and mm/s. Where the velocity of a support jumps, the one just before.
    reaction : ndarray, shape (k, n, d)
        Forces of the supports on the nodes, mN; the multipliers of constraint stabilisation.
    kinetic, elastic, work : ndarray, shape (k,)
        Kinetic energy, elastic energy, and work of supports and loads so far, mN mm.
    supports : tuple of Support
        As given.
    final : MotionState
        Last state, from which `simulate_motion` can continue.
    method : str
        Name of the integration method.
    steps, factorizations : int
        Numbers of time steps and of factorizations.
    """

    times: FloatArray
    displacement: FloatArray
    velocity: FloatArray
    reaction: FloatArray
    kinetic: FloatArray
    elastic: FloatArray
    work: FloatArray
    supports: tuple[Support, ...]
    final: MotionState
    method: str
    steps: int
    factorizations: int

    @property
    def dissipated(self) -> FloatArray:
        """Energy dissipated in dashpots, and numerically, since the first time (k,), mN mm."""
        stored = self.kinetic + self.elastic
        return np.asarray(self.work - self.work[0] - (stored - stored[0]))

    def force(self, name: str) -> FloatArray:
        """Return the force (k, d), mN, of the support called `name` on the body; zero while it is inactive.

        Raises
        ------
        InputError
            There is no such support.
        """
        for support in self.supports:
            if support.name == name:
                acts = (self.times > support.start_s) & (self.times <= support.end_s)
                axes = np.ones(self.reaction.shape[2]) if support.axes is None else np.zeros(self.reaction.shape[2])
                axes[list(support.axes or ())] = 1.0
                return np.asarray(self.reaction[:, support.nodes].sum(axis=1) * axes * acts[:, None])
        raise InputError(f"no support is called {name!r}; there are {', '.join(s.name for s in self.supports) or 'none'}")


def simulate_motion(
    body: LinearBody,
    materials: Rheology | CellRheology,
    density: ArrayLike | None,
    supports: Sequence[Support],
    times: ArrayLike,
    *,
    step: float | None = None,
    method: str = "sdirk2",
    mass: str = "lumped",
    load: ArrayLike | Load | None = None,
    breaks: Sequence[float] = (),
    initial: MotionState | None = None,
    stabilization: float | None = None,
    spectral_radius: float = 0.8,
    tolerance: float = 1e-6,
) -> Series:
    """Simulate the motion of a viscoelastic body.

    Parameters
    ----------
    body : LinearBody
        Mesh of lines, triangles or tetrahedra.
    materials : Rheology or CellRheology
        One for all cells, or a table.
    density : array_like or None
        kg/mm^3 (water: 1e-6), one number or one a cell; None neglects inertia (quasi-static).
    supports : sequence of Support
        Constrained nodes, their prescribed motion and when it applies.
    times : array_like, shape (k,)
        Increasing output times, s; the simulation starts at the first.
    step : float, optional
        Longest step, s; by default the spacing of `times`. Steps also end wherever a support or its speed changes.
    method : {"sdirk2", "backward_euler", "generalized_alpha", "rk4", "rkf45"}
        See `naibu.mechanics.small_strain.implicit_integrators`.
    mass : {"lumped", "consistent"}
        Mass matrix.
    load : array_like, shape (n, d), or callable, optional
        Forces on the nodes, mN, constant or as a function of time.
    breaks : sequence of float
        Times, s, at which the load jumps.
    initial : MotionState, optional
        Initial state; the reference configuration at rest by default.
    stabilization : float, optional
        Frequency, 1/s, of constraint stabilisation; supports are enforced exactly by default.
    spectral_radius : float
        Spectral radius at infinite frequency of ``"generalized_alpha"``.
    tolerance : float
        Relative local error of ``"rkf45"``.

    Returns
    -------
    Series
        Displacements, velocities, reactions and energies.

    Raises
    ------
    InputError
        An argument that cannot be used; a body without inertia whose rigid-body motions are not constrained.
    ConvergenceError
        Unstable explicit integration.
    """
    integrator = _integrator(method, spectral_radius, tolerance)
    return integrate_motion(
        integrator, body, materials, density, supports, times,
        step=step, mass=mass, load=load, breaks=breaks, initial=initial, stabilization=stabilization,
    )  # fmt: skip


def integrate_motion(
    integrator: Integrator,
    body: LinearBody,
    materials: Rheology | CellRheology,
    density: ArrayLike | None,
    supports: Sequence[Support],
    times: ArrayLike,
    *,
    step: float | None = None,
    mass: str = "lumped",
    load: ArrayLike | Load | None = None,
    breaks: Sequence[float] = (),
    initial: MotionState | None = None,
    stabilization: float | None = None,
) -> Series:
    """Simulate the motion of a viscoelastic body by a given integrator; other arguments as in `simulate_motion`."""
    output = _checked_times(times, step)
    law = CellRheology.of(body.simplices.n_cells, materials)
    inertia = None if density is None else mass_of(body, density, mass)
    if inertia is None and (integrator.needs_inertia or stabilization is not None):
        raise InputError("density=None needs method 'sdirk2' or 'backward_euler', without constraint stabilisation")
    names = [s.name for s in supports]
    if len(set(names)) < len(names):
        raise InputError(f"supports need different names, not {', '.join(names)}")
    rule = None if stabilization is None else Stabilization(stabilization)
    run = _Run(body, law, inertia, _as_function(load, body.points.shape), tuple(supports), integrator, rule)
    kept = run.through(output, _longest(output, step), _checked_breaks(breaks), _start(body, initial, float(output[0])))
    return Series(
        times=output,
        displacement=np.array([s.displacement for s in kept]),
        velocity=np.array([s.velocity for s in kept]),
        reaction=np.array([s.reaction for s in kept]),
        kinetic=np.array([0.0 if inertia is None else 0.5 * float((s.velocity * inertia.apply(s.velocity)).sum()) for s in kept]),
        elastic=np.array([elastic_energy(body.simplices, law, s.trace, s.strain) for s in kept]),
        work=np.array([s.work for s in kept]),
        supports=tuple(supports),
        final=kept[-1],
        method=integrator.name,
        steps=integrator.steps,
        factorizations=integrator.factorizations.made,
    )


def explicit_step_limit(body: LinearBody, materials: Rheology | CellRheology, density: ArrayLike) -> float:
    """Return a step, s, with which ``"rk4"`` is stable, from the fastest mode of any single cell with its lumped mass.

    The largest eigenvalue of an assembled body is at most the largest of its cells, so the limit is conservative.
    """
    cells = body.simplices
    law = CellRheology.of(cells.n_cells, materials)
    lame, shear = connection_matrices(cells)
    mass = per_cell(density, cells.n_cells, "density") * cells.measures / (cells.dimension + 1)
    stiff = law.spring * law.viscosity_ratio
    fastest = [np.linalg.eigvalsh(m[:, 0, None, None] * lame + m[:, 1, None, None] * shear)[:, -1] / mass for m in (stiff, law.dashpot)]
    rate, damping = np.maximum(fastest[0], 0.0), 0.5 * np.maximum(fastest[1], 0.0)
    return float(2.6 / (damping + np.sqrt(damping**2 + rate)).max())


class _Run:
    """One simulation in progress."""

    def __init__(
        self, body: LinearBody, law: CellRheology, mass: Mass | None, load: Load, supports: tuple[Support, ...],
        integrator: Integrator, rule: Stabilization | None,
    ) -> None:  # fmt: skip
        self.body, self.law, self.mass, self.load = body, law, mass, load
        self.flow = law.flow()
        self.supports, self.integrator, self.rule = supports, integrator, rule
        self.offsets: dict[str, FloatArray] = {}
        self.state = MotionState.at_rest(body.simplices)
        self.active: tuple[Support, ...] | None = None

    def through(self, output: FloatArray, longest: float, breaks: list[float], start: MotionState) -> list[MotionState]:
        """Step from event to event and keep the states at the output times."""
        self.state = start
        events = sorted({t for s in self.supports for t in s.events()} | set(breaks))
        events = [t for t in events if output[0] < t < output[-1]]
        stops = _merged(output, events)
        abrupt = {float(output[0]), *events}
        phase, kept = None, [start]
        self.integrator.record(start)
        for begin, end, wanted in zip(stops[:-1], stops[1:], [stop[1] for stop in stops[1:]], strict=True):
            span = end[0] - begin[0]
            count = max(1, int(np.ceil(span / longest * (1.0 - 1e-9))))
            active = tuple(s for s in self.supports if s.acts_at(0.5 * (begin[0] + end[0])))
            changed = begin[0] in breaks
            if phase is None or active != self.active:
                phase, changed = self._phase(active), True
            phase = replace(phase, load=_within(self.load, begin[0], end[0]))
            if begin[0] in abrupt:
                self.state = self.integrator.begin(phase, self.state, span / count, changed)
            for i in range(1, count + 1):
                until = end[0] if i == count else begin[0] + span * i / count
                self.state = self.integrator.step(phase, self.state, until)
            if wanted:
                kept.append(self.state)
                self.integrator.record(self.state)
        return kept

    def _phase(self, active: tuple[Support, ...]) -> Phase:
        for support in active:
            if support.relative and (self.active is None or support not in self.active):
                path = support.motion.displacement(self.state.time) if support.motion is not None else 0.0
                self.offsets[support.name] = self.state.displacement[support.nodes] - path
        self.active = active
        supports = ActiveSupports(active, self.body.points.shape, self.offsets)
        return Phase(self.body, self.law, self.flow, self.mass, self.load, supports, self.rule)


def _within(load: Load, begin: float, end: float) -> Load:
    """Return the load with times kept just inside an interval, at whose ends it may jump."""
    margin = 1e-9 * (end - begin)
    return lambda time: load(min(max(time, begin + margin), end - margin))


def _merged(output: FloatArray, events: list[float]) -> list[tuple[float, bool]]:
    """Return all times at which steps end, and whether they are output times; an event replaces an output time that it rounds to."""
    close = 1e-10 * float(output[-1] - output[0])
    stops = [(float(t), True) for t in output]
    for event in events:
        i = int(np.argmin(np.abs(output - event)))
        if abs(float(output[i]) - event) <= close:
            stops[i] = (event, True)
        else:
            stops.append((event, False))
    return sorted(stops)


def _integrator(method: str, spectral_radius: float, tolerance: float) -> Integrator:
    if method not in METHODS:
        raise InputError(f"method={method!r} is not known; use one of {', '.join(METHODS)}")
    if method == "generalized_alpha":
        return GeneralizedAlpha(spectral_radius)
    if method == "rkf45":
        return RungeKuttaFehlberg(tolerance)
    if method == "backward_euler":
        return BackwardEuler()
    return RungeKutta4() if method == "rk4" else Sdirk2()


def _checked_times(times: ArrayLike, step: float | None) -> FloatArray:
    output = np.array(times, dtype=float)
    if output.ndim != 1 or len(output) < 2 or not np.isfinite(output).all() or not (np.diff(output) > 0.0).all():
        raise InputError("times must be two or more finite numbers, s, that increase")
    if step is not None and not step > 0.0:
        raise InputError(f"step must be positive, not {step:g} s")
    return output


def _longest(output: FloatArray, step: float | None) -> float:
    return float(np.diff(output).min()) if step is None else step


def _checked_breaks(breaks: Sequence[float]) -> list[float]:
    if not np.isfinite(np.asarray(breaks, dtype=float)).all():
        raise InputError("breaks must be finite times, s")
    return [float(t) for t in breaks]


def _start(body: LinearBody, initial: MotionState | None, time: float) -> MotionState:
    cells = body.simplices
    if initial is None:
        return MotionState.at_rest(cells, time)
    d = cells.dimension
    shapes = [initial.displacement.shape, initial.velocity.shape, initial.trace.shape, initial.strain.shape]
    if shapes != [body.points.shape, body.points.shape, (cells.n_cells,), (cells.n_cells, d, d)]:
        raise InputError("initial is the state of another body")
    if abs(initial.time - time) > 1e-9 * max(1.0, abs(time)):
        raise InputError(f"initial is the state at {initial.time:g} s, but times start at {time:g} s")
    return initial


def _as_function(load: ArrayLike | Load | None, shape: tuple[int, ...]) -> Load:
    if callable(load):
        given: Load = load

        def checked(time: float) -> FloatArray:
            value = np.asarray(given(time), dtype=float)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError(f"load at {time:g} s must be finite forces of shape {shape}, mN")
            return value

        return checked
    constant = np.zeros(shape) if load is None else np.asarray(load, dtype=float)
    if constant.shape != shape or not np.isfinite(constant).all():
        raise InputError(f"load must be finite forces of shape {shape}, mN, not an array of shape {constant.shape}")
    return lambda _: constant
