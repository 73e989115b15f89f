"""Parts of an object that differ in intensity, such as lungs and what surrounds them, by the threshold of :cite:t:`otsu1979`."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from naibu.core.arrays import AnyFloatArray, BoolArray, Float32Array
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.bone_mask import otsu_thresholds
from naibu.imaging.preprocessing.morphology import large_regions, opened

SMOOTHING = 1.0  # voxels: standard deviation of the Gaussian before the threshold
# empirical: thinner structures, such as vessels and what the surface blurs, belong to the part around them; in fractions of the cube root
# of the volume of the object, and in voxels at least
THINNEST, LEAST_RADIUS = 0.03, 2.5
# least variance between the parts, as a fraction of that of all intensities: one normal distribution that is cut in two has 0.64
SEPARATE = 0.75
# radii: opening by a ball leaves out the tip of a wedge, up to 1 / sin(a / 2) - 1 radii from what is left of it: 2 for one of 39 degrees
WEDGE = 2.0
LEAST_SHARE = 1e-3  # of the object in the neighbourhood of a voxel: of its own voxels always more
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
    smooth = _smoothed(volume.values)
    inner = smooth[mask]
    if not np.ptp(inner) > 0.0:
        return ()
    threshold = otsu_thresholds(inner, 2)[0]
    above = inner > threshold
    share, distance = float(above.mean()), float(inner[above].mean() - inner[~above].mean())
    if share * (1.0 - share) * distance**2 < SEPARATE * float(inner.var()):
        return ()
    bright = (smooth > threshold) & mask
    spacing, radius = volume.spacing_mm[::-1], _thinnest_radius_mm(volume, mask)
    # vessels are bright and thin: what is left of the bright part when it is opened, the dark part surrounds; then the other way round
    dark = large_regions(opened(mask & ~opened(bright, spacing, radius), spacing, radius), SMALLEST * mask.sum())
    other = large_regions(mask & ~dark, SMALLEST * mask.sum())
    if not dark.any() or not other.any():
        return ()
    return mask & ~other, other


def structures_of_another(volume: Volume, part: BoolArray, other: BoolArray) -> BoolArray:
    """Return the voxels of a part that show thin structures of another: as bright as that one, and connected to it.

    Parameters
    ----------
    volume : Volume
        Scan of the object.
    part, other : ndarray, shape (nz, ny, nx), bool
        Both parts, of those that `intensity_parts` returns.

    Returns
    -------
    ndarray, shape (nz, ny, nx), bool
        Such voxels no further than `WEDGE` radii of the opening from the other part: others that are as bright, such as vessels, belong to
        the part that surrounds them.
    """
    object_ = (part | other).astype(np.float32)
    # of voxels of the object alone: the surface of a bright part is as bright as a darker one where the background is blurred into it
    smooth = _smoothed(np.where(object_ > 0.0, volume.values, 0.0)) / np.maximum(_smoothed(object_), LEAST_SHARE)
    near = ndimage.distance_transform_edt(~other, sampling=volume.spacing_mm[::-1]) < WEDGE * _thinnest_radius_mm(volume, part | other)
    own, of_other = (float(np.median(smooth[each])) for each in (part, other))
    alike = part & near & (np.abs(smooth - of_other) < np.abs(smooth - own))
    labels, n = ndimage.label(alike | other)
    connected = np.zeros(n + 1, dtype=bool)
    connected[labels[other]] = True
    return np.asarray(alike & connected[labels])


def _smoothed(values: AnyFloatArray) -> Float32Array:
    """Return the intensities (nz, ny, nx) by which parts are told apart."""
    reach = tuple(SMOOTHING if n > 1 else 0.0 for n in values.shape)
    return np.asarray(ndimage.gaussian_filter(np.asarray(values, dtype=np.float32), reach))


def _thinnest_radius_mm(volume: Volume, mask: BoolArray) -> float:
    """Return the radius, mm, of the ball that structures of an object (nz, ny, nx) have to hold to be parts."""
    voxel = float(np.prod(volume.spacing_mm)) ** (1.0 / 3.0)
    return float(voxel * max(THINNEST * float(mask.sum()) ** (1.0 / 3.0), LEAST_RADIUS))
