"""Factors of a matrix together with the part of its inverse between some of its nodes, by their Schur complement.

Where the unknowns C of those nodes are eliminated last, what is left of the matrix A before their turn is the Schur complement
``S = A_CC - A_CI A_II^-1 A_IC``, a dense matrix that any factorization passes through; its inverse is the part ``(A^-1)_CC``
:cite:p:`zhang2005`. It takes the time of the factorization alone, where columns of the inverse, one solution each, take many times as long.
"""

from __future__ import annotations

import ctypes

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from naibu.core.arrays import AnyFloatArray, FloatArray, Int32Array, IntArray
from naibu.core.errors import ConvergenceError
from naibu.mechanics.linear_algebra.direct import IN_SEQUENCE, PardisoSolver

_BACKWARD = 333  # PARDISO's phase of a solution from those unknowns that are eliminated last


class PardisoSchurSolver(PardisoSolver):
    """Factorization by oneMKL PARDISO of symmetric matrices, with the part of the inverse between some nodes.

    Parameters
    ----------
    matrix : bsr_matrix, shape (3 n, 3 n)
        A symmetric matrix of 3 x 3 blocks with the pattern of those to be factorized.
    single_precision : bool
        Whether to factorize in single precision.

    Attributes
    ----------
    nodes : ndarray, shape (k,), int64
        Those between which the inverse is sought, ascending; none at first.
    inverse : ndarray, shape (3 k, 3 k)
        The part of the inverse of the matrix factorized last that belongs to them, in the precision of the factors. It has entries that are
        not finite where the matrix has no inverse in this precision.

    Raises
    ------
    InputError
        oneMKL is not installed.
    """

    nodes: IntArray
    inverse: AnyFloatArray

    def __init__(self, matrix: sp.bsr_matrix, *, single_precision: bool = False) -> None:
        super().__init__(matrix, symmetric=True, single_precision=single_precision)
        self._type = -2  # LDL^T: where PARDISO's Cholesky factorization with a complement meets an indefinite matrix, its memory is damaged
        self.nodes = np.zeros(0, dtype=np.int64)
        self.inverse = np.zeros((0, 0), dtype=self._float)
        self._last: Int32Array = np.zeros(self._n, dtype=np.int32)

    def condense(self, nodes: IntArray) -> None:
        """Seek the part of the inverse between these nodes (k,), ascending, from the next factorization on, which analyses the pattern."""
        self._release()
        self.nodes, self.inverse = nodes, np.zeros((0, 0), dtype=self._float)
        self._last[:] = 0
        self._last.reshape(-1, 3)[nodes] = 1

    def solve_condensed(self, b: FloatArray) -> FloatArray:
        """Return x (3 n,) for a right side that is b (k, 3) at the nodes, and elsewhere zero: half the work of a solution."""
        there: AnyFloatArray = np.zeros((self._n // 3, 3), dtype=self._float)
        x: AnyFloatArray = np.zeros(self._n, dtype=self._float)
        there[self.nodes] = (self.inverse @ b.ravel().astype(self._float)).reshape(-1, 3)
        self._parameters[24] = IN_SEQUENCE
        if (error := self._call(_BACKWARD, there.ravel(), x, 1)) != 0:
            raise ConvergenceError(f"PARDISO could not solve the linear system (error {error})")
        return np.asarray(x, dtype=np.float64)

    def _set_parameters(self) -> None:
        super()._set_parameters()
        if len(self.nodes):
            self._parameters[35] = 2  # Schur complement, and factors for whole solutions

    def _permutation(self) -> ctypes.c_void_p | None:
        return self._last.ctypes.data_as(ctypes.c_void_p) if len(self.nodes) else None

    def _definite(self) -> bool:
        return int(self._parameters[22]) == 0  # negative pivots, those of the complement included

    def _factorized(self) -> int:
        if len(self.nodes) == 0:
            return super()._factorized()
        complement = np.zeros((3 * len(self.nodes),) * 2, dtype=self._float, order="F")
        error = self._call(22, np.zeros(1, dtype=self._float), complement, 1)
        self.inverse = _inverse(complement) if error == 0 else complement
        return error


def _inverse(matrix: AnyFloatArray) -> AnyFloatArray:
    """Return the inverse of a symmetric matrix in the order of columns; not finite where there is none.

    It is computed in double precision: the two sides of a cut that is held closed hardly move relative to each other.
    """
    double = matrix.astype(np.float64)
    factor, indefinite = la.lapack.dpotrf(double)
    if indefinite == 0:
        half = np.triu(la.lapack.dpotri(factor)[0])
        return np.asfortranarray(half + np.triu(half, 1).T, dtype=matrix.dtype)
    try:
        return np.asfortranarray(la.inv(double, check_finite=False), dtype=matrix.dtype)
    except la.LinAlgError:
        return np.full_like(matrix, np.nan)
