"""Quadratic functions of many variables under linear constraints, minimised with one sparse factorization (saddle-point systems)."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.mechanics.linear_algebra.direct import PardisoSolver

EQUILIBRATIONS = 4  # passes after which the largest entries of all rows are alike
SHIFT = 1e-9  # of the equilibrated diagonal: makes the system quasi-definite, so that pivots vanish in no order


class SaddlePoint:
    """The least value of ``x' A x / 2 - b' x`` under ``C x = 0``, by a factorization of ``[[A, C'], [C, 0]]``.

    The system is equilibrated (:cite:p:`ruiz2001`) and made quasi-definite by a small shift, with which it has an LDL' factorization in
    every order (:cite:p:`vanderbei1995`); PARDISO matches variables and constraints before it orders them. The shift leaves a relative
    error of some 1e-8: solutions serve as a preconditioner.

    Parameters
    ----------
    quadratic : csr_matrix, shape (n, n)
        A, symmetric and without negative eigenvalues; positive on what fulfils the constraints.
    constraints : csr_matrix, shape (m, n)
        C, of full rank.

    Raises
    ------
    ConvergenceError
        A pivot vanishes.
    """

    def __init__(self, quadratic: sp.csr_matrix, constraints: sp.csr_matrix) -> None:
        m, self._n = constraints.shape
        none = sp.csr_matrix((m, m))
        whole = sp.csr_matrix(sp.vstack([sp.hstack([quadratic, constraints.T]), sp.hstack([constraints, none])]))
        scale = np.ones(self._n + m)
        rows = np.repeat(np.arange(len(scale)), np.diff(whole.indptr))
        for _ in range(EQUILIBRATIONS):
            scaled = np.abs(whole.data) * scale[rows] * scale[whole.indices]
            scale /= np.sqrt(np.maximum(np.maximum.reduceat(scaled, whole.indptr[:-1]), 1e-300))
        whole.data *= scale[rows] * scale[whole.indices]
        shift = np.concatenate([np.full(self._n, SHIFT), np.full(m, -SHIFT)])
        shifted = sp.bsr_matrix(whole + sp.diags(shift), blocksize=(1, 1))
        shifted.sort_indices()
        self._scale, self._m = scale, m
        self._factor = _QuasiDefinite(shifted).factorize(shifted)

    def solve(self, b: FloatArray, c: FloatArray | None = None) -> FloatArray:
        """Return x for b of shape (n,) or (n, r); under ``C x = c`` with c of shape (m,) or (m, r) where it is given."""
        right = np.zeros((self._n + self._m, *b.shape[1:]))
        scale = self._scale.reshape(-1, *[1] * (b.ndim - 1))
        right[: self._n] = scale[: self._n] * b
        if c is not None:
            right[self._n :] = scale[self._n :] * c
        return np.asarray(scale[: self._n] * self._factor.solve(right)[: self._n])


class _QuasiDefinite(PardisoSolver):
    """PARDISO with matching for a symmetric indefinite matrix that is regular by its form."""

    def __init__(self, matrix: sp.bsr_matrix) -> None:
        super().__init__(matrix, symmetric=True)
        self._type = -2

    def _set_parameters(self) -> None:
        super()._set_parameters()
        self._parameters[9] = 13  # pivots that count as vanishing: below 10^-13
        self._parameters[10] = self._parameters[12] = 1  # scaling and matching

    def _require_regular(self) -> None:
        """It is."""
