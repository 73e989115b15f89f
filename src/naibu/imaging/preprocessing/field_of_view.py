"""Field of view of a scan: the box that holds data, without the planes that a resampling or an export filled in."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.volume import Volume

Box = tuple[slice, slice, slice]
TOUCHING = 0.02  # fraction of a plane that the object covers where padding cuts it off; a convex surface that just touches covers less


def fields_of_view(reference: Volume, deformed: Volume) -> tuple[Box, Box]:
    """Return the boxes (z, y, x) of two scans of one object that hold data.

    Outer planes of NaN are padding. Outer planes of one intensity are padding too, unless they are the background: where both scans end in
    planes of the same intensity, these are taken for the background, except on a side where both scans have equally many of them and the
    object is cut off by them in both.

    Parameters
    ----------
    reference, deformed : Volume
        Scans on one grid.

    Returns
    -------
    reference, deformed : tuple of slice
        Boxes along z, y, x; the whole scan where nothing is padded.
    """
    planes = [_outer_planes(np.asarray(v.values)) for v in (reference, deformed)]
    boxes: list[Box] = []
    for own, other, volume in ((planes[0], planes[1], reference), (planes[1], planes[0], deformed)):
        sides = []
        for axis in range(3):
            counts = []
            for end in range(2):
                count, level = own[axis][end]
                common = any(level == value for pair in other for n, value in pair if n)
                cut = count == other[axis][end][0] and _covered(volume, axis, end, count) > TOUCHING
                counts.append(count if np.isnan(level) or not common or cut else 0)
            n = volume.shape[axis]
            sides.append(slice(counts[0], n - counts[1]) if sum(counts) < n else slice(0, n))
        boxes.append((sides[0], sides[1], sides[2]))
    return boxes[0], boxes[1]


def in_box(box: Box, shape: tuple[int, ...]) -> BoolArray:
    """Return the voxels (nz, ny, nx) of a box."""
    inside = np.zeros(shape, dtype=bool)
    inside[box] = True
    return inside


def _outer_planes(values: FloatArray) -> list[tuple[tuple[int, float], tuple[int, float]]]:
    """Return for each axis, at both ends, how many planes have one intensity or are NaN, and that intensity."""
    found = []
    for axis in range(3):
        others = tuple(a for a in range(3) if a != axis)
        low, high = values.min(axis=others), values.max(axis=others)
        if values.dtype.kind == "f":
            missing = np.isnan(values).all(axis=others)
            low, high = np.where(missing, np.nan, low), np.where(missing, np.nan, high)
        found.append((_run(low, high), _run(low[::-1], high[::-1])))
    return found


def _run(low: FloatArray, high: FloatArray) -> tuple[int, float]:
    level = float(low[0])
    same = (np.isnan(low) & np.isnan(high)) if np.isnan(level) else (low == level) & (high == level)
    return (len(same) if same.all() else int(np.argmin(same))), level


def _covered(volume: Volume, axis: int, end: int, count: int) -> float:
    """Fraction of the first plane inside the padding that is brighter than halfway between the padding and the brightest."""
    n = volume.shape[axis]
    if not 0 < count < n:
        return 0.0
    values = np.moveaxis(np.asarray(volume.values, dtype=float), axis, 0)
    plane, level = values[count if end == 0 else n - 1 - count], values[0 if end == 0 else n - 1].flat[0]
    typical = np.nanpercentile(np.abs(values - level), 99)
    return float((np.abs(plane - level) > 0.3 * typical).mean())
