"""Direct sparse solvers: PARDISO :cite:p:`schenk2004` where oneMKL is installed, else SuperLU :cite:p:`demmel1999`."""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from naibu.core.arrays import AnyFloatArray, FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.memory import require_address_space
from naibu.mechanics.linear_algebra.protocols import Factorization, LinearSolver


@functools.cache
def pardiso_library() -> ctypes.CDLL | None:
    """Return the oneMKL runtime library if its wheel is installed, else None."""
    os.environ.setdefault("KMP_BLOCKTIME", "0")  # idle threads sleep at once instead of spinning beside those of Numba
    names = ("libmkl_rt.so.3", "libmkl_rt.so.2", "libmkl_rt.so.1", "libmkl_rt.2.dylib", "mkl_rt.3.dll", "mkl_rt.2.dll")
    folders = [Path(sys.prefix) / "lib", Path(sys.prefix) / "Library" / "bin"]
    try:  # any place of installation by pip: a user site, a base environment below a virtual one
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


@functools.cache
def _require_room() -> None:
    """Raise a MemoryError where oneMKL, which loads most of itself at its first use, would end the process for want of address space."""
    stated = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    threads = int(stated) if stated.isdecimal() else os.cpu_count() or 1
    require_address_space(MKL_MB + MKL_THREAD_MB * threads, f"PARDISO (oneMKL) and its {threads} threads (OMP_NUM_THREADS)")


def use_one_thread() -> None:
    """Restrict the direct solver to one thread when called from the present thread; for problems solved in parallel."""
    use_threads(1)


def use_threads(count: int) -> None:
    """Restrict the direct solver to a number of threads when called from the present thread."""
    library = pardiso_library()
    if library is not None:
        library.MKL_Set_Num_Threads_Local(count)


def usable_threads() -> int:
    """Return how many threads the direct solver may use when called from the present thread; 1 where oneMKL is not installed."""
    library = pardiso_library()
    return 1 if library is None else int(library.MKL_Get_Max_Threads())


MKL_MB = 400  # of address space for the libraries, twice of what they took here
MKL_THREAD_MB = 80  # for the stack and the heap of a thread
SINGULAR = {np.float64: 1e14, np.float32: 1e9}  # growth of a solution, beyond which it is rounding
_NO_MEMORY = -2  # PARDISO's number of this error
_BY_COLUMNS, IN_SEQUENCE = 0, 1  # how threads share a solution, its parameter 24: the right sides among them, or not at all


class PardisoSolver:
    """Supernodal factorization by oneMKL PARDISO; the symbolic analysis is kept between factorizations.

    Parameters
    ----------
    matrix : bsr_matrix, shape (n, n)
        A matrix with the pattern of those to be factorized.
    symmetric : bool
        Whether to use a Cholesky factorization (LDL^T where the matrix turns out indefinite) rather than LU.
    single_precision : bool
        Whether to factorize in single precision.

    Raises
    ------
    InputError
        oneMKL is not installed.
    """

    name = "PARDISO (oneMKL)"

    def __init__(self, matrix: sp.bsr_matrix, *, symmetric: bool, single_precision: bool = False) -> None:
        library = pardiso_library()
        if library is None:
            raise InputError('PARDISO is not installed; run: pip install "naibu[fast]"')
        _require_room()
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
        self._values = np.zeros(len(self._ja), dtype=self._float)
        self._threads = 0  # of the analysis; 0 before it

    def _analyse(self, threads: int) -> None:
        self._set_parameters()
        self._call(11, *self._nothing())
        self._threads = threads

    def _nothing(self) -> tuple[AnyFloatArray, AnyFloatArray, int]:
        """Return right side, solution and number of columns of a phase that has none."""
        empty: AnyFloatArray = np.zeros(1, dtype=self._float)
        return empty, empty, 1

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
        threads = int(self._library.MKL_Get_Max_Threads())
        if threads < self._threads:  # PARDISO then leaves parts out, or ends the process: an analysis is for so many threads or more
            self._release()
        if not self._threads:
            self._analyse(threads)
        error = self._factorized()
        if error == -4 and self._type == 2:  # not positive definite: use the indefinite factorization
            self._release()
            self._type = -2
            self._analyse(threads)
            error = self._factorized()
        perturbed = int(self._parameters[13])  # vanishing pivots, which PARDISO silently replaces by tiny ones
        if error != 0 or perturbed:
            what = f"PARDISO error {error}, {perturbed} vanishing pivots"
            raise ConvergenceError(f"the linear system is singular ({what}): are all rigid-body motions constrained?")
        if not self._definite():  # where all pivots are positive, it is regular, however badly it is scaled
            self._require_regular()
        return self

    def _factorized(self) -> int:
        """Factorize the values; returns PARDISO's number of the error, or 0."""
        return self._call(22, *self._nothing())

    def _definite(self) -> bool:
        """Whether the factorization has seen that all pivots are positive: Cholesky's does."""
        return self._type == 2

    def _permutation(self) -> ctypes.c_void_p | None:
        """Return what PARDISO takes for a permutation: none, it orders the unknowns itself."""
        return None

    def _require_regular(self) -> None:
        """Refuse a matrix whose solutions grow beyond rounding: which pivots count as vanishing depends on the processor.

        Raises
        ------
        ConvergenceError
            It is.
        """
        probe = np.random.default_rng(0).uniform(0.5, 1.0, self._n)
        growth = float(np.abs(self.solve(probe)).max()) * float(np.abs(self._values).max())
        if not growth < SINGULAR[self._float]:
            raise ConvergenceError(
                f"the linear system is singular (solutions grow {growth:.1g} times): are all rigid-body motions constrained?"
            )

    def solve(self, b: FloatArray) -> FloatArray:
        """Return x for b of shape (n,) or (n, r)."""
        columns = 1 if b.ndim == 1 else b.shape[1]
        # on several threads one column would be solved with contributions added in the order in which threads happen to finish them
        self._parameters[24] = IN_SEQUENCE if columns == 1 else _BY_COLUMNS
        rhs: AnyFloatArray = np.asarray(b, dtype=self._float, order="F")
        x: AnyFloatArray = np.zeros(rhs.shape, dtype=self._float, order="F")
        error = self._call(33, rhs, x, columns)
        if error != 0:
            raise ConvergenceError(f"PARDISO could not solve the linear system (error {error})")
        return np.asarray(x, dtype=np.float64)

    def _call(self, phase: int, b: AnyFloatArray, x: AnyFloatArray, columns: int) -> int:
        def integer(value: int) -> ctypes._CArgObject:
            return ctypes.byref(ctypes.c_int32(value))

        def pointer(array: NDArray[np.generic]) -> ctypes.c_void_p:
            return array.ctypes.data_as(ctypes.c_void_p)

        error = ctypes.c_int32(0)
        self._library.pardiso(
            pointer(self._handle), integer(1), integer(1), integer(self._type), integer(phase), integer(self._n),
            pointer(self._values), pointer(self._ia), pointer(self._ja), self._permutation(), integer(columns), pointer(self._parameters),
            integer(0), pointer(b), pointer(x), ctypes.byref(error),
        )  # fmt: skip
        if error.value == _NO_MEMORY:
            raise MemoryError(f"the factorization of {self._n} equations")
        return error.value

    def _release(self) -> None:
        if self._threads:
            self._call(-1, *self._nothing())
            self._handle[:] = 0
            self._threads = 0

    def __del__(self) -> None:
        if getattr(self, "_library", None) is not None and hasattr(self, "_threads") and not sys.is_finalizing():
            self._release()


class SuperLUSolver:
    """SciPy's SuperLU in symmetric mode."""

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
            raise ConvergenceError(f"the linear system is singular ({error}): are all rigid-body motions constrained?") from error


def direct_solver(matrix: sp.bsr_matrix, *, symmetric: bool) -> LinearSolver:
    """Return the fastest direct solver that is installed: PARDISO, else SuperLU.

    Parameters
    ----------
    matrix : bsr_matrix, shape (n, n)
        A matrix with the pattern of those to be factorized.
    symmetric : bool
        Whether all matrices will be symmetric.
    """
    if pardiso_library() is not None:
        return PardisoSolver(matrix, symmetric=symmetric)
    return SuperLUSolver()
