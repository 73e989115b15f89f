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
from naibu.mechanics.linear_algebra.multigrid.multigrid_solver import MultigridSolver
from naibu.mechanics.linear_algebra.petsc import PetscSolver
from naibu.mechanics.linear_algebra.protocols import LinearSolver
from naibu.mechanics.linear_algebra.recycled_factors import RecycledFactors

SolverName = Literal["automatic", "superlu", "pardiso", "recycled_cholesky", "recycled_lu", "multigrid", "petsc"]

DIRECT_LIMIT = 200_000  # unknowns from which a factorization costs more than multigrid whatever the body; a tenth of that for SuperLU
SERIES_LIMIT = 20_000  # unknowns from which multigrid solves systems that change little one after the other sooner, up to the ratio below
SINGLE_LIMIT = 4_000  # likewise a single system
COMPRESSIBLE = 0.49  # Poisson's ratio, beyond which the iterations of multigrid become many
ROUNDING = 1e-9  # of a ratio that is computed from Lame's constants
SINGLE_TOLERANCE = 1e-10  # relative, of a single system: digits cost little
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
    single: bool = False,
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
        See the module. ``"automatic"`` is direct for small systems and recycled LU for larger unsymmetric ones. Symmetric ones are solved
        by recycled Cholesky (with oneMKL) up to `DIRECT_LIMIT` unknowns, or a tenth of that without oneMKL, and by multigrid above; up to a
        Poisson's ratio of `COMPRESSIBLE` multigrid begins at `SERIES_LIMIT`, and for single systems at `SINGLE_LIMIT`.
    poisson_ratio : float, optional
        The largest in the body, if it is known and nothing but the body makes the matrix.
    single : bool
        Whether one system only is to be solved.

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
        solver = _automatic(matrix.shape[0], symmetric, poisson_ratio, single)
    if solver == "superlu":
        return SuperLUSolver()
    if solver == "pardiso":
        return PardisoSolver(matrix, symmetric=symmetric)
    if solver == "recycled_lu":
        return RecycledFactors(matrix)
    if not symmetric:
        raise InputError(
            f"solver={solver!r} needs a symmetric matrix; with friction use 'recycled_lu', 'pardiso', 'superlu' or 'automatic'"
        )
    if solver == "recycled_cholesky":
        return RecycledCholesky(matrix)
    if solver == "petsc":
        return PetscSolver(points, constrained)
    return MultigridSolver(
        points, constrained, relative_tolerance=SINGLE_TOLERANCE if single else 1e-8, falls_back=matrix.shape[0] <= DIRECT_LIMIT
    )


def _automatic(unknowns: int, symmetric: bool, poisson_ratio: float | None, single: bool) -> SolverName:
    with_mkl = pardiso_library() is not None
    direct: SolverName = "pardiso" if with_mkl else "superlu"
    if not symmetric:
        return "recycled_lu" if with_mkl and unknowns > UNSYMMETRIC_FROM else direct
    limit = DIRECT_LIMIT if with_mkl else DIRECT_LIMIT // 10
    if poisson_ratio is not None and poisson_ratio <= COMPRESSIBLE + ROUNDING:
        limit = min(limit, SINGLE_LIMIT if single else SERIES_LIMIT)
    if unknowns > limit:
        return "multigrid"
    return "recycled_cholesky" if with_mkl and unknowns > RECYCLING_FROM else direct
