"""Preconditioned conjugate gradients :cite:p:`hestenes1952` with a preconditioner recycled from an earlier matrix."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Protocol

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.mechanics.linear_algebra.direct import PardisoSolver, direct_solver
from naibu.mechanics.linear_algebra.protocols import Factorization, LinearSolver


class RecyclingSolver(ABC):
    """Conjugate gradients with a recycled preconditioner, kept from an earlier matrix while that is cheaper than a new one.

    Parameters
    ----------
    relative_tolerance : float
        Relative residual of a solve, unless another is given to it.
    max_iterations : int
        After which a preconditioner is made anew.
    """

    name = "CG"
    iterations_per_build = 12.0  # cost of a new preconditioner in iterations
    falls_back = False  # to a direct solver where the iteration fails, rather than raising

    def __init__(self, *, relative_tolerance: float = 1e-8, max_iterations: int = 400) -> None:
        self.tolerance = relative_tolerance
        self.max_iterations = max_iterations
        self._apply: Callable[[FloatArray], FloatArray] | None = None
        self._spent = 0.0
        self._digits = 0.0
        self._rebuild = True
        self._exact: LinearSolver | None = None

    @abstractmethod
    def preconditioner(self, matrix: sp.bsr_matrix) -> Callable[[FloatArray], FloatArray]:
        """Return a map from residuals (n, r) to corrections made for `matrix`."""

    def multiplication(self, matrix: sp.bsr_matrix) -> Callable[[FloatArray], FloatArray]:
        """Return the product of `matrix` with vectors (n, r)."""
        return lambda x: np.asarray(matrix @ x)

    def factorize(self, matrix: sp.bsr_matrix) -> Factorization:
        """Prepare for `matrix`, keeping the preconditioner of an earlier one while it is still efficient."""
        if self._rebuild and self._exact is None:
            self._build(matrix)
        return ApproximateFactorization(self, matrix) if self._exact is None else self._exact.factorize(matrix)

    def _build(self, matrix: sp.bsr_matrix) -> None:
        try:
            self._apply = self.preconditioner(matrix)
        except ConvergenceError:
            if not self.falls_back:
                raise
            self._exact, self._apply = direct_solver(matrix, symmetric=True), None
        self._spent, self._digits, self._rebuild = self.iterations_per_build, 0.0, False

    def iterate(self, matrix: sp.bsr_matrix, b: FloatArray, tolerance: float) -> FloatArray:
        """Solve for right-hand sides (n, r).

        Raises
        ------
        ConvergenceError
            No convergence even with a preconditioner made for this matrix.
        """
        for attempt in range(2):
            if attempt:
                self._build(matrix)
            if self._apply is None:
                break
            x, iterations = conjugate_gradients(self.multiplication(matrix), b, self._apply, tolerance, self.max_iterations)
            if x is not None:
                digits = max(-np.log10(tolerance), 0.1)
                self._spent += iterations
                self._digits += digits
                # the mean cost of a digit since the last build is minimal where the last digit costs as much as the mean
                self._rebuild = iterations / digits > self._spent / self._digits
                return x
        if not self.falls_back:
            raise ConvergenceError(
                f"no convergence to {tolerance:g} in {self.max_iterations} CG iterations; are all rigid-body motions constrained?"
            )
        self._exact, self._apply = self._exact or direct_solver(matrix, symmetric=True), None
        return self._exact.factorize(matrix).solve(b)


class Iteration(Protocol):
    """An iterative solver with its usual relative tolerance."""

    tolerance: float

    def iterate(self, matrix: sp.bsr_matrix, b: FloatArray, tolerance: float) -> FloatArray:
        """Solve for right-hand sides (n, r)."""
        ...


class ApproximateFactorization:
    """A matrix with a preconditioner that may stem from an earlier one; solves to the requested accuracy."""

    def __init__(self, solver: Iteration, matrix: sp.bsr_matrix) -> None:
        self._solver, self._matrix = solver, matrix

    def solve(self, b: FloatArray, relative_tolerance: float | None = None) -> FloatArray:
        """Return x for b of shape (n,) or (n, r); the solver's own tolerance is the default."""
        tolerance = self._solver.tolerance if relative_tolerance is None else relative_tolerance
        return self._solver.iterate(self._matrix, b.reshape(len(b), -1), tolerance).reshape(b.shape)


def conjugate_gradients(
    multiply: Callable[[FloatArray], FloatArray],
    b: FloatArray,
    precondition: Callable[[FloatArray], FloatArray],
    tolerance: float,
    max_iterations: int,
) -> tuple[FloatArray | None, int]:
    """Return the solution (n, r) and the number of iterations; None where they do not converge or something is not positive definite.

    Every right-hand side has its own iteration; all are advanced together.
    """
    x, r = np.zeros_like(b), b.copy()
    target = tolerance * np.linalg.norm(b, axis=0)
    p, rz = np.zeros_like(b), np.ones(b.shape[1])
    for iteration in range(max_iterations + 1):
        active = np.linalg.norm(r, axis=0) > target
        if not active.any():
            return x, iteration
        z = precondition(r)
        new = np.einsum("ij,ij->j", r, z)
        if not (new[active] > 0.0).all():
            return None, iteration
        p = z + p * (new / rz if iteration else 0.0)
        rz = np.where(active, new, 1.0)
        q = multiply(p)
        curvature = np.einsum("ij,ij->j", p, q)
        if not (curvature[active] > 0.0).all():
            return None, iteration
        alpha = np.where(active, new / np.where(active, curvature, 1.0), 0.0)
        x += alpha * p
        r -= alpha * q
    return None, max_iterations


class RecycledCholesky(RecyclingSolver):
    """Conjugate gradients in double precision, preconditioned by a single-precision Cholesky factor that serves several tangents."""

    name = "CG + PARDISO (oneMKL) in single precision"
    falls_back = True

    def __init__(self, matrix: sp.bsr_matrix, *, relative_tolerance: float = 1e-11, max_iterations: int = 60) -> None:
        super().__init__(relative_tolerance=relative_tolerance, max_iterations=max_iterations)
        self._factor = PardisoSolver(matrix, symmetric=True, single_precision=True)

    def preconditioner(self, matrix: sp.bsr_matrix) -> Callable[[FloatArray], FloatArray]:
        """Return the solution with the factor of `matrix`."""
        factor = self._factor.factorize(matrix)
        return lambda r: factor.solve(r).astype(np.float64)
