"""Sessions in real time that take a step in parts where its balance is not found, and leave one that takes long to the next call.

The balance of a part is easier to find: the motion is less, and the inertia of a shorter time holds the body more firmly. Where a body is
let go, or falls on its support, some parts with one tangent of theirs, each of few iterations, take less time than Newton's method for the
whole step, which follows the motion little by little.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.mechanics.contact.indenter_motion import IndenterMotion
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.contact.session_protocol import StepForces
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicSession, DynamicState
from naibu.mechanics.finite_strain.sessions.newton_session import NewtonSession
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent
from naibu.mechanics.finite_strain.sessions.trial_displacement import PASSABLE, Trial

PARTS = (8, 16)  # in which a step is taken whose balance is not found

Forces = tuple[FloatArray, FloatArray]  # of bodies and indenters, mN


class _UnderWay(Exception):
    """A step takes longer than it may, and goes on in the next call."""


@dataclass(slots=True, eq=False)
class DividedSession(NewtonSession):
    """A body in motion whose steps can be taken in parts; see `NewtonSession` for the other attributes.

    Attributes
    ----------
    under_way : bool
        Whether `step_within` has begun a step whose balance is not yet found.
    divided_steps : int
        Steps so far that were taken in parts.
    """

    divided_steps: int = field(init=False, default=0)
    _gaps: tuple[FloatArray, ...] = field(init=False, default=())
    _trial: Trial | None = field(init=False, default=None)
    _search: Generator[None, None, Forces] | None = field(init=False, default=None)  # of the step under way
    _midway: DynamicState | None = field(init=False, default=None)  # behind the parts of it that have been taken
    _own: EarlierTangent | None = field(init=False, default=None)  # of the parts of a step

    @property
    def under_way(self) -> bool:
        """Whether `step_within` has begun a step whose balance is not yet found."""
        return self._search is not None

    @property
    def positions_midway(self) -> FloatArray | None:
        """Where the parts that have been taken of the step under way lead the nodes (n, 3), mm; None where none has."""
        state = self._midway
        return None if state is None or state is self.reached else self.engine.points + state.displacement

    def step_within(self, budget_s: float, velocity: ArrayLike = 0.0, motions: Sequence[IndenterMotion] = ()) -> StepForces | None:
        """Take a step, or work on it for about a time of the processor; None: call again, with the same motions, to go on with it.

        The state is that before the step until its balance is found. Newton's method, where it is needed, is left to a thread; after
        `naibu.mechanics.finite_strain.sessions.newton_session.NEWTON_S` the step fails as one does that has no balance.
        """
        self._until = time.thread_time() + budget_s
        try:
            return self.step(velocity, motions)
        except _UnderWay:
            return None
        finally:
            self._until = np.inf

    def constrain(self, constrained: Sequence[ArrayLike], bodies: int = 0) -> None:
        """Constrain these nodes, and no others, from the next step on; see `DynamicSession.constrain`."""
        DynamicSession.constrain(self, constrained, bodies)
        self._give_up()

    @abstractmethod
    def _quasi_newton(self, moving: FloatArray, contacts: tuple[Contact, ...]) -> Generator[None, None, Trial | None]:
        """Return the balance at the end of a step, or part, or None; yields where one may go on later."""

    @abstractmethod
    def _forget(self) -> None:
        """Begin anew: what the last step left for the next one belongs to another motion."""

    @abstractmethod
    def _stiffer(self, contacts: tuple[Contact, ...], u: FloatArray) -> tuple[Contact, ...]:
        """Return contacts as the next step shall have them, stiffer where a balanced step went too deep."""

    def _give_up(self) -> None:
        """Give up the step under way, if there is one."""
        if self._search is not None:
            self._forget()
        self._search = self._midway = None

    def _advance(self, moving: FloatArray, along: FloatArray, spin: FloatArray, motions: Sequence[IndenterMotion]) -> Forces:
        """Take one step, or go on with the one under way; see `DynamicSession._advance`."""
        search = self._search or self._stepped(moving, along, spin, motions)
        before, self._search = self.reached, None
        if self._midway is not None:
            self.reached, self._midway = self._midway, None
        while True:
            try:
                next(search)
            except StopIteration as end:
                forces: Forces = end.value
                return forces
            except ConvergenceError:
                self.reached = before
                raise
            if time.thread_time() > self._until:
                self._search, self._midway, self.reached = search, self.reached, before
                raise _UnderWay

    def _stepped(
        self, moving: FloatArray, along: FloatArray, spin: FloatArray, motions: Sequence[IndenterMotion]
    ) -> Generator[None, None, Forces]:
        """Return the forces of a step: whole, in parts where its balance is not found, or by Newton's method where theirs is not either.

        Newton's method takes the whole step, unless an indenter would go through the body: in parts it found no balance that it had not
        found, and that of as short parts was sought before.
        """
        before, h, first = self.reached, self.engine.step, self._parts(moving, along, spin)
        for parts in (first, *(first * more for more in PARTS)):
            forces = yield from self._in_parts(parts, moving, along, spin)
            if forces is not None:
                self.divided_steps += parts > first
                return forces
            self.reached = before
            self._forget()
        self.newton_steps += 1
        if first > 1:
            return DynamicSession._advance(self, moving, along, spin, motions)
        contacts, alone = self._contacts(h, along, spin), self._until == np.inf
        found = self._balanced(h, moving, contacts) if alone else (yield from self._newtons_beside(moving, contacts))
        if found is None:
            raise ConvergenceError(f"a step of {h:g} s finds no balance of momentum; move the indenter more slowly, or less deep")
        return self._accepted(h, found, self._stiffer(contacts, found), spin)

    def _in_parts(self, parts: int, moving: FloatArray, along: FloatArray, spin: FloatArray) -> Generator[None, None, Forces | None]:
        """Return the mean forces of a step that quasi-Newton iterations take in equal parts; None where one of them finds no balance."""
        h = self._duration = self.engine.step / parts
        found = []
        try:
            for _ in range(parts):
                contacts = self._contacts(h, along, spin)
                trial = self._trial = yield from self._quasi_newton(moving, contacts)
                if trial is None:
                    return None
                next_ones = contacts if trial.unbalanced > PASSABLE else self._stiffer(contacts, trial.displacement)
                found.append(self._accepted(h, trial.displacement, next_ones, spin))
        finally:
            self._release_own()
        if parts > 1:  # the next step is whole again
            self._renew(self._soon_touched(contacts, self._gaps))
        bodies, indenters = (np.mean(forces, axis=0) for forces in zip(*found, strict=True))
        return bodies, indenters

    def _settled(self, h: float, moving: FloatArray, contacts: tuple[Contact, ...]) -> tuple[tuple[Contact, ...], FloatArray | None]:
        """Return contacts as the next step shall have them, and the displacement that Newton's method finds, or None."""
        u = self._balanced(h, moving, contacts)
        return contacts if u is None else self._stiffer(contacts, u), u

    def _tangent_of_parts(self) -> Generator[None, None, EarlierTangent]:
        """Return the tangent of the parts of a step; the first of them that needs one has it made."""
        if self._own is None:
            self._own = yield from self._renewed()
        return self._used(self._own)

    def _release_own(self) -> None:
        own, self._own = self._own, None
        self._release(own)
