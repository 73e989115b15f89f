"""Plates that objects lie on in a scan, such as the couch under a patient, told from their shape alone."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import BoolArray, IntArray

STEP = 2  # voxels: by which the outline of a curved plate goes up or down from column to column
ALIKE = 1  # voxels: by how much the outline of a plate, and its thickness, may differ along the scan
STEADY = 0.9  # share of the slices in which they are alike
THICKEST = 0.25  # of the height of plate and object together: what is thicker is no plate
MOST_OF_IT = 0.6  # of what stands out on one side, that has to be as thick
WING, LEAST_WING = 0.04, 3  # of the width of the plate, and voxels, by which it stands out on either side of what it bears


def supporting_plate(mask: BoolArray) -> BoolArray | None:
    """Return the plate that an object lies on, if the mask of both shows one.

    Parameters
    ----------
    mask : ndarray, shape (nz, ny, nx), bool
        Object and plate.

    Returns
    -------
    ndarray of shape (nz, ny, nx), bool, or None
        The plate, with the layer of voxels above it, which show both: what has the same outline and thickness in all slices, is thin, lies
        under the object on one of the four sides of the slices, and stands out on either side of where it bears it; or None.

    Notes
    -----
    Where object and plate touch nothing need show their surface: the plate is as thick there as where it stands out, seen from below.
    """
    for axis in (1, 2):
        for flip in (False, True):
            # seen as (slices, across, height), from below
            seen = mask.transpose(0, 3 - axis, axis)
            seen = seen if flip else seen[:, :, ::-1]
            found = _seen_from_below(seen)
            if found is not None:
                return (found if flip else found[:, :, ::-1]).transpose(*np.argsort((0, 3 - axis, axis))) & mask
    return None


def _seen_from_below(seen: BoolArray) -> BoolArray | None:
    """Return the plate (nz, across, height) of a mask whose last axis goes up, or None."""
    filled: BoolArray = np.logical_or.reduce(seen, axis=2)  # (nz, across)
    slices: BoolArray = np.logical_or.reduce(filled, axis=1)
    if slices.sum() < LEAST_WING:
        return None
    bottom = np.where(filled, seen.argmax(axis=2), -1)
    above = ~seen & (np.arange(seen.shape[2]) > bottom[..., None])
    top = np.where(above.any(axis=2), above.argmax(axis=2), seen.shape[2])
    steady, outline = _alike(bottom, filled, slices)
    height = int(np.ptp(np.flatnonzero(seen.any(axis=(0, 1))))) + 1
    flat, thickness = _alike(top - bottom, filled, slices)
    middle = int(np.argmax(np.where(steady, thickness, -1)))
    below = _reached(steady[1:] & steady[:-1] & (np.abs(np.diff(outline)) <= STEP), middle)
    thick = np.ones(len(flat), dtype=bool)
    thick[below] = ~flat[below] | (thickness[below] > THICKEST * height)
    borne = _reached(thick[1:] & thick[:-1], middle)
    if not thick[middle] or borne[0] <= below[0] or borne[-1] >= below[-1]:
        return None
    thickest = 0.0
    for columns in (below[below < borne[0]], below[below > borne[-1]]):
        own = float(np.median(thickness[columns]))
        plain = int((~thick[columns] & (np.abs(thickness[columns] - own) <= ALIKE)).sum())
        if plain < max(WING * len(below), LEAST_WING, MOST_OF_IT * len(columns)) or (thickest and abs(own - thickest) > ALIKE):
            return None
        thickest = max(thickest, own)
    up = np.arange(seen.shape[2]) - outline[:, None]
    plate = (up >= -ALIKE) & (up < thickest + 1)
    plate[: below[0]] = plate[below[-1] + 1 :] = False
    return np.asarray(np.broadcast_to(plate, seen.shape))


def _reached(joined: BoolArray, start: int) -> IntArray:
    """Return the columns that are joined to one without a gap; `joined` (n - 1,) tells which are to the next."""
    gaps = np.flatnonzero(~joined)
    left, right = gaps[gaps < start], gaps[gaps >= start]
    return np.arange(left[-1] + 1 if len(left) else 0, (right[0] if len(right) else len(joined)) + 1)


def _alike(values: IntArray, filled: BoolArray, slices: BoolArray) -> tuple[BoolArray, IntArray]:
    """Return in which columns (across,) values (nz, across) are alike in nearly all slices, and their medians."""
    middle = np.full(values.shape[1], -1, dtype=np.int64)
    for column in np.flatnonzero(np.logical_or.reduce(filled, axis=0)):
        middle[column] = int(np.median(values[filled[:, column], column]))
    same = filled & (np.abs(values - middle) <= ALIKE)
    return same.sum(axis=0) >= STEADY * slices.sum(), middle
