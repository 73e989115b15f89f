"""Morphological opening and closing by balls, by thresholds of Euclidean distance transforms :cite:p:`serra1982`."""

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
