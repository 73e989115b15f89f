"""The hexahedral mesh of a lattice, for output and comparison."""

from __future__ import annotations

import numpy as np

from naibu.core.mesh import Mesh
from naibu.mechanics.lattices.model.lattice import Lattice

_HEXAHEDRON = (0, 1, 3, 2, 4, 5, 7, 6)  # VTK's order of corners that are numbered x fastest


def lattice_mesh(lattice: Lattice) -> Mesh:
    """Return the cubes of a lattice as hexahedra, whose nodes are its masses; cubes of an octree meet with hanging nodes."""
    at = np.rint((lattice.points - lattice.points.min(axis=0)) / lattice.spacing_mm).astype(np.int64)
    ends = at[lattice.elements]
    reach = np.abs(ends[:, 1] - ends[:, 0])
    diagonal = (reach > 0).all(axis=1)  # only cubes have elements along all three axes
    low, which = np.unique(ends[diagonal].min(axis=1), axis=0, return_index=True)
    size = reach[diagonal].max(axis=1)[which]
    number = np.full(tuple(at.max(axis=0) + 1), -1, dtype=np.int64)
    number[tuple(at.T)] = np.arange(len(at))
    steps = np.array([(a, b, c) for c in (0, 1) for b in (0, 1) for a in (0, 1)])[list(_HEXAHEDRON)]
    corners = low[:, None, :] + size[:, None, None] * steps
    return Mesh.from_arrays(lattice.points, number[tuple(np.moveaxis(corners, -1, 0))], "hexahedron")
