# mypy: disallow-untyped-decorators=False
"""Numba kernels for `naibu.imaging.markers.washers`: likelihood of the height and tilt of a washer in slices thicker than it."""

from __future__ import annotations

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray, BoolArray, FloatArray


@njit(cache=True)
def _looked_up(table: FloatArray, step: float, at: float) -> float:
    """Interpolate an even function, tabulated from 0 upwards, that ends with zero."""
    s = abs(at) / step
    n = int(s)
    if n + 1 >= len(table):
        return 0.0
    return float(table[n] + (s - n) * (table[n + 1] - table[n]))


@njit(cache=True, parallel=True)
def column_sums(patches: AnyArray, background: FloatArray, seen: BoolArray, out: FloatArray) -> None:
    """Fill out (n, nj, ni) with the sums of patches (n, nk, nj, ni) over the slices `seen` (n, nk), less the background (n,)."""
    n, nk, nj, ni = patches.shape
    for p in prange(n):
        for j in range(nj):
            for i in range(ni):
                total = 0.0
                for k in range(nk):
                    if seen[p, k]:
                        total += patches[p, k, j, i] - background[p]
                out[p, j, i] = total


@njit(cache=True)
def _misfit(
    patch: AnyArray, columns: FloatArray, profile: FloatArray, step: float, at: float, slope: FloatArray, best: FloatArray
) -> float:
    """Return the least squared residual of a plate over its contrast and background; fill these two in `best`."""
    nk = patch.shape[0]
    sm, smm, sw, sww, smw, n = 0.0, 0.0, 0.0, 0.0, 0.0, 0
    for c in range(len(columns)):
        j, i, weight = int(columns[c, 0]), int(columns[c, 1]), columns[c, 2]
        middle = at + slope[0] * columns[c, 3] + slope[1] * columns[c, 4]
        for k in range(nk):
            m, w = weight * _looked_up(profile, step, k - middle), patch[k, j, i]
            sm, smm, sw, sww, smw, n = sm + m, smm + m * m, sw + w, sww + w * w, smw + m * w, n + 1
    mm, ww, mw = smm - sm * sm / n, sww - sw * sw / n, smw - sm * sw / n
    if mm <= 0.0 or mw <= 0.0:
        best[0], best[1] = 0.0, sw / n
        return float(ww)
    best[0] = mw / mm
    best[1] = (sw - best[0] * sm) / n
    return float(ww - mw * mw / mm)


@njit(cache=True, parallel=True)
def weigh_plates(
    patches: AnyArray,
    columns: FloatArray,
    profile: FloatArray,
    step: float,
    heights: FloatArray,
    slopes: FloatArray,
    tilt_sd: FloatArray,
    variance: float,
    mean: FloatArray,
    sd: FloatArray,
    residual: FloatArray,
) -> None:
    """Weight all heights and tilts of a plate by their posterior probability.

    Parameters
    ----------
    patches : ndarray, shape (n, nk, nj, ni)
        Intensities around every plate, k along its thin axis.
    columns : ndarray, shape (n, c, 5)
        Columns that the plate covers: j, i, fraction of the plate, and distance from its centre along j and i, mm.
    profile, step : ndarray, float
        Fraction of a plate inside a slice at a distance in slices, tabulated at this step.
    heights : ndarray, shape (n, h)
        Heights that are tried, slices from the first of the patch.
    slopes : ndarray, shape (t,)
        Tilts that are tried, slices per mm.
    tilt_sd : ndarray, shape (1,)
        Prior standard deviation of the tilts, slices per mm.
    variance : float
        Of the noise of a voxel, times the number of voxels with common noise.
    mean, sd : ndarray, shape (n,)
        Filled with the mean and the standard deviation of the height, slices.
    residual : ndarray, shape (n, nk, c)
        Filled with the residual of the best plate, intensity.
    """
    n, h, t = len(patches), heights.shape[1], len(slopes)
    for p in prange(n):
        cost, slope, fit = np.empty((h, t, t)), np.empty(2), np.empty(2)
        best, found = 1e300, np.zeros(3)
        for a in range(h):
            for b in range(t):
                for c in range(t):
                    slope[0], slope[1] = slopes[b], slopes[c]
                    tilt = (slope[0] ** 2 + slope[1] ** 2) / tilt_sd[0] ** 2
                    cost[a, b, c] = _misfit(patches[p], columns[p], profile, step, heights[p, a], slope, fit) / variance + tilt
                    if cost[a, b, c] < best:
                        best = cost[a, b, c]
                        found[0], found[1], found[2] = heights[p, a], slope[0], slope[1]
        total, first, second = 0.0, 0.0, 0.0
        for a in range(h):
            for b in range(t):
                for c in range(t):
                    w = np.exp(-0.5 * (cost[a, b, c] - best))
                    total, first = total + w, first + w * heights[p, a]
                    second += w * heights[p, a] ** 2
        mean[p] = first / total
        sd[p] = np.sqrt(max(second / total - mean[p] ** 2, 0.0) + (heights[p, 1] - heights[p, 0]) ** 2 / 12.0)
        slope[0], slope[1] = found[1], found[2]
        _misfit(patches[p], columns[p], profile, step, found[0], slope, fit)
        for c in range(columns.shape[1]):
            j, i = int(columns[p, c, 0]), int(columns[p, c, 1])
            middle = found[0] + slope[0] * columns[p, c, 3] + slope[1] * columns[p, c, 4]
            for k in range(patches.shape[1]):
                seen = fit[0] * columns[p, c, 2] * _looked_up(profile, step, k - middle) + fit[1]
                residual[p, k, c] = patches[p, k, j, i] - seen
