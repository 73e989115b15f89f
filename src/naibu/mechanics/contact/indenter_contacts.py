"""Penalty contact of the faces of a mesh with rigid indenters that move from step to step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.rigid_transform import rotation_matrix
from naibu.mechanics.contact.contact_surfaces import Friction, rigid_contact
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.contact.rigid_indenters import RigidIndenter


def require_one_friction(indenters: Sequence[RigidIndenter]) -> None:
    """Check that the contact of finite elements can represent indenters.

    Raises
    ------
    InputError
        An indenter with pull-off, or with a kinetic friction below the static one.
    """
    for k, indenter in enumerate(indenters):
        if indenter.pull_stiffness or indenter.pull_damping:
            raise InputError(f"indenters[{k}] has pull-off, which needs a lattice; use one, or leave pull-off out")
        if indenter.kinetic_friction != indenter.static_friction:
            raise InputError(f"indenters[{k}] has two friction coefficients; contact of finite elements has one: give both the same value")


def indenter_contacts(
    indenters: Sequence[RigidIndenter], points: FloatArray, faces: IntArray, *, normal_stiffness: float, tangential_stiffness: float
) -> tuple[Contact, ...]:
    """Return the contacts of faces with indenters that stand where they were made.

    Parameters
    ----------
    indenters : sequence of RigidIndenter
        In contact, or about to be.
    points : ndarray, shape (n, 3)
        Nodes in the reference configuration, mm.
    faces : ndarray, shape (f, 3) or (f, 4), int64
        Boundary faces.
    normal_stiffness, tangential_stiffness : float
        Penalties, kPa/mm.

    Raises
    ------
    InputError
        What `require_one_friction` and `naibu.mechanics.rigid_contact` refuse.
    """
    require_one_friction(indenters)
    return tuple(
        rigid_contact(
            f"indenter {k}", points, faces, i.geometry, start=i.centre, stop=i.centre,
            friction=Friction(i.static_friction, tangential_stiffness), normal_stiffness=normal_stiffness,
        )
        for k, i in enumerate(indenters)
    )  # fmt: skip


def moving_contacts(
    contacts: Sequence[Contact], centres: FloatArray, rotations: FloatArray, travel: FloatArray, turn: FloatArray
) -> tuple[Contact, ...]:
    """Return contacts whose bodies move by `travel` (k, 3), mm, and turn by `turn` (k, 3), rad, from where they are.

    They are at `centres` (k, 3), mm, with `rotations` (k, 3, 3) since they were made.
    """
    return tuple(
        replace(c, start=centres[k], stop=centres[k] + travel[k], rotation=rotations[k], tilt=turn[k] if turn[k].any() else None)
        for k, c in enumerate(contacts)
    )


def turned(rotations: FloatArray, turn: FloatArray) -> FloatArray:
    """Return rotations (k, 3, 3) turned further by rotation vectors (k, 3), rad."""
    return np.array([rotation_matrix(w) @ r if w.any() else r for w, r in zip(turn, rotations, strict=True)]).reshape(-1, 3, 3)
