"""Linear simplex elements (lines, triangles, tetrahedra): shape-function gradients, stiffness and mass matrices.

The stiffness of a cell is ``lambda J_lambda + mu J_mu`` with the connection matrices of :cite:t:`hirai2008` (chapter 3.2); for lumped and
consistent masses see :cite:t:`hughes2000`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np
from numpy.typing import ArrayLike

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, IntArray, require_positive
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh


@dataclass(frozen=True, slots=True, eq=False)
class Simplices:
    """Geometry of linear simplices; the displacement gradient is constant in each.

    Attributes
    ----------
    cells : ndarray, shape (m, d + 1), int64
        Node numbers.
    gradients : ndarray, shape (m, d + 1, d)
        Gradient of the shape function of every vertex, 1/mm.
    measures : ndarray, shape (m,)
        Volume, mm^3: the area times the thickness for triangles, the length times the cross-section for lines.
    n_points : int
        Number of nodes of the mesh.
    """

    cells: IntArray
    gradients: FloatArray
    measures: FloatArray
    n_points: int

    @property
    def dimension(self) -> int:
        """Number of displacement components at a node."""
        return int(self.gradients.shape[2])

    @property
    def n_cells(self) -> int:
        """Number of simplices."""
        return len(self.cells)

    def displacement_gradients(self, displacement: FloatArray) -> FloatArray:
        """Return du_a/dX_b (m, d, d) of a displacement (n, d), mm."""
        return np.asarray(np.swapaxes(displacement[self.cells], 1, 2) @ self.gradients)

    def scattered(self, of_cells: FloatArray) -> FloatArray:
        """Return nodal sums (n, d) of values at the vertices of all cells (m, d + 1, d)."""
        index = self.cells.ravel()
        return np.stack([np.bincount(index, of_cells[..., a].ravel(), minlength=self.n_points) for a in range(of_cells.shape[2])], axis=1)


def simplices(mesh: Mesh, *, thickness_mm: float = 1.0, cross_section_mm2: float = 1.0) -> Simplices:
    """Return the geometry of a mesh of lines, triangles (plane strain) or linear tetrahedra.

    Parameters
    ----------
    mesh : Mesh
        Cells ``"line"``, ``"triangle"`` or ``"tetra"``, positively oriented.
    thickness_mm : float
        Thickness of triangles, mm.
    cross_section_mm2 : float
        Cross-section of lines, mm^2.

    Raises
    ------
    InputError
        Another cell type, a cell without positive volume, or a thickness that is not positive.
    """
    if mesh.cell_type not in ("line", "triangle", "tetra"):
        raise InputError(f"linear simplices are lines, triangles or tetrahedra, not {mesh.cell_type!r} cells")
    require_positive("thickness_mm", thickness_mm)
    require_positive("cross_section_mm2", cross_section_mm2)
    d = mesh.dimension
    measures, gradients = (tetrahedron_geometry if d == 3 else _lines_or_triangles)(mesh.points, mesh.cells)
    if not (measures > 0.0).all():
        bad = int(np.argmin(measures))
        raise InputError(f"cell {bad} has volume {measures[bad]:g} mm^{d}; number its nodes the other way round, or repair the mesh")
    extent = {1: cross_section_mm2, 2: thickness_mm, 3: 1.0}[d]
    return Simplices(mesh.cells, gradients, measures * extent, mesh.n_points)


def _lines_or_triangles(points: FloatArray, cells: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return lengths or areas (m,) and, where they are positive, the gradients of the shape functions (m, d + 1, d)."""
    corners = points[cells]
    edges = corners[:, 1:] - corners[:, :1]
    determinants = np.linalg.det(edges)
    edges[~(determinants > 0.0)] = np.eye(points.shape[1])  # any invertible matrix; the caller refuses these cells
    inner = np.swapaxes(np.linalg.inv(edges), 1, 2)
    gradients = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
    return determinants / factorial(points.shape[1]), np.ascontiguousarray(gradients)


@njit(cache=True, error_model="numpy")
def tetrahedron_geometry(points, cells):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return volumes (m,) and, where they are positive, the gradients of the shape functions (m, 4, 3): cofactors of the edges."""
    volumes, gradients = np.empty(len(cells)), np.zeros((len(cells), 4, 3))
    edges = np.empty((3, 3))
    for c in range(len(cells)):
        g = gradients[c]
        for i in range(3):
            for a in range(3):
                edges[i, a] = points[cells[c, i + 1], a] - points[cells[c, 0], a]
        for i in range(3):
            p, q = edges[(i + 1) % 3], edges[(i + 2) % 3]
            for a in range(3):
                b, e = (a + 1) % 3, (a + 2) % 3
                g[i + 1, a] = p[b] * q[e] - p[e] * q[b]
        determinant = (edges[0] * g[1]).sum()
        volumes[c] = determinant / 6.0
        for i in range(1, 4):
            for a in range(3):
                g[i, a] /= determinant
                g[0, a] -= g[i, a]
    return volumes, gradients


def connection_matrices(body: Simplices) -> tuple[FloatArray, FloatArray]:
    """Return J_lambda and J_mu of every cell, so that its stiffness is lambda J_lambda + mu J_mu.

    Returns
    -------
    tuple of ndarray, shape (m, (d + 1) d, (d + 1) d)
        mm; the unknowns of a cell are ordered vertex by vertex.

    Notes
    -----
    ``J_lambda[i, l] = V g_i g_l^T`` and ``J_mu[i, l] = V ((g_i . g_l) I + g_l g_i^T)`` with the gradients g and the volume V; in
    two dimensions this is equation (3.3) of :cite:t:`hirai2008`.
    """
    g, d = body.gradients, body.dimension
    lame = np.einsum("m,mia,mlb->mialb", body.measures, g, g)
    shear = np.einsum("m,mic,mlc,ab->mialb", body.measures, g, g, np.eye(d)) + np.einsum("m,mib,mla->mialb", body.measures, g, g)
    size = (d + 1) * d
    return lame.reshape(-1, size, size), shear.reshape(-1, size, size)


def parameter_forces(body: Simplices, displacement: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the elastic forces at the vertices of every cell for lambda = 1 kPa and for mu = 1 kPa, (m, d + 1, d) each, mN.

    They are ``J_lambda u`` and ``J_mu u`` of :func:`connection_matrices`, without the matrices:
    the columns of the equilibrium-gap equations.
    """
    of_lame, of_shear = np.empty(body.gradients.shape), np.empty(body.gradients.shape)
    _parameter_forces(body.cells, body.gradients, body.measures, displacement, (0,) * body.dimension, of_lame, of_shear)
    return of_lame, of_shear


@njit(cache=True)
def _parameter_forces(cells, gradients, measures, u, zeros, of_lame, of_shear):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the forces of all cells; `zeros` is a tuple of d zeros, whose length the compiler knows."""
    for c in range(len(cells)):
        _cell_forces(cells[c], gradients[c], measures[c], u, zeros, of_lame[c], of_shear[c])


@njit(cache=True)
def _cell_forces(nodes, gradients, measure, u, zeros, of_lame, of_shear):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the forces at the vertices of one cell, for lambda = 1 and for mu = 1: volume times the trace, and times twice the strain."""
    d = len(zeros)
    of_shear[:], trace = 0.0, 0.0
    for a in range(d):
        for b in range(d):
            twice_strain = 0.0
            for k in range(d + 1):
                twice_strain += u[nodes[k], a] * gradients[k, b] + u[nodes[k], b] * gradients[k, a]
            if a == b:
                trace += 0.5 * twice_strain
            for k in range(d + 1):
                of_shear[k, a] += measure * twice_strain * gradients[k, b]
    for k in range(d + 1):
        for a in range(d):
            of_lame[k, a] = measure * trace * gradients[k, a]


def elastic_forces(body: Simplices, lame_lambda: ArrayLike, shear_modulus: ArrayLike, displacement: FloatArray) -> FloatArray:
    """Return the nodal elastic forces (n, d), mN, of a displacement (n, d), mm; moduli in kPa, one number or one a cell."""
    lame, shear = per_cell(lame_lambda, body.n_cells), per_cell(shear_modulus, body.n_cells)
    out = np.zeros((body.n_points, body.dimension))
    _add_elastic_forces(body.cells, body.gradients, body.measures, lame, shear, displacement, (0,) * body.dimension, out)
    return out


@njit(cache=True)
def _add_elastic_forces(cells, gradients, measures, lame, shear, u, zeros, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    d = len(zeros)
    of_lame, of_shear = np.empty((d + 1, d)), np.empty((d + 1, d))
    for c in range(len(cells)):
        _cell_forces(cells[c], gradients[c], measures[c], u, zeros, of_lame, of_shear)
        for k in range(d + 1):
            for a in range(d):
                out[cells[c, k], a] += lame[c] * of_lame[k, a] + shear[c] * of_shear[k, a]


def per_cell(value: ArrayLike, n_cells: int, name: str = "a parameter") -> FloatArray:
    """Return one number a cell, of one number or of one a cell.

    Raises
    ------
    InputError
        Another shape, or a number that is not finite.
    """
    given = np.asarray(value, dtype=float)
    if given.shape not in ((), (n_cells,)):
        raise InputError(f"{name} must be one number or one for each of the {n_cells} cells, not an array of shape {given.shape}")
    if not np.isfinite(given).all():
        raise InputError(f"{name} must be finite; cell {int(np.flatnonzero(~np.isfinite(np.atleast_1d(given)))[0])} is not")
    # of one kind, whatever is given: kernels are compiled for each kind of array
    return np.array(np.broadcast_to(given, (n_cells,)))


def lumped_mass(body: Simplices, density: ArrayLike) -> FloatArray:
    """Return the lumped mass of every node (n,), kg, for a density in kg/mm^3: ``rho V / (d + 1)`` at each vertex.

    Equation (3.12) of :cite:t:`hirai2008`, which prints the area S for the volume V.
    """
    nodal = per_cell(density, body.n_cells, "density") * body.measures / (body.dimension + 1)
    return np.bincount(body.cells.ravel(), np.repeat(nodal, body.dimension + 1), minlength=body.n_points).astype(float)


def consistent_mass_matrices(body: Simplices, density: ArrayLike) -> FloatArray:
    """Return the consistent mass matrix of every cell (m, d + 1, d + 1), kg: ``rho V (1 + delta_ij) / ((d + 1)(d + 2))``."""
    d = body.dimension
    mass = per_cell(density, body.n_cells, "density") * body.measures
    return np.asarray(mass[:, None, None] * (1.0 + np.eye(d + 1)) / ((d + 1) * (d + 2)))
