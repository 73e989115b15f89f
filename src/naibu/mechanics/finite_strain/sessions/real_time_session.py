"""Dynamic sessions of finite elements in real time: the steps of `dynamic_session` by a quasi-Newton method with earlier tangents.

Each step solves the same balance of momentum, with the same elements, law and contact, by iterations that need no tangent of their own.
They use the factors of the tangent of an earlier state, which a thread renews in the background, as in the asynchronous preconditioning of
:cite:t:`courtecuisse2010`. Two things change faster than those factors, and are treated exactly: what resists a change of volume, by
pressures of their own (`naibu.mechanics.finite_elements.pressure_elements`), and contacts that open, close, stick or slip, by the formula
of Woodbury. Anderson's acceleration does the rest. A step that these iterations do not solve is taken by Newton's method.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.contact.indenter_motion import harmless_ways, parts_of_approach, slow_enough
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.finite_elements.pressure_elements import PressureElements
from naibu.mechanics.finite_strain.lip_assembly import lips_of
from naibu.mechanics.finite_strain.nearby_contact import NearbyContact, local_positions
from naibu.mechanics.finite_strain.sessions.divided_session import DividedSession
from naibu.mechanics.finite_strain.sessions.dynamic_session import PENETRATION, DynamicSession, DynamicState
from naibu.mechanics.finite_strain.sessions.real_time_model import RealTimeModel
from naibu.mechanics.finite_strain.sessions.session_checks import dead_load
from naibu.mechanics.finite_strain.sessions.tangents.condensed_contact import CHANGES, UNAIDED, CondensedContact
from naibu.mechanics.finite_strain.sessions.tangents.contact_beside_tangent import ContactBesideTangent
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent
from naibu.mechanics.finite_strain.sessions.tangents.lips_beside_tangent import ApproachingLips, changing_lips, motion_in_threes
from naibu.mechanics.finite_strain.sessions.trial_displacement import FELT, Trial
from naibu.mechanics.linear_algebra.anderson import AndersonMixing

ITERATIONS = 5  # of a step at most
USUAL = 3  # of a step whose balance is then passable
DEPTH = 4  # earlier iterations that are mixed
ACCEPTED = 0.06  # of a step that has used up its iterations; where it was 0.2, some later steps found no balance and took seconds
BUDGET_S = 0.01  # of a processor for a step, after which a passable balance is taken; one that is worse goes on, and real time is lost
DIVERGED = 1e6  # out-of-balance force from which a step is tried from another beginning
FURTHER, NEARER = 5, 0.7  # more of them, where the others reduced the error to so much of what it was before
HOPE = 3  # iterations, behind which others are given up where the error is still above UNLIKELY
UNMOVED = 0.02  # change of an error in each of two iterations from which it stays: with this tangent, other beginnings lead to it as well
STALLED = 0.02  # of the contact forces: what iterations that reduce the error no longer may leave where sides of cuts rub
FEW = 200  # nodes of contact at most with which they cost less than a tangent of the step's own
UNLIKELY = 0.3  # error at the end of the motion from which the body at rest is tried
UNFORESEEN = 96  # nodes whose columns of the inverse are not made for an error above UNLIKELY: they take longer than parts of the step
SPARE = 8  # nodes for which a step that took no iteration prepares the inverse, if they are about to be in contact and it is not known
VAIN = 30  # beginnings, for which the body at rest is not tried again where it led nowhere
PATIENCE, LONGEST_S = 2.0, 0.25  # times of a tangent, and s, after which iterations are given up: parts take one, and some of their own
IN_PART_S = 0.05  # of a processor for the contact of an iteration of a part at most
JUMP = 10.0  # its growth from which earlier iterations are forgotten, as where contacts close
STIFFEST = 16.0  # times the first penalty, to which penalties rise: stiffer ones need more iterations
RUBBING = 8  # matrices for contacts in an iteration where sides of cuts rub: many pairs stick or slip by turns, and none is held back
RAISE = 1.3  # of a penalty in a step; where it leaps, pressure and limit of friction do, and the surface slips to another equilibrium


@dataclass(frozen=True, slots=True, eq=False)
class RealTimeEngine(RealTimeModel):
    """A finite element model prepared for implicit dynamic steps in real time; see `DynamicEngine` for the other attributes.

    Attributes
    ----------
    background : bool
        Whether a thread renews the factors, and iterations end when the time of a step is over; otherwise factors are renewed before every
        tenth step, and runs are repeatable.
    """

    def session(
        self,
        state: DynamicState | None = None,
        constrained: Sequence[ArrayLike] | None = None,
        external_force: ArrayLike | None = None,
        indenters: Sequence[RigidIndenter] = (),
    ) -> RealTimeSession:
        """Begin a session; see `DynamicEngine.session`."""
        return RealTimeSession(self, dead_load(external_force, self.points), self.rest()).begun(state, constrained, indenters)


@dataclass(slots=True, eq=False)
class RealTimeSession(DividedSession):
    """A body in motion that a loop steps in real time; made by `RealTimeEngine.session`. See `DividedSession` for the other attributes.

    Attributes
    ----------
    waits : int
        Steps so far that had to wait for a tangent of their own.
    iterations : int
        Quasi-Newton iterations so far.
    unbalanced : float
        Sum of the nodes' out-of-balance forces at the end of the last step, which the next steps take up, as a fraction of the sum of all
        forces or of those of contact, whichever is more; 0 where Newton's method took it.
    """

    waits: int = field(init=False, default=0)
    iterations: int = field(init=False, default=0)
    _pressure: FloatArray | None = field(init=False, default=None)
    _elements: PressureElements = field(init=False, repr=False)  # with the normals of the sides of cuts when the step begins
    _spare: bool = field(init=False, default=False)  # whether the last step took no iteration
    _vain: int = field(init=False, default=0)  # beginnings until the body at rest is tried again
    _patience: float = field(init=False, default=np.inf)  # processor time at which a step gives an earlier tangent up
    _stays: bool = field(init=False, default=False)  # whether the last iterations ended where their error stayed, near to balance

    def press(self, indenters: Sequence[RigidIndenter]) -> None:
        """Bring these indenters, and no others, into play; see `DynamicSession.press`."""
        DynamicSession.press(self, indenters)
        self._places = tuple(self._engine._surface.positions(c.nodes) for c in self._templates)
        self._give_up()
        self._near, self._gaps, self._trial = (), (), None

    def restore(self, state: DynamicState) -> None:
        """Go on from a state; see `DynamicSession.restore`."""
        DynamicSession.restore(self, state)
        self._give_up()
        self._forget()
        self._slipped, self._begun = self.reached.lips, self.reached.multipliers

    def _parts(self, moving: FloatArray, along: FloatArray, spin: FloatArray) -> int:
        """Parts of a step in each of which no indenter goes through the body; the loop has no time to divide steps as the body swings."""
        h, at = self.engine.step, self.reached
        if slow_enough(self.indenters, h * along, h * spin):
            return 1
        indenters, points, centres, axes = self._places_of(at)
        return parts_of_approach(indenters, points, np.zeros_like(points), centres, axes, h * along, h * spin)

    def _forget(self) -> None:
        """Begin anew; see `DividedSession`."""
        self._pressure, self._trial, self._near, self._gaps = None, None, (), ()

    def _stiffer(self, contacts: tuple[Contact, ...], u: FloatArray) -> tuple[Contact, ...]:
        """Return contacts as the next step shall have them; see `DividedSession`."""
        out = []
        for c, first, depth in zip(contacts, self._templates, self._depths(contacts, u), strict=True):
            raised = np.minimum(RAISE * c.normal_stiffness, STIFFEST * first.normal_stiffness)
            out.append(replace(c, normal_stiffness=np.where(depth > PENETRATION, raised, c.normal_stiffness)))
        return tuple(out)

    def _depths(self, contacts: tuple[Contact, ...], u: FloatArray) -> list[FloatArray]:
        """Return how deep indenters go into the faces; see `DynamicSession`. Of quasi-Newton steps only points near them are looked at."""
        if self._trial is None:
            return DynamicSession._depths(self, contacts, u)
        depths = [np.zeros(len(c.nodes)) for c in contacts]
        for depth, near in zip(depths, self._near, strict=True):
            depth[near.points] = -near.gap / near.contact.element_size
        return depths

    def _quasi_newton(self, moving: FloatArray, contacts: tuple[Contact, ...]) -> Generator[None, None, Trial | None]:
        """Return the balance at the end of a step, or None; yields where one may go on later."""
        start, h = self.reached, self._duration
        whole = h == self.engine.step
        self._elements = replace(self._engine._elements, assembler=self._assembler().in_step(start.displacement, start.lips))
        inertial = start.displacement + h * start.velocity
        travel = [float(np.linalg.norm(c.stop - c.start)) for c in contacts]
        fastest = h * float(np.sqrt((start.velocity**2).sum(axis=1).max()))
        if len(self._gaps) != len(contacts):
            self._gaps = tuple(local_positions(c, start.displacement, 0.0)[1] for c in contacts)
        self._near = tuple(
            NearbyContact.of(c, a, gap, 2.0 * (fastest + way) + 0.01 * self.engine._extent)
            for c, a, gap, way in zip(contacts, start.anchors, self._gaps, travel, strict=True)
        )
        tangent = self._current_tangent() if whole else (yield from self._tangent_of_parts())
        pressure = self._pressure
        if pressure is None:
            pressure = self._engine._elements.bulk * self._engine._elements.dilatation(start.displacement)[0]
        before, now = self.iterations, time.thread_time()
        live = self._engine.background
        deadline = now + BUDGET_S if live else np.inf
        self._patience, of_now = self._given_up(tangent), tangent.displacement is start.displacement
        best = yield from self._from_guesses(tangent, moving, inertial, pressure, deadline, still_first=of_now and not whole)
        if best is None or best.error > ACCEPTED:
            hopeless = best is None or best.error > UNLIKELY
            if of_now or (live and whole and hopeless):  # another tangent would not do; parts take less time
                return None
            self.waits += 1
            self._release_own()
            tangent = (yield from self._renewed()) if whole else (yield from self._tangent_of_parts())
            self._patience, deadline = self._given_up(tangent), np.inf if whole else deadline
            best = yield from self._from_guesses(tangent, moving, inertial, pressure, deadline, still_first=True)
        if best is None or best.error > ACCEPTED:
            return None
        for near in self._near:  # gaps and responses are those of the last trial
            near.add_force(best.displacement, np.zeros_like(best.displacement))
        self._spare = self.iterations == before
        return best

    def _given_up(self, tangent: EarlierTangent) -> float:
        """Return the processor time at which iterations are given up for another tangent, or parts: where those would have taken less."""
        live = self._engine.background and self._duration == self.engine.step
        return time.thread_time() + max(BUDGET_S, min(PATIENCE * tangent.seconds, LONGEST_S)) if live else np.inf

    def _sought_until(self) -> float:
        """Return the processor time until which the contact of an iteration is sought."""
        in_part = self._engine.background and self._duration < self.engine.step
        return time.thread_time() + IN_PART_S if in_part else self._patience

    def _from_guesses(
        self, tangent: EarlierTangent, moving: FloatArray, inertial: FloatArray, pressure: FloatArray, deadline: float, *, still_first: bool
    ) -> Generator[None, None, Trial | None]:
        """Return the best that is found from the guesses, one after the other until a balance is accepted."""
        best = None
        for first, near, most in self._guesses(tangent, moving, inertial, pressure, still_first=still_first):
            found = yield from self._iterated(near, first, inertial, deadline, most)
            best, self._vain = found.better(best), VAIN if near is not tangent and found.error > UNLIKELY else self._vain
            elsewhere = near is not tangent or tangent.displacement is self.reached.displacement
            if best.error <= ACCEPTED or (self._stays and not elsewhere) or time.thread_time() > self._patience:
                break
        return best

    def _guesses(
        self, tangent: EarlierTangent, moving: FloatArray, inertial: FloatArray, pressure: FloatArray, *, still_first: bool
    ) -> Iterator[tuple[Trial, EarlierTangent, int]]:
        """Yield where the motion leads and where the body is, with the tangent; before them its rest, if nearer: tools leave it fast.

        Where both are in balance, the body stays where it is: it would creep on, and frictional points would be carried along. Where the
        tangent is that of the body as it is, and the motion is fast, the way from there is the better one.
        """
        first = self._guessed(inertial, moving, inertial, pressure)
        self._vain = max(self._vain - 1, 0)
        if self._duration == self.engine.step and self._vain == 0 and (first is None or first.error > UNLIKELY):
            for kept in self._engine._rest:
                rest = self._at_rest(kept, moving, inertial) if np.array_equal(kept.held, tangent.held) else None
                if rest is not None and (first is None or rest.error < NEARER * first.error):
                    yield rest, kept, USUAL
        still, bulk = None, self._engine._elements.bulk
        if still_first or (first is not None and first.finished(bulk, begun=False)):
            still = self._guessed(self.reached.displacement, moving, inertial, pressure)
            first = still if still is not None and still.finished(bulk, begun=False) else first
        guesses = [still, first] if still_first else [first, still]
        for k, guess in enumerate(guesses):
            if k == 1 and guess is None and not still_first:
                guess = self._guessed(self.reached.displacement, moving, inertial, pressure)
            if guess is not None:
                yield guess, tangent, ITERATIONS + FURTHER

    def _at_rest(self, kept: EarlierTangent, moving: FloatArray, inertial: FloatArray) -> Trial | None:
        """Return what is out of balance where a tangent was made that is kept; None where the body would pass through an indenter."""
        indenters, points, _, _ = self._places_of(self.reached)
        if indenters:
            moves = self._templates[0].positions(kept.displacement) - points
            centres = np.array([near.contact.stop for near in self._near])
            axes = np.array([i.geometry.axes @ near.contact.orientation(1.0).T for i, near in zip(indenters, self._near, strict=True)])
            if parts_of_approach(indenters, points, moves, centres, axes, np.zeros_like(centres), np.zeros_like(centres)) > 1:
                return None
        elements = self._engine._elements
        return self._guessed(kept.displacement, moving, inertial, elements.bulk * elements.dilatation(kept.displacement)[0])

    def _guessed(self, guess: FloatArray, moving: FloatArray, inertial: FloatArray, pressure: FloatArray) -> Trial | None:
        """Return what is out of balance at a guess of the displacement (n, 3), mm, with bodies where they are led."""
        start = self.reached.displacement
        target = np.where(self._constrained, start, guess)
        for nodes, speed in zip(self.bodies, moving, strict=True):
            target[nodes] = start[nodes] + self._duration * speed
        return self._tried(target, inertial, pressure)

    def _iterated(
        self, tangent: EarlierTangent, trial: Trial, inertial: FloatArray, deadline: float, most: int
    ) -> Generator[None, None, Trial]:
        """Return the best that at most so many iterations find from a beginning, in the time of a processor that there is."""
        mixing, best, begun, bulk = AndersonMixing(DEPTH), trial, trial.error, self._engine._elements.bulk
        rubs, before, unmoved, self._stays = self.engine.assembler.unsymmetric, np.inf, 0, False
        for near in self._near:  # gaps are those of this guess, which need not be the last one that was looked at
            near.add_force(trial.displacement, np.zeros_like(trial.contact))
        for k in range(most):
            many = self._condensed is not None and len(self._condensed.nodes) > FEW
            if k >= HOPE and best.error > UNLIKELY:
                break
            if unmoved == 2 and (best.error > ACCEPTED or self._duration < self.engine.step):
                self._stays = ACCEPTED < best.error <= UNLIKELY
                break
            if k == ITERATIONS and (best.error <= ACCEPTED or best.error > NEARER * begun or many):
                break
            if trial.finished(bulk, begun=k > 0):
                return trial
            stalls = rubs and k > 1 and trial.error > NEARER * before and trial.felt <= STALLED
            if k and trial.passable(bulk) and (stalls or (k >= USUAL and trial.felt <= FELT) or time.thread_time() > deadline):
                return trial
            if time.thread_time() > self._patience and best.error > ACCEPTED:
                break
            yield
            after = yield from self._improved(tangent, trial, inertial, mixing)
            if after is None or after.error > DIVERGED:
                break
            if self._condensed is not None and not self._condensed.balanced and after.error >= trial.error:
                return after.better(best if k else None)  # no share of a step is of use whose contact finds no balance
            if after.error > JUMP * trial.error:
                mixing = AndersonMixing(DEPTH)
            unmoved = unmoved + 1 if abs(after.error - trial.error) <= UNMOVED * after.error else 0
            before, trial = trial.error, after
            best = trial.better(best if k else None)
        return best

    def _improved(
        self, tangent: EarlierTangent, trial: Trial, inertial: FloatArray, mixing: AndersonMixing
    ) -> Generator[None, None, Trial | None]:
        """Return the end of one quasi-Newton iteration; None where it inverts an element, or takes too long."""
        elements = self._engine._elements
        self.iterations += 1
        force = trial.balance.copy()
        elements.add_pressures(tangent.dilatation, trial.mismatch, force)
        step = yield from self._with_contact(tangent, trial, force, not mixing.steps)
        if step is None:
            return None
        if not np.isfinite(step).all():  # a tangent that has no factors in single precision
            used, self._own = self._earlier, None if tangent is self._own else self._own
            if used is not None and tangent.solver is used.solver:  # which may be turned
                self._kept.drop(used)
                self._release(used)
            return None
        rise = elements.pressure_change(tangent.dilatation, step, trial.mismatch)
        scale = 1e-2 * self.engine._extent / self.engine._modulus  # mm/kPa
        now = np.concatenate([trial.displacement.ravel(), scale * trial.pressure])
        mixed = mixing.step(now, np.concatenate([step.ravel(), scale * rise]))
        step, rise = mixed[: step.size].reshape(-1, 3), mixed[step.size :] / scale
        best = None
        for a in (1.0, 0.5, 0.25):
            after = self._tried(trial.displacement + a * step, inertial, trial.pressure + a * rise)
            if after is None:
                continue
            if self._condensed is None or self._condensed.balanced or after.error <= trial.error:
                return after
            best = after.better(best)
        return best

    def _tried(self, u: FloatArray, inertial: FloatArray, pressure: FloatArray) -> Trial | None:
        """Return what is out of balance at a displacement; None where an element is inverted."""
        engine = self._engine
        balance, mismatch, smallest = self._elements.forces(u, pressure)
        if not smallest > 0.0:
            return None
        contact = np.zeros_like(balance)
        for near in self._near:
            near.add_force(u, contact)
        residual, allowed = self._implicit_step(self._duration, ()).balance(u, balance, contact)
        rubbing = sum(some.rubbing(u) for some in lips_of(self._elements.assembler))
        wrong, touching = float(np.abs(residual).sum()), float(np.abs(contact).sum()) + rubbing
        balance += (engine.mass / self._duration**2)[:, None] * (u - inertial) - self.external_force
        error = wrong / (float(allowed) / engine.tolerance + touching)
        exerted = touching
        if touching and not rubbing:  # a body that is pulled off its table hardly touches it; friction of sides is small beside pulls
            pulls = [np.abs((balance - contact)[nodes].sum(axis=0)).sum() for nodes in self.bodies[1:]]
            exerted = max(touching, *map(float, pulls)) if pulls else touching
        felt = wrong / (exerted + engine.faint_mn) if touching else 0.0
        return Trial(u, pressure, balance, contact, mismatch, error, felt)

    def _with_contact(
        self, tangent: EarlierTangent, trial: Trial, balance: FloatArray, first: bool
    ) -> Generator[None, None, FloatArray | None]:
        """Return the step (n, 3), mm, that brings a balance (n, 3), mN, without contact to zero, with contacts as they are then, if any."""
        sides = self._approaching(tangent, trial.displacement)
        if sides is not None:  # without what presses now, so that the sides slide by about as much as in the end
            balance += sides.now(len(balance)).reshape(-1, 3)
        balance[self._constrained] = 0.0
        x = -tangent.factors.solve(balance.ravel())
        free = x.reshape(-1, 3)  # gripped nodes move as well: they are held below
        marked = np.zeros(len(free), dtype=bool)
        marked[tangent.touched] = True
        active = []
        for near in self._near:
            known = tangent.factors.covered(near.contact.nodes).all(axis=1)
            touches = (near.gap < 0.0) | (near.reached(trial.displacement, free) & known) | marked[near.contact.nodes].any(axis=1)
            active.append(near.only(touches))
        lips = [changing_lips(some, tangent, trial.displacement, free) for some in lips_of(self._elements.assembler)]
        for concerned in (*(c.contact.nodes for c in active), *(c.lips.pairs for c in lips)):
            marked[concerned] = True
        gripped = np.concatenate([*self.bodies[1:], np.zeros(0, np.int64)])
        marked[gripped] = marked[tangent.held] = False
        nodes = np.flatnonzero(marked).astype(np.int64)
        if len(nodes) or len(gripped) or sides is not None:
            condensed = yield from self._condensed_to(tangent, nodes, gripped, trial)
            if condensed is None:
                return None
            nodes = condensed.nodes
            places = [*self._places, *([self._engine._pairs] if lips else [])]
            law = ContactBesideTangent(nodes, trial.displacement, [*active, *lips], places, self._engine._surface, tangent, sides)
            begin = np.zeros_like(free)  # but nodes that indenters touch are carried along by them
            for near, gaps in zip(self._near if first else (), self._gaps, strict=False):
                carried = near.contact.nodes[gaps[near.points] < 0.0]
                way = near.contact.stop - near.contact.start
                begin[carried] = self.reached.displacement[carried] + way - trial.displacement[carried]
            extent, faint = self.engine._extent, self._engine.faint_mn
            longest = min(0.05 * extent, float(harmless_ways(self.indenters).min(initial=np.inf)))
            limits = (RUBBING, RUBBING) if self.engine.assembler.unsymmetric else (CHANGES, UNAIDED)
            still, begins = (np.concatenate([motion[nodes], *motion_in_threes(sides, motion)]) for motion in (free, begin))
            alone = condensed.held(still, free[gripped])
            if sides is not None:
                sides.slide(free)
            force = yield from condensed.forces(alone, law, begins, 1e-5 * extent, longest, faint, *limits, self._sought_until())
            holding = condensed.holding(free[gripped], force)
            behind = len(nodes)
            tangent.factors.add_columns(np.concatenate([nodes, gripped]), np.concatenate([force[:behind], holding]), x)
            if sides is not None:
                apart = condensed.moved(alone, force)[behind:]
                x += tangent.factors.solve(sides.on_nodes(force[behind:], apart, tangent.held, len(free)))
        free[self._constrained] = 0.0
        return free

    def _condensed_to(
        self, tangent: EarlierTangent, nodes: IntArray, gripped: IntArray, trial: Trial
    ) -> Generator[None, None, CondensedContact | None]:
        """Return the contact condensed to nodes (k,), beside gripped ones (g,); None where the columns of the inverse take too long.

        A trial that is thrown far off touches hundreds of nodes that a tangent was not prepared for, and leads nowhere.
        """
        condensed = self._condensed
        if condensed is not None and condensed.serves(tangent, nodes, gripped):
            return condensed
        both = np.concatenate([nodes, gripped])
        many = np.count_nonzero(~tangent.factors.covered(both)) > UNFORESEEN
        if many and trial.error > UNLIKELY and self._duration == self.engine.step:
            return None
        for _ in tangent.factors.prepared(both):
            if time.thread_time() > self._patience:
                return None
            yield
        self._condensed = CondensedContact(tangent, nodes, self._engine.stiffness_at(nodes, tangent.pairs), gripped)
        return self._condensed

    def _approaching(self, tangent: EarlierTangent, displacement: FloatArray) -> ApproachingLips | None:
        """Return the pairs of the sides of cuts whose approach a tangent knows, at a displacement (n, 3), mm."""
        known = tangent.pairs.n_pairs > 0
        return ApproachingLips.of(lips_of(self._elements.assembler)[0], tangent, displacement) if known else None

    def _accepted(self, h: float, u: FloatArray, contacts: tuple[Contact, ...], spin: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Keep the end of a step; returns the forces of the bodies and of the indenters, mN."""
        trial, self._slipped, self._begun = self._trial, self.reached.lips, self.reached.multipliers
        self.unbalanced = 0.0 if trial is None else trial.unbalanced
        if trial is None:
            return DynamicSession._accepted(self, h, u, contacts, spin)
        of_indenters, anchors, gaps = np.zeros((len(contacts), 3)), [], []
        for k, (contact, near) in enumerate(zip(contacts, self._near, strict=True)):
            of_indenters[k] = near.response.orientation @ near.response.force.sum(axis=0)
            local, gap = local_positions(contact, u, 1.0)
            gaps.append(gap)
            local[near.points] = near.contact.next_anchors(near.response)
            anchors.append(local)
        self.reached = self._behind(h, u, contacts, spin, tuple(anchors))
        self._pressure, self._gaps = trial.pressure, tuple(gaps)
        if h < self.engine.step:
            return self._exerted(trial), of_indenters
        ahead = self._soon_touched(contacts, self._gaps)
        self._renew(ahead)
        if self._spare and self._earlier is not None:
            self._earlier.factors.prepare(ahead[~self._earlier.factors.covered(ahead)][:SPARE])
        return self._exerted(trial), of_indenters

    def _exerted(self, trial: Trial) -> FloatArray:
        return np.array([(trial.balance - trial.contact)[nodes].sum(axis=0) for nodes in self.bodies]).reshape(-1, 3)
