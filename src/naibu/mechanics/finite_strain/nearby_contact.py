"""The contact points of a rigid body that a step may concern: those near it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import BoolArray, FloatArray, Int32Array, IntArray
from naibu.mechanics.contact._geometry_kernels import mesh_of, signed_distance
from naibu.mechanics.contact.indenter_geometry import packed_geometry
from naibu.mechanics.contact.penalty_contact import Contact, ContactResponse
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern


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
    response : ContactResponse
        At the last evaluation.
    """

    contact: Contact
    anchors: FloatArray
    points: IntArray
    response: ContactResponse = field(init=False)

    def only(self, which: BoolArray) -> NearbyContact:
        """Return the points that are marked (p,)."""
        return self if which.all() else NearbyContact(_points(self.contact, which), self.anchors[which], self.points[which])

    @classmethod
    def of(cls, contact: Contact, anchors: FloatArray, gap: FloatArray, margin_mm: float) -> NearbyContact:
        """Return the points whose gaps (p,) are below a margin, mm."""
        near = np.flatnonzero(gap < margin_mm).astype(np.int64)
        return cls(_points(contact, near), anchors[near], near)

    def evaluate(self, displacement: FloatArray) -> None:
        """Evaluate the contact at a displacement (n, 3), mm."""
        self.response = self.contact.evaluate(displacement, self.anchors, 1.0)

    def add_force(self, displacement: FloatArray, force: FloatArray) -> None:
        """Evaluate the contact at a displacement (n, 3), mm, and add its forces to `force` (n, 3), mN."""
        self.evaluate(displacement)
        if len(self.points):
            _scatter_forces(self.contact.nodes, self.contact.shape, self.response.force @ self.response.orientation.T, force)

    def add_stiffness(self, pattern: BlockPattern, positions: Int32Array, blocks: FloatArray) -> None:
        """Add the stiffness at the last evaluation; `positions` are those of all points in the pattern."""
        if len(self.points):
            self.contact.add_stiffness(self.response, pattern, positions[self.points], blocks)

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


def _points(contact: Contact, which: IntArray | BoolArray) -> Contact:
    return replace(
        contact, nodes=contact.nodes[which], shape=contact.shape[which], rest=contact.rest[which], area=contact.area[which],
        normal_stiffness=contact.normal_stiffness[which], tangential_stiffness=contact.tangential_stiffness[which],
        friction_coefficient=contact.friction_coefficient[which], element_size=contact.element_size[which],
    )  # fmt: skip


def local_positions(contact: Contact, displacement: FloatArray, load: float) -> tuple[FloatArray, FloatArray]:
    """Return the positions (p, 3) of all points in the frame of the body at a fraction of its path, and their gaps (p,), mm."""
    y, gap = np.empty((len(contact.nodes), 3)), np.empty(len(contact.nodes))
    _local(
        packed_geometry(contact.surface), contact.surface.axes, contact.nodes, contact.shape, contact.rest, displacement,
        contact.start + load * (contact.stop - contact.start), contact.orientation(load), y, gap,
    )  # fmt: skip
    return y, gap


@njit(cache=True, nogil=True)
def _local(geometry, axes, nodes, shape, rest, u, centre, orientation, y, gap):  # type: ignore[no-untyped-def]  # pragma: no cover
    kinds, sizes, _ = geometry
    mesh = mesh_of(geometry, 0)
    d, q, n, none = np.empty(3), np.empty(3), np.empty(3), np.empty((0, 0))
    for p in range(len(nodes)):
        for i in range(3):
            d[i] = rest[p, i] - centre[i]
            for a in range(shape.shape[1]):
                d[i] += shape[p, a] * u[nodes[p, a], i]
        for i in range(3):
            y[p, i] = d[0] * orientation[0, i] + d[1] * orientation[1, i] + d[2] * orientation[2, i]
        for i in range(3):
            q[i] = y[p, 0] * axes[i, 0] + y[p, 1] * axes[i, 1] + y[p, 2] * axes[i, 2]
        gap[p] = signed_distance(kinds[0], sizes[0], mesh, q, n, none)


@njit(cache=True, nogil=True)
def _scatter_forces(nodes, shape, point_force, force):  # type: ignore[no-untyped-def]  # pragma: no cover
    for p in range(len(nodes)):
        for a in range(shape.shape[1]):
            for i in range(3):
                force[nodes[p, a], i] += shape[p, a] * point_force[p, i]
