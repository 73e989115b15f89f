"""The sides of cuts of a mesh, which do not pass through each other."""

from __future__ import annotations

import numpy as np

from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_strain.lip_assembly import with_lips
from naibu.meshing.surface import boundary_faces


def with_sides_of_cuts(assembler: Assembler, mesh: Mesh, friction: float = 0.0) -> Assembler:
    """Return an assembler in which the sides of the cuts of a mesh of tetrahedra touch each other; the same where there is no cut.

    Parameters
    ----------
    assembler : Assembler
        Of the mesh.
    mesh : Mesh
        Linear tetrahedra; cuts have doubled some of its nodes.
    friction : float
        Coulomb's coefficient between the two sides.

    Raises
    ------
    InputError
        A negative coefficient.
    """
    points = mesh.points[np.lexsort(mesh.points.T)]
    if not (points[1:] == points[:-1]).all(axis=1).any():  # no node is doubled: the boundary need not be looked for
        return assembler
    return with_lips(assembler, mesh.points, boundary_faces(mesh).faces, friction)
