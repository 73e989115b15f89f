# mypy: disallow-untyped-decorators=False
"""Numba kernels for `naibu.imaging.markers.detection`: local maxima, their contrast, and Gaussian blobs :cite:p:`marquardt1963`."""

from __future__ import annotations

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray, BoolArray, FloatArray, IntArray

# background, height, centre (3), and the lower triangle, row by row, of the Cholesky factor of the inverse covariance (6)
BLOB_PARAMETERS = 11
_ROUNDS = 25  # Levenberg-Marquardt steps at most; empirical
_DONE = 1e-4  # of the step of the centre, in units of the start's width


@njit(cache=True, parallel=True)
def mark_peaks(v: AnyArray, allowed: BoolArray, reach: IntArray, least: float, peak: BoolArray) -> None:
    """Mark voxels of v (nz, ny, nx) above their 26 neighbours and, by `least`, above the mean of six voxels `reach` (z, y, x) away."""
    nz, ny, nx = v.shape
    for row in prange((nz - 2) * (ny - 2)):
        k, j = row // (ny - 2) + 1, row % (ny - 2) + 1
        for i in range(1, nx - 1):
            c = v[k, j, i]
            if c <= v[k, j, i - 1] or c < v[k, j, i + 1] or c <= v[k, j - 1, i] or c < v[k, j + 1, i] or not allowed[k, j, i]:
                continue
            z0, z1 = max(k - reach[0], 0), min(k + reach[0], nz - 1)
            y0, y1 = max(j - reach[1], 0), min(j + reach[1], ny - 1)
            x0, x1 = max(i - reach[2], 0), min(i + reach[2], nx - 1)
            around = (v[z0, j, i] + v[z1, j, i] + v[k, y0, i] + v[k, y1, i] + v[k, j, x0] + v[k, j, x1]) / 6.0
            if c - around < least:
                continue
            above = True
            for a in range(-1, 2):
                for b in range(-1, 2):
                    for e in range(-1, 2):
                        before = a < 0 or (a == 0 and (b < 0 or (b == 0 and e < 0)))
                        other = v[k + a, j + b, i + e]
                        if (other >= c if before else other > c) and not (a == 0 and b == 0 and e == 0):
                            above = False
            peak[k, j, i] = above


@njit(cache=True, parallel=True)
def shell_contrast(v: AnyArray, peaks: IntArray, shell: IntArray, fraction: float, out: FloatArray) -> None:
    """Fill out (n,) with v at the peaks (n, 3) less that quantile of the voxels at the offsets `shell` (m, 3); all z, y, x."""
    nz, ny, nx = v.shape
    for p in prange(len(peaks)):
        around = np.empty(len(shell))
        for s in range(len(shell)):
            k = min(max(peaks[p, 0] + shell[s, 0], 0), nz - 1)
            j = min(max(peaks[p, 1] + shell[s, 1], 0), ny - 1)
            i = min(max(peaks[p, 2] + shell[s, 2], 0), nx - 1)
            around[s] = v[k, j, i]
        out[p] = v[peaks[p, 0], peaks[p, 1], peaks[p, 2]] - np.sort(around)[int(fraction * (len(shell) - 1))]


@njit(cache=True)
def _window(centre: FloatArray, spacing: FloatArray, radius: FloatArray, shape: tuple[int, int, int], low: IntArray, high: IntArray) -> int:
    """Fill the first and last-but-one indices (3,), x, y, z, of the voxels around a centre (mm); return their number."""
    n = 1
    for a in range(3):
        low[a] = max(int(np.ceil((centre[a] - radius[a]) / spacing[a])), 0)
        high[a] = min(int(np.floor((centre[a] + radius[a]) / spacing[a])) + 1, shape[2 - a])
        n *= max(high[a] - low[a], 0)
    return n


@njit(cache=True)
def _blob(p: FloatArray, x: float, y: float, z: float, derivatives: FloatArray) -> float:
    """Return the blob p at a point (mm) and fill its derivatives (11,) by the parameters."""
    dx, dy, dz = x - p[2], y - p[3], z - p[4]
    u0 = p[5] * dx + p[6] * dy + p[8] * dz
    u1 = p[7] * dy + p[9] * dz
    u2 = p[10] * dz
    e = np.exp(-0.5 * (u0 * u0 + u1 * u1 + u2 * u2))
    f = p[1] * e
    derivatives[0], derivatives[1] = 1.0, e
    derivatives[2], derivatives[3], derivatives[4] = f * p[5] * u0, f * (p[6] * u0 + p[7] * u1), f * (p[8] * u0 + p[9] * u1 + p[10] * u2)
    derivatives[5], derivatives[6], derivatives[7] = -f * u0 * dx, -f * u0 * dy, -f * u1 * dy
    derivatives[8], derivatives[9], derivatives[10] = -f * u0 * dz, -f * u1 * dz, -f * u2 * dz
    return float(p[0] + f)


@njit(cache=True)
def _gather(v: AnyArray, sign: float, low: IntArray, high: IntArray, spacing: FloatArray, others: FloatArray, data: FloatArray) -> None:
    """Fill data (k, 4) with x, y, z (mm) and value of the voxels of a window, less the blobs `others` (m, 11)."""
    n, derivatives = 0, np.empty(11)
    for k in range(low[2], high[2]):
        for j in range(low[1], high[1]):
            for i in range(low[0], high[0]):
                x, y, z = i * spacing[0], j * spacing[1], k * spacing[2]
                value = sign * v[k, j, i]
                for m in range(len(others)):
                    value -= _blob(others[m], x, y, z, derivatives) - others[m, 0]
                data[n, 0], data[n, 1], data[n, 2], data[n, 3] = x, y, z, value
                n += 1


@njit(cache=True)
def _normal_equations(p: FloatArray, data: FloatArray, matrix: FloatArray, right: FloatArray) -> float:
    """Fill J^T J and J^T r of a blob at the data (k, 4); return the sum of squared residuals."""
    derivatives = np.empty(11)
    matrix[:], right[:] = 0.0, 0.0
    total = 0.0
    for n in range(len(data)):
        r = data[n, 3] - _blob(p, data[n, 0], data[n, 1], data[n, 2], derivatives)
        total += r * r
        for a in range(11):
            right[a] += derivatives[a] * r
            for b in range(a + 1):
                matrix[a, b] += derivatives[a] * derivatives[b]
    for a in range(11):
        for b in range(a):
            matrix[b, a] = matrix[a, b]
    return total


@njit(cache=True)
def _acceptable(p: FloatArray, start: FloatArray, radius: FloatArray, least: FloatArray) -> bool:
    """Whether a blob stays near its start, has the right sign, and is neither thinner than `least` (mm) nor wider than its window."""
    for a in range(3):
        sharpness = p[5] if a == 0 else (p[7] if a == 1 else p[10])
        if not abs(p[2 + a] - start[2 + a]) < 0.7 * radius[a] or not 1.0 / (0.7 * radius[a]) < sharpness < 1.0 / least[a]:
            return False
    return bool(p[1] > 0)


@njit(cache=True)
def _add_prior(p: FloatArray, start: FloatArray, variance: float, tilt: float, matrix: FloatArray, right: FloatArray) -> float:
    """Add the prior on the shape to the normal equations: widths near those of the start, `tilt` as weight; return its misfit."""
    total = 0.0
    for a in range(5, 11):
        diagonal = a == 5 or a == 7 or a == 10
        scale = start[a] if diagonal else start[5]
        weight = variance / (scale * scale) * (1.0 if diagonal else tilt)
        r = (start[a] if diagonal else 0.0) - p[a]
        matrix[a, a] += weight
        right[a] += weight * r
        total += weight * r * r
    return total


@njit(cache=True)
def _fit_one(
    data: FloatArray, p: FloatArray, variance: float, tilt: float, radius: FloatArray, least: FloatArray, covariance: FloatArray
) -> bool:
    """Fit one blob by Levenberg-Marquardt, in place; fill the covariance (3, 3) of its centre, mm^2."""
    start, damping = p.copy(), 1.0
    matrix, right = np.zeros((11, 11)), np.zeros(11)
    trial_matrix, trial_right = np.zeros((11, 11)), np.zeros(11)
    total = _normal_equations(p, data, matrix, right) + _add_prior(p, start, variance, tilt, matrix, right)
    width = 1.0 / p[5]
    for _ in range(_ROUNDS):
        damped = matrix.copy()
        for a in range(11):
            damped[a, a] += damping * matrix[a, a] + 1e-300
        step = np.linalg.solve(damped, right)
        trial = p + step
        if _acceptable(trial, start, radius, least):
            trial_total = _normal_equations(trial, data, trial_matrix, trial_right) + _add_prior(
                trial, start, variance, tilt, trial_matrix, trial_right
            )
            if trial_total <= total:
                gain = total - trial_total
                p[:], matrix[:], right[:], total = trial, trial_matrix, trial_right, trial_total
                damping = max(0.1 * damping, 1e-9)
                if max(abs(step[2]), abs(step[3]), abs(step[4])) < _DONE * width and gain < 1e-4 * total:
                    break
                continue
        damping *= 8.0
        if damping > 1e6:
            break
    for a in range(11):
        matrix[a, a] *= 1.0 + 1e-9
        matrix[a, a] += 1e-300
    inverse = np.linalg.inv(matrix)
    for a in range(3):
        for b in range(3):
            covariance[a, b] = inverse[2 + a, 2 + b] * total / max(len(data) - 11, 1)
    return bool(np.isfinite(inverse[2, 2]) and inverse[2, 2] > 0)


@njit(cache=True, parallel=True)
def fit_blobs(
    v: AnyArray,
    sign: float,
    variance: float,
    tilt: float,
    blobs: FloatArray,
    first: IntArray,
    near: IntArray,
    spacing: FloatArray,
    radius: FloatArray,
    least: FloatArray,
    out: FloatArray,
    covariance: FloatArray,
) -> None:
    """Fit a Gaussian blob around every start, the others near it subtracted.

    Parameters
    ----------
    v : ndarray, shape (nz, ny, nx)
        Intensities; `sign` is -1 where the blobs are darker than their surroundings.
    variance : float
        Of the noise of a voxel, intensity^2: weight of the prior on the shape, which matters for faint blobs.
    tilt : float
        Weight of the prior on the axes of the blobs, those of the volume, relative to that; a huge number constrains them.
    blobs : ndarray, shape (n, 11)
        Starts: see `BLOB_PARAMETERS`; positions are indices times spacing, mm.
    first, near : ndarray, shape (n + 1,), (m,)
        The blobs near blob b are ``near[first[b] : first[b + 1]]``.
    spacing, radius, least : ndarray, shape (3,)
        Of voxels, of the windows, and least width, along x, y, z, mm.
    out, covariance : ndarray, shape (n, 11), (n, 3, 3)
        Filled with the fits, NaN where there is none, and the covariance of their centres, mm^2, for noise that is white.
    """
    for b in prange(len(blobs)):
        low, high = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
        n = _window(blobs[b, 2:5], spacing, radius, v.shape, low, high)
        out[b] = np.nan
        if n < 2 * 11:
            continue
        data = np.empty((n, 4))
        _gather(v, sign, low, high, spacing, blobs[near[first[b] : first[b + 1]]], data)
        p = blobs[b].copy()
        if _fit_one(data, p, variance, tilt, radius, least, covariance[b]):
            out[b] = p
