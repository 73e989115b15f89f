"""Contact of the faces of one mesh of an adaptive body with rigid indenters, and its transfer to the next mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import FloatArray, Int32Array
from naibu.core.mesh import Mesh
from naibu.mechanics.contact.indenter_contacts import indenter_contacts, moving_contacts, turned
from naibu.mechanics.contact.indenter_motion import step_parts
from naibu.mechanics.contact.penalty_contact import Contact, ContactResponse
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern
from naibu.meshing.surface import boundary_faces
from naibu.simulation.adaptive.contact_transfer import nearest_points, points_with_normals


@dataclass(frozen=True, slots=True, eq=False)
class BodyContact:
    """Rigid indenters in contact with the boundary of one mesh.

    Attributes
    ----------
    indenters : tuple of RigidIndenter
        As they were made.
    contacts : tuple of Contact
        Of the boundary faces with each, with penalties as stiff as they had to be so far.
    surface : ndarray, shape (p, 6)
        Points of the contacts at rest, with normals; see `points_with_normals`.
    positions : tuple of ndarray
        Places of the points in the pattern of the tangent.
    centres, rotations : ndarray, shape (k, 3) and (k, 3, 3)
        Where the indenters are, mm, and their rotations since they were made.
    anchors : tuple of ndarray, shape (p, 3)
        Frictional anchors of the points, mm.
    """

    indenters: tuple[RigidIndenter, ...]
    contacts: tuple[Contact, ...]
    surface: FloatArray
    positions: tuple[Int32Array, ...]
    centres: FloatArray
    rotations: FloatArray
    anchors: tuple[FloatArray, ...]

    @classmethod
    def of(
        cls, indenters: Sequence[RigidIndenter], mesh: Mesh, pattern: BlockPattern, displacement: FloatArray,
        penalties: tuple[float, float],
    ) -> BodyContact:  # fmt: skip
        """Bring indenters into play where they were made, with normal and tangential penalties, kPa/mm.

        Raises
        ------
        InputError
            What `indenter_contacts` refuses.
        """
        faces = boundary_faces(mesh).faces
        normal, tangential = penalties
        contacts = indenter_contacts(indenters, mesh.points, faces, normal_stiffness=normal, tangential_stiffness=tangential)
        surface = np.zeros((0, 6))
        if contacts:
            surface = points_with_normals(contacts[0].rest.reshape(len(faces), -1, 3), mesh.points, faces)
        centres = np.array([i.centre for i in indenters], dtype=float).reshape(-1, 3)
        rotations = np.tile(np.eye(3), (len(centres), 1, 1))
        places = tuple(pattern.positions(c.nodes) for c in contacts)
        anchors = tuple(c.local(displacement, 0.0) for c in contacts)
        return cls(tuple(indenters), contacts, surface, places, centres, rotations, anchors)

    def on(self, mesh: Mesh, pattern: BlockPattern, before: FloatArray, after: FloatArray, penalties: tuple[float, float]) -> BodyContact:
        """Return the contact on another mesh of the body; `before` and `after` are the displacements (n, 3), mm, of both.

        Every point takes the elastic slip and the penalty of the nearest one before.
        """
        if not self.indenters:
            return self
        fresh = BodyContact.of(self.indenters, mesh, pattern, after, penalties)
        still = np.zeros_like(self.centres)
        now, then = (moving_contacts(c, self.centres, self.rotations, still, still) for c in (fresh.contacts, self.contacts))
        source = nearest_points(self.surface, fresh.surface)
        anchors = tuple(
            new.local(after, 0.0) - (old.local(before, 0.0) - anchor)[source]
            for new, old, anchor in zip(now, then, self.anchors, strict=True)
        )
        stiff = tuple(replace(new, normal_stiffness=old.normal_stiffness[source]) for new, old in zip(now, then, strict=True))
        return replace(fresh, contacts=stiff, centres=self.centres, rotations=self.rotations, anchors=anchors)

    def parts(self, displacement: FloatArray, travel: FloatArray, turn: FloatArray, approach: float) -> int:
        """Return into how many parts a step is divided so that no indenter passes through the body; see `step_parts`."""
        axes = np.array([i.geometry.axes @ r.T for i, r in zip(self.indenters, self.rotations, strict=True)]).reshape(-1, 3, 3)
        points = self.contacts[0].positions(displacement) if self.contacts else np.zeros((0, 3))
        return step_parts(self.indenters, points, self.centres, axes, travel, turn, approach)

    def moving(self, travel: FloatArray, turn: FloatArray) -> tuple[Contact, ...]:
        """Return contacts whose bodies move (k, 3), mm, and turn (k, 3), rad, from where they are."""
        return moving_contacts(self.contacts, self.centres, self.rotations, travel, turn)

    def behind(self, contacts: tuple[Contact, ...], responses: Sequence[ContactResponse], turn: FloatArray) -> BodyContact:
        """Return the contact after contacts have moved to their ends, with what they then exert."""
        anchors = tuple(c.next_anchors(r) for c, r in zip(contacts, responses, strict=True))
        centres = np.array([c.stop for c in contacts]).reshape(-1, 3)
        return replace(self, contacts=contacts, centres=centres, rotations=turned(self.rotations, turn), anchors=anchors)

    def distance(self, positions: FloatArray) -> FloatArray:
        """Return the signed distance (q,), mm, of positions (q, 3), mm, from the nearest indenter where it is now."""
        gaps = [i.geometry.distance((positions - c) @ r) for i, c, r in zip(self.indenters, self.centres, self.rotations, strict=True)]
        return np.asarray(np.min([np.full(len(positions), np.inf), *gaps], axis=0))
