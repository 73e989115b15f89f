"""Mesh quality: volumes, Jacobians, aspect ratios and a check for cells that no solver can use."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from naibu.core.arrays import FloatArray, Int32Array, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing._quality_kernels import largest_cosine
from naibu.meshing.element_conversion import HEXAHEDRON_EDGES, TETRA_EDGES

# The three neighbours of every corner, in the order that makes a positive triple product in a good cell.
_CORNERS = {
    "hexahedron": np.array([[1, 3, 4], [2, 0, 5], [3, 1, 6], [0, 2, 7], [7, 5, 0], [4, 6, 1], [5, 7, 2], [6, 4, 3]]),
    "tetra": np.array([[1, 2, 3], [2, 0, 3], [0, 1, 3], [0, 2, 1]]),
}
_EDGES = {"hexahedron": HEXAHEDRON_EDGES, "tetra": TETRA_EDGES}
_HEX_SIGNS = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=float)
# Degree-3 rule of a tetrahedron (barycentric points, weights of sum 1): exact for the Jacobian of a curved quadratic cell.
_TETRA_POINTS = np.vstack([np.full((1, 4), 0.25), np.full((4, 4), 1 / 6) + np.eye(4) / 3])
_TETRA_WEIGHTS = np.array([-0.8, 0.45, 0.45, 0.45, 0.45])


def signed_volumes(mesh: Mesh) -> FloatArray:
    """Return the volume (m,) of every cell, mm^3, exact for its shape functions; negative for inverted cells."""
    if mesh.cell_type == "tetra":
        p = mesh.points[mesh.cells]
        return np.asarray(np.linalg.det(p[:, 1:] - p[:, :1]) / 6, dtype=np.float64)
    if mesh.cell_type == "tetra10":
        return np.asarray(_tetra10_jacobians(mesh, _TETRA_POINTS) @ _TETRA_WEIGHTS / 6, dtype=np.float64)
    return np.asarray(_hex_jacobians(mesh, _HEX_SIGNS / np.sqrt(3.0)).sum(axis=1), dtype=np.float64)


def min_jacobians(mesh: Mesh) -> FloatArray:
    """Return the smallest Jacobian determinant (m,) found in every cell (corners and integration points), mm^3."""
    if mesh.cell_type == "tetra":
        return 6 * signed_volumes(mesh)
    if mesh.cell_type == "tetra10":
        return np.asarray(_tetra10_jacobians(mesh, np.vstack([_TETRA_POINTS, np.eye(4)])).min(axis=1))
    return np.asarray(_hex_jacobians(mesh, np.vstack([_HEX_SIGNS, _HEX_SIGNS / np.sqrt(3.0)])).min(axis=1))


def scaled_jacobians(mesh: Mesh) -> FloatArray:
    """Return the scaled Jacobian (m,) of every cell: 1 is a cube or a regular tetrahedron, 0 a flat cell, negative an inverted one.

    The smallest triple product of the unit edges at a corner :cite:p:`knupp2000`, times the square root of 2 for tetrahedra. Quadratic
    tetrahedra are assessed by their corners.
    """
    kind, corners = _linear_part(mesh)
    p = mesh.points[corners]
    edges = p[:, _CORNERS[kind]] - p[:, :, None, :]
    lengths = np.linalg.norm(edges, axis=3).prod(axis=2)
    triple = np.linalg.det(edges)
    scaled = np.divide(triple, lengths, out=np.zeros_like(triple), where=lengths > 0)
    return np.asarray(scaled.min(axis=1) * (np.sqrt(2.0) if kind == "tetra" else 1.0))


def aspect_ratios(mesh: Mesh) -> FloatArray:
    """Return the longest edge over the shortest (m,) of every cell; infinite where an edge has no length."""
    kind, corners = _linear_part(mesh)
    ends = mesh.points[corners][:, _EDGES[kind]]
    lengths = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2)
    longest, shortest = lengths.max(axis=1), lengths.min(axis=1)
    return np.asarray(np.divide(longest, shortest, out=np.full(len(lengths), np.inf), where=shortest > 0), dtype=np.float64)


def mean_edge_length(mesh: Mesh) -> float:
    """Return the mean length of the edges of all cells, mm."""
    kind, corners = _linear_part(mesh)
    ends = mesh.points[corners][:, _EDGES[kind]]
    return float(np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2).mean())


def smallest_dihedral_angle(points: FloatArray, cells: IntArray | Int32Array) -> float:
    """Return the smallest angle between two faces of tetrahedra (m, 4), degrees."""
    return float(np.degrees(np.arccos(np.clip(largest_cosine(points, cells), -1.0, 1.0))))


def unused_nodes(mesh: Mesh) -> IntArray:
    """Return the numbers (k,) of the nodes that no cell uses; each would make a stiffness matrix singular."""
    used = np.zeros(mesh.n_points, dtype=bool)
    used[mesh.cells] = True
    return np.flatnonzero(~used).astype(np.int64)


def duplicate_points(mesh: Mesh, *, tolerance_mm: float | None = None) -> IntArray:
    """Return the pairs (k, 2) of nodes that lie within `tolerance_mm` of each other (default: 1e-9 of the diagonal of the mesh).

    Sliding interfaces have them on purpose; elsewhere they are cracks.
    """
    limit = 1e-9 * float(np.linalg.norm(np.ptp(mesh.points, axis=0))) if tolerance_mm is None else tolerance_mm
    pairs = cKDTree(mesh.points).query_pairs(limit, output_type="ndarray")
    return np.asarray(pairs[np.lexsort(pairs.T[::-1])], dtype=np.int64)


def check(mesh: Mesh, *, min_scaled_jacobian: float = 1e-6) -> None:
    """Check that a mesh has no inverted, flat or unused parts.

    Parameters
    ----------
    mesh : Mesh
        Any mesh.
    min_scaled_jacobian : float
        Cells below this value are flat.

    Raises
    ------
    InputError
        Names the first cell that is inverted or flat, or the first node that no cell uses.
    """
    jacobians, scaled = min_jacobians(mesh), scaled_jacobians(mesh)
    bad = np.flatnonzero(~((jacobians > 0) & (scaled >= min_scaled_jacobian)))
    if len(bad):
        i = int(bad[0])
        what = "inverted" if jacobians[i] < 0 else "flat"
        raise InputError(
            f"cell {i} of {mesh.n_cells} ({mesh.cell_type}, nodes {mesh.cells[i].tolist()}) is {what}: its smallest Jacobian is "
            f"{jacobians[i]:.3g} mm^3 and its scaled Jacobian {scaled[i]:.3g} ({len(bad)} such cells); number its nodes in VTK order "
            "or remesh that region"
        )
    if len(unused := unused_nodes(mesh)):
        raise InputError(f"no cell uses node {int(unused[0])} ({len(unused)} such nodes); remove the nodes that belong to no cell")


def _linear_part(mesh: Mesh) -> tuple[str, IntArray]:
    """Return the kind of the straight cell, and its corners (m, 4 | 8)."""
    return ("tetra", mesh.cells[:, :4]) if mesh.cell_type == "tetra10" else (mesh.cell_type, mesh.cells)


def _hex_jacobians(mesh: Mesh, at: FloatArray) -> FloatArray:
    """Return the Jacobian determinants (m, q) of trilinear cells at reference points `at` (q, 3) in [-1, 1]^3."""
    factors = 1 + at[:, None, :] * _HEX_SIGNS
    gradients = np.stack([_HEX_SIGNS[:, i] * factors[:, :, (i + 1) % 3] * factors[:, :, (i + 2) % 3] / 8 for i in range(3)], axis=2)
    return np.asarray(np.linalg.det(np.einsum("qni,cnx->cqix", gradients, mesh.points[mesh.cells], optimize=True)), dtype=np.float64)


def _tetra10_jacobians(mesh: Mesh, at: FloatArray) -> FloatArray:
    """Return the Jacobian determinants (m, q) of quadratic tetrahedra at barycentric points `at` (q, 4)."""
    corner = at[:, :, None] * 4 - 1
    by_corner = corner * np.eye(4)
    edges = _EDGES["tetra"]
    by_edge = 4 * (at[:, edges[:, 1], None] * np.eye(4)[edges[:, 0]] + at[:, edges[:, 0], None] * np.eye(4)[edges[:, 1]])
    barycentric = np.concatenate([by_corner, by_edge], axis=1)
    gradients = barycentric[:, :, 1:] - barycentric[:, :, :1]
    return np.asarray(np.linalg.det(np.einsum("qni,cnx->cqix", gradients, mesh.points[mesh.cells], optimize=True)), dtype=np.float64)
