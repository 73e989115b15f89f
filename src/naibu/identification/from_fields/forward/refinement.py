"""Uniform refinement of the meshes of field identification, with load cases carried over to the new nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.meshing.element_conversion import to_quadratic
from naibu.meshing.primitives import grid_cells
from naibu.meshing.surface import boundary_faces

# Eight tetrahedra in one of ten nodes: the four corners, and four around the diagonal of the octahedron between them.
_TETRAHEDRA = np.array([[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3], [4, 9, 5, 6], [4, 9, 6, 7], [4, 9, 7, 8], [4, 9, 8, 5]])
_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])  # of a hexahedron


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """A mesh with every cell cut into eight, the nodes of the coarse mesh first.

    Attributes
    ----------
    mesh : Mesh
        The fine mesh; cells ``8 i`` to ``8 i + 7`` fill cell ``i``.
    parents : csr_matrix, shape (n_fine, n)
        Every node as the mean of coarse nodes.
    faces : ndarray, shape (f, k), int64
        Coarse boundary faces.
    on_faces : ndarray, shape (f, j), int64
        New nodes on each of them.
    """

    mesh: Mesh
    parents: sp.csr_matrix
    faces: IntArray
    on_faces: IntArray

    @classmethod
    def of(cls, mesh: Mesh) -> Refinement:
        """Refine a mesh of linear tetrahedra or hexahedra."""
        return _of_tetrahedra(mesh) if mesh.cell_type == "tetra" else _of_hexahedra(mesh)

    def load_case(self, load_case: FieldLoadCase) -> FieldLoadCase:
        """Return a load case on the fine nodes: new ones on wholly loaded faces are loaded, and forces are spread among acted nodes."""
        n, acted = self.parents.shape[1], (load_case.external_force != 0.0).any(axis=1)
        loaded = np.zeros(self.mesh.points.shape, dtype=bool)
        loaded[:n] = load_case.loaded
        whole = np.asarray(load_case.loaded[self.faces].all(axis=1))
        for axis, of_faces in enumerate(whole.T):
            loaded[self.on_faces[of_faces], axis] = True
        between = np.asarray(self.parents @ acted.astype(float) > 1.0 - 1e-9)
        between[:n] = False
        share = sp.diags(between.astype(float)) @ self.parents
        total = np.asarray(share.T @ np.ones(len(between)))
        spread = share @ (load_case.external_force / np.maximum(total, 1e-300)[:, None])
        spread[:n] += np.where((total > 0.0)[:, None], 0.0, load_case.external_force)
        return replace(load_case, loaded=loaded, external_force=np.asarray(spread))

    def zones(self, zones: Zones) -> Zones:
        """Return the zones of the fine cells."""
        lame, shear = np.repeat(zones.known_lambda, 8), np.repeat(zones.known_mu, 8)
        return replace(zones, of_cell=np.repeat(zones.of_cell, 8), known_lambda=lame, known_mu=shear, region_of_cell=None)

    def displacement(self, u: FloatArray) -> FloatArray:
        """Return the displacement (n_fine, d), mm, of the fine nodes from that of the coarse ones (n, d)."""
        return np.asarray(self.parents @ u)


def _of_tetrahedra(mesh: Mesh) -> Refinement:
    quadratic, n = to_quadratic(mesh), mesh.n_points
    cells = quadratic.cells[:, _TETRAHEDRA].reshape(-1, 4)
    corners = quadratic.points[cells]
    wrong = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0.0
    cells[wrong] = cells[wrong][:, [0, 2, 1, 3]]
    ends = np.empty((quadratic.n_points - n, 2), dtype=np.int64)
    ends[quadratic.cells[:, 4:].ravel() - n] = mesh.cells[:, [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]]].reshape(-1, 2)
    rows = np.concatenate([np.arange(n), np.repeat(np.arange(n, quadratic.n_points), 2)])
    values = np.concatenate([np.ones(n), np.full(ends.size, 0.5)])
    parents = sp.csr_matrix((values, (rows, np.concatenate([np.arange(n), ends.ravel()]))), shape=(quadratic.n_points, n))
    faces = boundary_faces(quadratic).faces
    fine = Mesh(quadratic.points, cells, "tetra", np.repeat(mesh.regions, 8), mesh.region_names)
    return Refinement(fine, parents, faces[:, :3], faces[:, 3:])


def _of_hexahedra(mesh: Mesh) -> Refinement:
    """Cut at the middles; a node is known by the coarse nodes whose mean it is, a sorted row of eight with repetitions."""
    n = mesh.n_points
    sets = []
    for at in product((0.0, 0.5, 1.0), repeat=3):
        near = np.flatnonzero((np.abs(_CORNERS - at[::-1]) <= 0.5).all(axis=1))
        sets.append(mesh.cells[:, np.repeat(near, 8 // len(near))])
    of_cells = np.sort(np.stack(sets, axis=1), axis=2)
    faces = boundary_faces(mesh).faces
    edges = np.stack([np.repeat(faces[:, [i, (i + 1) % 4]], 4, axis=1) for i in range(4)] + [np.repeat(faces, 2, axis=1)], axis=1)
    corners = np.repeat(np.arange(n)[:, None], 8, axis=1)
    rows = np.concatenate([corners, of_cells.reshape(-1, 8), np.sort(edges, axis=2).reshape(-1, 8)])
    unique, first, number = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")  # corners come first, in their order
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    number, unique = place[number.ravel()], unique[order]
    lattice = number[n : n + mesh.n_cells * 27].reshape(-1, 27)
    cells = lattice[:, grid_cells(3, 3, 3)].reshape(-1, 8)
    size = len(unique)
    parents = sp.csr_matrix((np.full(size * 8, 0.125), (np.repeat(np.arange(size), 8), unique.ravel())), shape=(size, n))
    parents.sum_duplicates()
    fine = Mesh(np.asarray(parents @ mesh.points), cells, "hexahedron", np.repeat(mesh.regions, 8), mesh.region_names)
    return Refinement(fine, parents, faces, number[n + mesh.n_cells * 27 :].reshape(len(faces), -1))
