"""Contact condensed to its nodes: a body that follows an earlier tangent, with contacts as they are.

In an iteration with the tangent A of an earlier state, a body moves by ``dx = free + A^-1 E g(y)``: `free` without contact, and g the
forces of contacts beside those that A contains, at the motion y = E^T dx of the nodes concerned. Newton's method finds y with the part
``W = E^T A^-1 E`` of the inverse alone (:cite:t:`courtecuisse2010` condense contacts in this way), at a cost that does not depend on the
size of the body. Contacts that open, close, stick or slip cost no iteration of the whole body then.
"""

from __future__ import annotations

from collections.abc import Sequence
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

EVALUATIONS = 24  # of the contact at most
PATIENCE = 3  # iterations that may make things worse: where a point closes, what is left grows before it vanishes
USUAL = 6  # evaluations after which ten times the tolerance is enough
HALVINGS = 5  # of a step that does not improve: points may stick and slip by turns
FAST = 0.2  # of what was left: progress with which an earlier derivative of the contact goes on being used


class ContactLaw(Protocol):
    """Forces of contacts at a motion of their nodes."""

    def __call__(self, motion: FloatArray) -> FloatArray:
        """Return the forces (k, 3), mN, at a motion (k, 3), mm."""

    def change(self) -> BlockChange:
        """Return minus the derivative of the forces at the last motion; its nodes are places among the k."""


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

    def forces(self, free: FloatArray, law: ContactLaw, begin: FloatArray, tolerance_mm: float, longest_mm: float) -> FloatArray:
        """Return the forces g (k, 3), mN, under which ``y = free + W g(y)``; the best that is found in a few iterations.

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

        def evaluated(y: FloatArray) -> tuple[FloatArray, FloatArray, float]:
            force = law(y)
            left = y - free - (self._inverse @ force.ravel().astype(np.float32)).reshape(-1, 3)
            return force, left, float(np.abs(left).max(initial=0.0))

        y, evaluations, unhelpful, fast = begin, 1, 0, True
        force, left, size = evaluated(y)
        best, least, nearest = force, size, y
        while size > tolerance_mm * (1.0 if evaluations < USUAL else 10.0) and evaluations < EVALUATIONS:
            if self._changed is None or not fast:
                self._changed = ChangedInverse.of(self._inverse, law.change())
            step, before = self._changed.solve(left), size
            share = min(1.0, longest_mm / float(np.abs(step).max()))
            for k in range(HALVINGS + 1):
                force, left, size = evaluated(y - share * step)
                evaluations += 1
                if size < (1.0 - 0.1 * share) * before or unhelpful < PATIENCE or k == HALVINGS:
                    break
                share *= 0.5
            y, fast, unhelpful = y - share * step, size <= FAST * before, unhelpful + 1
            if size < least:
                best, least, nearest, unhelpful = force, size, y, 0
            elif unhelpful == PATIENCE:
                y, fast = nearest, False
                force, left, size = evaluated(y)
        return best


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

    def change(self) -> BlockChange:
        """Return minus the derivative of the forces at the last motion; its nodes are places among the k."""
        blocks = np.zeros((self.pattern.n_blocks, 3, 3))
        for contact, places in zip(self.contacts, self.places, strict=False):  # lips, which come last, are not always there
            contact.touching().add_stiffness(self.pattern, places, blocks)
        return contact_change(self.pattern, blocks, self.tangent, self.nodes, self._place, self.gripped, self.hold)
