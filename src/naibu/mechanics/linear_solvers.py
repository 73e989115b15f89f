"""Two-phase solution of sparse linear systems: analyse a pattern once, factorize values, solve right-hand sides.

``solver = direct_solver(matrix)`` analyses the pattern, ``factorization = solver.factorize(matrix)`` takes the values, and
``factorization.solve(b)`` may be called for any number of right-hand sides. Supernodal PARDISO (Intel oneMKL, a pip wheel) is used
where it can be loaded, SuperLU of SciPy elsewhere. Large symmetric systems are better served by `MultigridSolver`: conjugate
gradients preconditioned by smoothed aggregation with rigid-body modes.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from pathlib import Path
from typing import Protocol

import numpy as np
import pyamg
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from naibu.core.errors import ConvergenceError, InputError

Array = NDArray[np.float64]
DIRECT_LIMIT = 120_000


class Factorization(Protocol):
    """Something that solves ``A x = b`` for many b."""

    def solve(self, b: Array) -> Array:
        """Return x for b of shape (n,) or (n, r)."""
        ...


class LinearSolver(Protocol):
    """Something that factorizes matrices of one pattern."""

    name: str

    def factorize(self, matrix: sp.bsr_matrix) -> Factorization:
        """Return the factorization of `matrix`, which has the pattern the solver was made for."""
        ...


@functools.cache
def pardiso_library() -> ctypes.CDLL | None:
    """Return the oneMKL runtime library if its wheel is installed, else None."""
    os.environ.setdefault("KMP_BLOCKTIME", "0")  # idle threads sleep at once instead of spinning beside Numba's
    names = ("libmkl_rt.so.3", "libmkl_rt.so.2", "libmkl_rt.so.1", "libmkl_rt.2.dylib", "mkl_rt.3.dll", "mkl_rt.2.dll")
    folders = [Path(sys.prefix) / "lib", Path(sys.prefix) / "Library" / "bin"]
    for path in (folder / name for folder in folders for name in names):
        if path.exists():
            try:
                return ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
            except OSError:
                continue
    return None


def use_one_thread() -> None:
    """Let the direct solver use one thread when called from the present one; for problems solved side by side."""
    library = pardiso_library()
    if library is not None:
        library.MKL_Set_Num_Threads_Local(1)


class PardisoSolver:
    """Supernodal factorization by oneMKL PARDISO; the analysis of the pattern is kept between factorizations."""

    name = "PARDISO (oneMKL)"

    def __init__(self, matrix: sp.bsr_matrix, *, symmetric: bool) -> None:
        library = pardiso_library()
        if library is None:
            raise InputError('PARDISO is not installed; run: pip install "naibu[fast]"')
        self._library = library
        self._symmetric = symmetric
        marked = sp.bsr_matrix((np.arange(1.0, matrix.data.size + 1.0).reshape(matrix.data.shape), matrix.indices, matrix.indptr), shape=matrix.shape).tocsr()
        pattern = (sp.triu(marked, format="csr") if symmetric else marked).sorted_indices()
        self._take = pattern.data.astype(np.int64) - 1
        self._ia = pattern.indptr.astype(np.int32)
        self._ja = pattern.indices.astype(np.int32)
        self._n = matrix.shape[0]
        self._type = 2 if symmetric else 1
        self._handle = np.zeros(64, dtype=np.int64)
        self._parameters = np.zeros(64, dtype=np.int32)
        self._set_parameters()
        self._values = np.zeros(len(self._ja))
        self._analysed = False

    def _set_parameters(self) -> None:
        iparm = self._parameters
        iparm[:] = 0
        iparm[0] = 1  # no defaults
        iparm[1] = 2  # METIS ordering
        iparm[9] = 13 if self._type in (1, 11) else 8  # pivot perturbation 10^-k
        iparm[34] = 1  # indices count from 0

    def factorize(self, matrix: sp.bsr_matrix) -> PardisoSolver:
        """Factorize the values of `matrix`; the factorization stays valid until the next call.

        Raises
        ------
        ConvergenceError
            The matrix is singular.
        """
        self._values = matrix.data.ravel()[self._take]
        empty = np.zeros(1)
        if not self._analysed:
            self._call(11, empty, empty, 1)
            self._analysed = True
        error = self._call(22, empty, empty, 1)
        if error == -4 and self._type == 2:  # not positive definite: an indefinite factorization serves
            self._release()
            self._type = -2
            self._set_parameters()
            self._call(11, empty, empty, 1)
            error = self._call(22, empty, empty, 1)
        perturbed = int(self._parameters[13])  # vanishing pivots, which PARDISO replaces by tiny ones without a word
        if error != 0 or perturbed:
            what = f"PARDISO error {error}, {perturbed} vanishing pivots"
            raise ConvergenceError(f"the linear system is singular ({what}): is every body held against rigid motion?")
        return self

    def solve(self, b: Array) -> Array:
        """Return x for b of shape (n,) or (n, r)."""
        columns = 1 if b.ndim == 1 else b.shape[1]
        rhs = np.asfortranarray(b, dtype=np.float64)
        x = np.zeros_like(rhs, order="F")
        error = self._call(33, rhs, x, columns)
        if error != 0:
            raise ConvergenceError(f"PARDISO could not solve the linear system (error {error})")
        return x

    def _call(self, phase: int, b: Array, x: Array, columns: int) -> int:
        def integer(value: int) -> ctypes._CArgObject:
            return ctypes.byref(ctypes.c_int32(value))

        def pointer(array: NDArray[np.generic]) -> ctypes.c_void_p:
            return array.ctypes.data_as(ctypes.c_void_p)

        error = ctypes.c_int32(0)
        self._library.pardiso(
            pointer(self._handle), integer(1), integer(1), integer(self._type), integer(phase), integer(self._n),
            pointer(self._values), pointer(self._ia), pointer(self._ja), None, integer(columns), pointer(self._parameters),
            integer(0), pointer(b), pointer(x), ctypes.byref(error),
        )  # fmt: skip
        return error.value

    def _release(self) -> None:
        if self._analysed:
            self._call(-1, np.zeros(1), np.zeros(1), 1)
            self._handle[:] = 0

    def __del__(self) -> None:
        if getattr(self, "_library", None) is not None and hasattr(self, "_analysed") and not sys.is_finalizing():
            self._release()


class SuperLUSolver:
    """SciPy's SuperLU in symmetric mode; needs nothing but SciPy."""

    name = "SuperLU (SciPy)"

    def factorize(self, matrix: sp.bsr_matrix) -> Factorization:
        """Factorize `matrix`.

        Raises
        ------
        ConvergenceError
            The matrix is singular.
        """
        try:
            return spla.splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=1e-3, options={"SymmetricMode": True})
        except RuntimeError as error:
            raise ConvergenceError(f"the linear system is singular ({error}): is every body held against rigid motion?") from error


class MultigridSolver:
    """Conjugate gradients with smoothed aggregation from the rigid-body modes; the hierarchy is rebuilt only when it has aged.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Node positions, mm, from which the rigid-body modes are made.
    held : ndarray, shape (3 n,), bool
        Degrees of freedom that are prescribed; their modes are zero.
    relative_tolerance : float
        Of the residual of each solve.
    """

    name = "CG + smoothed aggregation (pyamg)"

    def __init__(self, points: Array, held: NDArray[np.bool_], *, relative_tolerance: float = 1e-8, max_iterations: int = 400) -> None:
        self._modes = rigid_body_modes(points)
        self._modes[held] = 0.0
        self._tolerance = relative_tolerance
        self._max_iterations = max_iterations
        self._preconditioner: spla.LinearOperator | None = None
        self._fresh_iterations = 0
        self._rebuild = True

    def factorize(self, matrix: sp.bsr_matrix) -> Factorization:
        """Prepare the hierarchy for `matrix` (or keep that of an earlier matrix while it still serves)."""
        if self._rebuild or self._preconditioner is None:
            self._build(matrix)
        return _MultigridFactorization(self, matrix)

    def _build(self, matrix: sp.bsr_matrix) -> None:
        hierarchy = pyamg.smoothed_aggregation_solver(
            matrix, B=self._modes, strength=("symmetric", {"theta": 0.0}), smooth=("jacobi", {"omega": 4.0 / 3.0}),
            improve_candidates=None, max_coarse=600, coarse_solver="splu", presmoother=("block_gauss_seidel", {"sweep": "symmetric"}),
            postsmoother=("block_gauss_seidel", {"sweep": "symmetric"}),
        )  # fmt: skip
        self._preconditioner = hierarchy.aspreconditioner()
        self._rebuild = False
        self._fresh_iterations = 0

    def iterate(self, matrix: sp.bsr_matrix, b: Array) -> Array:
        """Solve for one right-hand side.

        Raises
        ------
        ConvergenceError
            No convergence even with a hierarchy made for this matrix.
        """
        for attempt in range(2):
            count = [0]
            x, status = spla.cg(matrix, b, rtol=self._tolerance, maxiter=self._max_iterations, M=self._preconditioner, callback=lambda _, c=count: c.__setitem__(0, c[0] + 1))
            if status == 0:
                if self._fresh_iterations == 0:
                    self._fresh_iterations = count[0]
                self._rebuild = count[0] > 1.7 * self._fresh_iterations + 5
                return np.asarray(x)
            if attempt == 0:
                self._build(matrix)
        raise ConvergenceError(f"conjugate gradients did not reach {self._tolerance:g} in {self._max_iterations} iterations; is every body held?")


class _MultigridFactorization:
    """A matrix with a hierarchy that may have been made for an earlier one."""

    def __init__(self, solver: MultigridSolver, matrix: sp.bsr_matrix) -> None:
        self._solver, self._matrix = solver, matrix

    def solve(self, b: Array) -> Array:
        if b.ndim == 1:
            return self._solver.iterate(self._matrix, b)
        return np.stack([self._solver.iterate(self._matrix, column) for column in b.T], axis=1)


def rigid_body_modes(points: Array) -> Array:
    """Return the six rigid-body modes (3 n, 6) of points (n, 3), about their centroid."""
    x, y, z = (points - points.mean(axis=0)).T
    modes = np.zeros((len(points), 3, 6))
    modes[:, 0, 0] = modes[:, 1, 1] = modes[:, 2, 2] = 1.0
    modes[:, 1, 3], modes[:, 2, 3] = -z, y
    modes[:, 0, 4], modes[:, 2, 4] = z, -x
    modes[:, 0, 5], modes[:, 1, 5] = -y, x
    return modes.reshape(-1, 6)


def direct_solver(matrix: sp.bsr_matrix, *, symmetric: bool) -> LinearSolver:
    """Return the fastest direct solver that is installed, for the pattern of `matrix`."""
    if pardiso_library() is not None:
        return PardisoSolver(matrix, symmetric=symmetric)
    return SuperLUSolver()


def choose_solver(matrix: sp.bsr_matrix, points: Array, held: NDArray[np.bool_], *, symmetric: bool) -> LinearSolver:
    """Choose by size: direct below `DIRECT_LIMIT` unknowns or for unsymmetric systems, multigrid above (measured in ``benchmarks/``)."""
    limit = DIRECT_LIMIT if pardiso_library() is not None else DIRECT_LIMIT // 6
    if symmetric and matrix.shape[0] > limit:
        return MultigridSolver(points, held)
    return direct_solver(matrix, symmetric=symmetric)
