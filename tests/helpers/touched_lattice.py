"""A small lattice to be touched."""

from __future__ import annotations

import numpy as np

from naibu.mechanics import LatticeEngine, box_mask, classic_lattice, lattice_mesh, lattice_parameters
from naibu.meshing import boundary_faces, to_tetra
from naibu.simulation import LatticeBody

SPACING = 10.0
TOP = 40.0


def touched_lattice(cubes: int = 4, spacing_mm: float = SPACING) -> LatticeBody:
    """Return a cube, of 40 mm by default, that stands on z = 0, where it is held."""
    lattice = classic_lattice(box_mask((cubes,) * 3), spacing_mm, total_mass_kg=1e-6 * (cubes * spacing_mm) ** 3)
    parameters = lattice_parameters(
        lattice,
        {"short": 60.0, "normal": 40.0, "long": 25.0},
        {"short": 30.0, "normal": 18.0, "long": 12.0},
        {"short": 90.0, "normal": 70.0, "long": 50.0},
    )
    tetra = to_tetra(lattice_mesh(lattice))
    lowest = np.flatnonzero(lattice.points[:, 2] < 1e-9)
    return LatticeBody(LatticeEngine.of(lattice, parameters, step=2e-3), boundary_faces(tetra).faces, tetra.cells, lowest)
