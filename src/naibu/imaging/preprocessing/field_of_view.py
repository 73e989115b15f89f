"""Field of view of a scan: the box that holds data, without the planes that a resampling or an export filled in."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.volume import Volume

Box = tuple[slice, slice, slice]
_Planes = list[tuple[tuple[int, float], tuple[int, float]]]  # of each axis: how many planes at both ends, and their intensity


def fields_of_view(reference: Volume, deformed: Volume) -> tuple[Box, Box]:
    """Return the boxes (z, y, x) of two scans of one object that hold data.

    Outer planes of NaN are padding. So are outer planes of one intensity, unless the other scan has outer planes of the same intensity:
    then it is that of a background without noise.

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
    return _box(planes[0], planes[1], reference.shape), _box(planes[1], planes[0], deformed.shape)


def _box(own: _Planes, other: _Planes, shape: tuple[int, ...]) -> Box:
    background = {level for ends in other for count, level in ends if count}
    slices = []
    for ends, n in zip(own, shape, strict=True):
        low, high = (0 if level in background else count for count, level in ends)
        slices.append(slice(low, n - high) if low + high < n else slice(0, n))
    return slices[0], slices[1], slices[2]


def in_box(box: Box, shape: tuple[int, ...]) -> BoolArray:
    """Return the voxels (nz, ny, nx) of a box."""
    inside = np.zeros(shape, dtype=bool)
    inside[box] = True
    return inside


def _outer_planes(values: FloatArray) -> _Planes:
    """Return for each axis, at both ends, how many planes have one intensity or are NaN, and that intensity."""
    found = []
    for axis in range(3):
        others = tuple(a for a in range(3) if a != axis)
        low, high = (f.reduce(values, axis=others) for f in (np.fmin, np.fmax))  # NaN only where a plane holds nothing else
        found.append((_run(low, high), _run(low[::-1], high[::-1])))
    return found


def _run(low: FloatArray, high: FloatArray) -> tuple[int, float]:
    level = float(low[0])
    same = (np.isnan(low) & np.isnan(high)) if np.isnan(level) else (low == level) & (high == level)
    return (len(same) if same.all() else int(np.argmin(same))), level
