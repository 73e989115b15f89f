# mypy: disallow-untyped-decorators=False
"""Numba kernels for `naibu.imaging.markers.linking.local_kriging`: a Gaussian process around every point, from its neighbours."""

from __future__ import annotations

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, IntArray

# variance of the affine part of a motion, in that of the noise: so large that it is as good as free
AFFINE = 1e5
# curvature of the covariance at zero
SLOPE = 56.0 / 3.0


@njit(cache=True, fastmath={"reassoc", "contract"})
def _factorized(x: FloatArray, noise: FloatArray, roughness: float, reach: float, matrix: FloatArray) -> None:
    """Fill the lower triangle of `matrix` (c, c) with the Cholesky factor of the covariance of values at the offsets x (c, d)."""
    c, d = x.shape
    for i in range(c):
        for j in range(i + 1):
            square, product = 0.0, 1.0
            for a in range(d):
                square += (x[i, a] - x[j, a]) ** 2
                product += x[i, a] * x[j, a]
            t = np.sqrt(square) / reach
            left = max(1.0 - t, 0.0) ** 3
            value = AFFINE * product + roughness * left * left * (35.0 * t * t + 18.0 * t + 3.0) / 3.0
            if i == j:
                value += noise[i]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(max(value, 1e-12)) if i == j else value / matrix[j, j]


@njit(cache=True, fastmath={"reassoc", "contract"})
def _forward(matrix: FloatArray, right: FloatArray, out: FloatArray) -> float:
    """Solve with the lower triangle into `out` (c,); return the square of its length."""
    total = 0.0
    for i in range(len(right)):
        value = right[i]
        for k in range(i):
            value -= matrix[i, k] * out[k]
        out[i] = value / matrix[i, i]
        total += out[i] * out[i]
    return total


@njit(cache=True, fastmath={"reassoc", "contract"})
def _carried(matrix: FloatArray, part: FloatArray, noise: FloatArray, weights: FloatArray) -> float:
    """Solve with the transposed lower triangle into `weights` (c,), those of the values; return the noise that they carry over."""
    total = 0.0
    for i in range(len(part) - 1, -1, -1):
        value = part[i]
        for k in range(i + 1, len(part)):
            value -= matrix[k, i] * weights[k]
        weights[i] = value / matrix[i, i]
        total += weights[i] ** 2 * noise[i]
    return total


@njit(cache=True, parallel=True)
def krige(
    some: IntArray,
    points: FloatArray,
    scale: FloatArray,
    neighbours: IntArray,
    values: FloatArray,
    noise: FloatArray,
    roughness: FloatArray,
    reach: float,
    derivatives: bool,
    predicted: FloatArray,
    variance: FloatArray,
    carried: FloatArray,
    gradient: FloatArray,
    gradient_variance: FloatArray,
) -> None:
    """Predict a value at some points from those at its neighbours, by a Gaussian process with a free affine part.

    Parameters
    ----------
    some : ndarray, shape (k,), int64
        Points where a prediction is wanted.
    points, scale : ndarray, shape (n, d), (n,)
        Points and the distance between neighbours around each, mm.
    neighbours : ndarray, shape (n, c), int64
        Neighbours from which each is predicted.
    values : ndarray, shape (n, v)
        Values.
    noise : ndarray, shape (n,)
        Variance of the noise of every value, in that of an ordinary one.
    roughness : ndarray, shape (n,)
        Variance around each point of the part that is not affine, in that of the noise.
    reach : float
        Distance, in scales, beyond which that part is not correlated.
    derivatives : bool
        Whether gradients are wanted.
    predicted, variance, carried : ndarray, shape (n, v), (n,), (n,)
        Filled there with predictions, the variance of their error, in that of the noise, and the part of it that the noise of the
        neighbours carries into them.
    gradient, gradient_variance : ndarray, shape (n, v, d), (n, d)
        Filled there with the derivatives of the values, per mm, and their variance in that of the noise per mm^2; only with `derivatives`.
    """
    c, d, v = neighbours.shape[1], points.shape[1], values.shape[1]
    for s in prange(len(some)):
        p = some[s]
        x, spread, matrix = np.empty((c, d)), np.empty(c), np.empty((c, c))
        right, part, middle, sides = np.empty(c), np.empty(c), np.zeros(v), np.empty((v, c))
        for i in range(c):
            q = neighbours[p, i]
            spread[i] = noise[q]
            for a in range(d):
                x[i, a] = (points[q, a] - points[p, a]) / scale[p]
            for b in range(v):
                middle[b] += values[q, b] / c
        _factorized(x, spread, roughness[p], reach, matrix)
        for b in range(v):
            for i in range(c):
                right[i] = values[neighbours[p, i], b] - middle[b]
            _forward(matrix, right, sides[b])
        for i in range(c):
            square = 0.0
            for a in range(d):
                square += x[i, a] ** 2
            t = np.sqrt(square) / reach
            left = max(1.0 - t, 0.0) ** 3
            right[i] = AFFINE + roughness[p] * left * left * (35.0 * t * t + 18.0 * t + 3.0) / 3.0
        explained = _forward(matrix, right, part)
        variance[p] = max(AFFINE + roughness[p] - explained, 0.0)
        carried[p] = _carried(matrix, part, spread, right)
        for b in range(v):
            predicted[p, b] = middle[b] + np.dot(sides[b], part)
        if derivatives:
            for a in range(d):
                for i in range(c):
                    square = 0.0
                    for e in range(d):
                        square += x[i, e] ** 2
                    t = np.sqrt(square) / reach
                    left = max(1.0 - t, 0.0)
                    right[i] = x[i, a] * (AFFINE + roughness[p] * SLOPE * left**5 * (5.0 * t + 1.0) / reach**2)
                explained = _forward(matrix, right, part)
                gradient_variance[p, a] = max(AFFINE + SLOPE * roughness[p] / reach**2 - explained, 0.0) / scale[p] ** 2
                for b in range(v):
                    gradient[p, b, a] = np.dot(sides[b], part) / scale[p]


@njit(cache=True, parallel=True)
def judge(
    some: IntArray,
    neighbours: IntArray,
    around: int,
    length: FloatArray,
    total: FloatArray,
    axes: int,
    middle: float,
    freedom: float,
    level: FloatArray,
    cost: FloatArray,
) -> None:
    """Judge for each roughness how well the values around a point are predicted, each of them left out.

    Parameters
    ----------
    some, neighbours : ndarray, shape (k,), (n, c)
        Points to judge, and the known points around each, the nearest first.
    around : int
        How many of these tell the likelihood; all of them tell the level of the noise.
    length, total : ndarray, shape (r, n)
        Lengths of the residuals in their standard deviations, were the noise 1, and the variances of the residuals then.
    axes : int
        Components of a value.
    middle : float
        Median of the length of a vector of so many standard normal components.
    freedom : float
        Degrees of freedom of Student's distribution of the residuals.
    level, cost : ndarray, shape (r, n)
        Filled there with the standard deviation of the noise, and the mean negative log-likelihood but for a constant.
    """
    c = neighbours.shape[1]
    for s in prange(len(some)):
        p = some[s]
        sorted_lengths = np.empty(c)
        for r in range(len(length)):
            for i in range(c):
                value, j = length[r, neighbours[p, i]], i
                while j > 0 and sorted_lengths[j - 1] > value:
                    sorted_lengths[j] = sorted_lengths[j - 1]
                    j -= 1
                sorted_lengths[j] = value
            sd = max(0.5 * (sorted_lengths[(c - 1) // 2] + sorted_lengths[c // 2]) / middle, 1e-300)
            level[r, p] = sd
            product, scales, few = 1.0, 1.0, min(around, c)
            tails, logs = 0.0, 0.0
            for i in range(few):
                q = neighbours[p, i]
                product *= 1.0 + (length[r, q] / sd) ** 2 / freedom
                scales *= total[r, q]
                if product > 1e200 or scales > 1e200:
                    tails, logs, product, scales = tails + np.log(product), logs + np.log(scales), 1.0, 1.0
            tails, logs = tails + np.log(product), logs + np.log(scales)
            cost[r, p] = (0.5 * (freedom + axes) * tails + 0.5 * axes * logs) / few + axes * np.log(sd)


@njit(cache=True, parallel=True)
def choose(
    some: IntArray, neighbours: IntArray, around: int, cost: FloatArray, level: FloatArray, bounds: FloatArray, best: IntArray,
    noise: FloatArray,
) -> None:  # fmt: skip
    """Choose the roughness of least cost around each point, and smooth the noise, within bounds of the level, over those around."""
    c = neighbours.shape[1]
    for s in prange(len(some)):
        p, few = some[s], min(around, neighbours.shape[1])
        least = np.inf
        for r in range(len(cost)):
            total = 0.0
            for i in range(few):
                total += cost[r, neighbours[p, i]]
            if total < least:
                least, best[p] = total, r
    for s in prange(len(some)):
        p, product = some[s], 0.0
        for i in range(c):
            q = neighbours[p, i]
            product += np.log(min(max(level[best[q], q], bounds[0]), bounds[1]))
        noise[p] = np.exp(product / c)
