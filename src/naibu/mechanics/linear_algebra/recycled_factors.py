"""Generalised minimal residuals (GMRES, :cite:p:`saad1986`) preconditioned by LU factors of an earlier matrix."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.mechanics.linear_algebra.direct import PardisoSolver, SuperLUSolver, direct_solver, pardiso_library
from naibu.mechanics.linear_algebra.iterative import ApproximateFactorization
from naibu.mechanics.linear_algebra.protocols import Factorization, LinearSolver

FACTORIZATION = 14.0  # its cost in iterations
MOST = 30  # iterations, after which the factors are made anew
NEWTON_TOLERANCE = 1e-2  # relative, of steps of Newton's method in motion: the next one corrects them
FINEST = 1e-8  # relative tolerance below which a factorization in double precision costs less


class RecycledFactors:
    """Solver for unsymmetric systems that change little from one to the next, such as tangents with friction.

    Single right-hand sides are solved to the tolerance that is asked for, with LU factors, in single precision where oneMKL is installed,
    that are kept while that is cheaper than new ones; several ones, and fine tolerances, with a factorization in double precision.

    Parameters
    ----------
    matrix : bsr_matrix, shape (n, n)
        A matrix with the pattern of those to be solved.
    relative_tolerance : float
        Relative residual of a solve, unless another is given to it.
    """

    def __init__(self, matrix: sp.bsr_matrix, *, relative_tolerance: float = 1e-11) -> None:
        self.tolerance = relative_tolerance
        single = pardiso_library() is not None
        self.name = f"GMRES + {PardisoSolver.name} in single precision" if single else f"GMRES + {SuperLUSolver.name}"
        self._direct: LinearSolver = PardisoSolver(matrix, symmetric=False, single_precision=True) if single else SuperLUSolver()
        self._rough: Factorization | None = None
        self._pattern = matrix
        self._direct_exact: LinearSolver | None = None
        self._exact: Factorization | None = None
        self._factorized: sp.bsr_matrix | None = None  # the matrix of the factors in double precision
        self._spent = self._digits = 0.0
        self._stale = True

    def factorize(self, matrix: sp.bsr_matrix) -> Factorization:
        """Prepare for a matrix; what is returned takes a relative tolerance beside the right-hand side."""
        return ApproximateFactorization(self, matrix)

    def iterate(self, matrix: sp.bsr_matrix, b: FloatArray, tolerance: float) -> FloatArray:
        """Solve for right-hand sides (n, r).

        Raises
        ------
        ConvergenceError
            The matrix is singular.
        """
        if b.shape[1] == 1 and tolerance > FINEST:
            for _ in range(2):
                if self._stale:
                    self._renew(matrix)
                if self._rough is None:
                    break
                x, iterations = gmres(matrix, b[:, 0], self._rough.solve, tolerance, MOST)
                if x is not None:
                    self._account(iterations, max(-np.log10(tolerance), 0.1))
                    return x[:, None]
                self._stale = True
        if self._direct_exact is None:
            self._direct_exact = direct_solver(self._pattern, symmetric=False)
        if self._exact is None or self._factorized is not matrix:
            self._exact = self._factorized = None
            self._exact = self._direct_exact.factorize(matrix)
            self._factorized = matrix
        return np.asarray(self._exact.solve(b))

    def _account(self, iterations: int, digits: float) -> None:
        """The mean cost of a digit since the last factorization is minimal where the last digit costs as much as the mean."""
        self._spent += iterations
        self._digits += digits
        self._stale = iterations / digits > self._spent / self._digits

    def _renew(self, matrix: sp.bsr_matrix) -> None:
        """Factorize roughly; there are no factors where the matrix is singular to that."""
        self._rough = None
        try:
            self._rough = self._direct.factorize(matrix)
        except ConvergenceError:
            return
        self._spent, self._digits, self._stale = FACTORIZATION, 0.0, False


def gmres(
    matrix: sp.bsr_matrix, b: FloatArray, precondition: Callable[[FloatArray], FloatArray], tolerance: float, max_iterations: int
) -> tuple[FloatArray | None, int]:
    """Return the solution (n,), preconditioned from the right, and the number of iterations; None where it does not converge.

    Parameters
    ----------
    matrix : bsr_matrix, shape (n, n)
        The matrix.
    b : ndarray, shape (n,)
        Right-hand side.
    precondition : callable
        Approximate inverse of the matrix.
    tolerance : float
        Relative residual.
    max_iterations : int
        After which the iteration is given up.
    """
    norm = float(np.linalg.norm(b))
    if norm == 0.0:
        return np.zeros_like(b), 0
    basis, directions = np.empty((max_iterations + 1, len(b))), np.empty((max_iterations, len(b)))
    basis[0] = b / norm
    hessenberg = np.zeros((max_iterations + 1, max_iterations))
    for k in range(max_iterations):
        directions[k] = precondition(basis[k])
        w = matrix @ directions[k]
        for _ in range(2):  # orthogonalised twice
            along = basis[: k + 1] @ w
            hessenberg[: k + 1, k] += along
            w -= along @ basis[: k + 1]
        hessenberg[k + 1, k] = np.linalg.norm(w)
        if not np.isfinite(hessenberg[: k + 2, k]).all():
            return None, k + 1
        right = np.zeros(k + 2)
        right[0] = norm
        y, *_ = np.linalg.lstsq(hessenberg[: k + 2, : k + 1], right, rcond=None)
        left = float(np.linalg.norm(right - hessenberg[: k + 2, : k + 1] @ y))
        if left <= tolerance * norm:
            return np.asarray(y @ directions[: k + 1]), k + 1
        if hessenberg[k + 1, k] <= 1e-14 * norm:
            return None, k + 1
        basis[k + 1] = w / hessenberg[k + 1, k]
    return None, max_iterations
