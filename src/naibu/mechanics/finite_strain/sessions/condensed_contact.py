"""Contact condensed to its nodes: a body that follows an earlier tangent, with contacts as they are.

In an iteration with the tangent A of an earlier state, a body moves by ``dx = free + A^-1 E g(y)``: `free` without contact, and g the
forces of contacts beside those that A contains, at the motion y = E^T dx of the nodes concerned. Newton's method finds y with the part
``W = E^T A^-1 E`` of the inverse alone (:cite:t:`courtecuisse2010` condense contacts in this way), at a cost that does not depend on the
size of the body. Contacts that open, close, stick or slip cost no iteration of the whole body then.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from naibu.core.arrays import FloatArray, Int32Array, IntArray
from naibu.mechanics.finite_strain.nearby_contact import NearbyContact
from naibu.mechanics.finite_strain.sessions.earlier_tangent import EarlierTangent, add_earlier_forces, contact_change
from naibu.mechanics.finite_strain.sessions.lips_beside_tangent import LipsBesideTangent
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern
from naibu.mechanics.linear_algebra.updated_factors import BlockChange, ChangedInverse

EVALUATIONS = 40  # of the contact at most
PATIENCE = 3  # steps that hardly help before they are searched: where a point closes, what is left grows before it vanishes
CHANGES = 12  # derivatives at most
SEARCHES = 5  # motions tried along a step
USUAL = 6  # evaluations after which ten times the tolerance is enough
ENOUGH = 0.005  # of the forces: how much those of the motion that they lead to may differ where no further derivative is worth while
FAST = 0.2  # of what was left: progress with which an earlier derivative of the contact goes on being used


class ContactLaw(Protocol):
    """Forces of contacts at a motion of their nodes."""

    def __call__(self, motion: FloatArray) -> FloatArray:
        """Return the forces (k, 3), mN, at a motion (k, 3), mm."""

    def change(self, symmetric: bool = False) -> BlockChange:
        """Return minus the derivative of the forces at the last motion; its nodes are places among the k.

        Symmetric, it lacks the growth of friction with pressure.
        """


@dataclass(slots=True, eq=False)
class CondensedContact:
    """Nodes concerned by contacts, and how they move one another.

    Attributes
    ----------
    tangent : EarlierTangent
        The body.
    nodes : ndarray, shape (k,), int64
        Their numbers in the body.
    """

    tangent: EarlierTangent
    nodes: IntArray
    _inverse: NDArray[np.float32] = field(init=False)
    _changed: ChangedInverse | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self._inverse = self.tangent.factors.between(self.nodes)

    def serves(self, tangent: EarlierTangent, nodes: IntArray) -> bool:
        """Whether these nodes (l,) are among those of the same body."""
        return tangent is self.tangent and bool(np.isin(nodes, self.nodes, assume_unique=True).all())

    def forces(
        self, free: FloatArray, law: ContactLaw, begin: FloatArray, tolerance_mm: float, longest_mm: float
    ) -> Generator[None, None, FloatArray]:
        """Return the forces g (k, 3), mN, under which ``y = free + W g(y)``; the best that is found in a few iterations.

        It yields before it factorizes, which takes longest: one may go on later.

        A step of Newton's method that hardly helps is searched for where the forces that are out of balance do no more work on it, as in
        `naibu.mechanics.finite_strain.sessions.implicit_step`: with contact, and friction of known limit, a convex energy is least there,
        and points that stick and slip by turns end the search. The growth of friction with pressure may lead a step uphill; the next one
        goes without it.

        Parameters
        ----------
        free : ndarray, shape (k, 3)
            Motion of the nodes without contact, mm.
        law : ContactLaw
            The forces g.
        begin : ndarray, shape (k, 3)
            First guess of y, mm.
        tolerance_mm : float
            What is left of the equation at its end, mm.
        longest_mm : float
            Motion in one iteration at most, mm: no node may pass through an indenter.
        """
        at = self._tried(begin, None, free, law)
        best, evaluations, changes, unhelpful, fast, symmetric = at, 1, 0, 0, True, False
        while at.size > tolerance_mm * (1.0 if evaluations < USUAL else 10.0) and evaluations < EVALUATIONS:
            if self._changed is None or not fast:
                if changes == CHANGES or self._consistent(at, law):
                    break
                yield
                self._changed, changes = ChangedInverse.of(self._inverse, law.change(symmetric)), changes + 1
            step, before = self._changed.solve(at.left), at.size
            target = at.force + self._changed.change.times(step)  # which exerted on the body leads to the end of the step
            share = min(1.0, longest_mm / float(np.abs(step).max()))
            if at.exerted is None or unhelpful < PATIENCE:
                at = self._tried(at.motion - share * step, target if share == 1.0 else None, free, law)
                evaluations += 1
            elif at.work(step) <= 0.0 and not symmetric:
                symmetric, fast = True, False
                continue
            else:
                at, tried = self._searched(at, step, target, share, free, law)
                evaluations += tried
                symmetric = symmetric and at.size > 0.5 * before
            fast, unhelpful = at.size <= FAST * before, unhelpful + (at.size > 0.5 * before)
            if at.size < best.size:
                best = at
        return best.force

    def _tried(self, motion: FloatArray, exerted: FloatArray | None, free: FloatArray, law: ContactLaw) -> _Motion:
        force = law(motion)
        left = motion - free - (self._inverse @ force.ravel().astype(np.float32)).reshape(-1, 3)
        return _Motion(motion, exerted, force, left, float(np.abs(left).max(initial=0.0)))

    def _consistent(self, at: _Motion, law: ContactLaw) -> bool:
        """Whether the forces of a motion are, but for little, those of the motion that they lead to; the law is left where it was."""
        apart = float(np.abs(law(at.motion - at.left) - at.force).sum())
        law(at.motion)
        return apart <= ENOUGH * float(np.abs(at.force).sum())

    def _searched(
        self, at: _Motion, step: FloatArray, target: FloatArray, share: float, free: FloatArray, law: ContactLaw
    ) -> tuple[_Motion, int]:
        """Return where the forces out of balance do little work on a step, and how many motions were tried."""
        assert at.exerted is not None
        before = low_work = at.work(step)
        low, high, high_work = 0.0, 0.0, 0.0
        for k in range(SEARCHES):
            found = self._tried(at.motion - share * step, at.exerted + share * (target - at.exerted), free, law)
            work = found.work(step)
            if abs(work) <= 0.5 * abs(before) or found.size < 0.5 * at.size or (work > 0.0 and high == 0.0) or k == SEARCHES - 1:
                break
            if work > 0.0:
                low, low_work = share, work
            else:
                high, high_work = share, work
            share = low + (high - low) * min(max(low_work / (low_work - high_work), 0.1), 0.9)
        return found, k + 1


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """A motion of the nodes concerned, mm.

    Attributes
    ----------
    motion : ndarray, shape (k, 3)
        y, mm.
    exerted : ndarray, shape (k, 3), optional
        Forces under which the body moves so, mN, where they are known.
    force : ndarray, shape (k, 3)
        g(y), mN.
    left : ndarray, shape (k, 3)
        y - free - W g(y), mm.
    size : float
        Its largest component.
    """

    motion: FloatArray
    exerted: FloatArray | None
    force: FloatArray
    left: FloatArray
    size: float

    def work(self, step: FloatArray) -> float:
        """Return the work of the forces out of balance on a step (k, 3), mm, that is subtracted; mN mm."""
        assert self.exerted is not None
        return float((step * (self.exerted - self.force)).sum())


@dataclass(slots=True, eq=False)
class ContactBesideTangent:
    """Forces of contacts and grips beside those that an earlier tangent contains: a `ContactLaw`.

    Attributes
    ----------
    nodes : ndarray, shape (k,), int64
        The nodes concerned.
    displacement : ndarray, shape (n, 3)
        From which they move, mm.
    contacts : sequence of NearbyContact or LipsBesideTangent
        With points of these nodes only.
    places : sequence of ndarray
        Of all points, or pairs, of every contact in the pattern of the surface.
    pattern : BlockPattern
        Of the surface.
    tangent : EarlierTangent
        With its contacts.
    gripped : ndarray, shape (g,), int64
        Nodes among them that stay where they are.
    hold : float
        Stiffness that represents this, mN/mm.
    """

    nodes: IntArray
    displacement: FloatArray
    contacts: Sequence[NearbyContact | LipsBesideTangent]
    places: Sequence[Int32Array]
    pattern: BlockPattern
    tangent: EarlierTangent
    gripped: IntArray
    hold: float
    _place: IntArray = field(init=False)

    def __post_init__(self) -> None:
        self._place = np.full(len(self.displacement), -1, dtype=np.int64)
        self._place[self.nodes] = np.arange(len(self.nodes))

    def __call__(self, motion: FloatArray) -> FloatArray:
        """Return the forces (k, 3), mN, at a motion (k, 3), mm."""
        moved, force = self.displacement.copy(), np.zeros_like(self.displacement)
        moved[self.nodes] += motion
        pattern = self.pattern
        add_earlier_forces(pattern.indptr, pattern.indices, self.tangent.contact, self.nodes, self._place, motion, force)
        force[self.gripped] -= self.hold * (moved - self.displacement)[self.gripped]
        for contact in self.contacts:
            contact.add_force(moved, force)
        return np.asarray(force[self.nodes])

    def change(self, symmetric: bool = False) -> BlockChange:
        """Return minus the derivative of the forces at the last motion; see `ContactLaw`."""
        blocks = np.zeros((self.pattern.n_blocks, 3, 3))
        for contact, places in zip(self.contacts, self.places, strict=True):
            touching = contact.touching()
            (touching.add_symmetric_stiffness if symmetric else touching.add_stiffness)(self.pattern, places, blocks)
        return contact_change(self.pattern, blocks, self.tangent, self.nodes, self._place, self.gripped, self.hold)
