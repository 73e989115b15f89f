"""The hexahedral mesh of a lattice in the scanner's frame, for output and comparison."""

from __future__ import annotations

import numpy as np

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.lattices.model.lattice import Lattice

_MIRRORED = (4, 5, 6, 7, 0, 1, 2, 3)  # corners of a hexahedron in a left-handed frame


def lattice_mesh(lattice: Lattice) -> Mesh:
    """Return the cubes of a lattice as hexahedra in the scanner's frame, mm; cubes of an octree meet with hanging nodes.

    Raises
    ------
    InputError
        A lattice without cells, such as one made from tetrahedra.
    """
    if lattice.cells is None:
        raise InputError("lattice has no cells; only those of voxels have")
    right_handed = np.linalg.det(lattice.frame.rotation) > 0.0
    cells = lattice.cells if right_handed else lattice.cells[:, _MIRRORED]
    return Mesh.from_arrays(lattice.frame.applied(lattice.points), cells, "hexahedron")
