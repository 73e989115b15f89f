"""Mask of the object: the largest connected region brighter than the air about it, by the threshold of :cite:t:`otsu1979`."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.bone_mask import otsu_thresholds

# empirical: upper bound of the threshold, in fractions from the mean of the air to that of the object: skin is darker than the mean
DIMMEST = 0.3
CLOSING = 2  # empirical, voxels: radius of the morphological closing that bridges noise at the surface


def object_mask(volume: Volume, *, margin: int = 0) -> BoolArray:
    """Return the mask of the largest bright region of a volume, with the holes in its slices filled.

    Parameters
    ----------
    volume : Volume
        Volume of one object in air, or of the inside of an object.
    margin : int
        Dilation, voxels, by which the mask includes the contrast of the surface.

    Returns
    -------
    ndarray, shape (nz, ny, nx), bool
        The object.

    Raises
    ------
    InputError
        Volume without contrast.
    """
    values = np.asarray(volume.values, dtype=np.float32)
    reach = tuple(1.0 if n > 1 else 0.0 for n in volume.shape)
    smooth = ndimage.gaussian_filter(values, reach)
    limit = float(otsu_thresholds(smooth, 2)[0])
    air, body = float(smooth[smooth < limit].mean()), float(smooth[smooth >= limit].mean())
    found = smooth > min(limit, air + DIMMEST * (body - air))
    labels, _ = ndimage.label(found)
    found = labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])
    pad = CLOSING + 1
    found = ndimage.binary_closing(np.pad(found, pad), iterations=CLOSING)[pad:-pad, pad:-pad, pad:-pad]
    found = np.stack([ndimage.binary_fill_holes(page) for page in found])
    return np.asarray(ndimage.binary_dilation(found, iterations=margin) if margin else found)
