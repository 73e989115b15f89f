"""The surface of a lattice, from the faces of its cubes."""

from __future__ import annotations

import numpy as np

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
    return faces.triangles(cells, faces.outer(cells))


def surface_faces(lattice: Lattice) -> IntArray:
    """Return the outer faces (f, 4) of a lattice's cubes, counterclockwise seen from outside.

    Raises
    ------
    InputError
        A lattice without cubes.
    """
    pairs = surface_triangles(lattice).reshape(-1, 2, 3)  # a, b, c and a, c, d of every face
    return np.concatenate([pairs[:, 0], pairs[:, 1, 2:]], axis=1)
