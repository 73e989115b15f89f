"""Dynamic sessions of finite elements in real time: the steps of `dynamic_session` by a quasi-Newton method with earlier tangents.

Each step solves the same balance of momentum, with the same elements, law and contact, by iterations that need no tangent of their own.
They use the factors of the tangent of an earlier state, which a thread renews in the background, as in the asynchronous preconditioning of
:cite:t:`courtecuisse2010`. Two things change faster than those factors, and are treated exactly: what resists a change of volume, by
pressures of their own (`naibu.mechanics.finite_elements.pressure_elements`), and contacts that open, close, stick or slip, by the formula
of Woodbury. Anderson's acceleration does the rest. A step that these iterations do not solve is taken by Newton's method.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, Int32Array, IntArray
from naibu.mechanics.contact.indenter_motion import parts_of_approach, slow_enough
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.finite_elements.pressure_elements import PressureElements
from naibu.mechanics.finite_strain.lip_assembly import lips_of
from naibu.mechanics.finite_strain.nearby_contact import NearbyContact, local_positions
from naibu.mechanics.finite_strain.sessions.condensed_contact import CondensedContact, ContactBesideTangent
from naibu.mechanics.finite_strain.sessions.dynamic_session import PENETRATION, DynamicEngine, DynamicSession, DynamicState
from naibu.mechanics.finite_strain.sessions.earlier_tangent import EarlierTangent, SolverPool, TangentThread
from naibu.mechanics.finite_strain.sessions.lips_beside_tangent import changing_lips
from naibu.mechanics.finite_strain.sessions.nodes_ahead import nodes_ahead
from naibu.mechanics.finite_strain.sessions.session_checks import dead_load
from naibu.mechanics.finite_strain.sessions.trial_displacement import FELT, PASSABLE, Trial
from naibu.mechanics.linear_algebra.anderson import AndersonMixing
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern, block_pattern, with_dirichlet_rows
from naibu.mechanics.linear_algebra.updated_factors import UpdatedFactors

ITERATIONS = 5  # of a step at most
USUAL = 2  # of a step whose balance is then passable
DEPTH = 4  # earlier iterations that are mixed
FAINT = 1e-5  # strain of the body under contact forces too small to be told from none
ACCEPTED = 0.06  # of a step that has used up its iterations; where it was 0.2, some later steps found no balance and took seconds
BUDGET_S = 0.01  # of a processor for a step, after which a passable balance is taken; one that is worse goes on, and real time is lost
DIVERGED = 1e6  # out-of-balance force from which a step is tried from another beginning
FURTHER, NEARER = 5, 0.7  # more of them, where the others reduced the error to so much of what it was before
FEW = 200  # nodes of contact at most with which they cost less than a tangent of the step's own
UNLIKELY = 0.3  # error at the end of the motion from which the body at rest is tried
SPARE = 8  # nodes for which a step that took no iteration prepares the inverse, if they are about to be in contact and it is not known
JUMP = 10.0  # its growth from which earlier iterations are forgotten, as where contacts close
STIFFEST = 16.0  # times the first penalty, to which penalties rise: stiffer ones need more iterations
RAISE = 1.3  # of a penalty in a step; where it leaps, pressure and limit of friction do, and the surface slips to another equilibrium
PERIOD = 10  # steps after which a tangent is renewed without a thread


@dataclass(frozen=True, slots=True, eq=False)
class RealTimeEngine(DynamicEngine):
    """A finite element model prepared for implicit dynamic steps in real time; see `DynamicEngine` for the other attributes.

    Attributes
    ----------
    background : bool
        Whether a thread renews the factors, and iterations end when the time of a step is over; otherwise factors are renewed before every
        tenth step, and runs are repeatable.
    """

    background: bool = True
    _elements: PressureElements = field(init=False)
    _surface: BlockPattern = field(init=False)
    _pairs: Int32Array = field(init=False)  # of the sides of cuts, in this pattern
    _solvers: SolverPool = field(init=False)
    _rest: list[EarlierTangent] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        DynamicEngine.__post_init__(self)
        object.__setattr__(self, "_elements", PressureElements.of(self.assembler))
        pairs = np.concatenate([np.zeros((0, 2), np.int64), *(lips.pairs for lips in lips_of(self.assembler))])
        object.__setattr__(self, "_surface", block_pattern(len(self.points), self.faces, pairs))
        object.__setattr__(self, "_pairs", self._surface.positions(pairs))
        object.__setattr__(self, "_solvers", SolverPool(self.assembler.pattern))

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
class RealTimeSession(DynamicSession):
    """A body in motion that a loop steps in real time; made by `RealTimeEngine.session`. See `DynamicSession` for the other attributes.

    Attributes
    ----------
    newton_steps : int
        Steps so far that Newton's method had to take.
    waits : int
        Steps so far that had to wait for a tangent of their own.
    iterations : int
        Quasi-Newton iterations so far.
    unbalanced : float
        Sum of the nodes' out-of-balance forces at the end of the last step, which the next steps take up, as a fraction of the sum of all
        forces or of those of contact, whichever is more.
    """

    newton_steps: int = field(init=False, default=0)
    waits: int = field(init=False, default=0)
    iterations: int = field(init=False, default=0)
    unbalanced: float = field(init=False, default=0.0)
    _earlier: EarlierTangent | None = field(init=False, default=None)
    _thread: TangentThread = field(init=False, default_factory=TangentThread)
    _near: tuple[NearbyContact, ...] = field(init=False, default=())
    _gaps: tuple[FloatArray, ...] = field(init=False, default=())
    _places: tuple[Int32Array, ...] = field(init=False, default=())
    _pressure: FloatArray | None = field(init=False, default=None)
    _condensed: CondensedContact | None = field(init=False, default=None)
    _trial: Trial | None = field(init=False, default=None)
    _elements: PressureElements = field(init=False, repr=False)  # with the normals of the sides of cuts when the step begins
    _seen: FloatArray | None = field(init=False, default=None)
    _age: int = field(init=False, default=0)
    _spare: bool = field(init=False, default=False)  # whether the last step took no iteration

    def press(self, indenters: Sequence[RigidIndenter]) -> None:
        """Bring these indenters, and no others, into play; see `DynamicSession.press`."""
        DynamicSession.press(self, indenters)
        self._places = tuple(self._engine._surface.positions(c.nodes) for c in self._templates)
        self._near, self._gaps, self._trial = (), (), None

    def restore(self, state: DynamicState) -> None:
        """Go on from a state; see `DynamicSession.restore`."""
        DynamicSession.restore(self, state)
        self._pressure, self._near, self._gaps, self._trial = None, (), (), None

    def keep_tangent(self) -> None:
        """Have the tangent of the state reached at hand for the next sessions of the engine, in place of that of the body at rest."""
        self._engine._rest[:] = [self._untouched(self.reached.displacement)]

    def close(self) -> None:
        """End the thread and release the factors."""
        self._thread.close()
        for tangent in (self._thread.take(), self._earlier):
            self._release(tangent)
        self._earlier = None
        DynamicSession.close(self)

    @property
    def _engine(self) -> RealTimeEngine:
        assert isinstance(self.engine, RealTimeEngine)
        return self.engine

    def _parts(self, moving: FloatArray, along: FloatArray, spin: FloatArray) -> int:
        """Parts of a step in each of which no indenter goes through the body; the loop has no time to divide steps as the body swings."""
        h, at = self.engine.step, self.reached
        if slow_enough(self.indenters, h * along, h * spin):
            return 1
        indenters, points, centres, axes = self._places_of(at)
        return parts_of_approach(indenters, points, np.zeros_like(points), centres, axes, h * along, h * spin)

    def _settled(self, h: float, moving: FloatArray, contacts: tuple[Contact, ...]) -> tuple[tuple[Contact, ...], FloatArray | None]:
        """Return contacts as the next step shall have them, stiffer where a balanced step went too deep, and the displacement."""
        u = self._balanced(h, moving, contacts)
        if u is None or self.unbalanced > PASSABLE:
            return contacts, u
        out = []
        for c, first, depth in zip(contacts, self._templates, self._depths(contacts, u), strict=True):
            raised = np.minimum(RAISE * c.normal_stiffness, STIFFEST * first.normal_stiffness)
            out.append(replace(c, normal_stiffness=np.where(depth > PENETRATION, raised, c.normal_stiffness)))
        return tuple(out), u

    def _balanced(self, h: float, moving: FloatArray, contacts: tuple[Contact, ...]) -> FloatArray | None:
        """Return the displacement that balances momentum after a time `h`; by Newton's method where it is not found in real time."""
        if h == self.engine.step:
            self._trial = self._quasi_newton(moving, contacts)
            if self._trial is not None:
                return self._trial.displacement
            self.newton_steps += 1
            self.unbalanced = 0.0
        self._pressure, self._trial, self._near, self._gaps = None, None, (), ()
        return DynamicSession._balanced(self, h, moving, contacts)

    def _depths(self, contacts: tuple[Contact, ...], u: FloatArray) -> list[FloatArray]:
        """Return how deep indenters go into the faces; see `DynamicSession`. Of quasi-Newton steps only points near them are looked at."""
        if self._trial is None:
            return DynamicSession._depths(self, contacts, u)
        depths = [np.zeros(len(c.nodes)) for c in contacts]
        for depth, near in zip(depths, self._near, strict=True):
            depth[near.points] = -near.gap / near.contact.element_size
        return depths

    def _quasi_newton(self, moving: FloatArray, contacts: tuple[Contact, ...]) -> Trial | None:
        """Return the balance at the end of a step, or None."""
        tangent, start, h = self._current_tangent(), self.reached, self.engine.step
        self._elements = replace(self._engine._elements, assembler=self.engine.assembler.in_step(start.displacement))
        inertial = start.displacement + h * start.velocity
        travel = [float(np.linalg.norm(c.stop - c.start)) for c in contacts]
        fastest = h * float(np.sqrt((start.velocity**2).sum(axis=1).max()))
        if len(self._gaps) != len(contacts):
            self._gaps = tuple(local_positions(c, start.displacement, 0.0)[1] for c in contacts)
        self._near = tuple(
            NearbyContact.of(c, a, gap, 2.0 * (fastest + way) + 0.01 * self.engine._extent)
            for c, a, gap, way in zip(contacts, start.anchors, self._gaps, travel, strict=True)
        )
        pressure = self._pressure
        if pressure is None:
            pressure = self._engine._elements.bulk * self._engine._elements.dilatation(start.displacement)[0]
        before, deadline = self.iterations, (time.thread_time() + BUDGET_S if self._engine.background else np.inf)
        best = self._from_guesses(tangent, moving, inertial, pressure, deadline)
        if best is None or best.error > ACCEPTED:
            self.waits += 1
            best = self._from_guesses(self._renewed(), moving, inertial, pressure, np.inf)
        if best is None or best.error > ACCEPTED:
            return None
        for near in self._near:  # gaps and responses are those of the last trial
            near.add_force(best.displacement, np.zeros_like(best.displacement))
        self.unbalanced, self._spare = max(best.error, best.felt), self.iterations == before
        return best

    def _from_guesses(
        self, tangent: EarlierTangent, moving: FloatArray, inertial: FloatArray, pressure: FloatArray, deadline: float
    ) -> Trial | None:
        """Return the best that is found from the guesses, one after the other until a balance is accepted."""
        best = None
        for first, near, most in self._guesses(tangent, moving, inertial, pressure):
            best = self._iterated(near, first, inertial, deadline, most).better(best)
            if best.error <= ACCEPTED:
                break
        return best

    def _guesses(
        self, tangent: EarlierTangent, moving: FloatArray, inertial: FloatArray, pressure: FloatArray
    ) -> Iterator[tuple[Trial, EarlierTangent, int]]:
        """Yield where the motion leads and where the body is, with the tangent; before them its rest, if nearer: tools leave it fast."""
        first = self._guessed(inertial, moving, inertial, pressure)
        if first is None or first.error > UNLIKELY:
            for kept in self._engine._rest:
                rest = self._guessed(np.zeros_like(inertial), moving, inertial, np.zeros_like(pressure))
                if rest is not None and np.array_equal(kept.held, tangent.held) and (first is None or rest.error < first.error):
                    yield rest, kept, USUAL
        if first is not None:
            yield first, tangent, ITERATIONS + FURTHER
        still = self._guessed(self.reached.displacement, moving, inertial, pressure)
        if still is not None:
            yield still, tangent, ITERATIONS + FURTHER

    def _guessed(self, guess: FloatArray, moving: FloatArray, inertial: FloatArray, pressure: FloatArray) -> Trial | None:
        """Return what is out of balance at a guess of the displacement (n, 3), mm, with bodies where they are led."""
        start = self.reached.displacement
        target = np.where(self._constrained, start, guess)
        for nodes, speed in zip(self.bodies, moving, strict=True):
            target[nodes] = start[nodes] + self.engine.step * speed
        return self._tried(target, inertial, pressure)

    def _iterated(self, tangent: EarlierTangent, trial: Trial, inertial: FloatArray, deadline: float, most: int) -> Trial:
        """Return the best that at most so many iterations find from a beginning, in the time of a processor that there is."""
        mixing, best, begun, bulk = AndersonMixing(DEPTH), trial, trial.error, self._engine._elements.bulk
        for k in range(most):
            many = self._condensed is not None and len(self._condensed.nodes) > FEW
            if k == ITERATIONS and (best.error <= ACCEPTED or best.error > NEARER * begun or many):
                break
            if trial.finished(bulk, begun=k > 0):
                return trial
            if k and trial.passable(bulk) and ((k >= USUAL and trial.felt <= FELT) or time.thread_time() > deadline):
                return trial
            after = self._improved(tangent, trial, inertial, mixing)
            if after is None or after.error > DIVERGED:
                break
            if after.error > JUMP * trial.error:
                mixing = AndersonMixing(DEPTH)
            trial = after
            best = trial.better(best if k else None)
        return best

    def _improved(self, tangent: EarlierTangent, trial: Trial, inertial: FloatArray, mixing: AndersonMixing) -> Trial | None:
        """Return the end of one quasi-Newton iteration; None where it inverts an element."""
        elements = self._engine._elements
        self.iterations += 1
        force = trial.balance.copy()
        elements.add_pressures(tangent.dilatation, trial.mismatch, force)
        step = self._with_contact(tangent, trial, force, not mixing.steps)
        if not np.isfinite(step).all():  # a tangent that has no factors in single precision
            if tangent is self._earlier:
                self._release(tangent)
                self._earlier, self._condensed = None, None
            return None
        rise = elements.pressure_change(tangent.dilatation, step, trial.mismatch)
        scale = 1e-2 * self.engine._extent / self.engine._modulus  # mm/kPa
        now = np.concatenate([trial.displacement.ravel(), scale * trial.pressure])
        mixed = mixing.step(now, np.concatenate([step.ravel(), scale * rise]))
        step, rise = mixed[: step.size].reshape(-1, 3), mixed[step.size :] / scale
        for a in (1.0, 0.5, 0.25):
            after = self._tried(trial.displacement + a * step, inertial, trial.pressure + a * rise)
            if after is not None:
                return after
        return None

    def _tried(self, u: FloatArray, inertial: FloatArray, pressure: FloatArray) -> Trial | None:
        """Return what is out of balance at a displacement; None where an element is inverted."""
        engine = self._engine
        balance, mismatch, smallest = self._elements.forces(u, pressure)
        if not smallest > 0.0:
            return None
        contact = np.zeros_like(balance)
        for near in self._near:
            near.add_force(u, contact)
        residual, allowed = self._implicit_step(engine.step, ()).balance(u, balance, contact)
        wrong, touching = float(np.abs(residual).sum()), float(np.abs(contact).sum())
        balance += (engine.mass / engine.step**2)[:, None] * (u - inertial) - self.external_force
        error = wrong / (float(allowed) / engine.tolerance + touching)
        felt = wrong / (touching + FAINT * engine._modulus * engine._extent**2) if touching else 0.0
        return Trial(u, pressure, balance, contact, mismatch, error, felt)

    def _with_contact(self, tangent: EarlierTangent, trial: Trial, balance: FloatArray, first: bool) -> FloatArray:
        """Return the step (n, 3), mm, that brings a balance (n, 3), mN, without contact to zero, with contacts as they then are."""
        balance[self._constrained] = 0.0
        x = -tangent.factors.solve(balance.ravel())
        free = x.reshape(-1, 3)  # gripped nodes move as well: they are held by the law below
        marked = np.zeros(len(free), dtype=bool)
        marked[tangent.touched] = True
        active = []
        for near in self._near:
            after = local_positions(near.contact, trial.displacement + free, 1.0)[1]
            known = tangent.factors.covered(near.contact.nodes).all(axis=1)
            touches = (near.gap < 0.0) | ((after < 0.0) & known) | marked[near.contact.nodes].any(axis=1)
            active.append(near.only(touches))
        lips = [changing_lips(some, tangent, trial.displacement, free) for some in lips_of(self._elements.assembler)]
        for concerned in (*(c.contact.nodes for c in active), *(c.lips.pairs for c in lips)):
            marked[concerned] = True
        gripped = np.concatenate([*self.bodies[1:], np.zeros(0, np.int64)])
        marked[gripped] = True
        marked[tangent.held] = False
        nodes = np.flatnonzero(marked).astype(np.int64)
        if len(nodes):
            condensed = self._condensed
            if condensed is None or not condensed.serves(tangent, nodes):
                condensed = self._condensed = CondensedContact(tangent, nodes)
            nodes = condensed.nodes
            hold = 1e3 * float(self._engine._elements.bulk.max()) * self.engine._extent
            places = [*self._places, *([self._engine._pairs] if lips else [])]
            law = ContactBesideTangent(nodes, trial.displacement, [*active, *lips], places, self._engine._surface, tangent, gripped, hold)
            begin = np.zeros_like(free)  # but nodes that indenters touch are carried along by them
            for near, gaps in zip(self._near if first else (), self._gaps, strict=False):
                carried = near.contact.nodes[gaps[near.points] < 0.0]
                way = near.contact.stop - near.contact.start
                begin[carried] = self.reached.displacement[carried] + way - trial.displacement[carried]
            force = condensed.forces(free[nodes], law, begin[nodes], 1e-5 * self.engine._extent, 0.05 * self.engine._extent)
            tangent.factors.add_columns(nodes, force, x)
        free[self._constrained] = 0.0
        return free

    def _accepted(self, h: float, u: FloatArray, contacts: tuple[Contact, ...], spin: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Keep the end of a step; returns the forces of the bodies and of the indenters, mN."""
        trial = self._trial
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
        ahead = self._soon_touched(contacts, gaps)
        self._renew(ahead)
        if self._spare and self._earlier is not None:
            self._earlier.factors.prepare(ahead[~self._earlier.factors.covered(ahead)][:SPARE])
        return np.array([(trial.balance - trial.contact)[nodes].sum(axis=0) for nodes in self.bodies]).reshape(-1, 3), of_indenters

    def _soon_touched(self, contacts: Sequence[Contact], gaps: Sequence[FloatArray]) -> IntArray:
        engine = self._engine
        return nodes_ahead(contacts, gaps, engine.faces.shape[1], engine._extent, engine.assembler, self.reached.displacement)

    def _current_tangent(self) -> EarlierTangent:
        """Return the newest tangent; where there is none for these supports, it is made now."""
        if (done := self._thread.take()) is not None:
            self._take(done)
        for known in (self._earlier, *self._engine._rest):
            if known is not None and np.array_equal(known.held, self._held()):
                self._earlier = known
                return known
        self._engine._rest[:] = [self._untouched(np.zeros_like(self.engine.points))]
        self._earlier, self._seen = self._engine._rest[0], np.zeros_like(self.engine.points)
        return self._earlier

    def _untouched(self, u: FloatArray) -> EarlierTangent:
        """Return the tangent at a displacement without contacts of indenters."""
        gaps = [local_positions(c, self.reached.displacement, 0.0)[1] for c in self._templates]
        return self._made(u, (), (), self._held(), self._soon_touched(self._templates, gaps))

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
            self._thread.submit(partial(self._made, u, self._near, self._places, self._held(), ahead))
        else:
            self._take(self._made(u, self._near, self._places, self._held(), ahead))

    def _renewed(self) -> EarlierTangent:
        """Return the tangent of the state reached, which the step waits for."""
        u = self.reached.displacement
        gaps = []
        for near, contact in zip(self._near, self._templates, strict=True):
            near.add_force(u, np.zeros_like(u))
            gaps.append(np.full(len(contact.nodes), np.inf))
            gaps[-1][near.points] = near.gap
        return self._take(self._made(u, self._near, self._places, self._held(), self._soon_touched(self._templates, gaps)))

    def _take(self, tangent: EarlierTangent) -> EarlierTangent:
        """Use a tangent from now on."""
        self._release(self._earlier)
        self._earlier, self._age, self._condensed = tangent, 0, None
        return tangent

    def _held(self) -> IntArray:
        return self.bodies[0] if self.bodies else np.zeros(0, np.int64)

    def _made(
        self, u: FloatArray, near: tuple[NearbyContact, ...], places: tuple[Int32Array, ...], held: IntArray, ahead: IntArray
    ) -> EarlierTangent:
        """Return the tangent at a displacement with contacts, and columns of its inverse for nodes `ahead`."""
        engine, pattern = self._engine, self._engine.assembler.pattern
        blocks = engine.assembler.evaluate(u)[2]
        contact = np.zeros((engine._surface.n_blocks, 3, 3))
        for some, place, all_places in zip(near, places, self._positions, strict=False):
            some.add_symmetric_stiffness(pattern, all_places, blocks)
            some.add_symmetric_stiffness(engine._surface, place, contact)
        blocks[pattern.diagonal()] += (engine.mass / engine.step**2)[:, None, None] * np.eye(3)
        fixed = np.zeros(engine.points.shape, dtype=bool)
        fixed[held] = True
        solver = engine._solvers.get()
        factors = UpdatedFactors(solver.factorize(with_dirichlet_rows(pattern.matrix(blocks), fixed)), len(u))
        factors.prepare(ahead)
        touched = np.unique(engine._surface.indices[(contact != 0.0).any(axis=(1, 2))]).astype(np.int64)
        lips = np.concatenate([np.zeros((0, 3, 3)), *(some.add(u, np.zeros_like(u))[1] for some in lips_of(engine.assembler))])
        return EarlierTangent(factors, engine._elements.dilatation(u)[1], contact, held, touched, lips, solver)

    def _release(self, tangent: EarlierTangent | None) -> None:
        """Let the solver of a tangent factorize again, unless the tangent is kept for the next session."""
        if tangent is not None and not any(tangent is kept for kept in self._engine._rest):
            self._engine._solvers.put(tangent.solver)
