"""Two-phase solution of sparse linear systems: analyse a pattern once, factorize values, solve right-hand sides.

``solver = direct_solver(matrix)`` analyses the pattern, ``factorization = solver.factorize(matrix)`` takes the values, and
``factorization.solve(b)`` may be called for any number of right-hand sides. Supernodal PARDISO (Intel oneMKL, a pip wheel) is used
where it can be loaded, SuperLU of SciPy elsewhere. Symmetric systems that change little from one to the next are better served by
`RecycledCholesky`, conjugate gradients preconditioned by an earlier factorization, and large ones by `MultigridSolver`, conjugate
gradients preconditioned by smoothed aggregation with rigid-body modes. What these solve, they solve as accurately as asked.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Protocol

import numpy as np
import pyamg
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from naibu.core.errors import ConvergenceError, InputError

Array = NDArray[np.float64]
DIRECT_LIMIT = 200_000  # unknowns from which a factorization costs more than multigrid, even if it is recycled; a tenth of that for SuperLU
RECYCLING_FROM = 4_000  # unknowns from which a factorization is worth recycling


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
    try:  # wherever pip put it: a user's own site, a base environment below a virtual one
        files = metadata.files("mkl") or []
        folders += [Path(str(file.locate())).resolve().parent for file in files if file.name in names]
    except metadata.PackageNotFoundError:
        pass
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

    def __init__(self, matrix: sp.bsr_matrix, *, symmetric: bool, single_precision: bool = False) -> None:
        library = pardiso_library()
        if library is None:
            raise InputError('PARDISO is not installed; run: pip install "naibu[fast]"')
        self._library = library
        self._symmetric = symmetric
        marked = sp.bsr_matrix(
            (np.arange(1.0, matrix.data.size + 1.0).reshape(matrix.data.shape), matrix.indices, matrix.indptr), shape=matrix.shape
        ).tocsr()
        pattern = (sp.triu(marked, format="csr") if symmetric else marked).sorted_indices()
        self._take = pattern.data.astype(np.int64) - 1
        self._ia = pattern.indptr.astype(np.int32)
        self._ja = pattern.indices.astype(np.int32)
        self._n = matrix.shape[0]
        self._type = 2 if symmetric else 1
        self._float = np.float32 if single_precision else np.float64
        self._handle = np.zeros(64, dtype=np.int64)
        self._parameters = np.zeros(64, dtype=np.int32)
        self._set_parameters()
        self._values = np.zeros(len(self._ja), dtype=self._float)
        self._analysed = False

    def _set_parameters(self) -> None:
        iparm = self._parameters
        iparm[:] = 0
        iparm[0] = 1  # no defaults
        iparm[1] = 2  # METIS ordering
        iparm[9] = 13 if self._type in (1, 11) else 8  # pivot perturbation 10^-k
        iparm[27] = int(self._float is np.float32)
        iparm[34] = 1  # indices count from 0

    def factorize(self, matrix: sp.bsr_matrix) -> PardisoSolver:
        """Factorize the values of `matrix`; the factorization stays valid until the next call.

        Raises
        ------
        ConvergenceError
            The matrix is singular.
        """
        self._values = matrix.data.ravel()[self._take].astype(self._float, copy=False)
        empty: NDArray[np.floating] = np.zeros(1, dtype=self._float)
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
        rhs: NDArray[np.floating] = np.asarray(b, dtype=self._float, order="F")
        x: NDArray[np.floating] = np.zeros(rhs.shape, dtype=self._float, order="F")
        error = self._call(33, rhs, x, columns)
        if error != 0:
            raise ConvergenceError(f"PARDISO could not solve the linear system (error {error})")
        return np.asarray(x, dtype=np.float64)

    def _call(self, phase: int, b: NDArray[np.floating], x: NDArray[np.floating], columns: int) -> int:
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


class RecyclingSolver(ABC):
    """Conjugate gradients with a preconditioner that is kept from an earlier matrix for as long as that is cheaper than a new one.

    Parameters
    ----------
    relative_tolerance : float
        Of the residual of each solve, unless it asks for another.
    max_iterations : int
        After which a preconditioner is given up.
    """

    name = "CG"
    iterations_per_build = 12.0  # how many iterations cost as much as a new preconditioner
    falls_back = False  # on a direct solver where the iteration fails, rather than to say so

    def __init__(self, *, relative_tolerance: float = 1e-8, max_iterations: int = 400) -> None:
        self.tolerance = relative_tolerance
        self.max_iterations = max_iterations
        self._apply: Callable[[Array], Array] | None = None
        self._spent = 0.0
        self._digits = 0.0
        self._rebuild = True
        self._exact: LinearSolver | None = None

    @abstractmethod
    def preconditioner(self, matrix: sp.bsr_matrix) -> Callable[[Array], Array]:
        """Return a map from residuals (n, r) to corrections made for `matrix`."""

    def factorize(self, matrix: sp.bsr_matrix) -> Factorization:
        """Prepare for `matrix`, keeping what was made for an earlier one while it still serves."""
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

    def iterate(self, matrix: sp.bsr_matrix, b: Array, tolerance: float) -> Array:
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
            x, iterations = conjugate_gradients(matrix, b, self._apply, tolerance, self.max_iterations)
            if x is not None:
                digits = max(-np.log10(tolerance), 0.1)
                self._spent += iterations
                self._digits += digits
                # the mean price of a digit since the last build has its minimum where the last digit costs as much as the mean
                self._rebuild = iterations / digits > self._spent / self._digits
                return x
        if not self.falls_back:
            raise ConvergenceError(
                f"conjugate gradients did not reach {tolerance:g} in {self.max_iterations} iterations; is every body held?"
            )
        self._exact, self._apply = self._exact or direct_solver(matrix, symmetric=True), None
        return self._exact.factorize(matrix).solve(b)


class ApproximateFactorization:
    """A matrix with a preconditioner that may have been made for an earlier one; solves as accurately as asked."""

    def __init__(self, solver: RecyclingSolver, matrix: sp.bsr_matrix) -> None:
        self._solver, self._matrix = solver, matrix

    def solve(self, b: Array, relative_tolerance: float | None = None) -> Array:
        """Return x for b of shape (n,) or (n, r); the solver's own tolerance is the default."""
        tolerance = self._solver.tolerance if relative_tolerance is None else relative_tolerance
        return self._solver.iterate(self._matrix, b.reshape(len(b), -1), tolerance).reshape(b.shape)


def conjugate_gradients(
    matrix: sp.bsr_matrix, b: Array, precondition: Callable[[Array], Array], tolerance: float, max_iterations: int
) -> tuple[Array | None, int]:
    """Return the solution (n, r) and the number of iterations; None where they do not converge or something is not positive definite.

    Every right-hand side has its own iteration; those of one call are advanced together.
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
        q = matrix @ p
        curvature = np.einsum("ij,ij->j", p, q)
        if not (curvature[active] > 0.0).all():
            return None, iteration
        alpha = np.where(active, new / np.where(active, curvature, 1.0), 0.0)
        x += alpha * p
        r -= alpha * q
    return None, max_iterations


class RecycledCholesky(RecyclingSolver):
    """PARDISO in single precision, corrected by conjugate gradients in double precision; one factorization serves several tangents."""

    name = "CG + PARDISO (oneMKL) in single precision"
    falls_back = True

    def __init__(self, matrix: sp.bsr_matrix, *, relative_tolerance: float = 1e-11, max_iterations: int = 60) -> None:
        super().__init__(relative_tolerance=relative_tolerance, max_iterations=max_iterations)
        self._factor = PardisoSolver(matrix, symmetric=True, single_precision=True)

    def preconditioner(self, matrix: sp.bsr_matrix) -> Callable[[Array], Array]:
        """Return the solution with the factor of `matrix`."""
        factor = self._factor.factorize(matrix)
        return lambda r: factor.solve(r).astype(np.float64)


class MultigridSolver(RecyclingSolver):
    """Conjugate gradients with smoothed aggregation from the rigid-body modes.

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
        super().__init__(relative_tolerance=relative_tolerance, max_iterations=max_iterations)
        self._modes = rigid_body_modes(points)
        self._modes[held] = 0.0

    def preconditioner(self, matrix: sp.bsr_matrix) -> Callable[[Array], Array]:
        """Return one V-cycle of a hierarchy made for `matrix`."""
        hierarchy = pyamg.smoothed_aggregation_solver(
            matrix, B=self._modes, strength=("symmetric", {"theta": 0.0}), smooth=("jacobi", {"omega": 4.0 / 3.0}),
            improve_candidates=None, max_coarse=600, coarse_solver="splu", presmoother=("block_gauss_seidel", {"sweep": "forward"}),
            postsmoother=("block_gauss_seidel", {"sweep": "backward"}),
        )  # fmt: skip
        cycle = hierarchy.aspreconditioner()
        return lambda r: np.stack([cycle @ column for column in r.T], axis=1)


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
    """Choose by size: direct for unsymmetric and for small systems, recycled Cholesky up to `DIRECT_LIMIT` unknowns, multigrid above."""
    limit = DIRECT_LIMIT if pardiso_library() is not None else DIRECT_LIMIT // 10
    if symmetric and matrix.shape[0] > limit:
        return MultigridSolver(points, held)
    if symmetric and matrix.shape[0] > RECYCLING_FROM and pardiso_library() is not None:
        return RecycledCholesky(matrix)
    return direct_solver(matrix, symmetric=symmetric)
