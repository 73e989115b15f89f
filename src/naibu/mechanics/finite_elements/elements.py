"""Finite elements with mean dilatation: nodes, shape-function gradients and integration points.

An element here is a *group*: a set of nodes and integration points that may share one mean dilatation. A hexahedron is a group of
8 nodes and 8 points; a patch of tetrahedra is a group too. One kernel (`assembly`) serves all of them. Averaging the dilatation,
``F_bar = (Theta / J)^(1/3) F`` with Theta the volume average of J over the group, prevents volumetric locking of nearly incompressible
solids: the mean-dilatation method of :cite:t:`simo1985` for hexahedra, and the F-bar patch of :cite:t:`desouzaneto2005` for tetrahedra,
here in variational form, so that the tangent is symmetric.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.linear_simplices import tetrahedron_geometry

Formulation = Literal["mean_dilatation", "standard"]
TETRAHEDRA_PER_PATCH = 8

_CORNERS = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=float)
_TETRA10_EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])


@dataclass(frozen=True, slots=True, eq=False)
class Elements:
    """Groups of nodes and integration points.

    Attributes
    ----------
    n_points : int
        Number of mesh nodes.
    connectivity : ndarray, shape (m, k), int64
        Nodes of every group; a padded entry repeats a node and has zero gradients.
    gradients : ndarray, shape (m, q, k, 3), float64
        Gradients of the shape functions in the reference configuration, 1/mm.
    weights : ndarray, shape (m, q), float64
        Volume of every integration point, mm3; 0 where padded.
    cell_of_point : ndarray, shape (m, q), int64
        The mesh cell to which an integration point belongs, for its material.
    shared_dilatation : bool
        Whether the points of a group share their mean dilatation.
    """

    n_points: int
    connectivity: IntArray
    gradients: FloatArray
    weights: FloatArray
    cell_of_point: IntArray
    shared_dilatation: bool

    @property
    def volume(self) -> float:
        """Volume of all groups, mm3."""
        return float(self.weights.sum())

    def moved(self, shift: FloatArray) -> Elements:
        """Return the elements of the same mesh with its nodes moved by `shift` (n, 3), mm, in the reference configuration."""
        gradient = np.eye(3) + np.einsum("mai,mqaj->mqij", shift[self.connectivity], self.gradients)
        inverse = np.linalg.inv(gradient)
        gradients = np.ascontiguousarray(np.einsum("mqaj,mqji->mqai", self.gradients, inverse))
        return replace(self, gradients=gradients, weights=np.ascontiguousarray(self.weights * np.linalg.det(gradient)))


def elements(mesh: Mesh, formulation: Formulation = "mean_dilatation") -> Elements:
    """Return the finite elements of a mesh.

    Parameters
    ----------
    mesh : Mesh
        Hexahedra, linear or quadratic tetrahedra.
    formulation : {"mean_dilatation", "standard"}
        Whether the dilatation is averaged over a hexahedron, a quadratic tetrahedron, or a patch of about 8 linear tetrahedra of one
        region. ``"standard"`` locks near incompressibility and serves compressible solids and comparisons.

    Raises
    ------
    InputError
        An inverted or degenerate cell, named.
    """
    if formulation not in ("mean_dilatation", "standard"):
        raise InputError(f"formulation {formulation!r} is not known; use 'mean_dilatation' or 'standard'")
    gradients, weights = _linear_tetrahedra(mesh) if mesh.cell_type == "tetra" else _isoparametric(mesh)
    cell = np.repeat(np.arange(mesh.n_cells)[:, None], weights.shape[1], axis=1)
    shared = formulation == "mean_dilatation"
    if shared and mesh.cell_type == "tetra":
        return _patches(mesh, gradients[:, 0], weights[:, 0])
    return Elements(mesh.n_points, mesh.cells, gradients, weights, cell, shared)


def _linear_tetrahedra(mesh: Mesh) -> tuple[FloatArray, FloatArray]:
    """Return gradients (m, 1, 4, 3) and volumes (m, 1): adaptive meshes ask for them at every step."""
    volumes, gradients = tetrahedron_geometry(mesh.points, mesh.cells)
    _require_upright(6.0 * volumes[:, None])
    return gradients[:, None], volumes[:, None]


def _isoparametric(mesh: Mesh) -> tuple[FloatArray, FloatArray]:
    """Return gradients (m, q, k, 3) and weights (m, q) of the integration points of hexahedra or quadratic tetrahedra."""
    derivatives, quadrature = _reference_element(mesh.cell_type)
    jacobian = np.einsum("qaj,mai->mqij", derivatives, mesh.points[mesh.cells])
    determinant = np.linalg.det(jacobian)
    _require_upright(determinant)
    gradients = np.einsum("qaj,mqji->mqai", derivatives, np.linalg.inv(jacobian))
    return np.ascontiguousarray(gradients), np.ascontiguousarray(determinant * quadrature)


def _require_upright(determinant: FloatArray) -> None:
    """Refuse cells whose Jacobian (m, q) is not positive."""
    if determinant.min() <= 0.0:
        bad = int(np.argmin(determinant.min(axis=1)))
        raise InputError(
            f"cell {bad} of the mesh is inverted or flat (Jacobian {determinant[bad].min():.3g}); reorder its nodes or repair the mesh"
        )


def _reference_element(cell_type: str) -> tuple[FloatArray, FloatArray]:
    """Return derivatives (q, k, 3) of the shape functions in reference coordinates, and quadrature weights (q,)."""
    if cell_type == "hexahedron":
        x = _CORNERS / np.sqrt(3.0)
        factor = 1.0 + x[:, None, :] * _CORNERS[None, :, :]
        derivatives = np.empty((8, 8, 3))
        for j in range(3):
            others = [k for k in range(3) if k != j]
            derivatives[:, :, j] = 0.125 * _CORNERS[None, :, j] * factor[:, :, others[0]] * factor[:, :, others[1]]
        return derivatives, np.ones(8)
    barycentric = np.vstack([-np.ones(3), np.eye(3)])
    a, b = 0.5854101966249685, 0.1381966011250105
    points = np.full((4, 4), b) + (a - b) * np.eye(4)
    corner = (4.0 * points - 1.0)[:, :, None] * barycentric[None]
    i, j = _TETRA10_EDGES.T
    edge = 4.0 * (points[:, i, None] * barycentric[None, j] + points[:, j, None] * barycentric[None, i])
    return np.concatenate([corner, edge], axis=1), np.full(4, 1.0 / 24.0)


def _patches(mesh: Mesh, gradients: FloatArray, volumes: FloatArray) -> Elements:
    """Gather linear tetrahedra (gradients (m, 4, 3), volumes (m,)) into groups of about `TETRAHEDRA_PER_PATCH` of one region."""
    patch_of_cell = _grow_patches(mesh.cells, _face_neighbours(mesh.cells), mesh.regions, TETRAHEDRA_PER_PATCH)
    order = np.argsort(patch_of_cell, kind="stable")
    sizes = np.bincount(patch_of_cell)
    slot = np.arange(len(order)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    n_patches, q = len(sizes), int(sizes.max())
    key = patch_of_cell[:, None] * mesh.n_points + mesh.cells
    unique = np.unique(key)
    patch, node = np.divmod(unique, mesh.n_points)
    counts = np.bincount(patch, minlength=n_patches)
    first = np.cumsum(counts) - counts
    k = int(counts.max())
    connectivity = np.repeat(node[first][:, None], k, axis=1)
    local = np.arange(len(unique)) - first[patch]
    connectivity[patch, local] = node
    grouped = np.zeros((n_patches, q, k, 3))
    position = np.searchsorted(unique, key) - first[patch_of_cell][:, None]
    slot_of_cell = np.empty(mesh.n_cells, dtype=np.int64)
    slot_of_cell[order] = slot
    grouped[patch_of_cell[:, None], slot_of_cell[:, None], position] = gradients
    weights = np.zeros((n_patches, q))
    weights[patch_of_cell, slot_of_cell] = volumes
    cell = np.repeat(order[np.cumsum(sizes) - sizes][:, None], q, axis=1)
    cell[patch_of_cell, slot_of_cell] = np.arange(mesh.n_cells)
    return Elements(mesh.n_points, connectivity, grouped, weights, cell, True)


def _face_neighbours(cells: IntArray) -> IntArray:
    """Return (m, 4): the tetrahedron across the face opposite to each corner, -1 at the boundary."""
    faces = np.sort(cells[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    order = np.lexsort(faces.T)
    same = (np.diff(faces[order], axis=0) == 0).all(axis=1)
    neighbours = np.full(len(faces), -1, dtype=np.int64)
    a, b = order[:-1][same], order[1:][same]
    neighbours[a], neighbours[b] = b // 4, a // 4
    return neighbours.reshape(-1, 4)


@njit(cache=True)
def _grow_patches(cells, neighbours, regions, size):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Assign every tetrahedron to a compact, face-connected patch of up to `size` cells of one region.

    A patch grows by the neighbour that shares most nodes with it. Left-over patches smaller than half of `size` join a neighbouring one.
    """
    n = len(cells)
    patch = np.full(n, -1, np.int64)
    members = np.empty(2 * size, np.int64)
    count = 0
    for seed in range(n):
        if patch[seed] >= 0:
            continue
        members[0] = seed
        patch[seed] = count
        filled = 1
        while filled < size:
            best, best_score = -1, -1
            for m in range(filled):
                for other in neighbours[members[m]]:
                    if other < 0 or patch[other] >= 0 or regions[other] != regions[seed]:
                        continue
                    score = 0
                    for node in cells[other]:
                        for k in range(filled):
                            for mine in cells[members[k]]:
                                score += node == mine
                    if score > best_score:
                        best, best_score = other, score
            if best < 0:
                break
            members[filled] = best
            patch[best] = count
            filled += 1
        if 2 * filled < size:
            home = -1
            for m in range(filled):
                for other in neighbours[members[m]]:
                    if other >= 0 and patch[other] >= 0 and patch[other] != count and regions[other] == regions[seed]:
                        home = patch[other]
            if home >= 0:
                for m in range(filled):
                    patch[members[m]] = home
                continue
        count += 1
    return patch
