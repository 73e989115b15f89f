"""What is asked of the volumes and masks of a digital volume correlation, and how they are read."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from naibu.core.arrays import Float32Array, Int32Array
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.field_of_view import Box, in_box
from naibu.imaging.preprocessing.resampling import require_mask
from naibu.imaging.preprocessing.volume_pair import intensity_pair, require_known

LEAST_SIZE = 4  # voxels along an axis: cubic B-splines have four nodes in a cell


def check_shape(reference: Volume, deformed: Volume) -> None:
    """Refuse volumes that are too small for cubic B-splines.

    Raises
    ------
    InputError
        Such a volume.
    """
    for name, volume in (("reference", reference), ("deformed", deformed)):
        if min(volume.shape) < LEAST_SIZE:
            raise InputError(
                f"the {name} volume has {' x '.join(map(str, volume.shape[::-1]))} voxels; volume correlation needs {LEAST_SIZE} or more "
                "along every axis. For an image or a few slices use naibu.imaging.lucas_kanade (method='lucas-kanade')"
            )


def filled_pair(reference: Volume, deformed: Volume, views: tuple[Box, Box]) -> tuple[Float32Array, Float32Array]:
    """Return the intensities of both volumes; those outside the fields of view, which are never compared, are the mean of those inside."""
    filled = [_filled(*each) for each in (("reference", reference, views[0]), ("deformed", deformed, views[1]))]
    before, after = intensity_pair(*filled)
    return before, after


def _filled(name: str, volume: Volume, view: Box) -> Volume:
    require_known(volume, view, name)
    values = np.asarray(volume.values, dtype=np.float32)
    inside = values[view]
    if inside.shape != values.shape:
        values = np.where(in_box(view, values.shape), values, inside.mean(dtype=np.float64).astype(np.float32))
    return volume.with_values(values)


def labelled(rigid_mask: ArrayLike, volume: Volume) -> Int32Array:
    """Return the labels (nz, ny, nx) of rigid inclusions, 0 outside of all; those of a boolean mask are its connected parts.

    Raises
    ------
    InputError
        A mask on another grid, or of another kind.
    """
    given = np.asarray(rigid_mask)
    require_mask(given, volume, name="rigid_mask")
    if given.dtype.kind == "b":
        return np.asarray(ndimage.label(given)[0], dtype=np.int32)
    if given.dtype.kind not in "iu":
        raise InputError(f"rigid_mask must be boolean or hold labels of inclusions, not {given.dtype}")
    return given.astype(np.int32)
