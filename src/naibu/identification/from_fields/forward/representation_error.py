"""Representation error of measurements: what no displacement that is interpolated in the cells of a mesh can follow.

Where a body deforms on a scale below that of the cells - along the edge of a plate that sticks to it, in layers one cell thick - no moduli
and no motion of the surface make the model follow the measurement. If such points count with the accuracy of the measurement alone, a few
of them outweigh all others, and moduli are bent to lessen errors of interpolation. As in data assimilation, the variance of what the mesh
cannot represent is therefore part of that of a measurement (:cite:p:`janjic2018`). It is found without any mechanics, from the difference
of the measurement from the nearest interpolated displacement; by Cea's lemma the error of the elements is of that order.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import cg

from naibu.core.arrays import FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.forward_model import SURFACE_STRAIN
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.meshing.point_location import locate

PROBES = 24  # random signs that estimate how far points are followed because they were fitted (:cite:p:`bekas2007`)
SIGNIFICANT = 3.0  # standard deviations by which squares exceed those of noise
FEWEST = 0.2  # of the measurements around a cell: degrees of freedom that the nodes must leave


def with_representation_error(mesh: Mesh, load_case: FieldLoadCase) -> tuple[FieldLoadCase, float]:
    """Return the load case with the variance that the mesh cannot represent added, and the part of its points to which any was.

    Noise that is stated too small everywhere is no representation error, and left to the verdict. Nothing is added where no covariance is
    stated.

    Parameters
    ----------
    mesh : Mesh
        The model.
    load_case : FieldLoadCase
        Measurements within its cells, mm.
    """
    field = load_case.field
    if field.covariance is None or not field.valid.all():
        return load_case, 0.0
    variance = _variance(mesh, field)
    if not variance.any():
        return load_case, 0.0
    covariance = field.covariance + variance[:, None, None] * np.eye(field.vectors.shape[1])
    more = DisplacementField.from_arrays(field.points, field.vectors, covariance=covariance)
    return replace(load_case, field=more), float(np.mean(variance > 0.0))


def _variance(mesh: Mesh, field: DisplacementField) -> FloatArray:
    """Return the variance (k,) of a component, mm^2, that no interpolated displacement follows, alike in a cell and its neighbours."""
    assert field.covariance is not None
    d, n = field.vectors.shape[1], mesh.n_points
    stated = np.trace(field.covariance, axis1=1, axis2=2) / d
    if not (stated > 0.0).all():
        return np.zeros(len(stated))
    at = locate(mesh, field.points, tolerance_mm=np.inf)
    rows = np.repeat(np.arange(len(stated)), at.weights.shape[1])
    within = sp.csr_matrix((at.weights.ravel(), (rows, mesh.cells[at.cells].ravel())), shape=(len(stated), n))
    whole = sp.diags(stated**-0.5) @ within
    matrix = (whole.T @ whole + _smoothness(mesh)).tocsr()
    inverse_diagonal = sp.diags(1.0 / matrix.diagonal())

    def followed(values: FloatArray) -> FloatArray:
        right = whole.T @ values
        return np.stack([whole @ cg(matrix, b, rtol=1e-6, maxiter=2000, M=inverse_diagonal)[0] for b in right.T], axis=1)

    measured = field.vectors / np.sqrt(stated)[:, None]
    left = ((measured - followed(measured)) ** 2).sum(axis=1) / d
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(stated), PROBES))
    free = 1.0 - np.clip((signs * followed(signs)).mean(axis=1), 0.0, 1.0)
    touched = sp.csr_matrix(
        (np.ones(mesh.cells.size), (np.repeat(np.arange(mesh.n_cells), mesh.cells.shape[1]), mesh.cells.ravel())), (mesh.n_cells, n)
    )
    near = sp.csr_matrix(touched @ touched.T)
    near.data[:] = 1.0
    squares, freedom, count = (near @ np.bincount(at.cells, v, mesh.n_cells) for v in (left, free, np.ones_like(free)))
    enough = freedom > np.maximum(FEWEST * count, 1.0)
    ratio = squares / np.maximum(freedom, 1.0)
    factor = max(1.0, float(np.median(ratio[at.cells]))) if enough.any() else 1.0
    beyond = ratio / factor - 1.0
    significant = enough & (beyond > SIGNIFICANT * np.sqrt(2.0 / (d * np.maximum(freedom, 1.0))))
    return np.asarray(np.where(significant, factor * beyond, 0.0)[at.cells] * stated)


def _smoothness(mesh: Mesh) -> sp.csr_matrix:
    """Return the graph Laplacian over the edges of cells, each weighted by (strain length)^-2, 1/mm^2: weak where anything is measured."""
    a, b = np.triu_indices(mesh.cells.shape[1], 1)
    edges = np.unique(np.sort(mesh.cells[:, np.stack([a, b], axis=1)].reshape(-1, 2), axis=1), axis=0)
    weight = (SURFACE_STRAIN * np.linalg.norm(mesh.points[edges[:, 0]] - mesh.points[edges[:, 1]], axis=1)) ** -2.0
    one = sp.csr_matrix((weight, (edges[:, 0], edges[:, 1])), shape=(mesh.n_points, mesh.n_points))
    both = one + one.T
    return sp.csr_matrix(sp.diags(np.asarray(both.sum(axis=1)).ravel()) - both)
