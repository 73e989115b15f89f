"""Protocols of linear solvers: factorize once, solve many times."""

from __future__ import annotations

from typing import Protocol

import scipy.sparse as sp

from naibu.core.arrays import FloatArray


class Factorization(Protocol):
    """A factorized matrix A: solves ``A x = b`` for many b."""

    def solve(self, b: FloatArray) -> FloatArray:
        """Return x for b of shape (n,) or (n, r)."""
        ...


class LinearSolver(Protocol):
    """A linear solver for matrices of one sparsity pattern."""

    name: str

    def factorize(self, matrix: sp.bsr_matrix) -> Factorization:
        """Return the factorization of `matrix`, which has the pattern the solver was made for."""
        ...
