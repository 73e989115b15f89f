"""Candidates for rigid inclusions: regions that a dark rim encloses, such as bones in magnetic resonance images.

Morphological opening and closing by thresholds of Euclidean distance transforms :cite:p:`serra1982`.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, Int32Array
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.morphology import closed, opened

# rims are thin and broken: candidates are found at each of these thresholds, between the intensity of air (0) and of the object (1), and
# closing radii, in units of the size; what enough of the nine find is kept. Empirical, as are all lengths here, in units of the size.
DARK = (0.5, 0.6, 0.7)
CLOSING = (0.0, 0.3, 0.5)
VOTES = 3
LARGEST_AREA = 25.0  # enclosed in a slice, in squares of the size
LEAST_VOLUME = 3.0  # in cubes of the size
DEPTH, OPENING = 0.47, 0.31
ENOUGH_VOXELS = 4.0  # along the size: finer volumes are thinned out


def inclusion_candidates(volume: Volume, mask: BoolArray, size_mm: float) -> Int32Array:
    """Return labels of regions that a dark rim encloses: candidates for rigid inclusions.

    Parameters
    ----------
    volume : Volume
        The reference.
    mask : ndarray, shape (nz, ny, nx), bool
        The object.
    size_mm : float
        Size of the smallest inclusion: it is thicker than about half of it, lies deeper than that in the object, and has the volume of
        three cubes of it.

    Returns
    -------
    ndarray, shape (nz, ny, nx), int32
        Label of every voxel from 1, 0 outside of all candidates.
    """
    stride = np.maximum((size_mm / (ENOUGH_VOXELS * volume.spacing_mm[::-1])).astype(int), 1)
    thin = tuple(slice(None, None, int(n)) for n in stride)
    smooth = ndimage.gaussian_filter(np.asarray(volume.values, dtype=np.float32), 0.5 * stride)[thin]
    if mask[thin].all():
        return np.zeros(volume.shape, np.int32)
    found = _in_thinned(smooth, mask[thin], volume.spacing_mm[::-1] * stride, size_mm)
    for axis, n in enumerate(stride):
        # a coarse voxel stands for those around its middle
        nearest = np.minimum((np.arange(volume.shape[axis]) + n // 2) // n, found.shape[axis] - 1)
        found = found.take(nearest, axis=axis)
    return found


def _in_thinned(smooth: Float32Array, mask: BoolArray, spacing: FloatArray, size_mm: float) -> Int32Array:
    """Return the labels (nz, ny, nx) in a volume that is no finer than the size needs."""
    out = np.zeros(mask.shape, np.int32)
    air = float(np.median(smooth[~mask]))
    tissue = float(np.median(smooth[mask]))
    where = np.argwhere(mask)
    box = tuple(slice(int(a), int(b)) for a, b in zip(where.min(axis=0), where.max(axis=0) + 1, strict=True))
    smooth, inside = smooth[box], mask[box]
    # the object goes on beyond the faces of the volume that it touches
    rim = [(int(w.start > 0), int(w.stop < n)) for w, n in zip(box, mask.shape, strict=True)]
    cut = tuple(slice(a, a + n) for (a, _), n in zip(rim, inside.shape, strict=True))
    depth = ndimage.distance_transform_edt(np.pad(inside, rim), sampling=spacing)[cut]
    deep = depth > DEPTH * size_mm
    votes = np.zeros(inside.shape, np.int8)
    for level in DARK:
        dark = (smooth < air + level * (tissue - air)) & deep
        for radius in CLOSING:
            votes += _filled(closed(dark, spacing, radius * size_mm) if radius else dark, spacing, LARGEST_AREA * size_mm**2)
    filled = votes >= VOTES
    inclusions = opened(filled, spacing, OPENING * size_mm) & filled
    labels, n = ndimage.label(inclusions)
    big = np.bincount(labels.ravel(), minlength=n + 1) * np.prod(spacing) > LEAST_VOLUME * size_mm**3
    big[0] = False
    number = np.cumsum(big) * big
    out[box] = number[labels]
    return out


def _filled(found: BoolArray, spacing: FloatArray, largest: float) -> BoolArray:
    """Return a region with its holes filled in slices across any axis, if they are no larger than an area, mm^2."""
    out = found.copy()
    for axis in range(3):
        area = float(np.prod(np.delete(spacing, axis)))
        for page, solid in zip(np.moveaxis(out, axis, 0), np.moveaxis(found, axis, 0), strict=True):
            if not solid.any():
                continue
            open_parts, n = ndimage.label(~solid)
            enclosed = np.bincount(open_parts.ravel(), minlength=n + 1) * area <= largest
            enclosed[0] = False
            for edge in (open_parts[0], open_parts[-1], open_parts[:, 0], open_parts[:, -1]):
                enclosed[edge] = False
            if enclosed.any():
                page |= enclosed[open_parts]
    return out
