"""Outline of the object at the voxels of a volume that is read block by block: that of `naibu.imaging.object_mask`, or a given one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray, Int8Array
from naibu.imaging.large_volumes.block_frame import BlockFrame
from naibu.imaging.preprocessing.morphology import closed_by_steps, dilated
from naibu.imaging.preprocessing.object_mask import CLOSING, SMOOTHING

BAND = 2  # coarse voxels to both sides of the coarse outline, in which the fine one lies
MARGIN = 1  # voxel, as in memory


def inside_block(frame: BlockFrame, low: Sequence[int], high: Sequence[int], source: Any) -> tuple[BoolArray, BoolArray]:
    """Return which voxels of a box (z, y, x) belong to the object and have unknown coefficients, and which to rigid inclusions.

    Parameters
    ----------
    frame : BlockFrame
        Of the voxels.
    low, high : sequence of int
        First voxel of the box, and the one after its last.
    source : array with slicing, shape (nz, ny, nx)
        The mask if one was given, else the intensities of the reference.
    """
    object_ = _object(frame, low, high, source)
    cell = np.ix_(*(frame.cell_along(2 - a)[low[a] : high[a]] for a in range(3)))
    view = np.zeros(object_.shape, dtype=bool)
    view[tuple(slice(max(s.start - a, 0), max(s.stop - a, 0)) for s, a in zip(frame.views[0], low, strict=True))] = True
    return object_ & frame.cells[cell] & view, frame.rigid[frame.coarse(low, high)]


def _object(frame: BlockFrame, low: Sequence[int], high: Sequence[int], source: Any) -> BoolArray:
    if frame.factor == 1 or frame.thinning > 1:
        # voxels of the outline that is known, or means of voxels, for which the coarse outline is good enough
        return np.asarray(frame.interpolated(frame.mask, low, high) > 0.5)
    if frame.threshold is None:
        return np.asarray(source[tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))] != 0)
    reach = BAND * frame.factor + CLOSING + MARGIN + 2
    shown = [(s.start or 0, n if s.stop is None else s.stop) for s, n in zip(frame.views[0], frame.shape, strict=True)]
    first = [max(int(a) - reach, s) for a, (s, _) in zip(low, shown, strict=True)]
    last = [min(int(b) + reach, e) for b, (_, e) in zip(high, shown, strict=True)]
    out = np.zeros(tuple(int(b) - int(a) for a, b in zip(low, high, strict=True)), dtype=bool)
    if any(a >= b for a, b in zip(first, last, strict=True)):
        return out
    zone = frame.zone[frame.coarse(first, last)]
    inner = tuple(slice(max(int(a), f) - f, min(int(b), e) - f) for a, b, f, e in zip(low, high, first, last, strict=True))
    if (zone[inner] == zone.flat[0]).all() and zone.flat[0] != 1 and not (zone == 1).any():
        found = zone == 2
    else:
        found = _outlined(frame, zone, first, np.asarray(source[tuple(slice(a, b) for a, b in zip(first, last, strict=True))]))
    there = tuple(slice(f + s.start - int(a), f + s.stop - int(a)) for a, f, s in zip(low, first, inner, strict=True))
    out[there] = found[inner]
    return out


def _outlined(frame: BlockFrame, zone: Int8Array, first: Sequence[int], values: Any) -> BoolArray:
    """Return the object in a box, from its intensities and the zones of its voxels: 0 outside, 2 inside, 1 in between."""
    outside = zone == 0
    dark = (zone == 1) & (ndimage.gaussian_filter(values.astype(np.float32), SMOOTHING) <= frame.threshold)
    # what is dark but enclosed belongs to the object, such as a cavity under a thin wall
    labels, n = ndimage.label(dark | outside)
    open_ = np.zeros(n + 1, dtype=bool)
    open_[labels[outside]] = True
    open_[0] = False
    found = ~open_[labels]
    # what is bright but belongs to something else is not connected to the object
    labels, n = ndimage.label(found)
    kept = np.zeros(n + 1, dtype=bool)
    kept[labels[frame.mask[frame.coarse(first, [a + m for a, m in zip(first, zone.shape, strict=True)])]]] = True
    kept[0] = False
    closed = closed_by_steps(np.pad(kept[labels], CLOSING, mode="edge"), CLOSING)[(slice(CLOSING, -CLOSING),) * 3]
    return dilated(closed, MARGIN)
