"""Conjugate gradients with algebraic multigrid by PETSc :cite:p:`balay2022`, on the ranks of an MPI program."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray, require_shape
from naibu.core.errors import ConvergenceError
from naibu.core.optional_packages import optional_package
from naibu.mechanics.linear_algebra.iterative import ApproximateFactorization
from naibu.mechanics.linear_algebra.multigrid.multigrid_solver import rigid_body_modes
from naibu.mechanics.linear_algebra.protocols import Factorization


class PetscSolver:
    """Conjugate gradients preconditioned by PETSc's smoothed aggregation (GAMG) of the rigid-body modes.

    Every rank of an MPI program calls it with the same matrix and right-hand sides, keeps a block of rows, and gets the whole solution.

    Parameters
    ----------
    points : ndarray, shape (n, d)
        Node positions, mm, from which the rigid-body modes are made.
    constrained : ndarray, shape (n, d), bool
        Constrained components; their modes are zero.
    relative_tolerance : float
        Of the residual of each solve.
    max_iterations : int
        After which a solve fails.

    Raises
    ------
    InputError
        `constrained` has another shape than `points`.
    MissingDependencyError
        petsc4py is not installed.
    """

    name = "CG + GAMG (PETSc)"

    def __init__(self, points: FloatArray, constrained: BoolArray, *, relative_tolerance: float = 1e-8, max_iterations: int = 400) -> None:
        require_shape("constrained", constrained, points.shape)
        self._petsc: Any = optional_package("petsc4py.PETSc", "solver='petsc'", "naibu[petsc]")
        self.tolerance, self._most = relative_tolerance, max_iterations
        self._comm = self._petsc.COMM_WORLD
        modes = rigid_body_modes(points)
        modes[constrained.ravel()] = 0.0
        self._modes = np.linalg.qr(modes)[0]
        n, d = points.shape
        ends = d * (n * np.arange(self._comm.getSize() + 1) // self._comm.getSize())
        self._rows = slice(int(ends[self._comm.getRank()]), int(ends[self._comm.getRank() + 1]))
        self._block = d
        self._matrix: sp.bsr_matrix | None = None
        self._solver: Any = None

    def factorize(self, matrix: sp.bsr_matrix) -> Factorization:
        """Set up the preconditioner of `matrix`."""
        self._set_up(matrix)
        return ApproximateFactorization(self, matrix)

    def _set_up(self, matrix: sp.bsr_matrix) -> None:
        petsc, rows, whole = self._petsc, self._rows, matrix.shape[0]
        mine = matrix.tocsr()[rows]
        indices = (mine.indptr.astype(petsc.IntType), mine.indices.astype(petsc.IntType), mine.data)
        size = (rows.stop - rows.start, whole)
        distributed = petsc.Mat().createAIJ(size=(size, size), bsize=self._block, csr=indices, comm=self._comm)
        modes = [petsc.Vec().createWithArray(np.ascontiguousarray(m[rows]), size=size, comm=self._comm) for m in self._modes.T]
        distributed.setNearNullSpace(petsc.NullSpace().create(vectors=modes, comm=self._comm))
        distributed.setOption(petsc.Mat.Option.SPD, True)
        solver = petsc.KSP().create(comm=self._comm)
        solver.setOperators(distributed)
        solver.setType("cg")
        solver.setNormType(petsc.KSP.NormType.UNPRECONDITIONED)
        solver.getPC().setType("gamg")
        self._matrix, self._solver = matrix, solver

    def iterate(self, matrix: sp.bsr_matrix, b: FloatArray, tolerance: float) -> FloatArray:
        """Solve for right-hand sides (n, r).

        Raises
        ------
        ConvergenceError
            No convergence.
        """
        if self._matrix is not matrix:
            self._set_up(matrix)
        self._solver.setTolerances(rtol=tolerance, atol=0.0, max_it=self._most)
        x, right = self._solver.getOperators()[0].createVecs()
        gather, whole = self._petsc.Scatter.toAll(x)
        out = np.empty_like(b)
        for column in range(b.shape[1]):
            right.setArray(b[self._rows, column])
            self._solver.solve(right, x)
            if self._solver.getConvergedReason() < 0:
                raise ConvergenceError(
                    f"no convergence to {tolerance:g} in {self._solver.getIterationNumber()} iterations of PETSc; "
                    "are all rigid-body motions constrained?"
                )
            gather.scatter(x, whole, mode=self._petsc.ScatterMode.FORWARD)
            out[:, column] = whole.getArray()
        return out
