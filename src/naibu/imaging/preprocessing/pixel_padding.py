"""Padding of reconstructed slices: what lies outside of the circle that a scanner reconstructs, filled with an intensity far below air."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from naibu.core.arrays import AnyFloatArray, BoolArray
from naibu.imaging.preprocessing.bone_mask import otsu_thresholds

# empirical: least share of the voxels that are padding; share of those next to it that are as dark as air, by which it is told from air of
# one intensity about an object; gap between both, in fractions from the darkest to the brightest that is measured
LEAST, AIR_BESIDE, GAP = 0.01, 0.7, 0.1
FULL = 0.95  # empirical: share of the side of a slice that the circle spans at least
EXTREME = 0.1  # per cent of the measured voxels that may be as dark, as blurred edges of the padding are


def padding_as_air(values: AnyFloatArray) -> AnyFloatArray:
    """Return intensities (nz, ny, nx) in which padding about the circle of reconstruction has the intensity of air; else the same array.

    Such padding has the lowest intensity, is the same in all slices, and what it leaves reaches all sides of them.
    """
    lowest = values.min()
    filled = values == lowest
    if not LEAST <= filled.mean() < 1.0:
        return values
    slices = [axis for axis in range(3) if values.shape[axis] > 1 and np.array_equal(filled.any(axis), filled.all(axis))]
    if not any(_reaches_all_sides(~filled.any(axis)) for axis in slices):
        return values
    measured = values[~filled]
    darkest, brightest = np.percentile(measured, (EXTREME, 100.0 - EXTREME))
    if not darkest - lowest > GAP * (brightest - darkest) > 0.0:
        return values
    limit = otsu_thresholds(measured, 2)[0]
    beside = values[ndimage.binary_dilation(filled) & ~filled]
    if np.mean(beside < limit) < AIR_BESIDE:
        return values
    return np.where(filled, np.median(measured[measured < limit]), values).astype(values.dtype)


def _reaches_all_sides(plane: BoolArray) -> bool:
    """Return whether true pixels (n, m) reach all four sides, or nearly so."""
    return all(np.ptp(np.flatnonzero(plane.any(axis))) + 1 >= FULL * n for axis, n in enumerate(plane.shape[::-1]))
