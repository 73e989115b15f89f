"""Zones that end inside of cells: moduli of the cells of a mesh, from the regions in which parts of them lie."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.load_cases import KnownRegion, Zones
from naibu.identification.from_fields.forward.sensitivities import logarithms
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters

RIGID = 30.0  # times the shear modulus of another known region: from here on a region counts as rigid, and is not mixed
RegionAt = Callable[[FloatArray], IntArray]  # number of the region of the mesh at points (k, d), mm; negative outside of the body


def parts_within_cells(mesh: Mesh, zones: Zones, region_at: RegionAt) -> sp.csr_matrix:
    """Return the part of every cell in each zone, and then in each known region, (m, zones + known regions).

    A region that is as good as rigid has cells for the most part within it wholly and no others: in proportion it would stiffen cells far
    around, as mixtures of rigid and soft parts are as soft as the latter until the former touch (:cite:p:`hill1965`).

    Parameters
    ----------
    mesh : Mesh
        Cells, with the regions that parts outside of the body get.
    zones : Zones
        One zone for each region that is not known.
    region_at : callable
        Region at points.
    """
    place = {name: i for i, name in enumerate((*zones.names, *(region.name for region in zones.known)))}
    corners = mesh.points[mesh.cells]
    middles = 0.5 * (corners + corners.mean(axis=1, keepdims=True))  # of as many parts as there are corners
    found = region_at(middles.reshape(-1, middles.shape[2])).reshape(middles.shape[:2])
    found = np.where(found < 0, mesh.regions[:, None], found)
    columns = np.array([place[name] for name in mesh.region_names])[found]
    share = np.full(columns.size, 1.0 / columns.shape[1])
    rows = np.repeat(np.arange(mesh.n_cells), columns.shape[1])
    parts = sp.csr_matrix((share, (rows, columns.ravel())), shape=(mesh.n_cells, len(place)))
    shear = np.array([lame_parameters(region.young_modulus, region.poisson_ratio)[1] for region in zones.known])
    rigid = zones.count + np.flatnonzero(shear > RIGID * shear.min(initial=np.inf))
    return _without_rigid_mixtures(parts, rigid) if len(rigid) else parts


def _without_rigid_mixtures(parts: sp.csr_matrix, rigid: IntArray) -> sp.csr_matrix:
    """Return parts (m, k) in which each of the columns `rigid` has a cell wholly or not at all."""
    out = parts.toarray()
    for column in rigid:
        whole = (out[:, column] > 0.5) | (out[:, column] >= out.sum(axis=1) - 1e-12)
        out[whole] = 0.0
        out[:, column] = whole
    return sp.csr_matrix(out / out.sum(axis=1, keepdims=True))


def logarithms_of_regions(theta: FloatArray, known: Sequence[KnownRegion]) -> FloatArray:
    """Return ln mu and ln(kappa / mu) of zones and then of known regions (zones + known regions, 2); kPa."""
    lame, shear = np.array([lame_parameters(r.young_modulus, r.poisson_ratio) for r in known]).reshape(-1, 2).T
    return np.concatenate([theta.reshape(2, -1).T, logarithms(lame, shear).reshape(2, -1).T])


def moduli_within_cells(mesh: Mesh, zones: Zones, theta: FloatArray, region_at: RegionAt) -> tuple[FloatArray, FloatArray]:
    """Return lambda and mu (m,), kPa, of the cells of a mesh, the logarithms of their moduli mixed by what lies in them.

    Parameters
    ----------
    mesh, zones, region_at
        See `parts_within_cells`.
    theta : ndarray, shape (2 count,)
        Logarithms of the moduli of the zones.
    """
    mixed = parts_within_cells(mesh, zones, region_at) @ logarithms_of_regions(theta, zones.known)
    shear, ratio = np.exp(np.asarray(mixed)).T
    return shear * (ratio - 2.0 / 3.0), shear
