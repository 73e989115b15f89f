"""Kriging of a motion: every point is predicted from those around it by a Gaussian process as rough as the motion is there.

Beside a cell that pulls at a hydrogel, or under the edge of an indenter, a motion is not affine over the few particles that tell it. The
process has a free affine part and another of Wendland's covariance, which is four times differentiable and vanishes beyond its reach
:cite:p:`rasmussen2006`. How large that part is, relative to the noise, is chosen from place to place by how well points are predicted that
are left out, so that where the motion is affine its prediction is that of an affine fit.
"""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.imaging.markers.linking._kriging_kernels import choose, judge, krige

# Empirical values, judged by tests/imaging/markers/linking and benchmarks/traction_gels.py.
REACH = 16.0  # of the correlation, in mean distances of nearest neighbours
ROUGHNESS = (0.2, 3.0, 20.0, 100.0, 500.0)  # variances of the part that is not affine that are tried, in that of the noise
KRIGED = {2: 14, 3: 24}  # neighbours from which a point is predicted
AROUND = 12  # predicted points that tell which roughness suits a place
FREEDOM = 4.0  # degrees of freedom of Student's distribution of what is left out: wrong links among them do not tell the roughness
LOCAL = (0.5, 8.0)  # bounds of the local noise, as multiples of that of all
MEDIAN = {2: 1.1774, 3: 1.5382}  # of the length of a vector of standard normal components


class LocalKriging:
    """Predictions of values at n points from those around each, itself left out, kept up to date as values are changed.

    Parameters
    ----------
    points, scale : ndarray, shape (n, d), (n,)
        Points and the distance between neighbours around each, mm.

    Attributes
    ----------
    predicted : ndarray, shape (n, d)
        Values.
    sd : ndarray, shape (n,)
        Standard deviation of the difference of an ordinary value from its prediction, along each axis.
    noise_sd : ndarray, shape (n,)
        That of the noise of an ordinary value alone.
    carried : ndarray, shape (n,)
        Variance that the noise of the neighbours carries into a prediction, in that of the noise.
    roughness : ndarray, shape (n,)
        Variance of the part of the motion that is not affine, in that of the noise.
    """

    predicted: FloatArray
    sd: FloatArray
    noise_sd: FloatArray
    carried: FloatArray
    roughness: FloatArray

    def __init__(self, points: FloatArray, scale: FloatArray) -> None:
        n, levels = len(points), len(ROUGHNESS)
        self._points, self._scale = points, scale
        self._all_predicted, self._all_variance = np.zeros((levels, *points.shape)), np.ones((levels, n))
        self._all_carried, self.carried = np.ones((levels, n)), np.ones(n)
        self._length, self._total = np.zeros((levels, n)), np.ones((levels, n))
        self._level, self._cost = np.ones((levels, n)), np.zeros((levels, n))
        self._best, self.noise_sd = np.zeros(n, dtype=np.int64), np.ones(n)
        self.predicted, self.sd, self.roughness = np.zeros_like(points), np.ones(n), np.full(n, ROUGHNESS[0])

    def update(self, some: IntArray, neighbours: IntArray, values: FloatArray, known: BoolArray, noise: FloatArray) -> None:
        """Predict some points anew, and choose the roughness around them.

        Parameters
        ----------
        some : ndarray, shape (k,), int64
            Points whose value, whose neighbours, or whose neighbours' values or noise are others than before.
        neighbours : ndarray, shape (n, c), int64
            Points of known value around each, itself left out, the nearest first.
        values : ndarray, shape (n, d)
            Values.
        known : ndarray, shape (n,), bool
            Where a value is known.
        noise : ndarray, shape (n,)
            Variance of the noise of every value, in that of an ordinary one.
        """
        axes = values.shape[1]
        for k, roughness in enumerate(ROUGHNESS):
            _solve(
                some, self._points, self._scale, neighbours, values, noise, np.full(len(values), roughness), self._all_predicted[k],
                self._all_variance[k], self._all_carried[k],
            )  # fmt: skip
        self._total[:, some] = noise[some] + self._all_variance[:, some]
        self._length[:, some] = np.linalg.norm(values[some] - self._all_predicted[:, some], axis=2) / np.sqrt(self._total[:, some])
        typical = np.median(self._length[:, known], axis=1) if known.any() else np.ones(len(ROUGHNESS))
        alone = some[~known[some]]
        self._length[:, alone] = typical[:, None]
        stale = np.zeros(len(values), dtype=bool)
        stale[some] = True
        wide = np.flatnonzero(stale | stale[neighbours].any(axis=1))
        judge(wide, neighbours, AROUND, self._length, self._total, axes, MEDIAN[axes], FREEDOM, self._level, self._cost)
        everyone = np.arange(len(values))
        overall = float(np.median(self._level[self._best, everyone]))
        # the noise differs less from place to place than a median of so few tells
        bounds = np.array([LOCAL[0] * overall, LOCAL[1] * overall])
        choose(wide, neighbours, AROUND, self._cost, self._level, bounds, self._best, self.noise_sd)
        best = self._best[wide]
        self.predicted[wide], self.roughness[wide] = self._all_predicted[best, wide], np.array(ROUGHNESS)[best]
        self.sd[wide] = self.noise_sd[wide] * np.sqrt(1.0 + self._all_variance[best, wide])
        self.carried[wide] = self._all_carried[best, wide]

    def roughen(self, some: IntArray, factor: FloatArray, neighbours: IntArray, values: FloatArray, noise: FloatArray) -> None:
        """Predict some points (k,) as if the motion were rougher there, by a factor (k,) of its variance, than around."""
        roughness, variance = self.roughness.copy(), np.empty(len(values))
        roughness[some] *= factor
        _solve(some, self._points, self._scale, neighbours, values, noise, roughness, self.predicted, variance, self.carried)
        self.sd[some] = self.noise_sd[some] * np.sqrt(1.0 + variance[some])


def _solve(
    some: IntArray, points: FloatArray, scale: FloatArray, neighbours: IntArray, values: FloatArray, noise: FloatArray,
    roughness: FloatArray, predicted: FloatArray, variance: FloatArray, carried: FloatArray,
) -> None:  # fmt: skip
    slope, slope_variance = np.empty((0, 1, 1)), np.empty((0, 1))
    krige(
        some, points, scale, neighbours, values, noise, roughness, REACH, False, predicted, variance, carried, slope, slope_variance
    )  # fmt: skip


def kriged_gradient(
    points: FloatArray, scale: FloatArray, neighbours: IntArray, values: FloatArray, noise: FloatArray, roughness: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives (n, d, d) of the values along the axes, and their variance (n, d) for values of unit variance.

    Parameters are those of `LocalKriging.update`; `neighbours` may include the point itself.
    """
    (n, d), everyone = points.shape, np.arange(len(points))
    gradient, variance = np.empty((n, d, d)), np.empty((n, d))
    predicted, error, carried = np.empty((n, d)), np.empty(n), np.empty(n)
    krige(
        everyone, points, scale, neighbours, values, noise, roughness, REACH, True, predicted, error, carried, gradient, variance,
    )  # fmt: skip
    return gradient, variance
