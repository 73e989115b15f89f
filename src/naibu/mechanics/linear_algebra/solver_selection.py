"""Choice of a linear solver by size, symmetry and what is installed.

Sparse systems are solved in two phases: ``solver = choose_solver(matrix, ...)`` analyses the pattern, ``solver.factorize(matrix)`` takes
the values, and ``solve(b)`` of the factorization may be called for any number of right-hand sides. The solvers are

``"superlu"``
    Sparse LU factorization of SciPy; always there.
``"pardiso"``
    Supernodal Cholesky or LU factorization of Intel oneMKL, a pip wheel.
``"recycled_cholesky"``
    Conjugate gradients preconditioned by a single-precision Cholesky factor of an earlier matrix, for symmetric systems that change little
    from one to the next.
``"recycled_lu"``
    GMRES preconditioned by a single-precision LU factor of an earlier matrix, for unsymmetric systems that change little likewise.
``"multigrid"``
    Conjugate gradients preconditioned by smoothed aggregation with rigid-body modes, for large symmetric systems :cite:p:`vanek1996`.
``"petsc"``
    The same by PETSc :cite:p:`balay2022`, on all ranks of an MPI program.

All solve to their relative tolerance whatever the preconditioner.
"""

from __future__ import annotations

from typing import Literal, get_args

import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.linear_algebra.direct import PardisoSolver, SuperLUSolver, pardiso_library
from naibu.mechanics.linear_algebra.iterative import RecycledCholesky
from naibu.mechanics.linear_algebra.multigrid import MultigridSolver
from naibu.mechanics.linear_algebra.petsc import PetscSolver
from naibu.mechanics.linear_algebra.protocols import LinearSolver
from naibu.mechanics.linear_algebra.recycled_factors import RecycledFactors

SolverName = Literal["automatic", "superlu", "pardiso", "recycled_cholesky", "recycled_lu", "multigrid", "petsc"]

DIRECT_LIMIT = 200_000  # unknowns from which a factorization costs more than multigrid, even if it is recycled; a tenth of that for SuperLU
SINGLE_LIMIT = 25_000  # unknowns from which multigrid solves a single system sooner, up to the Poisson's ratio below
COMPRESSIBLE = 0.49  # beyond it the iterations of multigrid become many
RECYCLING_FROM = 4_000  # unknowns from which a factorization is worth recycling
UNSYMMETRIC_FROM = 1_000  # likewise for unsymmetric systems, of which LU factors cost twice as much


def choose_solver(
    matrix: sp.bsr_matrix,
    points: FloatArray,
    constrained: BoolArray,
    *,
    symmetric: bool,
    solver: SolverName = "automatic",
    poisson_ratio: float | None = None,
) -> LinearSolver:
    """Return a linear solver for matrices of the pattern of `matrix`.

    Parameters
    ----------
    matrix : bsr_matrix, shape (n d, n d)
        A first matrix, with the rows and columns of the constrained components replaced.
    points : ndarray, shape (n, d)
        Node positions, mm.
    constrained : ndarray, shape (n, d), bool
        Constrained components.
    symmetric : bool
        Whether all matrices will be symmetric.
    solver : {"automatic", "superlu", "pardiso", "recycled_cholesky", "recycled_lu", "multigrid", "petsc"}
        See the module. ``"automatic"`` is direct for small systems; recycled LU for larger unsymmetric ones, recycled Cholesky for
        symmetric ones up to `DIRECT_LIMIT` unknowns (with oneMKL), and multigrid above; without oneMKL multigrid begins at a tenth of that.
    poisson_ratio : float, optional
        The largest in the body, if one system only is to be solved: multigrid then begins at `SINGLE_LIMIT` unknowns up to `COMPRESSIBLE`.

    Raises
    ------
    InputError
        An unknown solver, one that needs oneMKL where it is not installed, or an iterative one for an unsymmetric matrix.
    MissingDependencyError
        ``"petsc"`` without petsc4py.
    """
    if solver not in get_args(SolverName):
        raise InputError(f"solver={solver!r} is not known; use one of {', '.join(get_args(SolverName))}")
    if solver == "automatic":
        solver = _automatic(matrix.shape[0], symmetric, poisson_ratio)
    if solver == "superlu":
        return SuperLUSolver()
    if solver == "pardiso":
        return PardisoSolver(matrix, symmetric=symmetric)
    if solver == "recycled_lu":
        return RecycledFactors(matrix)
    if not symmetric:
        raise InputError(f"solver={solver!r} needs a symmetric matrix; with friction use 'pardiso', 'superlu' or 'automatic'")
    if solver == "recycled_cholesky":
        return RecycledCholesky(matrix)
    return PetscSolver(points, constrained) if solver == "petsc" else MultigridSolver(points, constrained)


def _automatic(unknowns: int, symmetric: bool, poisson_ratio: float | None) -> SolverName:
    with_mkl = pardiso_library() is not None
    direct: SolverName = "pardiso" if with_mkl else "superlu"
    if not symmetric:
        return "recycled_lu" if with_mkl and unknowns > UNSYMMETRIC_FROM else direct
    single = poisson_ratio is not None and poisson_ratio <= COMPRESSIBLE
    limit = DIRECT_LIMIT if with_mkl else DIRECT_LIMIT // 10
    if unknowns > (min(limit, SINGLE_LIMIT) if single else limit):
        return "multigrid"
    return "recycled_cholesky" if with_mkl and unknowns > RECYCLING_FROM else direct
