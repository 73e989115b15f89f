"""Where the object is in a scan: what is brighter than the air about it."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.bone_mask import otsu_thresholds

# of the way from the air to the object, where the threshold lies at most: skin and cartilage are darker than the mean of the object
DIMMEST = 0.3
CLOSING = 2


def object_mask(volume: Volume, *, margin: int = 0) -> BoolArray:
    """Return the largest body of a scan, holes in its slices filled.

    Parameters
    ----------
    volume : Volume
        A scan of one object in air, or of the inside of an object.
    margin : int
        By how many voxels the mask reaches over the object, so that its surface is seen.

    Returns
    -------
    ndarray, shape (nz, ny, nx), bool
        The object.

    Raises
    ------
    InputError
        A scan without contrast.
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
