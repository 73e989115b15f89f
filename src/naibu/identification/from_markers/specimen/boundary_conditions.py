"""Contacts of a measured object: table, plates and bars, and the joints between its blocks."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import IntArray
from naibu.core.experiment import Experiment
from naibu.core.mesh import Mesh
from naibu.mechanics.contact.contact_surfaces import Friction, interface, rigid_contact
from naibu.mechanics.contact.indenter_geometry import IndenterGeometry, bar_geometry, plane_geometry
from naibu.mechanics.contact.penalty_contact import STICK, Contact
from naibu.meshing.interfaces import split_at_plane
from naibu.meshing.surface import faces_among, node_areas


def sliding_joints(experiment: Experiment, mesh: Mesh, normal_stiffness: float) -> tuple[Mesh, list[Contact]]:
    """Split a mesh where separately cast blocks meet, and return it with the contacts between them."""
    joints = []
    for height in experiment.joined_at_mm:
        area = node_areas(mesh, _plane_faces(mesh, height))
        mesh, split = split_at_plane(mesh, height)
        name = f"joint at {height:g} mm"
        joints.append(interface(name, mesh.points, split, area[split[:, 0]], friction=Friction(0.3), normal_stiffness=normal_stiffness))
    return mesh, joints


def _plane_faces(mesh: Mesh, height: float) -> IntArray:
    """Faces of the cells below a horizontal plane that lie on it."""
    below = mesh.points[mesh.cells][:, :, 2].max(axis=1) <= height + 1e-6
    lower = Mesh(mesh.points, mesh.cells[below], mesh.cell_type, mesh.regions[below], mesh.region_names)
    return faces_among(lower, np.flatnonzero(np.abs(mesh.points[:, 2] - height) < 1e-6))


def rigid_bodies(
    experiment: Experiment, mesh: Mesh, faces: IntArray, normal_stiffness: float, tangential_stiffness: float
) -> list[Contact]:
    """Return the table and the indenters; an indenter starts where it touches the undeformed object. Stiffnesses in kPa/mm."""
    stick = Friction(STICK, tangential_stiffness)
    loading, size = experiment.loading, experiment.shape.size_mm

    def body(name: str, surface: IndenterGeometry, start: ArrayLike) -> Contact:
        return rigid_contact(name, mesh.points, faces, surface, start=start, stop=start, friction=stick, normal_stiffness=normal_stiffness)

    # where only its weight holds the object down, it starts pressed into the table by a hair, for the contact to have a stiffness
    ground = 1e-4 if loading.kind == "side_plates" else 0.0
    bodies = [body(f"base of {loading.base_material}", plane_geometry((0.0, 0.0, 1.0)), (0.0, 0.0, ground))]
    counter = loading.counter_material
    if loading.kind == "side_plates":
        axis = "xyz".index(loading.bar_axis)
        for sign, side in ((-1.0, "low"), (1.0, "high")):
            inward = np.array([-sign, 0.0, 0.0] if axis == 0 else [0.0, -sign, 0.0])
            # a plate leans about half of the object's height, so that the angle does not change the distance there
            middle = np.array([0.0, 0.0, 0.5 * size[2]]) - 0.5 * size[axis] * inward
            bodies.append(body(f"indenter ({side} side) of {counter}", plane_geometry(inward), middle))
    elif loading.kind == "bar":
        surface = bar_geometry(loading.bar_axis, loading.bar_width_mm or 0.0)
        bodies.append(body(f"indenter of {counter}", surface, (0.0, 0.0, size[2])))
    else:
        bodies.append(body(f"indenter of {counter}", plane_geometry((0.0, 0.0, -1.0)), (0.0, 0.0, size[2])))
    return bodies


def material_of(contact: Contact) -> str:
    """Return the material of a rigid body, from its name."""
    return contact.name.rpartition(" of ")[2]
