"""Objects that slide on the plate that they lie on, as patients do on a couch: measured by themselves, without it.

A plate in the mask of an object would drag its surface along, where that has no texture of its own to show how it moves.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray
from naibu.core.errors import InputError
from naibu.core.progress import Progress
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.field_of_view import Box, fields_of_view, in_box
from naibu.imaging.preprocessing.object_mask import mask_in_view
from naibu.imaging.preprocessing.supporting_plate import supporting_plate
from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.imaging.volume_correlation.results.correlation_result import CorrelationResult
from naibu.imaging.volume_correlation.sliding.part_by_part import JUMPING

MOVED, MOVING = 1.0, 0.05  # voxels that an object has to move on its plate, and in which share of it, for a slide to be looked for
AT_REST = 0.9  # overlap of a plate in both scans, above which it is at rest
CHI_SQUARED_95 = 5.991  # two degrees of freedom


def without_plate(
    reference: Volume, deformed: Volume, inside: BoolArray, whole: CorrelationResult, progress: Progress | None = None
) -> tuple[BoolArray, CorrelationResult] | None:
    """Return an object without the plate that it lies on, if it slides on that.

    Parameters
    ----------
    reference, deformed : Volume
        Volumes before and after the deformation, on one grid.
    inside : ndarray, shape (nz, ny, nx), bool
        Object and plate in the reference.
    whole : CorrelationResult
        Displacement of both by one field.
    progress : Progress, optional
        As of `correlate_volumes`.

    Returns
    -------
    tuple of (ndarray of shape (nz, ny, nx), CorrelationResult), or None
        Voxels of the object alone, and its displacement; None without a plate that is at rest in both volumes, where nothing moves on it,
        and where the own field of the object rests, too, where both meet.
    """
    plate = supporting_plate(inside)
    if plate is None:
        return None
    views = fields_of_view(reference, deformed)
    alone = _alone(reference, inside, plate, views[0])
    voxel = float(np.prod(reference.spacing_mm)) ** (1.0 / 3.0)
    moved = np.linalg.norm(whole.displacement.vectors[alone & whole.valid][:, :2], axis=1)
    if not len(moved) or (moved > MOVED * voxel).mean() < MOVING:
        return None
    there = mask_in_view(deformed, views[1])
    plate_there = supporting_plate(there)
    if plate_there is None or _shared(plate, plate_there) < AT_REST:
        return None
    there = _alone(deformed, there, plate_there, views[1])
    # the surface has much of the contrast
    compared = ndimage.binary_dilation(alone, mask=in_box(views[0], reference.shape) & ~plate)
    try:
        own = correlate_volumes(reference, deformed, mask=compared, deformed_mask=there, progress=progress)
    except InputError:
        return None  # the field of both stands
    return (alone, own) if _slides(own, alone, plate, MOVED * voxel) else None


def _alone(volume: Volume, inside: BoolArray, plate: BoolArray, view: Box) -> BoolArray:
    """Return the object as it is found where air takes the place of its plate: the outline of both closes narrow gaps between them."""
    outside = in_box(view, volume.shape) & ~inside
    if not outside.any():
        return inside & ~plate
    alone = volume.with_values(np.where(plate, np.median(volume.values[outside]), volume.values))
    return mask_in_view(alone, view) & inside & ~plate


def _shared(one: BoolArray, other: BoolArray) -> float:
    """Return twice what two regions share, over the sum of both (coefficient of Dice)."""
    return 2.0 * float((one & other).sum()) / float(one.sum() + other.sum())


def _slides(own: CorrelationResult, alone: BoolArray, plate: BoolArray, least_mm: float) -> bool:
    """Return whether an object moves across its plate where both meet, beyond the 95 % regions of its own field.

    Only within the slices: a plate that is the same in all of them does not show how it moves along the scan, and holds nothing there.
    """
    at = np.argwhere(alone & ndimage.binary_dilation(plate))
    points = own.volume.to_physical(at[:, ::-1])
    jump, covariance = own.displacement_at(points)[:, :2], own.covariance_at(points)[:, :2, :2]
    known = np.isfinite(jump).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    if not known.any():
        return False
    jump = jump[known]
    squared = np.einsum("ni,ni->n", jump, np.linalg.solve(covariance[known], jump[..., None])[..., 0])
    return bool(((squared > CHI_SQUARED_95) & (np.linalg.norm(jump, axis=1) > least_mm)).mean() > JUMPING)
