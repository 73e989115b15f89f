"""Contact condensed to its nodes: a body that follows an earlier tangent, with contacts as they are.

In an iteration with the tangent A of an earlier state, a body moves by ``dx = free + A^-1 E g(y)``: `free` without contact, and g the
forces of contacts beside those that A contains, at the motion y = E^T dx of the nodes concerned. Newton's method finds y with the part
``W = E^T A^-1 E`` of the inverse alone (:cite:t:`courtecuisse2010` condense contacts in this way), at a cost that does not depend on the
size of the body. Contacts that open, close, stick or slip cost no iteration of the whole body then.

The derivative of Coulomb friction vanishes along the direction of slip. Steps of Newton's method are far too long where points begin or
cease to slip, and points stick and slip by turns. With the secant of the friction instead, the force over the elastic slip, every step
reduces the energy of friction of a known limit (Kacanov's method :cite:p:`han1997`). One such matrix serves for many steps, which
Anderson's acceleration mixes :cite:p:`walker2011`. Near its end, where no point changes between sticking and slipping any more, these steps
creep, and those of Newton's method with the derivative itself end the search. Where points change until the end, the steps of Newton's
method are cut where the forces that are left do no more work along them.

The tangent of a compressed body may be indefinite without the contact that held its surface. Where that contact slips or opens, and the
body has moved on, such a tangent has no equilibrium nearby, and forces grow without bound. Springs as stiff as the elements then hold the
nodes back, as in the method of Levenberg and Marquardt :cite:p:`nocedal2006`. From the balance with them, weaker ones go on, and at last
none; where that does not succeed, the iterations of the whole body take up what the weakest have left.
"""

from __future__ import annotations

import time
from collections.abc import Generator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent
from naibu.mechanics.linear_algebra.anderson import AndersonMixing
from naibu.mechanics.linear_algebra.updated_factors import BlockChange, ChangedInverse

EVALUATIONS = 60  # of the contact at most
CHANGES = 12  # matrices at most
UNAIDED = 10  # of them before steps of another kind
DAMPED = 20  # matrices of these, with the derivative of friction, before nodes are held back
FAR = 3  # steps that are cut short, after which nodes are held back
WEAKER = 8.0  # times which springs become weaker where a balance with them is found
WEAKEST = 0.01  # of the stiffness of the elements: springs that are not made weaker still, but left out
DEPTH = 6  # earlier steps with a matrix that are mixed
TRIAL = 3  # steps with a matrix before it is judged: where a point closes, what is left grows before it vanishes
SLOW = 0.7  # of what was left: mean progress of a step from which another matrix is worth while
JUMP = 3.0  # growth of what is left from which it is at once
CLOSE = 3.0  # times the tolerance: what may be left where a matrix has the derivative of friction instead of its secant
USUAL = 6  # evaluations after which ten times the tolerance is enough
BALANCED = 0.003  # of the forces: how much those of the motion that they lead to may differ, where hardly any motion is left
DOWNHILL = 2  # times as many matrices where steps end when the forces that are left do no more work
LEFT = 0.5  # of the work at the beginning of such a step: what may be left at its end
SEARCHED = 8  # ends of a step that are tried
UNMOVED, IDLE = 0.01, 3  # change of what is left in two such steps, and how many in a row change it by no more before they are given up
ENOUGH = 0.005  # likewise, where no further matrix is worth while
ROUNDED = 0.1  # of the tolerance: what is left below it, and no longer falls by half in so many evaluations, is rounding
AT_FLOOR = 3


class ContactLaw(Protocol):
    """Forces of contacts at a motion of their nodes, beside those that a tangent contains.

    Attributes
    ----------
    exerted : float
        Sum of the components of all forces of contact at the last motion, mN, those that the tangent contains included. Where sides slide
        that stick in the tangent, these forces are small, and those beside it are not.
    """

    exerted: float

    @property
    def slips(self) -> bool:
        """Whether `change` contains a secant of friction that its exact derivative does not."""

    def __call__(self, motion: FloatArray) -> FloatArray:
        """Return the forces (k, 3), mN, at a motion (k, 3), mm."""

    def change(self, *, exact: bool = False) -> BlockChange:
        """Return minus the derivative of the forces at the last motion, with the secant of friction along the slip, or `exact` without it.

        Its nodes are places among the k.
        """

    def opened(self) -> BlockChange:
        """Return what `change` would be if no contact touched."""


@dataclass(slots=True, eq=False)
class CondensedContact:
    """Nodes concerned by contacts, and how they move one another.

    Attributes
    ----------
    tangent : EarlierTangent
        The body.
    nodes : ndarray, shape (k,), int64
        Their numbers in the body. Behind them come the pairs of the tangent whose approach is condensed, in rows of three: what is said of
        nodes (k, 3) below is said of their approach as well.
    stiffness : ndarray, shape (k,)
        Of the elements at the nodes, mN/mm, and at the pairs.
    gripped : ndarray, shape (g,), int64
        Other nodes, which do not move.
    balanced : bool
        Whether the last forces that were sought are those of a balance, with springs or without.
    """

    tangent: EarlierTangent
    nodes: IntArray
    stiffness: FloatArray
    gripped: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    balanced: bool = field(init=False, default=True)
    _carried: NDArray[np.float32] = field(init=False)  # forces on gripped nodes (3 g, 3 k) from forces on the others, negative
    _holding: tuple[FloatArray, NDArray[np.int32]] = field(init=False)
    _inverse: NDArray[np.float32] = field(init=False)
    _changed: ChangedInverse | None = field(init=False, default=None)
    _share: float = field(init=False, default=0.0)  # of the stiffness of the elements, with which springs hold the nodes back
    _held_by: float = field(init=False, default=0.0)  # the share that `_changed` contains

    def __post_init__(self) -> None:
        whole = self._with_pairs(self.tangent.factors.between(np.concatenate([self.nodes, self.gripped])))
        free = len(whole) - 3 * len(self.gripped)
        self._inverse, self._carried = whole, np.zeros((0, free), dtype=np.float32)
        if len(self.gripped):
            self._holding = la.lu_factor(whole[free:, free:].astype(np.float64), check_finite=False)
            self._carried = np.asarray(la.lu_solve(self._holding, whole[free:, :free], check_finite=False), dtype=np.float32)
            self._inverse = np.asfortranarray(whole[:free, :free] - whole[:free, free:] @ self._carried)

    def _with_pairs(self, between: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the part of the inverse between nodes, pairs and gripped nodes, from that between nodes and gripped nodes."""
        pairs, own = self.tangent.pairs, 3 * len(self.nodes)
        count = pairs.n_pairs
        if count == 0:
            return between
        rows = 3 * -(-count // 3)
        whole = np.zeros((len(between) + rows, len(between) + rows), dtype=np.float32, order="F")
        place = np.concatenate([np.arange(own), np.arange(own + rows, len(whole))])
        across = pairs.under(self.tangent.factors, np.concatenate([self.nodes, self.gripped]))
        whole[np.ix_(place, place)] = between
        whole[own : own + count, place], whole[place, own : own + count] = across, across.T
        whole[own : own + count, own : own + count] = pairs.inverse
        return whole

    def serves(self, tangent: EarlierTangent, nodes: IntArray, gripped: IntArray) -> bool:
        """Whether these nodes (l,) are among those of the same body, of which the same ones are gripped."""
        same = tangent is self.tangent and np.array_equal(gripped, self.gripped)
        return same and bool(np.isin(nodes, self.nodes, assume_unique=True).all())

    def held(self, free: FloatArray, gripped: FloatArray) -> FloatArray:
        """Return the motion of the nodes (k, 3), mm, if the gripped ones are held, from those (k, 3) and (g, 3) without grip."""
        return free - (gripped.ravel() @ self._carried).reshape(-1, 3)

    def moved(self, alone: FloatArray, force: FloatArray) -> FloatArray:
        """Return the motion of the nodes (k, 3), mm, under forces (k, 3), mN, from that without them."""
        return alone + (self._inverse @ force.ravel().astype(np.float32)).reshape(-1, 3)

    def holding(self, gripped: FloatArray, force: FloatArray) -> FloatArray:
        """Return what holds the gripped nodes (g, 3), mN, from their motion (g, 3) without grip and the forces on the others (k, 3)."""
        if len(gripped) == 0:
            return gripped
        still = la.lu_solve(self._holding, gripped.ravel(), check_finite=False)
        return np.asarray(-(still + self._carried @ force.ravel().astype(np.float32)).reshape(-1, 3))

    def forces(
        self,
        free: FloatArray,
        law: ContactLaw,
        begin: FloatArray,
        tolerance_mm: float,
        longest_mm: float,
        faint_mn: float,
        most: int = CHANGES,
        unaided: int = UNAIDED,
        until: float = np.inf,
    ) -> Generator[None, None, FloatArray]:
        """Return the forces g (k, 3), mN, under which ``y = free + W g(y)``; the best that is found in a few iterations.

        It yields before it factorizes, which takes longest: one may go on later.

        Parameters
        ----------
        free : ndarray, shape (k, 3)
            Motion of the nodes without contact, mm.
        law : ContactLaw
            The forces g.
        begin : ndarray, shape (k, 3)
            First guess of y, mm.
        tolerance_mm : float
            What is left of the equation at its end, mm. Where contact is so light that this motion matters to its forces, it is less.
        longest_mm : float
            Motion in one iteration at most, mm: no node may pass through an indenter.
        faint_mn : float
            Forces so small, mN, that it does not matter by how much they are wrong.
        most : int
            Matrices at most.
        unaided : int
            Of them before steps of Newton's method that are cut, and after these, nodes are held back.
        until : float
            Time of the thread, s, from which no further matrix is made.
        """
        search = _Search(self, free, law, tolerance_mm, longest_mm, faint_mn, until)
        anchor, kept = begin, None
        while True:
            aided = self._share > 0.0 or most == unaided
            found, balanced = yield from search.near(anchor, most if aided else unaided, EVALUATIONS if aided else FAR)
            if not (balanced or aided or self.tangent.pairs.n_pairs) and law.slips:
                found, balanced = yield from search.downhill(found, DAMPED, exact=True)
            self.balanced = balanced or kept is not None
            if balanced and self._share == 0.0:
                return found.force
            if balanced:  # the springs go on from where the nodes are, and weaker: at last they take nothing
                anchor, kept = found.motion, found
                self._share = self._share / WEAKER if self._share > WEAKEST else 0.0
            elif kept is not None:
                self._share = WEAKER * max(self._share, WEAKEST / WEAKER)
                return kept.force
            elif self._share == 1.0 or most == unaided or len(law.opened().nodes) == 0:
                return found.force
            else:
                self._share = 1.0


@dataclass(slots=True, eq=False)
class _Search:
    """A search for the motion ``y = free + W g(y)``; see `CondensedContact.forces` for the attributes."""

    body: CondensedContact
    free: FloatArray
    law: ContactLaw
    tolerance_mm: float
    longest_mm: float
    faint_mn: float
    until: float
    _begin: FloatArray = field(init=False)
    _springs: FloatArray = field(init=False)  # that hold the nodes back (k,), mN/mm

    def near(self, begin: FloatArray, most: int, far: int) -> Generator[None, None, tuple[_Motion, bool]]:
        """Return the best that is found from a motion (k, 3), mm, with springs that end there, and whether it is a balance with them.

        It takes at most so many matrices, and none once more than `far` steps have been longer than they may.
        """
        body, law, self._begin = self.body, self.law, begin
        self._springs = np.zeros(len(begin))
        if body._share:
            held = law.opened().nodes
            self._springs[held] = body._share * body.stiffness[held]
        if body._held_by != body._share:
            body._changed, body._held_by = None, body._share
        at = best = begun = self._tried(begin)
        evaluations, changes, steps, cut_short, mixing = 1, 0, 0, 0, AndersonMixing(DEPTH)
        floor = _Floor(ROUNDED * self.tolerance_mm)
        useless, exact, slips = body._changed is None, False, law.slips
        while evaluations < EVALUATIONS:
            if at.size <= self.tolerance_mm * (1.0 if evaluations < USUAL else 10.0) and self._consistent(at, BALANCED):
                return at, True
            if body._changed is None or useless:
                if self._consistent(at, ENOUGH):
                    return at, True
                if changes and body.tangent.pairs.n_pairs:
                    return (yield from self.downhill(best, DOWNHILL * most))
                if changes == most or cut_short > far or (changes and time.thread_time() > self.until):
                    break
                yield
                law(at.motion)  # its last motion may be another
                exact = slips and at.size <= CLOSE * self.tolerance_mm
                change = law.change(exact=exact).with_springs(self._springs)
                body._changed, changes = ChangedInverse.of(body._inverse, change), changes + 1
                begun, steps, mixing = at, 0, AndersonMixing(DEPTH)
            step = mixing.step(at.motion.ravel(), -body._changed.solve(at.left).ravel()).reshape(-1, 3)
            share = min(1.0, self.longest_mm / max(float(np.abs(step).max()), 1e-300))
            cut_short += share < 1.0
            before, at = at, self._tried(at.motion + share * step)
            evaluations, steps = evaluations + 1, steps + 1
            if mixing.steps > 1 and at.size > JUMP * before.size:
                at, mixing = before, AndersonMixing(DEPTH)
            slow = steps >= TRIAL and at.size > SLOW**steps * begun.size
            slow |= slips and not exact and SLOW * before.size < at.size <= CLOSE * self.tolerance_mm
            useless = slow or share < 1.0 or at.size > JUMP * begun.size
            if exact and useless:  # points begin or cease to slip after all
                at, slips = best, False
            if at.size < best.size:
                best = at
            if floor.reached(at.size):
                return best, True
        return best, False

    def downhill(self, at: _Motion, most: int, *, exact: bool = False) -> Generator[None, None, tuple[_Motion, bool]]:
        """Return the best that steps of Newton's method find from a motion, with at most so many matrices, and whether it is a balance.

        Hundreds of pairs that open and close at once let such steps go much too far. The energy of pairs without friction is convex: along
        every step, the forces that are left do work until it is least, and there the step ends. They are left of the forces under which a
        motion is ``y = free + W f``, which a whole step determines. With friction, whose derivative may be `exact`, no such energy exists,
        but a step that ends there does not carry points past where they begin to stick.
        """
        law, nodes, best, exerted, idle, sizes = self.law, len(self.body.nodes), at, None, 0, [np.inf, at.size]
        floor = _Floor(ROUNDED * self.tolerance_mm)
        for _ in range(most):
            if time.thread_time() > self.until or idle == IDLE:
                break
            yield
            law(at.motion)  # its last motion may be another
            change = law.change(exact=exact).with_springs(self._springs)
            self.body._changed = changed = ChangedInverse.of(self.body._inverse, change)
            step = -changed.solve(at.left)
            resisted = change.times(step)
            share = min(1.0, self.longest_mm / max(float(np.abs(step[:nodes]).max(initial=0.0)), 1e-300))
            if exerted is None:
                if share < 1.0:
                    break
                exerted = at.force - resisted
            else:
                further = at.force - exerted - resisted
                share = self._least(at.motion, exerted, step, further, share)
                exerted = exerted + share * further
            at = self._tried(at.motion + share * step)
            best = at if at.size < best.size else best
            sizes.append(at.size)
            idle = idle + 1 if abs(at.size - sizes[-3]) <= UNMOVED * at.size else 0
            if at.size <= 10.0 * self.tolerance_mm and self._consistent(at, ENOUGH):
                return at, True
            if floor.reached(at.size):
                return best, True
        return best, False

    def _least(self, motion: FloatArray, exerted: FloatArray, step: FloatArray, further: FloatArray, most: float) -> float:
        """Return the share of a step, and of the change of forces along it, at which the forces that are left do nearly no work on it."""

        def work(share: float) -> float:
            left = exerted + share * further - self._forces(motion + share * step)
            return float((left * step).sum())

        low, high, first = 0.0, most, work(0.0)
        at_low, at_high = first, work(most)
        for _ in range(SEARCHED):
            if abs(at_high) <= LEFT * abs(first) or at_high < 0.0:
                break
            share = low + (high - low) * min(max(at_low / (at_low - at_high), 0.1), 0.9)
            now = work(share)
            if abs(now) <= LEFT * abs(first):
                return share
            low, at_low, high, at_high = (share, now, high, at_high) if now < 0.0 else (low, at_low, share, now)
        return high

    def _tried(self, motion: FloatArray) -> _Motion:
        force = self._forces(motion)
        left = motion - self.body.moved(self.free, force)
        return _Motion(motion, force, left, float(np.abs(left).max(initial=0.0)), self.law.exerted)

    def _forces(self, motion: FloatArray) -> FloatArray:
        """Return the forces (k, 3) of contacts, and of the springs that hold the nodes back, mN."""
        return np.asarray(self.law(motion) - self._springs[:, None] * (motion - self._begin))

    def _consistent(self, at: _Motion, fraction: float) -> bool:
        """Whether the forces of a motion are, but for little, those of the motion that they lead to."""
        if np.isnan(at.apart):
            at.apart = float(np.abs(self._forces(at.motion - at.left) - at.force).sum())
        return at.apart <= fraction * (min(float(np.abs(at.force).sum()), at.exerted) + self.faint_mn)


@dataclass(slots=True, eq=False)
class _Floor:
    """Tells where what is left of an equation no longer falls, mm, far below what is sought.

    The inverse has single precision. Where stiff contacts press hard against each other, and together exert next to nothing, what rounding
    leaves of the motion is more than their forces may differ by, and neither evaluations nor matrices make it less.
    """

    below: float
    least: float = np.inf
    idle: int = 0

    def reached(self, size: float) -> bool:
        """Take note of what is left, mm, and say whether it has stayed."""
        self.idle = self.idle + 1 if 0.5 * self.least < size <= self.below else 0
        self.least = min(self.least, size)
        return self.idle == AT_FLOOR


@dataclass(slots=True, eq=False)
class _Motion:
    """A motion of the nodes concerned, mm.

    Attributes
    ----------
    motion : ndarray, shape (k, 3)
        y, mm.
    force : ndarray, shape (k, 3)
        g(y), mN.
    left : ndarray, shape (k, 3)
        y - free - W g(y), mm.
    size : float
        Its largest component.
    exerted : float
        See `ContactLaw`.
    apart : float
        Sum of the components by which the forces differ from those of the motion that they lead to, mN; NaN until it is asked for.
    """

    motion: FloatArray
    force: FloatArray
    left: FloatArray
    size: float
    exerted: float
    apart: float = np.nan
