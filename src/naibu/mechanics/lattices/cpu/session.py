"""Sessions: lattices in loops that ask for a few steps at a time, without any conversion of the state between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from types import TracebackType
from typing import Protocol
from weakref import finalize

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.contact.indenter_motion import IndenterForce, IndenterMotion, indenter_velocities
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.contact.session_protocol import StepForces
from naibu.mechanics.lattices.cpu.contact.stepper import ContactStepper, DrivenIndenter
from naibu.mechanics.lattices.cpu.stepper import Stepper
from naibu.mechanics.lattices.model.contact_state import ContactState, begin_contact
from naibu.mechanics.lattices.model.contact_surface import ContactSurface
from naibu.mechanics.lattices.model.lattice import Lattice
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState, Method, checked_velocity, require_constrained

CHECK_EVERY = 200  # explicit steps between two checks whether they diverged
BALANCE = 1e-3  # error of the balance of a driven indenter, as a fraction of the largest force


class SteppedEngine(Protocol):
    """What a session needs of `naibu.mechanics.lattices.cpu.engine.LatticeEngine`."""

    @property
    def lattice(self) -> Lattice:
        """Nodes and elements."""

    @property
    def step(self) -> float:
        """Length of a step, s."""

    @property
    def method(self) -> Method:
        """Method of integration."""

    def rest(self) -> LatticeState:
        """Return the lattice in the reference configuration."""

    def stepper(self, state: LatticeState, external_force: ArrayLike | None = None) -> Stepper:
        """Return a stepper that begins at a state."""

    def state(self, stepper: Stepper) -> LatticeState:
        """Return a copy of the state that a stepper has reached."""

    def check(self, stepper: Stepper, steps: int) -> None:
        """Check that explicit steps did not diverge."""

    def surface(self) -> ContactSurface:
        """Return the faces that indenters may touch."""

    def in_contact(self, stepper: Stepper, indenters: Sequence[RigidIndenter], contact: ContactState) -> ContactStepper:
        """Return what takes the steps of a stepper with indenters beside the lattice."""


@dataclass(slots=True, eq=False, weakref_slot=True)
class LatticeSession:
    """A lattice in motion, stepped by a loop; made by `LatticeEngine.session`.

    It takes the steps that `LatticeEngine.run` takes, with the same results to the last bit, and those in contact with rigid indenters,
    which it keeps with the state of their contacts. An engine of several threads splits an explicit step into as many parts; workers of a
    thread pool take parts while the steps keep the calling thread busy most of the time, and the calling thread takes what they leave. The
    result depends on the number of threads of the engine only, not on who computed a part.

    Sessions of one engine can be stepped in several Python threads at once, each in one.

    Attributes
    ----------
    engine : LatticeEngine
        Lattice, parameters, step and method.
    stepper : Stepper
        State as the kernels hold it.
    constrained : ConstrainedNodes
        Nodes that bodies move.
    bodies : int
        Number of these bodies.
    indenters : tuple of RigidIndenter
        In contact.
    steps : int
        Steps taken.
    iterations : int
        Iterations of the implicit solver in all of them.
    rotation_limited : int
        Implicit steps in which the stretching by rotation was limited.
    unsettled : int
        Steps whose contacts did not settle; each kept what the last pass gave.
    speed : ndarray, shape (k, 3)
        Velocities of the indenters at the end of the last step, mm/s.
    clock : callable
        Returns the time, s.
    """

    engine: SteppedEngine
    stepper: Stepper
    external_force: ArrayLike | None = None
    constrained: ConstrainedNodes = field(default_factory=ConstrainedNodes.none)
    bodies: int = 0
    indenters: tuple[RigidIndenter, ...] = ()
    steps: int = 0
    iterations: int = 0
    rotation_limited: int = 0
    unsettled: int = 0
    speed: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    clock: Callable[[], float] = perf_counter
    _contact: ContactStepper | None = None
    _resting: tuple[RigidIndenter, ...] = ()
    _largest_force: float = 0.0
    _began: float = 0.0
    _ended: float = 0.0
    _path: FloatArray = field(default_factory=lambda: np.zeros((1, 0, 3)))
    _forces: StepForces = field(default_factory=lambda: StepForces(np.zeros((0, 0, 3))))
    _unchecked: int = 0

    @classmethod
    def of(
        cls,
        engine: SteppedEngine,
        state: LatticeState | None = None,
        constrained: ConstrainedNodes | None = None,
        external_force: ArrayLike | None = None,
        indenters: Sequence[RigidIndenter] = (),
    ) -> LatticeSession:
        """Begin at a state, and compile what the steps need; see `LatticeEngine.session`."""
        start = state or engine.rest()
        _require_indenters(start, indenters)
        stepper = engine.stepper(start, external_force)
        session = cls(engine, stepper, external_force)
        finalize(session, stepper.close)
        session.constrain(constrained or ConstrainedNodes.none())
        if indenters:
            session._bring(indenters, start)
        return session

    def constrain(self, constrained: ConstrainedNodes, bodies: int = 0) -> None:
        """Constrain these nodes, and no others, from the next step on; they are in no contact.

        Parameters
        ----------
        constrained : ConstrainedNodes
            Nodes that bodies move.
        bodies : int
            Number of bodies, if some move no node at present.

        Raises
        ------
        InputError
            Nodes that are not there, or constrained twice in directions that are not orthogonal; the old constraints then stay.
        """
        require_constrained(constrained, self.engine.lattice.n_nodes)
        self.bodies = max(int(constrained.body.max(initial=-1)) + 1, bodies)
        self.constrained = constrained
        self._path = np.zeros((0, self.bodies, 3))
        entries = (constrained.node, constrained.direction, constrained.weight, constrained.body)
        self.stepper.constrain(entries, self.bodies)
        if self._contact is not None and self._contact.base is not self.stepper:
            self._contact.base.constrain(entries, self.bodies)
        self.stepper.advance(self._path, np.zeros((0, self.bodies, 3)))  # compiles what is to run, and builds what belongs to these nodes

    def press(self, indenters: Sequence[RigidIndenter]) -> None:
        """Bring these indenters, and no others, into play from the next step on, where they were made.

        Those that were last in play and have not moved may be pressed into the object a little, as what carries it is.

        Raises
        ------
        InputError
            Contact by ``"euler"`` or in single precision, or a new indenter inside the object.
        """
        if self._contact is not None:
            where = self._contact.contact.centres
            self._resting = tuple(p for p, centre in zip(self.indenters, where, strict=True) if np.array_equal(p.centre, centre))
            self._contact.close()
        self._contact, self.indenters = None, ()
        if indenters:
            self._bring(indenters, None, self._resting)

    def step(self, velocity: ArrayLike = 0.0, motions: Sequence[IndenterMotion] = (), *, steps: int = 1) -> StepForces:
        """Take steps.

        Parameters
        ----------
        velocity : array_like
            Velocities of the bodies that move constrained nodes, mm/s, broadcast to (steps, bodies, 3).
        motions : sequence of IndenterMotion
            One for each indenter, or none, and they stand still: the pose at the end of the last step, reached at a constant velocity; a
            velocity; or, for one of them, a force.
        steps : int
            How many, at least one.

        Returns
        -------
        StepForces
            Of the bodies and the indenters on the lattice in every step, mN: times the step they are impulses.

        Raises
        ------
        InputError
            A velocity of another shape or with NaN, another number of motions than of indenters, two driven by forces, or no step.
        ConvergenceError
            The explicit method diverged; checked every 200 steps, and by `state`.
        """
        if steps < 1:
            raise InputError(f"steps must be at least 1, not {steps}")
        if len(self._path) != steps:
            self._path = np.zeros((steps, self.bodies, 3))
        given = np.asarray(velocity, dtype=float)
        if given.shape != (self.bodies, 3) or not np.isfinite(given).all():
            given = checked_velocity(velocity, steps, self.bodies)
            if given.shape[1:] != (self.bodies, 3):
                raise InputError(f"velocity has {given.shape[1]} bodies, {self.bodies} move nodes: give ({self.bodies}, 3)")
        self._path[:] = given
        if motions and len(motions) != len(self.indenters):
            raise InputError(f"motions has {len(motions)} entries for {len(self.indenters)} indenters; give one for each")
        forces = StepForces(np.zeros(self._path.shape), np.zeros((steps, len(self.indenters), 3)))
        if self._contact is None:
            self._advance(forces.bodies)
        else:
            self._advance_in_contact(self._contact, motions, forces)
        self.steps += steps
        self._unchecked += steps
        self._forces = forces
        if self._unchecked >= CHECK_EVERY:
            self._check()
        return forces

    def forces(self) -> StepForces:
        """Return the forces of the last call of `step`."""
        return self._forces

    def state(self) -> LatticeState:
        """Return a copy of the state, that of the contacts included.

        Raises
        ------
        ConvergenceError
            The explicit method diverged.
        """
        self._check()
        found = self.engine.state(self.stepper)
        return found if self._contact is None else replace(found, contact=self._contact.contact.copied())

    def restore(self, state: LatticeState) -> None:
        """Go on from a state, with the same constraints and indenters.

        Raises
        ------
        InputError
            A state of another lattice, or in contact with another number of indenters.
        """
        _require_indenters(state, self.indenters)
        self.stepper.close()
        self.stepper = self.engine.stepper(state, self.external_force)
        finalize(self, self.stepper.close)
        self.constrain(self.constrained, self.bodies)
        if self.indenters:
            self._bring(self.indenters, state)

    def positions(self, nodes: ArrayLike | None = None) -> FloatArray:
        """Return positions of nodes, by default of all, mm, shape (k, 3)."""
        by_component = self.stepper.position.reshape(3, -1)[:, : self.engine.lattice.n_nodes]
        chosen = by_component if nodes is None else by_component[:, np.asarray(nodes, dtype=np.int64)]
        return np.ascontiguousarray(chosen.T, dtype=np.float64)

    def poses(self) -> tuple[FloatArray, FloatArray]:
        """Return where the indenters are: reference points (k, 3), mm, and axes (k, 3, 3), in rows."""
        if self._contact is None:
            return np.zeros((0, 3)), np.zeros((0, 3, 3))
        return self._contact.contact.centres.copy(), self._contact.contact.axes.copy()

    def close(self) -> None:
        """Send the threads of the pool away, until the next step; the garbage collector does it as well."""
        self.stepper.close()
        if self._contact is not None:
            self._contact.close()

    def __enter__(self) -> LatticeSession:
        """Return the session."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close it."""
        self.close()

    def _bring(self, indenters: Sequence[RigidIndenter], state: LatticeState | None, resting: Sequence[RigidIndenter] = ()) -> None:
        lattice, stepper = self.engine.lattice, self.stepper
        known, surface = None if state is None else state.contact, self.engine.surface()
        known = known or begin_contact(lattice, surface, indenters, self.positions(), resting)
        self._contact = self.engine.in_contact(stepper, indenters, known)
        self.indenters, self.speed, self._largest_force = tuple(indenters), np.zeros((len(indenters), 3)), 0.0

    def _advance(self, reaction: FloatArray) -> None:
        now = self.clock()
        idle = now - self._ended > self._ended - self._began
        self._began = now
        iterations, rotation_limited = self.stepper.advance(self._path, reaction, alone=idle)
        self._ended = self.clock()
        self.iterations += iterations
        self.rotation_limited += rotation_limited

    def _advance_in_contact(self, stepper: ContactStepper, motions: Sequence[IndenterMotion], forces: StepForces) -> None:
        steps, contact = len(self._path), stepper.contact
        duration = steps * self.engine.step
        velocity, spin, poses = indenter_velocities(self.indenters, motions, contact.centres, contact.axes, duration)
        path, spins = velocity[None].repeat(steps, axis=0), spin[None].repeat(steps, axis=0)
        driven = [k for k, motion in enumerate(motions) if isinstance(motion, IndenterForce)]
        if len(driven) > 1:
            raise InputError(f"motions of the indenters {', '.join(map(str, driven))} are forces; one indenter can be driven by a force")
        now = self.clock()
        stepper.alone = now - self._ended > self._ended - self._began
        self._began = now
        if driven:
            found = self._driven_steps(stepper, driven[0], motions[driven[0]], (path, spins), forces)
        else:
            found = stepper.advance(self._path, path, spins, (forces.bodies, forces.indenters))
        self._ended = self.clock()
        for k, (centre, axes) in poses.items():
            contact.centres[k], contact.axes[k] = centre, axes
        self.speed = path[-1].copy()
        self.iterations += found[0]
        self.unsettled += found[2]

    def _driven_steps(
        self, stepper: ContactStepper, number: int, motion: IndenterMotion, paths: tuple[FloatArray, FloatArray], forces: StepForces
    ) -> tuple[int, int, int]:
        assert isinstance(motion, IndenterForce)
        along, inertia = motion.guide(), motion.mass_kg / self.engine.step
        self._largest_force = max(self._largest_force, abs(motion.force), 1e-300)
        body = DrivenIndenter(number, along, inertia, float(self.speed[number] @ along), inertia)
        total = np.zeros(3, dtype=np.int64)
        for n in range(len(self._path)):
            own = (self._path[n : n + 1], paths[0][n : n + 1], paths[1][n : n + 1])
            reactions = (forces.bodies[n : n + 1], forces.indenters[n : n + 1])
            total += body.advance(stepper, motion.force, BALANCE * self._largest_force, own, reactions)
        return int(total[0]), int(total[1]), int(total[2])

    def _check(self) -> None:
        self.engine.check(self.stepper, self.steps)
        self._unchecked = 0


def _require_indenters(state: LatticeState, indenters: Sequence[RigidIndenter]) -> None:
    """Refuse a state whose contacts are those of other indenters: nothing is left out silently."""
    if state.contact is not None and state.contact.indenters != len(indenters):
        raise InputError(
            f"state is in contact with {state.contact.indenters} indenters, and indenters has {len(indenters)}; give those of the "
            "state, or its copy without contact: dataclasses.replace(state, contact=None)"
        )
