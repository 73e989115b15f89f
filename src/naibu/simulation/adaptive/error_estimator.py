# mypy: disallow-untyped-decorators=False
"""Error indicators of linear simplices, from which cells are marked: recovery of stresses, and their jumps between cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, require_shape
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.linear_simplices import Simplices, per_cell, simplices


def recovery_indicators(mesh: Mesh, stress: FloatArray, shear_modulus: ArrayLike) -> FloatArray:
    """Return the error (m,) of every cell by comparison with stresses averaged at the nodes :cite:p:`zienkiewicz1987`.

    Parameters
    ----------
    mesh : Mesh
        Triangles (of 1 mm thickness) or linear tetrahedra.
    stress : ndarray, shape (m, d, d)
        Stress of every cell, kPa.
    shear_modulus : array_like
        mu, kPa, one number or one a cell.

    Returns
    -------
    ndarray, shape (m,)
        Roots of energies, ``(mN mm)^(1/2)``: ``eta^2`` is the integral of ``|s* - s|^2 / (2 mu)``, with the linear stress s* between the
        averages over the cells of one region around each node.

    Raises
    ------
    InputError
        Other cells, or a stress or moduli of another shape.
    """
    body, mu = _checked(mesh, stress, shear_modulus)
    gap = recovered_differences(mesh, body, stress.reshape(body.n_cells, -1))
    return np.asarray(np.sqrt(linear_products(body, gap, gap) / (2.0 * mu)))


def recovered_differences(mesh: Mesh, body: Simplices, values: FloatArray) -> FloatArray:
    """Return how values of the cells (m, k) differ from their averages at the nodes (m, d + 1, k), over the cells of one region."""
    number = body.cells + mesh.n_points * mesh.regions[:, None]
    count = mesh.n_points * (int(mesh.regions.max()) + 1)
    return np.asarray(_differences(number, body.measures, np.ascontiguousarray(values), count))


@njit(cache=True)
def _differences(number, measures, values, count):  # type: ignore[no-untyped-def]  # pragma: no cover
    m, corners = number.shape
    k = values.shape[1]
    total, sums = np.zeros(count), np.zeros((count, k))
    for c in range(m):
        for i in range(corners):
            n = number[c, i]
            total[n] += measures[c]
            for a in range(k):
                sums[n, a] += measures[c] * values[c, a]
    out = np.empty((m, corners, k))
    for c in range(m):
        for i in range(corners):
            n = number[c, i]
            for a in range(k):
                out[c, i, a] = sums[n, a] / total[n] - values[c, a]
    return out


def linear_products(body: Simplices, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the integrals (m,) of the products of two fields that are linear in every cell, given at its nodes (m, d + 1, k)."""
    d = body.dimension
    squares = np.einsum("mik,mik->m", first, second) + np.einsum("mk,mk->m", *(np.einsum("mik->mk", gap) for gap in (first, second)))
    return np.asarray(body.measures * squares / ((d + 1) * (d + 2)))


def residual_indicators(mesh: Mesh, stress: FloatArray, shear_modulus: ArrayLike, body_force: ArrayLike = 0.0) -> FloatArray:
    """Return the error (m,) of every cell from the residual, jumps of the traction and body force :cite:p:`verfuerth2013`.

    Parameters
    ----------
    mesh : Mesh
        Triangles (of 1 mm thickness) or linear tetrahedra.
    stress : ndarray, shape (m, d, d)
        Stress of every cell, kPa.
    shear_modulus : array_like
        mu, kPa, one number or one a cell.
    body_force : array_like
        Per volume, mN/mm^3, broadcast to (m, d).

    Returns
    -------
    ndarray, shape (m,)
        Roots of energies, ``(mN mm)^(1/2)``, up to a constant factor: ``eta^2 = h^2 |f|^2 V / (2 mu) + sum h |[s n]|^2 A / (4 mu)`` with
        ``h = V^(1/d)``.

    Raises
    ------
    InputError
        Other cells, or a stress or moduli of another shape.
    """
    body, mu = _checked(mesh, stress, shear_modulus)
    d, m = body.dimension, body.n_cells
    size = body.measures ** (1.0 / d)
    force = np.broadcast_to(np.asarray(body_force, dtype=float), (m, d))
    squares = size**2 * (force**2).sum(axis=1) * body.measures / (2.0 * mu)
    others = np.array([[j for j in range(d + 1) if j != i] for i in range(d + 1)])
    faces = np.sort(body.cells[:, others].reshape(-1, d), axis=1)
    order = np.lexsort(faces.T)
    same = (np.diff(faces[order], axis=0) == 0).all(axis=1)
    one, two = order[:-1][same], order[1:][same]
    first, second = one // (d + 1), two // (d + 1)
    normal = -d * body.measures[first, None] * body.gradients[first, one % (d + 1)]  # times the area
    area = np.linalg.norm(normal, axis=1)
    jump = np.einsum("fij,fj->fi", stress[first] - stress[second], normal) / area[:, None]
    of_face = (jump**2).sum(axis=1) * area
    for cell in (first, second):
        squares += np.bincount(cell, size[cell] * of_face / (4.0 * mu[cell]), minlength=m)
    return np.asarray(np.sqrt(squares))


def _checked(mesh: Mesh, stress: FloatArray, shear_modulus: ArrayLike) -> tuple[Simplices, FloatArray]:
    if mesh.cell_type not in ("triangle", "tetra"):
        raise InputError(f"indicators are those of triangles or linear tetrahedra, not of {mesh.cell_type!r} cells")
    require_shape("stress", stress, (mesh.n_cells, mesh.dimension, mesh.dimension))
    mu = per_cell(shear_modulus, mesh.n_cells, "shear_modulus")
    if not (mu > 0.0).all():
        raise InputError(f"shear_modulus must be positive, not {mu.min():g} kPa")
    return simplices(mesh), mu
