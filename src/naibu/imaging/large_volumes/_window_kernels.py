# mypy: disallow-untyped-decorators=False
"""Numba kernel of windows into periodic random fields."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray, BoolArray, IntArray


@njit(cache=True)
def fill_window(field: AnyArray, mask: BoolArray, z: IntArray, y: IntArray, x: IntArray, factor: np.float32, out: AnyArray) -> None:
    """Fill out (n,) with a factor times the values of a field at indices z, y, x along its axes, for the voxels of a mask."""
    p = 0
    for k in range(len(z)):
        for j in range(len(y)):
            line = field[z[k], y[j]]
            for i in range(len(x)):
                if mask[k, j, i]:
                    out[p] = factor * line[x[i]]
                    p += 1
