"""Smoothed-aggregation algebraic multigrid with rigid-body modes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyamg
import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray
from naibu.mechanics.linear_algebra.iterative import RecyclingSolver


class MultigridSolver(RecyclingSolver):
    """Conjugate gradients with smoothed aggregation from the rigid-body modes.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Node positions, mm, from which the rigid-body modes are made.
    constrained : ndarray, shape (3 n,), bool
        Degrees of freedom that are prescribed; their modes are zero.
    relative_tolerance : float
        Of the residual of each solve.
    """

    name = "CG + smoothed aggregation (pyamg)"

    def __init__(self, points: FloatArray, constrained: BoolArray, *, relative_tolerance: float = 1e-8, max_iterations: int = 400) -> None:
        super().__init__(relative_tolerance=relative_tolerance, max_iterations=max_iterations)
        self._modes = rigid_body_modes(points)
        self._modes[constrained] = 0.0

    def preconditioner(self, matrix: sp.bsr_matrix) -> Callable[[FloatArray], FloatArray]:
        """Return one V-cycle of a hierarchy made for `matrix`."""
        hierarchy = pyamg.smoothed_aggregation_solver(
            matrix, B=self._modes, strength=("symmetric", {"theta": 0.0}), smooth=("jacobi", {"omega": 4.0 / 3.0}),
            improve_candidates=None, max_coarse=600, coarse_solver="splu", presmoother=("block_gauss_seidel", {"sweep": "forward"}),
            postsmoother=("block_gauss_seidel", {"sweep": "backward"}),
        )  # fmt: skip
        cycle = hierarchy.aspreconditioner()
        return lambda r: np.stack([cycle @ column for column in r.T], axis=1)


def rigid_body_modes(points: FloatArray) -> FloatArray:
    """Return the six rigid-body modes (3 n, 6) of points (n, 3), about their centroid."""
    x, y, z = (points - points.mean(axis=0)).T
    modes = np.zeros((len(points), 3, 6))
    modes[:, 0, 0] = modes[:, 1, 1] = modes[:, 2, 2] = 1.0
    modes[:, 1, 3], modes[:, 2, 3] = -z, y
    modes[:, 0, 4], modes[:, 2, 4] = z, -x
    modes[:, 0, 5], modes[:, 1, 5] = -y, x
    return modes.reshape(-1, 6)
