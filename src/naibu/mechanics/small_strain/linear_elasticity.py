"""Small-strain elasticity on linear simplices: assembled stiffness, reduced to free unknowns and factorized (spec M1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from naibu._numba.compilation import njit
from naibu.core.arrays import BoolArray, FloatArray, Int32Array
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.boundary_conditions import Prescribed
from naibu.mechanics.finite_elements.linear_simplices import Simplices, elastic_forces, per_cell, simplices
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern, block_pattern, with_dirichlet_rows
from naibu.mechanics.linear_algebra.protocols import Factorization
from naibu.mechanics.linear_algebra.solver_selection import choose_solver


@dataclass(frozen=True, slots=True, eq=False)
class LinearBody:
    """Simplices and the fixed pattern of their stiffness; moduli are arguments, so that identification may change them.

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
        """Prepare a mesh of lines, triangles or tetrahedra (see `naibu.mechanics.finite_elements.linear_simplices.simplices`)."""
        body = simplices(mesh, thickness_mm=thickness_mm, cross_section_mm2=cross_section_mm2)
        pattern = block_pattern(mesh.n_points, mesh.cells)
        return cls(mesh.points, body, pattern, pattern.positions(mesh.cells))

    def stiffness(self, lame_lambda: ArrayLike, shear_modulus: ArrayLike) -> sp.bsr_matrix:
        """Return the stiffness (n d, n d), mN/mm, for moduli in kPa, one number or one a cell."""
        m, d = self.simplices.n_cells, self.simplices.dimension
        blocks = np.zeros((self.pattern.n_blocks, d, d))
        lame, shear = per_cell(lame_lambda, m, "lame_lambda"), per_cell(shear_modulus, m, "shear_modulus")
        _assemble(self.simplices.gradients, self.simplices.measures, lame, shear, self.positions, (0,) * d, blocks)
        return self.pattern.matrix(blocks)

    def forces(self, lame_lambda: ArrayLike, shear_modulus: ArrayLike, displacement: FloatArray) -> FloatArray:
        """Return the nodal forces (n, d), mN, that hold a displacement (n, d), mm."""
        return elastic_forces(self.simplices, lame_lambda, shear_modulus, displacement)

    def factorized(self, lame_lambda: ArrayLike, shear_modulus: ArrayLike, constrained: BoolArray) -> Factorization:
        """Factorize the stiffness with the unknowns `constrained` (n, d) eliminated.

        Solving returns zero at them where the right-hand side is zero.

        Raises
        ------
        InputError
            The body can move freely.
        """
        return self._factorized(self.stiffness(lame_lambda, shear_modulus), constrained)

    def _factorized(self, stiffness: sp.bsr_matrix, constrained: BoolArray) -> Factorization:
        """Factorize a stiffness, which is changed in place."""
        require_constrained(self.points, constrained)
        matrix = with_dirichlet_rows(stiffness, constrained)
        return choose_solver(matrix, self.points, constrained, symmetric=True).factorize(matrix)

    def solve(
        self, lame_lambda: ArrayLike, shear_modulus: ArrayLike, prescribed: Prescribed, external_force: FloatArray | None = None
    ) -> FloatArray:
        """Return the displacement (n, d), mm, in equilibrium with prescribed displacements and nodal forces (n, d), mN.

        Raises
        ------
        InputError
            Supports or forces of another shape than the nodes, or a body that can move freely.
        """
        constrained = prescribed.constrained
        if constrained.shape != self.points.shape:
            raise InputError(f"the supports are for {constrained.shape} components, the body has {self.points.shape}")
        stiffness = self.stiffness(lame_lambda, shear_modulus)
        right = -(stiffness @ np.where(constrained, prescribed.values, 0.0).ravel()).reshape(constrained.shape)
        if external_force is not None:
            if external_force.shape != self.points.shape:
                raise InputError(f"external forces must have shape {self.points.shape}, not {external_force.shape}")
            right += external_force
        right[constrained] = 0.0
        solution = self._factorized(stiffness, constrained).solve(right.ravel()).reshape(right.shape)
        return np.where(constrained, prescribed.values, solution)


def require_constrained(points: FloatArray, constrained: BoolArray) -> None:
    """Check that holding the components `constrained` (n, d) of points (n, d) leaves no rigid motion.

    Raises
    ------
    InputError
        The body can move freely; the message says in how many ways.
    """
    d = points.shape[1]
    centred = points - points.mean(axis=0)
    modes = [np.broadcast_to(np.eye(d)[a], points.shape) for a in range(d)]
    for a in range(d):
        for b in range(a + 1, d):
            turn = np.zeros_like(points)
            turn[:, a], turn[:, b] = -centred[:, b], centred[:, a]
            modes.append(turn / max(float(np.abs(turn).max()), 1e-300))
    free = len(modes) - np.linalg.matrix_rank(np.array([mode[constrained] for mode in modes])) if constrained.any() else len(modes)
    if free:
        raise InputError(f"the body can move freely in {free} of {len(modes)} rigid ways: hold more nodes or components")


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
