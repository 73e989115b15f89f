"""Conjugate gradients preconditioned by smoothed aggregation of the rigid-body modes :cite:p:`vanek1996`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray, require_shape
from naibu.mechanics.linear_algebra.iterative import RecyclingSolver
from naibu.mechanics.linear_algebra.multigrid import _cycle_kernels as cycle
from naibu.mechanics.linear_algebra.multigrid.smoothed_aggregation import SmoothedAggregation
from naibu.mechanics.linear_algebra.row_chunks import RowChunks


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
    falls_back : bool
        Whether such a system is then solved by a direct solver.

    Raises
    ------
    InputError
        `constrained` has another shape than `points`.
    """

    name = "CG + smoothed aggregation"

    def __init__(
        self,
        points: FloatArray,
        constrained: BoolArray,
        *,
        relative_tolerance: float = 1e-8,
        max_iterations: int = 400,
        falls_back: bool = False,
    ) -> None:
        super().__init__(relative_tolerance=relative_tolerance, max_iterations=max_iterations)
        self.falls_back = falls_back
        require_shape("constrained", constrained, points.shape)
        self._modes = np.where(constrained.ravel()[:, None], 0.0, rigid_body_modes(points))
        self._aggregation: SmoothedAggregation | None = None

    def preconditioner(self, matrix: sp.bsr_matrix) -> Callable[[FloatArray], FloatArray]:
        """Return one V-cycle of a hierarchy made for `matrix`."""
        if self._aggregation is None or not self._aggregation.fits(matrix):
            self._aggregation = SmoothedAggregation(matrix, self._modes)
        return self._aggregation.hierarchy(matrix).correction

    def multiplication(self, matrix: sp.bsr_matrix) -> Callable[[FloatArray], FloatArray]:
        """Return the product of `matrix` with vectors (n, r), by all threads."""
        d, chunks = matrix.blocksize[0], RowChunks(matrix.indptr)

        def multiply(vectors: FloatArray) -> FloatArray:
            out = np.empty(vectors.shape)
            for column in range(vectors.shape[1]):
                x, y = np.ascontiguousarray(vectors[:, column]).reshape(-1, d), np.empty((len(vectors) // d, d))
                chunks.run(cycle.product, matrix.indptr, matrix.indices, matrix.data, x, y, sizes=((0,) * d, (0,) * d))
                out[:, column] = y.ravel()
            return out

        return multiply


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
