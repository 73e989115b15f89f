"""Parts of an object that differ in intensity, such as lungs and what surrounds them, by the threshold of :cite:t:`otsu1979`."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.bone_mask import otsu_thresholds
from naibu.imaging.preprocessing.morphology import large_regions, opened

SMOOTHING = 1.0  # voxels: standard deviation of the Gaussian before the threshold
# empirical: thinner structures, such as vessels and what the surface blurs, belong to the part around them; in fractions of the cube root
# of the volume of the object, and in voxels at least
THINNEST, LEAST_RADIUS = 0.03, 2.5
# least variance between the parts, as a fraction of that of all intensities: one normal distribution that is cut in two has 0.64
SEPARATE = 0.75
SMALLEST = 0.02  # of the object: smaller pieces belong to the part around them


def intensity_parts(volume: Volume, mask: BoolArray) -> tuple[BoolArray, ...]:
    """Return the dark and the bright part of an object, without the thin and the small pieces of either, which belong to the other part.

    Parameters
    ----------
    volume : Volume
        Scan of the object.
    mask : ndarray, shape (nz, ny, nx), bool
        The object.

    Returns
    -------
    tuple of ndarray, shape (nz, ny, nx), bool
        The dark part and the bright one, which together are the object; none where the object has one part only.
    """
    if not mask.any():
        return ()
    reach = tuple(SMOOTHING if n > 1 else 0.0 for n in volume.shape)
    smooth = ndimage.gaussian_filter(np.asarray(volume.values, dtype=np.float32), reach)
    inner = smooth[mask]
    if not np.ptp(inner) > 0.0:
        return ()
    threshold = otsu_thresholds(inner, 2)[0]
    above = inner > threshold
    share, distance = float(above.mean()), float(inner[above].mean() - inner[~above].mean())
    if share * (1.0 - share) * distance**2 < SEPARATE * float(inner.var()):
        return ()
    bright = (smooth > threshold) & mask
    spacing = volume.spacing_mm[::-1]
    voxel = float(np.prod(spacing)) ** (1.0 / 3.0)
    radius = voxel * max(THINNEST * float(mask.sum()) ** (1.0 / 3.0), LEAST_RADIUS)
    # vessels are bright and thin: what is left of the bright part when it is opened, the dark part surrounds; then the other way round
    dark = large_regions(opened(mask & ~opened(bright, spacing, radius), spacing, radius), SMALLEST * mask.sum())
    other = large_regions(mask & ~dark, SMALLEST * mask.sum())
    if not dark.any() or not other.any():
        return ()
    return mask & ~other, other
