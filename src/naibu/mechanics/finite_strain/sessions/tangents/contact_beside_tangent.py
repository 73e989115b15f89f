"""Forces of contacts beside those that an earlier tangent of the body contains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray, Int32Array, IntArray
from naibu.mechanics.finite_strain.nearby_contact import NearbyContact
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent, add_earlier_forces, contact_change
from naibu.mechanics.finite_strain.sessions.tangents.lips_beside_tangent import (
    ApproachingLips,
    LipsBesideTangent,
    change_in_threes,
    in_threes,
)
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern
from naibu.mechanics.linear_algebra.updated_factors import BlockChange


@dataclass(slots=True, eq=False)
class ContactBesideTangent:
    """Forces of contacts beside those that an earlier tangent contains: a `ContactLaw` of `condensed_contact`.

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
    sides : ApproachingLips, optional
        Pairs of the sides of cuts whose approach is condensed, in rows of three behind the nodes.
    """

    nodes: IntArray
    displacement: FloatArray
    contacts: Sequence[NearbyContact | LipsBesideTangent]
    places: Sequence[Int32Array]
    pattern: BlockPattern
    tangent: EarlierTangent
    sides: ApproachingLips | None = None
    exerted: float = field(init=False, default=0.0)
    _place: IntArray = field(init=False)
    _there: FloatArray = field(init=False)  # displacements (l, 3) of the nodes and, behind them, of others of contacts, which do not move
    _indenters: list[NearbyContact] = field(init=False)  # with points of nodes in this order
    _lips: list[LipsBesideTangent] = field(init=False)

    def __post_init__(self) -> None:
        self._place = np.full(len(self.displacement), -1, dtype=np.int64)
        self._place[self.nodes] = np.arange(len(self.nodes))
        own = [c.contact.nodes if isinstance(c, NearbyContact) else c.lips.pairs for c in self.contacts]
        concerned = np.unique(np.concatenate([np.zeros(0, np.int64), *(nodes.ravel() for nodes in own)]))
        order = np.concatenate([self.nodes, concerned[self._place[concerned] < 0]])
        number = np.empty(len(self.displacement), dtype=np.int64)
        number[order] = np.arange(len(order))
        self._there = self.displacement[order]
        self._indenters = [c.numbered(number) for c in self.contacts if isinstance(c, NearbyContact)]
        self._lips = [c.numbered(number) for c in self.contacts if isinstance(c, LipsBesideTangent)]

    @property
    def slips(self) -> bool:
        """Whether points may slip: sides of cuts have the secant of their friction always; see `ContactLaw`."""
        return bool(self._indenters) and all(lips.lips.friction == 0.0 for lips in self._lips)

    def __call__(self, motion: FloatArray) -> FloatArray:
        """Return the forces (k, 3), mN, at a motion (k, 3), mm."""
        count, moved, force, own = len(self.nodes), self._there.copy(), np.zeros_like(self._there), np.zeros_like(self._there)
        motion, behind = motion[:count], motion[count:]
        moved[:count] += motion
        pattern = self.pattern
        add_earlier_forces(pattern.indptr, pattern.indices, self.tangent.contact, self.nodes, self._place, motion, force)
        for contact in self._indenters:
            contact.add_force(moved, own)
        for lips in self._lips:
            lips.add_force(moved, force)
        self.exerted = float(np.abs(own).sum()) + sum(lips.exerted for lips in self._lips)
        if self.sides is None:
            return np.asarray((force + own)[:count])
        across = in_threes(self.sides.forces(behind.ravel()[: len(self.sides.gap)]))
        self.exerted += self.sides.exerted
        return np.concatenate([(force + own)[:count], across])

    def change(self, *, exact: bool = False) -> BlockChange:
        """Return the stiffness at the last motion; see `ContactLaw`."""
        blocks = np.zeros((self.pattern.n_blocks, 3, 3))
        numbered: list[NearbyContact | LipsBesideTangent] = [*self._indenters, *self._lips]
        for contact, places in zip(numbered, self.places, strict=True):
            (contact.add_stiffness if exact else contact.add_secant_stiffness)(self.pattern, places, blocks)
        return self._beside(blocks, self.sides.change() if self.sides else None)

    def opened(self) -> BlockChange:
        """Return minus the stiffness of the contacts that the tangent contains; see `ContactLaw`."""
        return self._beside(np.zeros((self.pattern.n_blocks, 3, 3)), self.sides.opened() if self.sides else None)

    def _beside(self, blocks: FloatArray, across: FloatArray | None) -> BlockChange:
        change = contact_change(self.pattern, blocks, self.tangent, self.nodes, self._place)
        return change if across is None else change.and_also(change_in_threes(across, len(self.nodes)))
