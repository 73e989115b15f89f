"""The triangulated surface of a lattice, from the faces of its cubes."""

from __future__ import annotations

from naibu.core.arrays import IntArray
from naibu.mechanics.contact.triangle_tree import TriangleTree
from naibu.mechanics.lattices.model.cube_faces import cube_faces, require_cubes
from naibu.mechanics.lattices.model.lattice import Lattice


def surface_of(lattice: Lattice) -> TriangleTree:
    """Return the outer faces of a lattice's cubes as triangles; those of cuts are outer faces.

    Raises
    ------
    InputError
        A lattice without cubes, such as one made from tetrahedra; give its triangles to TriangleTree.of.
    """
    return TriangleTree.of(surface_triangles(lattice), lattice.points)


def surface_triangles(lattice: Lattice) -> IntArray:
    """Return the outer faces (t, 3) of a lattice's cubes as triangles, counterclockwise seen from outside.

    Raises
    ------
    InputError
        A lattice without cubes.
    """
    cells, faces = require_cubes(lattice), cube_faces(lattice)
    return faces.triangles(cells, faces.outer())
