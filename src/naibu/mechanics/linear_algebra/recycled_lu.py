"""Stabilised biconjugate gradients :cite:p:`vandervorst1992` preconditioned by LU factors of an earlier matrix."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from naibu.core.arrays import FloatArray
from naibu.mechanics.linear_algebra.direct import PardisoSolver, SuperLUSolver, pardiso_library
from naibu.mechanics.linear_algebra.protocols import Factorization, LinearSolver

SLOW = 4  # iterations from which new factors are cheaper than the next solves with the old ones
MOST = 30


@dataclass(slots=True, eq=False)
class RecycledLU:
    """Solver for unsymmetric systems that change little from one to the next.

    Attributes
    ----------
    matrix : bsr_matrix, shape (n, n)
        A matrix with the pattern of those to be solved.
    relative_tolerance : float
        Relative residual of a solve.
    """

    matrix: sp.bsr_matrix
    relative_tolerance: float = 1e-2
    name: str = "BiCGSTAB with recycled LU factors"
    _direct: LinearSolver = field(init=False)
    _factors: Factorization | None = field(init=False, default=None)
    _stale: bool = field(init=False, default=False)

    def __post_init__(self) -> None:
        with_library = pardiso_library() is not None
        self._direct = PardisoSolver(self.matrix, symmetric=False, single_precision=True) if with_library else SuperLUSolver()

    def factorize(self, matrix: sp.bsr_matrix) -> Factorization:
        """Prepare for a matrix; its factors are made when the old ones serve no more.

        Raises
        ------
        ConvergenceError
            The matrix is singular.
        """
        self.matrix = matrix
        if self._factors is None or self._stale:
            self._renew()
        return self

    def solve(self, b: FloatArray) -> FloatArray:
        """Return x for b of shape (n,)."""
        factors = self._factors or self._renew()
        for _ in range(2):
            preconditioner = spla.LinearOperator(self.matrix.shape, matvec=factors.solve, dtype=np.float64)
            count = [0]

            def counted(_: FloatArray, count: list[int] = count) -> None:
                count[0] += 1

            x, failed = spla.bicgstab(self.matrix, b, rtol=self.relative_tolerance, maxiter=MOST, M=preconditioner, callback=counted)
            if not failed and np.isfinite(x).all():
                self._stale = count[0] > SLOW
                return np.asarray(x, dtype=np.float64)
            factors = self._renew()
        return np.asarray(factors.solve(b), dtype=np.float64)

    def _renew(self) -> Factorization:
        self._factors, self._stale = self._direct.factorize(self.matrix), False
        return self._factors
