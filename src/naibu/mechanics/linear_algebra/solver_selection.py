"""Two-phase solution of sparse linear systems: analyse a pattern once, factorize values, solve right-hand sides.

``solver = direct_solver(matrix)`` analyses the pattern, ``factorization = solver.factorize(matrix)`` takes the values, and
``factorization.solve(b)`` may be called for any number of right-hand sides. Supernodal PARDISO (Intel oneMKL, a pip wheel) is used
where it can be loaded, SuperLU of SciPy elsewhere. Symmetric systems that change little from one to the next are better served by
`RecycledCholesky`, conjugate gradients preconditioned by an earlier factorization, and large ones by `MultigridSolver`, conjugate
gradients preconditioned by smoothed aggregation with rigid-body modes. What these solve, they solve as accurately as asked.
"""

from __future__ import annotations

import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray
from naibu.mechanics.linear_algebra.direct import direct_solver, pardiso_library
from naibu.mechanics.linear_algebra.iterative import RecycledCholesky
from naibu.mechanics.linear_algebra.multigrid import MultigridSolver
from naibu.mechanics.linear_algebra.protocols import LinearSolver

DIRECT_LIMIT = 200_000  # unknowns from which a factorization costs more than multigrid, even if it is recycled; a tenth of that for SuperLU
RECYCLING_FROM = 4_000  # unknowns from which a factorization is worth recycling


def choose_solver(matrix: sp.bsr_matrix, points: FloatArray, constrained: BoolArray, *, symmetric: bool) -> LinearSolver:
    """Choose by size: direct for unsymmetric and for small systems, recycled Cholesky up to `DIRECT_LIMIT` unknowns, multigrid above."""
    limit = DIRECT_LIMIT if pardiso_library() is not None else DIRECT_LIMIT // 10
    if symmetric and matrix.shape[0] > limit:
        return MultigridSolver(points, constrained)
    if symmetric and matrix.shape[0] > RECYCLING_FROM and pardiso_library() is not None:
        return RecycledCholesky(matrix)
    return direct_solver(matrix, symmetric=symmetric)
