"""The triangulated surface of a lattice, from the faces of its cubes."""

from __future__ import annotations

import numpy as np

from naibu.core.errors import InputError
from naibu.mechanics.contact.triangle_tree import TriangleTree
from naibu.mechanics.lattices.model.lattice import Lattice

_FACES = (  # corners of a cube, numbered x fastest, counter-clockwise seen from outside, and the way outwards
    ((0, 4, 6, 2), (-1, 0, 0)),
    ((1, 3, 7, 5), (1, 0, 0)),
    ((0, 1, 5, 4), (0, -1, 0)),
    ((2, 6, 7, 3), (0, 1, 0)),
    ((0, 2, 3, 1), (0, 0, -1)),
    ((4, 5, 7, 6), (0, 0, 1)),
)


def surface_of(lattice: Lattice) -> TriangleTree:
    """Return the outer faces of a lattice's cubes as triangles.

    Raises
    ------
    InputError
        A lattice without cubes, such as one made from tetrahedra.
    """
    at = np.rint((lattice.points - lattice.points.min(axis=0)) / lattice.spacing_mm).astype(np.int64)
    ends = at[lattice.elements]
    reach = np.abs(ends[:, 1] - ends[:, 0])
    diagonal = (reach > 0).all(axis=1) & (reach.max(axis=1) == reach.min(axis=1))
    if not diagonal.any():
        raise InputError(
            "the lattice has no space diagonals, hence no cubes whose faces could be its surface; give its triangles to TriangleTree.of"
        )
    cubes, which = np.unique(ends[diagonal].min(axis=1), axis=0, return_index=True)
    sizes = reach[diagonal].max(axis=1)[which]
    filled = np.zeros(at.max(axis=0) + 2, dtype=bool)  # an empty layer behind the last cubes, which index -1 finds too
    for size in np.unique(sizes):
        steps = np.array(list(np.ndindex(size, size, size)))
        filled[tuple((cubes[sizes == size][:, None, :] + steps).reshape(-1, 3).T)] = True
    shape = tuple(at.max(axis=0) + 1)
    number = np.full(shape, -1, dtype=np.int64)
    number[tuple(at.T)] = np.arange(len(at))
    corner_steps = np.array([(a, b, c) for c in (0, 1) for b in (0, 1) for a in (0, 1)])
    corners = number[tuple((cubes[:, None, :] + sizes[:, None, None] * corner_steps).reshape(-1, 3).T)].reshape(-1, 8)
    triangles = []
    for face, way in _FACES:
        # the finest voxel beyond the middle of the face
        beyond = cubes + np.where(np.array(way) > 0, sizes[:, None], np.where(np.array(way) < 0, -1, sizes[:, None] // 2))
        open_face = ~filled[tuple(beyond.T)]
        a, b, c, d = corners[open_face][:, face].T
        triangles += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    return TriangleTree.of(np.concatenate(triangles), lattice.points)
