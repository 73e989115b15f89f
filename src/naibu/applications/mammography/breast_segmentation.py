"""The breast in a mammogram, told from the air beside it."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError

_SMOOTH_MM = 0.8
_EDGE_PART = 0.02  # of the columns, at each side
_SIGMAS = 6.0
_LEAST_CONTRAST = 0.04  # of the range of intensities
_LEAST_PART, _MOST_PART = 0.02, 0.95


def breast_mask(pixels: FloatArray, pixel_mm: float, *, wall_at_right: bool | None = None, what: str = "mammogram") -> BoolArray:
    """Return which pixels show the breast.

    Intensities that differ from those of the air by more than its noise, smoothed; the largest region that touches the chest wall, without
    holes. Labels beside the breast are other regions. The pectoral muscle counts as breast.

    Parameters
    ----------
    pixels : ndarray, shape (rows, columns)
        Intensities; the breast may be brighter or darker than the air.
    pixel_mm : float
        Size of a pixel.
    wall_at_right : bool, optional
        On which side of the image the chest wall lies; by default where the intensities vary more.
    what : str
        Name of the image in messages.

    Raises
    ------
    InputError
        No contrast, or no region of a breast's size at that side.
    """
    grey = ndimage.gaussian_filter(np.asarray(pixels, dtype=float), _SMOOTH_MM / pixel_mm)
    low, high = np.percentile(grey, [0.5, 99.5])
    if not high > low:
        raise InputError(f"{what}: all its pixels are {low:g}; it shows no breast")
    count = max(2, int(_EDGE_PART * grey.shape[1]))
    sides = grey[:, :count], grey[:, -count:]
    at_right = (
        bool(np.ptp(np.percentile(sides[1], [5, 95])) > np.ptp(np.percentile(sides[0], [5, 95])))
        if wall_at_right is None
        else wall_at_right
    )
    air = sides[0] if at_right else sides[1]
    middle = float(np.median(air))
    noise = 1.4826 * float(np.median(np.abs(air - middle)))
    apart = np.abs(grey - middle) > max(_SIGMAS * noise, _LEAST_CONTRAST * float(high - low))
    regions, _ = ndimage.label(apart)
    touching = np.bincount(regions[:, -1 if at_right else 0], minlength=regions.max() + 1)
    touching[0] = 0
    found: BoolArray = np.asarray(ndimage.binary_fill_holes(regions == int(touching.argmax()))) if touching.any() else np.zeros_like(apart)
    part = float(found.mean())
    if not _LEAST_PART <= part <= _MOST_PART:
        side = "right" if at_right else "left"
        raise InputError(f"{what}: {100 * part:.0f} % of it look like a breast at its {side} side; give a mask or an outline instead")
    return found
