"""Lattices in real time: steps one by one, without any conversion of the state between them (spec L1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from types import TracebackType
from weakref import finalize

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.cpu.stepper import Stepper
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState, checked_velocity, require_constrained

CHECK_EVERY = 200  # explicit steps between two looks whether they blew up


@dataclass(slots=True, eq=False, weakref_slot=True)
class LatticeSession:
    """A lattice in motion, for loops that ask for a few steps at a time; made by `LatticeSession.of`.

    It takes the steps that `LatticeEngine.run` takes, with the same results to the last bit. An engine of several threads cuts a step into
    as many parts; helpers take parts where they come in time, and the calling thread takes what they leave, so that another process on a
    core costs no more than the helper's share. They are asked only while the steps keep the calling thread busy most of the time: a loop
    that has time left needs none. Who computed a part changes nothing in the result: it depends on the number of threads that the engine
    was made for, and on nothing else of the machine's.

    Sessions of one engine can advance in several Python threads at once, each in one.

    Attributes
    ----------
    engine : LatticeEngine
        Lattice, parameters, step and method.
    constrained : ConstrainedNodes
        What bodies hold.
    bodies : int
        Number of bodies.
    steps : int
        Steps taken.
    iterations : int
        Iterations of the implicit solver in all of them.
    held_back : int
        Implicit steps in which the stretching by rotation was held back.
    clock : callable
        Returns the time, s.
    """

    engine: LatticeEngine
    constrained: ConstrainedNodes
    bodies: int
    stepper: Stepper
    steps: int = 0
    iterations: int = 0
    rotation_limited: int = 0
    clock: Callable[[], float] = perf_counter
    _began: float = 0.0
    _ended: float = 0.0
    _path: FloatArray = field(default_factory=lambda: np.zeros((1, 0, 3)))
    _reaction: FloatArray = field(default_factory=lambda: np.zeros((1, 0, 3)))
    _unchecked: int = 0

    @classmethod
    def of(
        cls,
        engine: LatticeEngine,
        state: LatticeState | None = None,
        constrained: ConstrainedNodes | None = None,
        external_force: ArrayLike | None = None,
    ) -> LatticeSession:
        """Begin where a state is, by default at rest, and compile what the steps need.

        Parameters
        ----------
        engine : LatticeEngine
            Of any method.
        state : LatticeState
            Where it begins; copied.
        constrained : ConstrainedNodes
            Masses that bodies move; see `constrain`.
        external_force : array_like
            Forces on the masses that do not change, mN, broadcast to (n, 3).

        Raises
        ------
        InputError
            Shapes that do not fit, NaN, or held masses that are not there or held twice.
        """
        stepper = engine.stepper(state or engine.rest(), external_force)
        session = cls(engine, ConstrainedNodes.none(), 0, stepper)
        finalize(session, stepper.close)
        session.constrain(constrained or ConstrainedNodes.none())
        return session

    def constrain(self, constrained: ConstrainedNodes, bodies: int = 0) -> None:
        """Hold these masses, and no others, from the next step on.

        Parameters
        ----------
        constrained : ConstrainedNodes
            Masses that bodies move.
        bodies : int
            Number of bodies, if some hold nothing at present.

        Raises
        ------
        InputError
            Masses that are not there, or held twice in directions that are not orthogonal; what was held before is then held still.
        """
        require_constrained(constrained, self.engine.lattice.n_nodes)
        self.bodies = max(int(constrained.body.max(initial=-1)) + 1, bodies)
        self.constrained = constrained
        self._path = self._reaction = np.zeros((0, self.bodies, 3))
        self.stepper.constrain((constrained.node, constrained.direction, constrained.weight, constrained.body), self.bodies)
        self.stepper.advance(self._path, self._reaction)  # compiles what is to run, and builds what belongs to these masses

    def advance(self, velocity: ArrayLike = 0.0, steps: int = 1) -> FloatArray:
        """Take steps with constant velocities of the bodies.

        Parameters
        ----------
        velocity : array_like
            mm/s, broadcast to (bodies, 3).
        steps : int
            How many, at least one.

        Returns
        -------
        ndarray, shape (bodies, 3)
            Forces that the bodies exert on the lattice, mN, in the mean over the steps: times their duration they are the impulse.

        Raises
        ------
        InputError
            A velocity of another shape or with NaN, or no step.
        ConvergenceError
            The explicit method blew up; looked for every 200 steps, and by `state`.
        """
        if steps < 1:
            raise InputError(f"a session advances by at least one step, not {steps}")
        if len(self._path) != steps:
            self._path, self._reaction = np.zeros((steps, self.bodies, 3)), np.zeros((steps, self.bodies, 3))
        given = np.asarray(velocity, dtype=float)
        if given.shape != (self.bodies, 3) or not np.isfinite(given).all():
            given = checked_velocity(velocity, 1, self.bodies)[0]
            if given.shape != (self.bodies, 3):
                raise InputError(f"velocities of {len(given)} bodies are given, {self.bodies} hold masses: give ({self.bodies}, 3)")
        self._path[:] = given
        now = self.clock()
        idle = now - self._ended > self._ended - self._began
        self._began = now
        iterations, rotation_limited = self.stepper.advance(self._path, self._reaction, alone=idle)
        self._ended = self.clock()
        self.steps += steps
        self.iterations += iterations
        self.rotation_limited += rotation_limited
        self._unchecked += steps
        if self._unchecked >= CHECK_EVERY:
            self._check()
        return self._reaction[0].copy() if steps == 1 else np.asarray(self._reaction.mean(axis=0))

    def state(self) -> LatticeState:
        """Return a copy of the state.

        Raises
        ------
        ConvergenceError
            The explicit method blew up.
        """
        self._check()
        return self.engine.state(self.stepper)

    def positions(self, nodes: ArrayLike | None = None) -> FloatArray:
        """Return positions of masses, by default of all, mm, shape (k, 3)."""
        by_component = self.stepper.position.reshape(3, -1)[:, : self.engine.lattice.n_nodes]
        chosen = by_component if nodes is None else by_component[:, np.asarray(nodes, dtype=np.int64)]
        return np.ascontiguousarray(chosen.T, dtype=np.float64)

    def close(self) -> None:
        """Send helping threads away, until the next step; the garbage collector does it as well."""
        self.stepper.close()

    def __enter__(self) -> LatticeSession:
        """Return the session."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close it."""
        self.close()

    def _check(self) -> None:
        self.engine.check(self.stepper, self.steps)
        self._unchecked = 0
