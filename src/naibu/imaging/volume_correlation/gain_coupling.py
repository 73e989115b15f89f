"""Displacement and local gain of digital volume correlation, solved for together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from naibu.core.arrays import Float32Array, FloatArray
from naibu.imaging.volume_correlation.image_level import GainMap, gain_curvature
from naibu.imaging.volume_correlation.splines.normal_equations import SplineSystem


@dataclass(frozen=True, slots=True, eq=False)
class CoupledGain:
    """What gain and offset of some voxels share with their displacement: see `GainCoupling`.

    Attributes
    ----------
    loads : ndarray, shape (m, 64, 3, 2), float32
        Sums over the voxels of a cell of weight times gradient times the spline of each of its nodes, times the intensity of the deformed
        volume, and times one.
    matrix : ndarray, shape (2 k, 2 k)
        Of gain and offset, with the curvature of robust weights.
    """

    loads: Float32Array
    matrix: FloatArray


class GainCoupling:
    """What displacement and local gain share of the normal equations of the intensities.

    With unknown steps s of the coefficients and t of gain and offset, the Gauss-Newton equations are ``A s + B t = l`` and
    ``B^T s + C t = C d``, where d is the step to the most probable gain at the present displacement. Eliminated, by the Schur complement
    :cite:p:`nocedal2006`: ``(A - B C^-1 B^T) s = l - B d``, and ``t = d - C^-1 B^T s``. Without it the two converge against each
    other, slowly where both explain an edge.

    Parameters
    ----------
    system : SplineSystem
        Of n nodes and m cells.
    shared : CoupledGain
        Of all cells.
    at : ndarray, shape (m, 3)
        Indices x, y, z of the middles of the cells, in voxels of the lattice's level: gain varies little in a cell.
    lattice : GainMap
        Of gain and offset.
    regression : tuple of ndarray, float and tuple of float
        Matrix, variance and gain of all voxels of the regression in which robust weights are constant: see `gain_curvature`.
    to_gain : ndarray, shape (2 k,)
        Step to the gain and offset of that regression.

    Attributes
    ----------
    gain_step : ndarray, shape (2 k,)
        The step d.
    """

    def __init__(
        self,
        system: SplineSystem,
        shared: CoupledGain,
        at: FloatArray,
        lattice: GainMap,
        regression: tuple[FloatArray, float, tuple[float, float, float]],
        to_gain: FloatArray,
    ) -> None:
        loads = shared.loads
        points, weights = lattice.corners(at)
        m, n, k = len(at), 3 * system.n, 2 * int(np.prod(lattice.n))
        row = 3 * system.cell_nodes[:, :, None, None] + np.arange(3)[:, None]
        column = 2 * np.arange(m)[:, None, None, None] + np.arange(2)
        row, column = (np.broadcast_to(v, loads.shape).ravel() for v in (row, column))
        by_cell = sparse.csr_matrix((loads.ravel(), (row, column)), shape=(n, 2 * m))
        row = np.broadcast_to(2 * np.arange(m)[:, None, None] + np.arange(2), (m, 8, 2)).ravel()
        column = (2 * points[:, :, None] + np.arange(2)).ravel()
        spread = np.repeat(weights.astype(np.float32)[:, :, None], 2, axis=2).ravel()
        self._shared = by_cell @ sparse.csr_matrix((spread, (row, column)), shape=(2 * m, k))
        self._transposed = self._shared.T.tocsr()
        self._inverse = np.linalg.inv(gain_curvature(shared.matrix, *regression[1:]))
        self.gain_step = self._inverse @ (gain_curvature(*regression) @ to_gain)

    def lost(self, step: Float32Array) -> Float32Array:
        """Return what the gain takes from the product of the matrix with a step (n, 3): ``B C^-1 B^T s``."""
        return self.load(-self.followed(step))

    def followed(self, step: Float32Array) -> FloatArray:
        """Return how gain and offset (2 k,) follow a step (n, 3) of the coefficients."""
        return np.asarray(-self._inverse @ (self._transposed @ step.ravel()))

    def load(self, gain_step: FloatArray) -> Float32Array:
        """Return the load (n, 3) of a step (2 k,) of gain and offset."""
        return np.asarray((self._shared @ gain_step.astype(np.float32)).reshape(-1, 3))
