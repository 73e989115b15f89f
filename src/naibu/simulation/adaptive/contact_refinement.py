"""Refinement of a mesh where rigid indenters will press into it, before anything is solved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.contact.contact_surfaces import face_quadrature
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.meshing.refinement.forest import BisectionForest
from naibu.meshing.refinement.marking import NearContact
from naibu.meshing.surface import boundary_faces

LEAST_POINTS = 12  # of contact within an indenter, from which on errors can be estimated
MOST_ROUNDS = 60


def mesh_in_contact(mesh: Mesh, indenters: Sequence[RigidIndenter], travel: ArrayLike) -> Mesh:
    """Return a mesh whose faces are small enough for every indenter, at the end of its way, to overlap several points of contact.

    A coarse mesh may have no point under a small indenter, which would then not touch it.

    Parameters
    ----------
    mesh : Mesh
        Linear tetrahedra.
    indenters : sequence of RigidIndenter
        Where they begin.
    travel : array_like, shape (k, 3) or (3,)
        How far they move, mm.

    Raises
    ------
    InputError
        An indenter that never reaches the body at rest.
    """
    ways = np.broadcast_to(np.asarray(travel, dtype=float), (len(indenters), 3))
    forest = BisectionForest.of(mesh)
    for k, (indenter, way) in enumerate(zip(indenters, ways, strict=True)):
        _refined_under(forest, indenter, indenter.centre + way, f"indenters[{k}]")
    return forest.leaf_mesh().mesh


def _refined_under(forest: BisectionForest, indenter: RigidIndenter, centre: FloatArray, name: str) -> None:
    def distance(positions: FloatArray) -> FloatArray:
        return indenter.geometry.distance(positions - centre)

    criterion = NearContact(distance, 0.0, np.inf)
    for _ in range(MOST_ROUNDS):
        leaf = forest.leaf_mesh()
        faces = boundary_faces(leaf.mesh).faces
        shape, _ = face_quadrature(leaf.mesh.points, faces)
        at = np.einsum("qk,fki->fqi", shape, leaf.mesh.points[faces]).reshape(-1, 3)
        if int((distance(at) < 0.0).sum()) >= LEAST_POINTS:
            return
        marks = criterion.marks(forest, leaf, np.zeros_like(leaf.mesh.points))
        surface = np.isin(leaf.mesh.cells, faces).sum(axis=1) >= 3
        near = leaf.cells[marks.refine & surface]
        if not len(near):
            break
        forest.refine(near)
    raise InputError(f"{name} does not press into the body on its way of which the end is at {np.round(centre, 3).tolist()} mm; move it")
