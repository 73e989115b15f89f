"""Sessions that keep the tangent of an earlier state, and have it renewed as the body moves."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from naibu.core.arrays import FloatArray, Int32Array, IntArray
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.finite_strain.lip_assembly import LipMultipliers
from naibu.mechanics.finite_strain.nearby_contact import NearbyContact, local_positions
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicSession
from naibu.mechanics.finite_strain.sessions.real_time_model import RealTimeModel, nodes_ahead, tangent_at
from naibu.mechanics.finite_strain.sessions.tangents.condensed_contact import CondensedContact
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent, TangentThread
from naibu.mechanics.finite_strain.sessions.tangents.kept_tangents import KeptTangents
from naibu.mechanics.finite_strain.sessions.tangents.turned_tangent import TurnedTangents
from naibu.mechanics.finite_strain.sessions.trial_displacement import PASSABLE

PERIOD = 10  # steps after which a tangent is renewed without a thread


@dataclass(slots=True, eq=False)
class TangentSession(DynamicSession):
    """A body in motion with the tangent of an earlier state; see `DynamicSession` for the other attributes.

    Attributes
    ----------
    unbalanced : float
        See `naibu.mechanics.finite_strain.sessions.real_time_session.RealTimeSession`.
    """

    unbalanced: float = field(init=False, default=0.0)
    _earlier: EarlierTangent | None = field(init=False, default=None)
    _kept: KeptTangents = field(init=False, default_factory=KeptTangents)
    _turned: TurnedTangents = field(init=False, default_factory=TurnedTangents)
    _thread: TangentThread = field(init=False, default_factory=TangentThread)
    _near: tuple[NearbyContact, ...] = field(init=False, default=())
    _places: tuple[Int32Array, ...] = field(init=False, default=())
    _condensed: CondensedContact | None = field(init=False, default=None)
    _seen: FloatArray | None = field(init=False, default=None)
    _age: int = field(init=False, default=0)
    _slipped: FloatArray | None = field(init=False, default=None)  # anchors of the sides of cuts when the last step began
    _begun: LipMultipliers | None = field(init=False, default=None)  # and what they exerted
    _duration: float = field(init=False, default=0.0)  # of the step, or part, whose balance is sought, s; 0: a step
    _until: float = field(init=False, default=np.inf)  # processor time at which a step is left to the next call

    def keep_tangent(self) -> None:
        """Have the tangent of the state reached at hand for the next sessions of the engine, in place of that of the body at rest.

        It contains the contacts with indenters that touch in this state, such as the table on which the body lies: without them a body that
        nothing else holds is free to move, and the first steps would have to find its whole support by iterations of the contact.
        """
        u = self.reached.displacement
        contacts = self._still()
        near = [NearbyContact.of(c, a, np.zeros(len(c.nodes)), np.inf) for c, a in zip(contacts, self.reached.anchors, strict=True)]
        for some in near:
            some.add_force(u, np.zeros_like(u))
        touching = tuple(some.touching() for some in near)
        ahead = self._soon_touched(contacts, [some.gap for some in near])
        self._engine._rest[:] = [self._made(u, touching, self._places, self._held(), ahead, self._slipped, self._begun)]

    def close(self) -> None:
        """End the thread and release the factors."""
        self._thread.close()
        for tangent in (self._thread.take(), *self._kept.drained()):
            self._release(tangent)
        self._earlier = None
        DynamicSession.close(self)

    @property
    def _engine(self) -> RealTimeModel:
        assert isinstance(self.engine, RealTimeModel)
        return self.engine

    def _soon_touched(self, contacts: Sequence[Contact], gaps: Sequence[FloatArray]) -> IntArray:
        engine = self._engine
        ahead = nodes_ahead(contacts, gaps, engine.faces.shape[1], engine._extent, self._assembler(), self.reached.displacement)
        return np.concatenate([*self.bodies[1:], ahead])

    def _current_tangent(self) -> EarlierTangent:
        """Return the tangent of the state nearest to where the body goes, turned as it has; where there is none, it is made now."""
        if (done := self._thread.take()) is not None:
            self._keep(done)
        at, points = self.reached, self.engine.points
        there = at.displacement + self.engine.step * at.velocity
        known = self._kept.nearest(points, there, self._held(), self._engine._extent, self._engine._rest)
        if known is None:
            self._engine._rest[:] = [self._untouched()]
            known, self._seen = self._engine._rest[0], np.zeros_like(self.engine.points)
        return self._turned.of(self._used(known), points, there)

    def _untouched(self) -> EarlierTangent:
        """Return the tangent of the body at rest without contacts of indenters."""
        contacts = self._still()
        gaps = [local_positions(c, self.reached.displacement, 0.0)[1] for c in contacts]
        return self._made(np.zeros_like(self.engine.points), (), (), self._held(), self._soon_touched(contacts, gaps), None, None)

    def _still(self) -> tuple[Contact, ...]:
        """Contacts of indenters where they are now."""
        still = np.zeros((len(self._templates), 3))
        return self._contacts(0.0, still, still)

    def _renew(self, ahead: IntArray) -> None:
        """Have a tangent made of the state reached, if anything has changed since the last one."""
        u = self.reached.displacement
        still = self._seen is not None and float(np.abs(u - self._seen).max()) < 1e-4 * self.engine._extent
        still &= self._earlier is not None and self.unbalanced <= PASSABLE and bool(self._earlier.factors.covered(ahead).all())
        self._age += 1
        if still or not self._thread.idle or (not self._engine.background and self._age < PERIOD):
            return
        self._seen = u
        if self._engine.background:
            self._thread.submit(partial(self._made, u, self._near, self._places, self._held(), ahead, self._slipped, self._begun))
        else:
            self._keep(self._made(u, self._near, self._places, self._held(), ahead, self._slipped, self._begun))

    def _renewed(self) -> Generator[None, None, EarlierTangent]:
        """Return the tangent of the state reached, which the step waits for; the thread makes it where there is no time."""
        u, whole = self.reached.displacement, self._duration == self.engine.step
        gaps = []
        for near, contact in zip(self._near, self._templates, strict=True):
            near.add_force(u, np.zeros_like(u))
            gaps.append(np.full(len(contact.nodes), np.inf))
            gaps[-1][near.points] = near.gap
        ahead = self._soon_touched(self._templates, gaps)
        make = partial(self._made, u, self._near, self._places, self._held(), ahead, self._slipped, self._begun, self._duration)
        if not self._engine.background or self._until == np.inf:
            return self._used(self._keep(make()) if whole else make())
        while not self._thread.idle:
            if (done := self._thread.take()) is not None and self._keep(done).displacement is u and whole:
                return self._used(done)  # which was begun when the last step ended
            yield from self._pause()
        self._thread.submit(make)
        while (done := self._thread.take()) is None:
            yield from self._pause()
        return self._used(self._keep(done) if whole else done)

    def _pause(self) -> Iterator[None]:
        """Wait a moment, and end the frame if it has an end."""
        time.sleep(1e-3)
        self._until = -np.inf if self._until < np.inf else np.inf
        yield

    def _keep(self, tangent: EarlierTangent) -> EarlierTangent:
        """Have a new tangent at hand."""
        self._age = 0
        for given_up in self._kept.keep(tangent):
            self._release(given_up)
        return tangent

    def _used(self, tangent: EarlierTangent) -> EarlierTangent:
        """Use a tangent from now on."""
        if tangent is not self._earlier:
            self._earlier, self._condensed = tangent, None
            self._turned.forget()
        return tangent

    def _held(self) -> IntArray:
        return self.bodies[0] if self.bodies else np.zeros(0, np.int64)

    def _made(
        self,
        u: FloatArray,
        near: tuple[NearbyContact, ...],
        places: tuple[Int32Array, ...],
        held: IntArray,
        ahead: IntArray,
        slipped: FloatArray | None,
        begun: LipMultipliers | None,
        duration: float = 0.0,
    ) -> EarlierTangent:
        """Return the tangent at a displacement with contacts, and columns of its inverse for nodes `ahead`.

        Of sides of cuts that slide, its secant is that of a step that began with these anchors: at the end of a step they have slipped.
        Those that press do so as in this step.
        """
        return tangent_at(self._engine, u, (near, places, self._positions), held, ahead, slipped, begun, duration)

    def _release(self, tangent: EarlierTangent | None) -> None:
        """Let the solver of a tangent factorize again, unless the tangent is kept for the next session."""
        if tangent is self._earlier:
            self._earlier, self._condensed = None, None
            self._turned.forget()
        if tangent is not None and not any(tangent is kept for kept in self._engine._rest):
            self._engine._solvers.put(tangent.solver)
