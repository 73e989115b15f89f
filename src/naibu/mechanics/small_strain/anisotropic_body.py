"""Anisotropic linear elasticity on quadratic tetrahedra: stiffness, mass, response to prescribed displacements, and strain at the nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from naibu._numba.compilation import njit
from naibu.core.arrays import BoolArray, FloatArray, Int32Array, require_shape
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.elements import Elements, elements
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern, block_pattern, with_dirichlet_rows
from naibu.mechanics.linear_algebra.solver_selection import SolverName, choose_solver
from naibu.mechanics.small_strain.linear_elasticity import require_constrained

# edges of a tetrahedron in the order of the mid-edge nodes
_EDGES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))
_INNER, _OUTER = 0.5854101966249685, 0.1381966011250105  # barycentric coordinates of the four integration points


@dataclass(frozen=True, slots=True, eq=False)
class AnisotropicBody:
    """A linear elastic body of any anisotropy at small strain; the stiffness tensors are arguments.

    Attributes
    ----------
    mesh : Mesh
        Quadratic tetrahedra, which bend without locking.
    elements : Elements
        Their integration points.
    pattern : BlockPattern
        Sparsity of the stiffness.
    positions : ndarray, shape (m, 10, 10), int32
        Where the blocks of every cell are stored.
    """

    mesh: Mesh
    elements: Elements
    pattern: BlockPattern
    positions: Int32Array

    @classmethod
    def of(cls, mesh: Mesh) -> AnisotropicBody:
        """Return the body of a mesh of quadratic tetrahedra.

        Raises
        ------
        InputError
            Other cells, or an inverted one.
        """
        if mesh.cell_type != "tetra10":
            raise InputError(f"mesh has {mesh.cell_type!r} cells; give quadratic tetrahedra, as naibu.meshing.to_quadratic makes them")
        pattern = block_pattern(mesh.n_points, mesh.cells)
        return cls(mesh, elements(mesh, "standard"), pattern, pattern.positions(mesh.cells))

    def stiffness(self, tensors: FloatArray) -> sp.bsr_matrix:
        """Return the stiffness matrix (3 n, 3 n), mN/mm.

        Parameters
        ----------
        tensors : ndarray, shape (r, 3, 3, 3, 3)
            Stiffness tensor of every region, kPa.

        Raises
        ------
        InputError
            Not one tensor for every region.
        """
        require_shape("tensors", tensors, (len(self.mesh.region_names), 3, 3, 3, 3))
        blocks = np.zeros((self.pattern.n_blocks, 3, 3))
        _assemble(self.elements.gradients, self.elements.weights, self.mesh.regions, np.ascontiguousarray(tensors), self.positions, blocks)
        return self.pattern.matrix(blocks)

    def response(
        self, tensors: FloatArray, constrained: BoolArray, values: FloatArray, *, solver: SolverName = "automatic"
    ) -> tuple[FloatArray, FloatArray]:
        """Return displacements and nodal forces for several sets of prescribed displacements.

        Parameters
        ----------
        tensors : ndarray, shape (r, 3, 3, 3, 3)
            Stiffness tensor of every region, kPa.
        constrained : ndarray, shape (n, 3), bool
            Prescribed components; the other ones bear no force.
        values : ndarray, shape (k, n, 3)
            Their displacements in every set, mm.
        solver : str
            Linear solver; see `naibu.mechanics.choose_solver`.

        Returns
        -------
        displacement : ndarray, shape (k, n, 3)
            mm.
        force : ndarray, shape (k, n, 3)
            Forces that act on the nodes, mN: those of the supports.

        Raises
        ------
        InputError
            Arrays of other shapes, rigid-body motions that remain, or a solver that cannot be used.
        ConvergenceError
            The iterative solver did not converge.
        """
        n = self.mesh.n_points
        require_shape("constrained", constrained, (n, 3))
        require_shape("values", values, (len(values), n, 3))
        require_constrained(self.mesh.points, constrained)
        stiffness = self.stiffness(tensors)
        held = np.where(constrained, values, 0.0).reshape(len(values), -1)
        right = -(stiffness @ held.T)
        right[constrained.ravel()] = 0.0
        eliminated = with_dirichlet_rows(stiffness.copy(), constrained)
        factorization = choose_solver(eliminated, self.mesh.points, constrained, symmetric=True, solver=solver).factorize(eliminated)
        solved = np.stack([factorization.solve(np.ascontiguousarray(column)) for column in right.T])
        displacement = np.where(constrained.ravel(), held, solved)
        return displacement.reshape(values.shape), np.asarray(stiffness @ displacement.T).T.reshape(values.shape)

    def nodal_strain(self, displacement: FloatArray) -> FloatArray:
        """Return the strain at the nodes (n, 3, 3): that of the cells, extrapolated from their integration points and averaged by volume.

        Parameters
        ----------
        displacement : ndarray, shape (n, 3)
            Displacement of the nodes, mm.
        """
        e = self.elements
        gradient = np.einsum("mai,mqaj->mqij", displacement[self.mesh.cells], e.gradients)
        strain = 0.5 * (gradient + np.swapaxes(gradient, 2, 3))
        corners = np.linalg.inv(_OUTER * np.ones((4, 4)) + (_INNER - _OUTER) * np.eye(4))
        of_node = np.concatenate([corners, [0.5 * (corners[i] + corners[j]) for i, j in _EDGES]])
        volume = e.weights.sum(axis=1)
        weighted = np.einsum("aq,mqij,m->maij", of_node, strain, volume).reshape(-1, 9)
        nodes = self.mesh.cells.ravel()
        total = np.stack([np.bincount(nodes, weighted[:, c], minlength=self.mesh.n_points) for c in range(9)], axis=1)
        shared = np.bincount(nodes, np.repeat(volume, 10), minlength=self.mesh.n_points)
        return (total / shared[:, None]).reshape(-1, 3, 3)

    def mass_matrix(self, density: FloatArray) -> sp.csr_matrix:
        """Return the consistent mass matrix (n, n), kg, the same for every component.

        Parameters
        ----------
        density : ndarray, shape (r,)
            Density of every region, kg/mm^3.

        Raises
        ------
        InputError
            Not one density for every region.
        """
        require_shape("density", density, (len(self.mesh.region_names),))
        mass = self.elements.weights.sum(axis=1) * density[self.mesh.regions]
        cells = self.mesh.cells
        data = mass[:, None, None] * _unit_mass()[None]
        rows, columns = np.repeat(cells, 10, axis=1), np.tile(cells, (1, 10))
        return sp.csr_matrix((data.ravel(), (rows.ravel(), columns.ravel())), shape=(self.mesh.n_points, self.mesh.n_points))


def _unit_mass() -> FloatArray:
    """Return the consistent mass matrix (10, 10) of a straight ten-node tetrahedron of unit mass."""
    touches = [{i} for i in range(4)] + [set(edge) for edge in _EDGES]
    matrix = np.empty((10, 10))
    for a, first in enumerate(touches):
        for b, second in enumerate(touches):
            shared = len(first & second)
            if a < 4 and b < 4:
                matrix[a, b] = 6.0 if a == b else 1.0
            elif a < 4 or b < 4:
                matrix[a, b] = -4.0 if shared else -6.0
            else:
                matrix[a, b] = (8.0, 16.0, 32.0)[shared]
    return matrix / 420.0


@njit(cache=True)
def _assemble(gradients, weights, regions, tensors, positions, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add ``w g_ak C_ikjl g_bl`` of all cells and integration points."""
    m, q, k = gradients.shape[0], gradients.shape[1], gradients.shape[2]
    part = np.empty((3, 3, 3))
    for e in range(m):
        tensor = tensors[regions[e]]
        for p in range(q):
            g = gradients[e, p]
            for a in range(k):
                for i in range(3):
                    for j in range(3):
                        for n in range(3):
                            v = 0.0
                            for c in range(3):
                                v += g[a, c] * tensor[i, c, j, n]
                            part[i, j, n] = weights[e, p] * v
                for b in range(k):
                    block = blocks[positions[e, a, b]]
                    for i in range(3):
                        for j in range(3):
                            for n in range(3):
                                block[i, j] += part[i, j, n] * g[b, n]
