"""Morphological dilation, opening and closing :cite:p:`serra1982`, by balls or step by step from voxel to voxel.

Those by balls are thresholds of Euclidean distance transforms. Those by steps are `scipy.ndimage.binary_dilation` and `binary_closing` with
their default structure, in a seventh of the time.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray, FloatArray


def closed(found: BoolArray, spacing: FloatArray, radius: float) -> BoolArray:
    """Return a region (nz, ny, nx) with what no ball outside of it reaches; `spacing` is along z, y, x, lengths in mm."""
    pad = [int(radius // s) + 1 for s in spacing]
    wide = np.pad(found, [(p, p) for p in pad], mode="edge")
    if not wide.any():
        return found
    grown = ndimage.distance_transform_edt(~wide, sampling=spacing) <= radius
    shrunk = ndimage.distance_transform_edt(grown, sampling=spacing) > radius
    return np.asarray(shrunk[tuple(slice(p, -p) for p in pad)])


def opened(found: BoolArray, spacing: FloatArray, radius: float) -> BoolArray:
    """Return what balls within a region (nz, ny, nx) reach; the region goes on beyond the faces of the volume."""
    pad = [int(radius // s) + 1 for s in spacing]
    wide = np.pad(found, [(p, p) for p in pad], mode="edge")
    core = ndimage.distance_transform_edt(wide, sampling=spacing) > radius
    if not core.any():
        return np.zeros_like(found)
    grown = ndimage.distance_transform_edt(~core, sampling=spacing) <= radius
    return np.asarray(grown[tuple(slice(p, -p) for p in pad)])


def dilated(found: BoolArray, steps: int) -> BoolArray:
    """Return the voxels (nz, ny, nx) that so many steps along the axes lead to from a region."""
    out = found.copy()
    for _ in range(steps):
        before = out.copy()
        for own, other in ((out, before), (out.swapaxes(0, 1), before.swapaxes(0, 1)), (out.swapaxes(0, 2), before.swapaxes(0, 2))):
            own[1:] |= other[:-1]
            own[:-1] |= other[1:]
    return out


def closed_by_steps(found: BoolArray, steps: int) -> BoolArray:
    """Return a region (nz, ny, nx) closed by so many steps of dilation and as many of erosion; beyond the faces there is none of it."""
    wide = dilated(np.pad(found, steps), steps)
    return ~dilated(~wide, steps)[(slice(steps, -steps),) * 3] if steps else found.copy()


def large_regions(mask: BoolArray, least: float) -> BoolArray:
    """Return a mask (nz, ny, nx) without its connected regions of fewer than so many voxels."""
    labels, n = ndimage.label(mask)
    kept = np.bincount(labels.ravel(), minlength=n + 1) >= least
    kept[0] = False
    return np.asarray(kept[labels])
