"""Representation error of measurements: what no displacement that is interpolated in the cells of a mesh can follow.

Where a body deforms on a scale below that of the cells - along the edge of a plate that sticks to it, in layers one cell thick - no moduli
and no motion of the surface make the model follow the measurement. If such points count with the accuracy of the measurement alone, a few
of them outweigh all others, and moduli are bent to lessen errors of interpolation. As in data assimilation, the variance of what the mesh
cannot represent is therefore part of that of a measurement (:cite:p:`janjic2018`). It is found without any mechanics, from the difference
of the measurement from the nearest interpolated displacement; by Cea's lemma the error of the elements is of that order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import cg

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.forward_model import EXACT, SURFACE_STRAIN
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.meshing.point_location import locate

PROBES = 24  # random signs that estimate how far points are followed because they were fitted (:cite:p:`bekas2007`)
SIGNIFICANT = 3.0  # standard deviations by which squares exceed those of noise
FEWEST = 0.2  # of the measurements around a cell: degrees of freedom that the nodes must leave
NOTEWORTHY = 1.05  # standard deviations are hardly ever known better
PASSES = 2  # with a noise that is not stated: how much the nearest displacement is smoothed depends a little on it


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


def with_noise_of_neighbours(mesh: Mesh, load_case: FieldLoadCase) -> tuple[FieldLoadCase, float]:
    """Return the load case with covariances raised to the noise that neighbours show, and the factor of standard deviations, 1 or more.

    Rules that choose how much a map may vary (the discrepancy principle, the information criterion of its regions) take noise that is
    stated too small for structure of the body. How far measurements scatter about the nearest interpolated displacement, in the degrees of
    freedom that its nodes leave, tells the noise without any mechanics. Where no covariance is stated, all of it is found so, and the
    factor is NaN.

    Parameters
    ----------
    mesh : Mesh
        The model.
    load_case : FieldLoadCase
        Measurements within its cells, mm.
    """
    field = load_case.field
    if not field.valid.all():
        return load_case, 1.0
    d, stated = field.vectors.shape[1], field.covariance is not None
    covariance = field.covariance
    if covariance is None:
        nominal = (EXACT * float(np.abs(field.vectors).max())) ** 2
        covariance = np.broadcast_to(nominal * np.eye(d), (len(field.points), d, d))
    if not (np.trace(covariance, axis1=1, axis2=2) > 0.0).all():
        return load_case, 1.0
    factor = 1.0
    for _ in range(1 if stated else PASSES):
        square = _noise_factor(mesh, DisplacementField.from_arrays(field.points, field.vectors, covariance=covariance))
        factor, covariance = factor * square**0.5, square * covariance
    if stated and factor == 1.0:
        return load_case, 1.0
    more = DisplacementField.from_arrays(field.points, field.vectors, covariance=covariance)
    return replace(load_case, field=more), factor if stated else float("nan")


def _noise_factor(mesh: Mesh, field: DisplacementField) -> float:
    """Return the variance of measurements about the nearest interpolated displacement over that stated, 1 where it is not clearly more."""
    scatter = _Scatter.of(mesh, field)
    if not scatter.enough.any():
        return 1.0
    square = float(np.median(scatter.ratio[scatter.cells]))
    doubt = float(np.sqrt(2.0 / (field.vectors.shape[1] * scatter.total_freedom)))
    return square if square > max(1.0 + SIGNIFICANT * doubt, NOTEWORTHY**2) else 1.0


def _variance(mesh: Mesh, field: DisplacementField) -> FloatArray:
    """Return the variance (k,) of a component, mm^2, that no interpolated displacement follows, alike in a cell and its neighbours."""
    assert field.covariance is not None
    d = field.vectors.shape[1]
    stated = np.trace(field.covariance, axis1=1, axis2=2) / d
    if not (stated > 0.0).all():
        return np.zeros(len(stated))
    found = _Scatter.of(mesh, field)
    factor = max(1.0, float(np.median(found.ratio[found.cells]))) if found.enough.any() else 1.0
    beyond = found.ratio / factor - 1.0
    significant = found.enough & (beyond > SIGNIFICANT * np.sqrt(2.0 / (d * np.maximum(found.freedom, 1.0))))
    return np.asarray(np.where(significant, factor * beyond, 0.0)[found.cells] * stated)


def nearest_interpolated(mesh: Mesh, field: DisplacementField) -> FloatArray:
    """Return the displacement of the nodes (n, d), mm, that is nearest to the valid measurements of a field in units of their noise.

    Where no covariance is stated, that is a small part of the largest displacement.
    """
    points, vectors = field.points[field.valid], field.vectors[field.valid]
    variance = np.full(len(points), (EXACT * float(np.abs(vectors).max())) ** 2)
    if field.covariance is not None:
        variance = np.maximum(np.trace(field.covariance[field.valid], axis1=1, axis2=2) / vectors.shape[1], 1e-12 * variance)
    return _Nearest.of(mesh, points, variance).nodes(vectors / np.sqrt(variance)[:, None])


@dataclass(frozen=True, slots=True, eq=False)
class _Nearest:
    """Interpolated displacements nearest to measurements at points.

    Attributes
    ----------
    cells : ndarray, shape (k,), int64
        Cell of every point.
    whole : csr_matrix, shape (k, n)
        Interpolation at the points, over the standard deviation there, 1/mm.
    matrix : csr_matrix, shape (n, n)
        Of the normal equations, 1/mm^2.
    """

    cells: IntArray
    whole: sp.csr_matrix
    matrix: sp.csr_matrix

    @classmethod
    def of(cls, mesh: Mesh, points: FloatArray, variance: FloatArray) -> _Nearest:
        """Weigh measurements at points (k, d), mm, of a variance (k,) of components, mm^2, against smoothness."""
        at = locate(mesh, points, tolerance_mm=np.inf)
        rows = np.repeat(np.arange(len(variance)), at.weights.shape[1])
        within = sp.csr_matrix((at.weights.ravel(), (rows, mesh.cells[at.cells].ravel())), shape=(len(variance), mesh.n_points))
        whole = sp.csr_matrix(sp.diags(variance**-0.5) @ within)
        return cls(at.cells, whole, (whole.T @ whole + _smoothness(mesh)).tocsr())

    def nodes(self, values: FloatArray) -> FloatArray:
        """Return the values at the nodes (n, r), mm, nearest to those measured (k, r), in units of their standard deviations."""
        inverse_diagonal = sp.diags(1.0 / self.matrix.diagonal())
        right = self.whole.T @ values
        return np.stack([cg(self.matrix, b, rtol=1e-6, maxiter=2000, M=inverse_diagonal)[0] for b in right.T], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class _Scatter:
    """Measurements about the nearest interpolated displacement.

    Attributes
    ----------
    cells : ndarray, shape (k,), int64
        Cell of every measurement.
    ratio, freedom : ndarray, shape (m,)
        In a cell and its neighbours: variance over that stated, and the degrees of freedom that nodes leave, of one component.
    enough : ndarray, shape (m,), bool
        Where these are enough to tell.
    total_freedom : float
        Of one component, in all cells.
    """

    cells: IntArray
    ratio: FloatArray
    freedom: FloatArray
    enough: BoolArray
    total_freedom: float

    @classmethod
    def of(cls, mesh: Mesh, field: DisplacementField) -> _Scatter:
        """Compare measurements with positive variances with the nearest interpolated displacement."""
        assert field.covariance is not None
        d, n = field.vectors.shape[1], mesh.n_points
        stated = np.trace(field.covariance, axis1=1, axis2=2) / d
        nearest = _Nearest.of(mesh, field.points, stated)

        def followed(values: FloatArray) -> FloatArray:
            return np.asarray(nearest.whole @ nearest.nodes(values))

        measured = field.vectors / np.sqrt(stated)[:, None]
        left = ((measured - followed(measured)) ** 2).sum(axis=1) / d
        signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(stated), PROBES))
        free = 1.0 - np.clip((signs * followed(signs)).mean(axis=1), 0.0, 1.0)
        touched = sp.csr_matrix(
            (np.ones(mesh.cells.size), (np.repeat(np.arange(mesh.n_cells), mesh.cells.shape[1]), mesh.cells.ravel())), (mesh.n_cells, n)
        )
        near = sp.csr_matrix(touched @ touched.T)
        near.data[:] = 1.0
        squares, freedom, count = (near @ np.bincount(nearest.cells, v, mesh.n_cells) for v in (left, free, np.ones_like(free)))
        enough = freedom > np.maximum(FEWEST * count, 1.0)
        return cls(nearest.cells, squares / np.maximum(freedom, 1.0), freedom, enough, float(free.sum()))


def _smoothness(mesh: Mesh) -> sp.csr_matrix:
    """Return the graph Laplacian over the edges of cells, each weighted by (strain length)^-2, 1/mm^2: weak where anything is measured."""
    a, b = np.triu_indices(mesh.cells.shape[1], 1)
    edges = np.unique(np.sort(mesh.cells[:, np.stack([a, b], axis=1)].reshape(-1, 2), axis=1), axis=0)
    weight = (SURFACE_STRAIN * np.linalg.norm(mesh.points[edges[:, 0]] - mesh.points[edges[:, 1]], axis=1)) ** -2.0
    one = sp.csr_matrix((weight, (edges[:, 0], edges[:, 1])), shape=(mesh.n_points, mesh.n_points))
    both = one + one.T
    return sp.csr_matrix(sp.diags(np.asarray(both.sum(axis=1)).ravel()) - both)
