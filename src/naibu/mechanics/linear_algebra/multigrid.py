"""Smoothed-aggregation algebraic multigrid with rigid-body modes :cite:p:`vanek1996`, by pyamg :cite:p:`bell2022`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pyamg
import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray, require_shape
from naibu.mechanics.linear_algebra.iterative import RecyclingSolver


class MultigridSolver(RecyclingSolver):
    """Conjugate gradients preconditioned by smoothed aggregation of the rigid-body modes.

    Parameters
    ----------
    points : ndarray, shape (n, d)
        Node positions, mm, from which the rigid-body modes are made.
    constrained : ndarray, shape (n, d), bool
        Constrained components; their modes are zero.
    relative_tolerance : float
        Of the residual of each solve.
    max_iterations : int
        After which a hierarchy is built anew, and after a second time the solve fails.

    Raises
    ------
    InputError
        `constrained` has another shape than `points`.
    """

    name = "CG + smoothed aggregation (pyamg)"

    def __init__(self, points: FloatArray, constrained: BoolArray, *, relative_tolerance: float = 1e-8, max_iterations: int = 400) -> None:
        super().__init__(relative_tolerance=relative_tolerance, max_iterations=max_iterations)
        self._modes = rigid_body_modes(points)
        require_shape("constrained", constrained, points.shape)
        self._modes[constrained.ravel()] = 0.0

    def preconditioner(self, matrix: sp.bsr_matrix) -> Callable[[FloatArray], FloatArray]:
        """Return one V-cycle of a hierarchy made for `matrix`."""
        hierarchy = pyamg.smoothed_aggregation_solver(
            matrix, B=self._modes, strength=("symmetric", {"theta": 0.0}),
            smooth=("jacobi", {"omega": 4.0 / 3.0}), improve_candidates=None, max_coarse=600, coarse_solver="splu",
            presmoother=("block_gauss_seidel", {"sweep": "forward"}), postsmoother=("block_gauss_seidel", {"sweep": "backward"}),
        )  # fmt: skip

        return lambda r: np.stack([v_cycle(hierarchy, 0, np.ascontiguousarray(column)) for column in r.T], axis=1)


def v_cycle(hierarchy: Any, number: int, b: FloatArray) -> FloatArray:
    """Return the correction of one V-cycle from level `number` down, from zero; pyamg's own computes two residuals more.

    Parameters
    ----------
    hierarchy : pyamg.multilevel.MultilevelSolver
        Levels with their smoothers, and the solver of the coarsest.
    number : int
        The level; 0 is the finest.
    b : ndarray, shape (n,)
        Its residual.
    """
    level = hierarchy.levels[number]
    if number == len(hierarchy.levels) - 1:
        return np.asarray(hierarchy.coarse_solver(level.A, b), dtype=float).ravel()
    x = np.zeros_like(b)
    level.presmoother(level.A, x, b)
    x += level.P @ v_cycle(hierarchy, number + 1, level.R @ (b - level.A @ x))
    level.postsmoother(level.A, x, b)
    return x


def rigid_body_modes(points: FloatArray) -> FloatArray:
    """Return the rigid-body modes (n d, d (d + 1) / 2) of points (n, d), about their centroid: translations, then rotations."""
    n, d = points.shape
    centred = points - points.mean(axis=0)
    planes = [(1, 2), (2, 0), (0, 1)] if d == 3 else [(0, 1)] * (d - 1)
    modes = np.zeros((n, d, d + len(planes)))
    modes[:, range(d), range(d)] = 1.0
    for k, (a, b) in enumerate(planes):
        modes[:, a, d + k], modes[:, b, d + k] = -centred[:, b], centred[:, a]
    return modes.reshape(n * d, -1)
