"""Small-strain linear elasticity on simplex elements: stiffness matrix, Dirichlet conditions and solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from naibu._numba.compilation import njit
from naibu.core.arrays import BoolArray, FloatArray, Int32Array, require_shape
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.linear_simplices import Simplices, elastic_forces, per_cell, simplices
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern, block_pattern, with_dirichlet_rows
from naibu.mechanics.linear_algebra.multigrid.multigrid_solver import rigid_body_modes
from naibu.mechanics.linear_algebra.protocols import Factorization
from naibu.mechanics.linear_algebra.solver_selection import SolverName, choose_solver


@dataclass(frozen=True, slots=True, eq=False)
class LinearBody:
    """A linear elastic body: simplex elements and the fixed sparsity of their stiffness; moduli are arguments.

    Attributes
    ----------
    points : ndarray, shape (n, d)
        Nodes, mm.
    simplices : Simplices
        Geometry of the cells.
    pattern : BlockPattern
        Sparsity of the stiffness.
    positions : ndarray, shape (m, d + 1, d + 1), int32
        Where the blocks of every cell are stored.
    """

    points: FloatArray
    simplices: Simplices
    pattern: BlockPattern
    positions: Int32Array

    @classmethod
    def of(cls, mesh: Mesh, *, thickness_mm: float = 1.0, cross_section_mm2: float = 1.0) -> LinearBody:
        """Return the body of a mesh.

        Parameters
        ----------
        mesh : Mesh
            Lines, triangles (plane strain) or linear tetrahedra.
        thickness_mm, cross_section_mm2 : float
            Thickness of triangles, mm, and cross-section of lines, mm^2.

        Raises
        ------
        InputError
            Another cell type, a cell without positive volume, or a thickness that is not positive.
        """
        body = simplices(mesh, thickness_mm=thickness_mm, cross_section_mm2=cross_section_mm2)
        pattern = block_pattern(mesh.n_points, mesh.cells)
        return cls(mesh.points, body, pattern, pattern.positions(mesh.cells))

    def stiffness(self, lame_lambda: ArrayLike, shear_modulus: ArrayLike) -> sp.bsr_matrix:
        """Return the stiffness matrix (n d, n d), mN/mm.

        Parameters
        ----------
        lame_lambda, shear_modulus : array_like
            Lame's constants, kPa, one number or one a cell.

        Raises
        ------
        InputError
            Moduli of another shape, or that are not finite.
        """
        m, d = self.simplices.n_cells, self.simplices.dimension
        blocks = np.zeros((self.pattern.n_blocks, d, d))
        lame, shear = per_cell(lame_lambda, m, "lame_lambda"), per_cell(shear_modulus, m, "shear_modulus")
        _assemble(self.simplices.gradients, self.simplices.measures, lame, shear, self.positions, (0,) * d, blocks)
        return self.pattern.matrix(blocks)

    def forces(self, lame_lambda: ArrayLike, shear_modulus: ArrayLike, displacement: FloatArray) -> FloatArray:
        """Return the nodal elastic forces (n, d), mN.

        Parameters
        ----------
        lame_lambda, shear_modulus : array_like
            Lame's constants, kPa, one number or one a cell.
        displacement : ndarray, shape (n, d)
            Displacement of the nodes, mm.
        """
        return elastic_forces(self.simplices, lame_lambda, shear_modulus, displacement)

    def factorized(
        self, lame_lambda: ArrayLike, shear_modulus: ArrayLike, constrained: BoolArray, *, solver: SolverName = "automatic"
    ) -> Factorization:
        """Factorize the stiffness with constrained components eliminated.

        Parameters
        ----------
        lame_lambda, shear_modulus : array_like
            Lame's constants, kPa, one number or one a cell.
        constrained : ndarray, shape (n, d), bool
            Constrained components. A solution is zero there where the right-hand side is zero.
        solver : str
            Linear solver; see `naibu.mechanics.linear_algebra.solver_selection`.

        Raises
        ------
        InputError
            `constrained` has another shape than the nodes, rigid-body motions remain, or the solver cannot be used.
        """
        return self._factorized(self.stiffness(lame_lambda, shear_modulus), constrained, solver)

    def _factorized(
        self, stiffness: sp.bsr_matrix, constrained: BoolArray, solver: SolverName, poisson_ratio: float | None = None
    ) -> Factorization:
        """Factorize a stiffness, which is changed in place; with `poisson_ratio` for a single right-hand side."""
        require_shape("constrained", constrained, self.points.shape)
        require_constrained(self.points, constrained)
        matrix = with_dirichlet_rows(stiffness, constrained)
        chosen = choose_solver(
            matrix, self.points, constrained, symmetric=True, solver=solver, poisson_ratio=poisson_ratio, single=poisson_ratio is not None
        )
        return chosen.factorize(matrix)

    def solve(
        self,
        lame_lambda: ArrayLike,
        shear_modulus: ArrayLike,
        prescribed: PrescribedDisplacement,
        external_force: FloatArray | None = None,
        *,
        solver: SolverName = "automatic",
    ) -> FloatArray:
        """Return the displacement (n, d), mm, in static equilibrium.

        Parameters
        ----------
        lame_lambda, shear_modulus : array_like
            Lame's constants, kPa, one number or one a cell.
        prescribed : PrescribedDisplacement
            Dirichlet boundary conditions.
        external_force : ndarray, shape (n, d), optional
            Nodal forces, mN.
        solver : str
            Linear solver; see `naibu.mechanics.linear_algebra.solver_selection`.

        Raises
        ------
        InputError
            Boundary conditions or forces of another shape than the nodes, a body whose rigid-body motions are not constrained, or a solver
            that cannot be used.
        ConvergenceError
            The iterative solver did not converge.
        """
        constrained = prescribed.constrained
        require_shape("prescribed.constrained", constrained, self.points.shape)
        stiffness = self.stiffness(lame_lambda, shear_modulus)
        right = -(stiffness @ np.where(constrained, prescribed.values, 0.0).ravel()).reshape(constrained.shape)
        if external_force is not None:
            require_shape("external_force", external_force, self.points.shape)
            right += external_force
        right[constrained] = 0.0
        lam = np.asarray(lame_lambda, dtype=float)
        largest = float(np.max(0.5 * lam / (lam + np.asarray(shear_modulus, dtype=float))))
        solution = self._factorized(stiffness, constrained, solver, largest).solve(right.ravel()).reshape(right.shape)
        return np.where(constrained, prescribed.values, solution)


def require_constrained(points: FloatArray, constrained: BoolArray) -> None:
    """Check that the constrained components (n, d) of points (n, d) leave no rigid-body motion.

    Raises
    ------
    InputError
        Rigid-body motions remain; the message says how many.
    """
    modes = rigid_body_modes(points)
    modes = modes / np.maximum(np.abs(modes).max(axis=0), 1e-300)
    count = modes.shape[1]
    free = count - int(np.linalg.matrix_rank(modes[constrained.ravel()])) if constrained.any() else count
    if free:
        raise InputError(f"{free} of {count} rigid-body motions are not constrained: constrain more nodes or components")


@njit(cache=True)
def _assemble(gradients, measures, lame, shear, positions, zeros, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the blocks of all cells; `zeros` is a tuple of d zeros, whose length the compiler knows, so that it unrolls the loops."""
    d = len(zeros)
    k = d + 1
    for c in range(len(gradients)):
        g = gradients[c]
        of_lame, of_shear = measures[c] * lame[c], measures[c] * shear[c]
        for i in range(k):
            for j in range(k):
                block = blocks[positions[c, i, j]]
                dot = 0.0
                for a in range(d):
                    dot += g[i, a] * g[j, a]
                dot *= of_shear
                for a in range(d):
                    for b in range(d):
                        block[a, b] += of_lame * g[i, a] * g[j, b] + of_shear * g[j, a] * g[i, b]
                    block[a, a] += dot
