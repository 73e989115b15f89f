"""Tissue that holds air, such as lungs, told from the air outside where both are connected, and where a body surrounds space."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from naibu.core.arrays import AnyFloatArray, BoolArray, FloatArray, Int8Array, IntArray

DIRECTIONS = 6  # along the axes
# empirical: directions in which tissue with air in it meets the body, in the mean over a connected region of it: lungs 5 to 6, or 4 where
# the scan cuts them at both ends; a mattress below the body 1, what lies between limbs 2 or 3
ENCLOSED = 4.0
# empirical: of the air outside, voxels with the fewest of these directions are looked at, at least so large a part, with so few of them
SAMPLE, OPEN = 0.05, 3
CLEAR = 2  # voxels: what lies nearer to the body is blurred by it
WINDOW = 1.5  # voxels: standard deviation of the window of a local mean
# empirical: by how much denser than air, in standard deviations of its local mean and in fractions from it to the body
DENSER_SD, DENSER = 5.0, 0.03
BESIDE = 4.0  # voxels: what is too near to the body to be judged is as what lies next to it, up to so far away


def meets_body(body: BoolArray) -> Int8Array:
    """Return in how many of the six directions along the axes each voxel (nz, ny, nx) meets the body."""
    count = np.zeros(body.shape, dtype=np.int8)
    for axis in range(3):
        for end in (slice(None), slice(None, None, -1)):
            way = (slice(None),) * axis + (end,)
            count[way] += np.logical_or.accumulate(body[way], axis=axis)
    return count


def aerated_tissue(values: AnyFloatArray, body: BoolArray, outside: BoolArray, stride: IntArray) -> BoolArray:
    """Return which blocks of voxels hold tissue with air in it, that is connected to the air outside.

    Parameters
    ----------
    values : ndarray, shape (nz, ny, nx)
        Intensities.
    body, outside : ndarray, shape (nz, ny, nx), bool
        The bright region, and what is dark and connected to the air outside.
    stride : ndarray, shape (3,), int
        Voxels along z, y, x of a block.

    Returns
    -------
    ndarray, shape (mz, my, mx), bool
        Connected blocks whose mean is denser than the air outside, and which the body surrounds; none where no such air is shown.
    """
    solid = summed(body, stride) > 0
    # beyond the faces of the scan a body goes on: what its outline encloses in a face is met there
    directions = meets_body(_closed_at_faces(solid))[1:-1, 1:-1, 1:-1]
    air = summed(outside, stride) > 0
    none = np.zeros(solid.shape, dtype=bool)
    if not (air & (directions >= ENCLOSED)).any():
        return none
    clear = outside & ndimage.binary_erosion(~body, iterations=CLEAR, border_value=1)
    count = summed(clear, stride)
    mean, judged = _local_mean(summed(np.where(clear, values, 0.0), stride), count)
    samples = np.bincount(directions[judged], minlength=DIRECTIONS + 1).cumsum()
    fewest = int(np.argmax(samples >= SAMPLE * max(samples[-1], 1)))
    if fewest > OPEN:
        return none
    open_air = mean[judged & (directions <= fewest)]
    level = float(np.median(open_air))
    spread = 1.4826 * float(np.median(np.abs(open_air - level)))
    denser = judged & (mean > level + max(DENSER_SD * spread, DENSER * (float(np.median(values[body])) - level)))
    if not denser.any():
        return none
    away, nearest = ndimage.distance_transform_edt(~judged, return_indices=True)
    found = air & denser[tuple(nearest)] & (away <= BESIDE)
    labels, n = ndimage.label(found)
    enclosed = np.flatnonzero(ndimage.mean(directions, labels, np.arange(1, n + 1)) >= ENCLOSED) + 1
    return np.asarray(np.isin(labels, enclosed))


def summed(values: AnyFloatArray | BoolArray, stride: IntArray) -> FloatArray:
    """Return the sums of blocks of voxels; those at the end of an axis may hold fewer."""
    out: FloatArray = np.asarray(values, dtype=np.float32)
    for axis, step in enumerate(stride):
        if step > 1:
            out = np.add.reduceat(out, np.arange(0, out.shape[axis], int(step)), axis=axis)
    return out


def _local_mean(sums: FloatArray, count: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the local mean of blocks that hold voxels, and which these are."""
    near, known = (ndimage.gaussian_filter(v, WINDOW) for v in (sums, count))
    judged = count > 0
    return np.divide(near, known, out=np.zeros_like(near), where=judged), judged


def _closed_at_faces(body: BoolArray) -> BoolArray:
    """Return the body with a layer beyond each face of the volume, which holds what the outline encloses within that face."""
    out = np.pad(body, 1)
    for axis in range(3):
        if body.shape[axis] == 1:
            continue
        inner = tuple(slice(1, -1) for _ in range(2))
        for end in (0, -1):
            at = (slice(None),) * axis + (end,)
            out[at][inner] = ndimage.binary_fill_holes(body[at])
    return out
