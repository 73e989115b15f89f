"""Mask of the object: what the contour of its bright region encloses, by the threshold of :cite:t:`otsu1979`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from naibu.core.arrays import AnyFloatArray, BoolArray, Float32Array, FloatArray, IntArray
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.aerated_tissue import aerated_tissue, meets_body, summed
from naibu.imaging.preprocessing.bone_mask import otsu_thresholds
from naibu.imaging.preprocessing.field_of_view import Box, in_box
from naibu.imaging.preprocessing.morphology import closed_by_steps, dilated
from naibu.imaging.preprocessing.pixel_padding import padding_as_air

# empirical: upper bound of the threshold, in fractions from the mean of the air to that of the object: skin is darker than the mean
DIMMEST = 0.3
SMOOTHING = 1.0  # voxels: standard deviation of the Gaussian before the threshold
CLOSING = 2  # empirical, voxels: radius of the morphological closing that bridges noise at the surface
# empirical: radii of the throats through which cavities may be open, in fractions of the cube root of the volume of the bright region; a
# cavity has room for a ball so much larger than its throat, or it is a gap of the outline
THROATS = (0.02, 0.04, 0.08)
WIDER = 1.6
THROAT_VOXELS = 300_000  # about so many coarse voxels show the throats
# share of a slice, of the larger of two neighbours, in which their masks differ, above which the mask jumps
JUMP = 0.25
STEADY, STEADILY = 2, 1.5  # slices to either side that tell how an object tapers, and how much faster than that it may
AIR = 0.01  # share of the field of view with exactly the intensity of the padding, above which that is the intensity of air
SURROUNDED = 5  # of six directions along the axes, in which space meets the object that surrounds it but for an opening
LEAST_AREA = 0.02  # of the largest slice: smaller ones are the tip of an object, where slices differ much


def object_mask(volume: Volume, *, margin: int = 0) -> BoolArray:
    """Return the mask of the largest bright region of a volume, with all cavities that its outline encloses, such as lungs.

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

    Notes
    -----
    Cavities are found in three dimensions: air is outside if it is connected to air on a face of the volume that no outline encloses within
    that face. A cavity may be open to the outside, as lungs are by the trachea, through a throat much narrower than itself. Through a wide
    opening it belongs to the object if it is denser than the air outside, as aerated tissue is, and surrounded by the object.
    """
    values = padding_as_air(volume.values)
    smooth = _smoothed(values)
    found = smooth > _limit(smooth)
    labels, _ = ndimage.label(found)
    found = labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])
    found = _with_cavities(closed_by_steps(found, CLOSING), values, volume.spacing_mm)
    return dilated(found, margin) if margin else found


def object_threshold(volume: Volume) -> float:
    """Return the intensity above which `object_mask` takes smoothed voxels for bright.

    Raises
    ------
    InputError
        Volume without contrast.
    """
    return _limit(_smoothed(padding_as_air(volume.values)))


def _smoothed(values: AnyFloatArray) -> Float32Array:
    reach = tuple(SMOOTHING if n > 1 else 0.0 for n in values.shape)
    return np.asarray(ndimage.gaussian_filter(np.asarray(values, dtype=np.float32), reach))


def _limit(smooth: Float32Array) -> float:
    limit = float(otsu_thresholds(smooth, 2)[0])
    air, body = float(smooth[smooth < limit].mean()), float(smooth[smooth >= limit].mean())
    return min(limit, air + DIMMEST * (body - air))


def mask_in_view(volume: Volume, view: Box, *, margin: int = 0) -> BoolArray:
    """Return the object (nz, ny, nx) that the field of view of a volume shows.

    Parameters
    ----------
    volume : Volume
        Scan, which may be padded.
    view : tuple of slice
        Its field of view (see `naibu.imaging.preprocessing.field_of_view`).
    margin : int
        See `object_mask`.

    Raises
    ------
    InputError
        As `object_mask`.
    """
    values = np.asarray(volume.values)
    inside = in_box(view, volume.shape)
    filled = values[~inside]
    if filled.size and (filled == filled[0]).all() and np.mean(values[view] == filled[0]) > AIR:
        # filled with the intensity of air: an object that ends there is then told from air as elsewhere
        return object_mask(volume, margin=margin) & inside
    mask = np.zeros(volume.shape, dtype=bool)
    mask[view] = object_mask(Volume.from_array(values[view], spacing_mm=volume.spacing_mm), margin=margin)
    return mask


def mask_jumps(mask: BoolArray) -> IntArray:
    """Return the slices (n,) whose mask differs from that of the slice before by more than a quarter of the larger of both.

    The sections of a rounded object in thick slices change as much next to its ends, but steadily: the area by which the slices around
    grow or shrink is no jump.

    Parameters
    ----------
    mask : ndarray, shape (nz, ny, nx), bool
        The object.

    Returns
    -------
    ndarray, shape (n,), int64
        Indices along z; the ends of the object are no jumps, a slice without object between others is.
    """
    area = mask.sum(axis=(1, 2))
    filled = np.flatnonzero(area)
    if not len(filled):
        return np.zeros(0, dtype=np.int64)
    inner = mask[filled[0] : filled[-1] + 1]
    larger = np.maximum(inner[1:].sum(axis=(1, 2)), inner[:-1].sum(axis=(1, 2)))
    changed = (inner[1:] != inner[:-1]).sum(axis=(1, 2))
    steady: FloatArray = np.zeros(len(changed))
    if len(changed) > STEADY:
        grown = np.pad(np.diff(inner.sum(axis=(1, 2))), STEADY, mode="reflect")
        around = np.delete(np.lib.stride_tricks.sliding_window_view(grown, 2 * STEADY + 1), STEADY, axis=1)
        steady = STEADILY * np.abs(np.median(around, axis=1))
    jumps = (changed - steady > JUMP * larger) & (larger > LEAST_AREA * area.max())
    return np.asarray(filled[0] + 1 + np.flatnonzero(jumps), dtype=np.int64)


@dataclass(frozen=True, slots=True)
class LeftOut:
    """What a mask leaves out that may belong to the object, in fractions of its volume.

    Attributes
    ----------
    surrounded : float
        Space that the object surrounds but for an opening, and that is as dark as the air outside.
    separate : float
        Bright regions that are not connected to the object.
    """

    surrounded: float
    separate: float


def left_out(volume: Volume, mask: BoolArray, view: Box) -> LeftOut:
    """Return what the mask of an object, as `mask_in_view` finds it, leaves out that may belong to it.

    Parameters
    ----------
    volume : Volume
        Scan.
    mask : ndarray, shape (nz, ny, nx), bool
        The object.
    view : tuple of slice
        Field of view of the scan.
    """
    inside = mask[view]
    smooth = _smoothed(padding_as_air(np.asarray(volume.values[view])))
    dark = smooth <= _limit(smooth)
    surrounded = dark & ~inside & (meets_body(inside) >= SURROUNDED)
    # the outline is closed, and what is blurred about it is bright
    near = dilated(inside, CLOSING + 1)
    size = max(int(inside.sum()), 1)
    return LeftOut(float(surrounded.sum()) / size, float((~dark & ~near).sum()) / size)


def _with_cavities(bright: BoolArray, values: AnyFloatArray, spacing_mm: FloatArray) -> BoolArray:
    """Return the bright region with the cavities that it encloses, also those that are open through a throat."""
    outside = _from_outside(~bright, ~bright)
    voxel = max((bright.size * float(np.prod(spacing_mm)) / THROAT_VOXELS) ** (1 / 3), float(spacing_mm.min()))
    stride = np.maximum(np.round(voxel / spacing_mm[::-1]), 1).astype(int)
    # coarse voxels are bright where any of theirs is: thin walls stay closed
    blocked = summed(~outside, stride) > 0
    cavities = aerated_tissue(values, bright, outside, stride)
    cavities |= _through_throats(blocked | cavities, spacing_mm[::-1] * stride)
    if cavities.any():
        fine = cavities.repeat(stride[0], 0).repeat(stride[1], 1).repeat(stride[2], 2)[tuple(map(slice, bright.shape))]
        fine = ndimage.binary_dilation(fine & outside, iterations=int(stride.max()) + 1, mask=outside)
        outside = _from_outside(outside & ~fine, outside & ~fine)
    return ~outside


def _through_throats(closed: BoolArray, spacing: FloatArray) -> BoolArray:
    """Return the open voxels of cavities into which no ball of the radius of a throat fits from outside."""
    size = (float(closed.sum()) * float(np.prod(spacing))) ** (1 / 3)
    room = ndimage.distance_transform_edt(~closed, sampling=spacing)
    found = np.zeros_like(closed)
    for throat in (f * size for f in reversed(THROATS)):
        free = _from_outside(room > throat, ~closed)
        touched = free | (ndimage.distance_transform_edt(~free, sampling=spacing) <= throat) if free.any() else free
        shut = ~closed & ~touched
        # what a large ball can touch a smaller one can, too
        if not (room[shut] > WIDER * THROATS[0] * size).any():
            break
        labels, n = ndimage.label(shut)
        largest = ndimage.maximum(room, labels, np.arange(1, n + 1))
        found |= np.isin(labels, 1 + np.flatnonzero(largest > WIDER * throat))
    return found


def _from_outside(free: BoolArray, air: BoolArray) -> BoolArray:
    """Return the free voxels that are connected to air on a face of the volume, where no outline encloses it within the face."""
    seeds = np.zeros_like(free)
    for axis in range(3):
        if free.shape[axis] == 1:
            continue
        for end in (0, -1):
            face = (slice(None),) * axis + (end,)
            seeds[face] |= free[face] & ~ndimage.binary_fill_holes(~air[face])
    labels, n = ndimage.label(free)
    reached = np.zeros(n + 1, dtype=bool)
    reached[labels[seeds]] = True
    return np.asarray(reached[labels])
