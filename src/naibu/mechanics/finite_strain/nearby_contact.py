"""The contact points of a rigid body that a step may concern: those near it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, Int32Array, IntArray
from naibu.mechanics.contact.indenter_geometry import packed_geometry
from naibu.mechanics.contact.penalty_contact import Contact, ContactResponse
from naibu.mechanics.finite_strain._nearby_kernels import add_forces, add_stiffness, local
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern


@dataclass(frozen=True, slots=True, eq=False)
class ContactTangent:
    """Where the stiffness of a contact is added.

    Attributes
    ----------
    pattern : BlockPattern
        Of the tangent.
    positions : ndarray, shape (p, k, k), int32
        Blocks of the nodes of all points in the pattern.
    blocks : ndarray, shape (n_blocks, 3, 3)
        Of the tangent, mN/mm; changed.
    curvature : bool
        See `Contact.evaluate`.
    """

    pattern: BlockPattern
    positions: Int32Array
    blocks: FloatArray
    curvature: bool


@dataclass(slots=True, eq=False)
class NearbyContact:
    """Points of a contact that lie near its body.

    Attributes
    ----------
    contact : Contact
        Of these points only.
    anchors : ndarray, shape (p, 3)
        Their anchors.
    points : ndarray, shape (p,), int64
        Their numbers.
    gap : ndarray, shape (p,)
        At the last evaluation, mm.
    """

    contact: Contact
    anchors: FloatArray
    points: IntArray
    gap: FloatArray = field(init=False)
    _displacement: FloatArray = field(init=False)
    _response: ContactResponse | None = field(init=False, default=None)

    def only(self, which: BoolArray) -> NearbyContact:
        """Return the points that are marked (p,)."""
        return self if which.all() else NearbyContact(at_points(self.contact, which), self.anchors[which], self.points[which])

    def numbered(self, place: IntArray) -> NearbyContact:
        """Return these points of nodes that are numbered anew: `place` (n,) has the new number of each."""
        return NearbyContact(replace(self.contact, nodes=place[self.contact.nodes]), self.anchors, self.points)

    @classmethod
    def of(cls, contact: Contact, anchors: FloatArray, gap: FloatArray, margin_mm: float) -> NearbyContact:
        """Return the points whose gaps (p,) are below a margin, mm."""
        near = np.flatnonzero(gap < margin_mm).astype(np.int64)
        return cls(at_points(contact, near), anchors[near], near)

    @property
    def response(self) -> ContactResponse:
        """Tractions and their derivatives at the last evaluation, without the curvature of the body's surface.

        Points that a step begins with lie deep in a body that has moved on, and their pressure times the curvature would make the tangent
        indefinite; where points rest, penetrations are small, and so is what is left out.
        """
        if self._response is None:
            self._response = self.contact.evaluate(self._displacement, self.anchors, 1.0, curvature=False)
        return self._response

    def add_force(self, displacement: FloatArray, force: FloatArray) -> None:
        """Evaluate the contact at a displacement (n, 3), mm, which must not change afterwards, and add its forces to `force` (n, 3), mN."""
        self._displacement, self._response = displacement, None
        self.gap = add_contact_forces(self.contact, self.anchors, displacement, 1.0, force)

    def reached(self, displacement: FloatArray, motion: FloatArray) -> BoolArray:
        """Return which points (p,) come into the body, or may pass it, where nodes move (n, 3), mm, from the last evaluation."""
        after = local_positions(self.contact, displacement + motion, 1.0)[1]
        moves = np.einsum("pk,pki->pi", self.contact.shape, motion[self.contact.nodes])
        far = np.linalg.norm(moves, axis=1) > self.contact.surface.inradius
        if not far.any():
            return np.asarray(after < 0.0)
        ahead = local_positions(self.contact, displacement + 1e-3 * motion, 1.0)[1]
        return np.asarray((after < 0.0) | (far & (self.gap < np.linalg.norm(moves, axis=1)) & (ahead < self.gap)))

    def touching(self) -> NearbyContact:
        """Return the points that touch, at the last evaluation."""
        some = self.only(self.gap < 0.0)
        some.gap, some._displacement = self.gap[self.gap < 0.0], self._displacement
        return some

    def add_stiffness(self, pattern: BlockPattern, positions: Int32Array, blocks: FloatArray) -> None:
        """Add the stiffness at the last evaluation, without the curvature of the body's surface, to blocks of a pattern.

        `positions` are those of all points in the pattern.
        """
        self._add_stiffness(positions, blocks, secant=False)

    def add_secant_stiffness(self, pattern: BlockPattern, positions: Int32Array, blocks: FloatArray) -> None:
        """Add what `add_stiffness` adds and, where points slip, the friction over the elastic slip, along the slip."""
        self._add_stiffness(positions, blocks, secant=True)

    def _add_stiffness(self, positions: Int32Array, blocks: FloatArray, *, secant: bool) -> None:
        c = self.contact
        add_stiffness(
            packed_geometry(c.surface), c.surface.axes, c.nodes, c.shape, c.rest, c.area, c.normal_stiffness, c.tangential_stiffness,
            c.friction_coefficient, c.tied, self._displacement, c.position(1.0), c.orientation(1.0), self.anchors, self.gap, self.points,
            positions, secant, blocks,
        )  # fmt: skip

    def add_symmetric_stiffness(self, pattern: BlockPattern, positions: Int32Array, blocks: FloatArray) -> None:
        """Add what `add_stiffness` adds but the growth of friction with pressure, without which the stiffness is symmetric."""
        if len(self.points):
            r = self.response
            friction = self.contact.area[:, None, None] * r.tangential_stiffness
            normal = r.stiffness - friction
            size = np.trace(normal, axis1=1, axis2=2)[:, None, None]
            along = normal / np.where(size == 0.0, 1.0, size)  # the projection on the normal, as far as the surface is flat
            friction = friction - friction @ along
            symmetric = replace(r, stiffness=normal + 0.5 * (friction + friction.transpose(0, 2, 1)))
            self.contact.add_stiffness(symmetric, pattern, positions[self.points], blocks)


def at_points(contact: Contact, which: IntArray | BoolArray) -> Contact:
    """Return the contact of some of its points only: their numbers, or which of them (p,)."""
    return replace(
        contact, nodes=contact.nodes[which], shape=contact.shape[which], rest=contact.rest[which], area=contact.area[which],
        normal_stiffness=contact.normal_stiffness[which], tangential_stiffness=contact.tangential_stiffness[which],
        friction_coefficient=contact.friction_coefficient[which], element_size=contact.element_size[which],
    )  # fmt: skip


def add_contact_forces(contact: Contact, anchors: FloatArray, displacement: FloatArray, load: float, force: FloatArray) -> FloatArray:
    """Add the forces of a contact at a displacement (n, 3), mm, to `force` (n, 3), mN, and return the gaps (p,), mm.

    Parameters
    ----------
    contact : Contact
        The contact.
    anchors : ndarray, shape (p, 3)
        Anchors of its points, mm.
    displacement : ndarray, shape (n, 3)
        Of the nodes, mm.
    load : float
        Fraction of the path of the body.
    force : ndarray, shape (n, 3)
        Of the nodes, mN; changed.
    """
    c, gap = contact, np.empty(len(contact.nodes))
    add_forces(
        packed_geometry(c.surface), c.surface.axes, c.nodes, c.shape, c.rest, c.area, c.normal_stiffness, c.tangential_stiffness,
        c.friction_coefficient, c.tied, displacement, c.position(load), c.orientation(load), anchors, gap, force,
    )  # fmt: skip
    return gap


def add_contact(
    contact: Contact, anchors: FloatArray, displacement: FloatArray, load: float, force: FloatArray, tangent: ContactTangent
) -> None:
    """Add the forces of a contact to `force` (n, 3), mN, and its stiffness to a tangent; arguments as for `add_contact_forces`."""
    gap = add_contact_forces(contact, anchors, displacement, load, force)
    touching = np.arange(len(gap)) if contact.tied else np.flatnonzero(gap < 0.0)  # few of all points
    if len(touching):
        some = at_points(contact, touching)
        response = some.evaluate(displacement, anchors[touching], load, curvature=tangent.curvature)
        some.add_stiffness(response, tangent.pattern, tangent.positions[touching], tangent.blocks)


def local_positions(contact: Contact, displacement: FloatArray, load: float) -> tuple[FloatArray, FloatArray]:
    """Return the positions (p, 3) of all points in the frame of the body at a fraction of its path, and their gaps (p,), mm."""
    y, gap = np.empty((len(contact.nodes), 3)), np.empty(len(contact.nodes))
    local(
        packed_geometry(contact.surface), contact.surface.axes, contact.nodes, contact.shape, contact.rest, displacement,
        contact.position(load), contact.orientation(load), y, gap,
    )  # fmt: skip
    return y, gap
