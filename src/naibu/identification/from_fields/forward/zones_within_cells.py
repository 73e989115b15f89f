"""Zones that end inside of cells: moduli of the cells of a finer mesh, from the region in which each part of them lies."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import logarithms
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters

RegionAt = Callable[[FloatArray], IntArray]  # number of the region of the mesh at points (k, d), mm; negative outside of the body


def moduli_within_cells(mesh: Mesh, zones: Zones, theta: FloatArray, region_at: RegionAt) -> tuple[FloatArray, FloatArray]:
    """Return lambda and mu (m,), kPa, of the cells of a mesh, the logarithms of their moduli mixed by what lies in them.

    Parameters
    ----------
    mesh : Mesh
        Cells, with the regions that parts outside of the body get.
    zones : Zones
        One zone for each region that is not known.
    theta : ndarray, shape (2 count,)
        Logarithms of the moduli of the zones.
    region_at : callable
        Region at points.
    """
    of_region = np.empty((len(mesh.region_names), 2))
    known = {region.name: region for region in zones.known}
    for number, name in enumerate(mesh.region_names):
        if name in known:
            lame, shear = lame_parameters(known[name].young_modulus, known[name].poisson_ratio)
            of_region[number] = logarithms(np.array([lame]), np.array([shear]))
        else:
            of_region[number] = theta.reshape(2, -1)[:, zones.names.index(name)]
    corners = mesh.points[mesh.cells]
    parts = 0.5 * (corners + corners.mean(axis=1, keepdims=True))  # middles of as many parts as there are corners
    found = region_at(parts.reshape(-1, parts.shape[2])).reshape(parts.shape[:2])
    found = np.where(found < 0, mesh.regions[:, None], found)
    shear, ratio = np.exp(of_region[found].mean(axis=1)).T
    return shear * (ratio - 2.0 / 3.0), shear
