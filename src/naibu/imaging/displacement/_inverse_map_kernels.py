# mypy: disallow-untyped-decorators=False
"""Numba kernel of the inverse of a displacement field by fixed-point iteration :cite:p:`chen2008b`."""

from __future__ import annotations

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray
from naibu.imaging.preprocessing._interpolation_kernels import interpolate

# fraction of the remaining distance in one step: converges for stretches below 2.5
DAMPING = 0.8


@njit(cache=True, parallel=True)
def invert(move: AnyArray, ends: AnyArray, tolerance: float, iterations: int, starts: AnyArray) -> None:
    """Fill starts (n, 3) with the indices x, y, z that the displacement move (3, nz, ny, nx), voxels, maps to ends (n, 3).

    NaN where there is none within the field.
    """
    for p in prange(len(ends)):
        x, y, z = ends[p, 0], ends[p, 1], ends[p, 2]
        found = False
        for _ in range(iterations):
            u = interpolate(move[0], x, y, z)
            v = interpolate(move[1], x, y, z)
            w = interpolate(move[2], x, y, z)
            if np.isnan(u + v + w):
                # try again at the edge: the iterates may leave the field
                nz, ny, nx = move.shape[1:]
                inner_x, inner_y, inner_z = min(max(x, 0.0), nx - 1.0), min(max(y, 0.0), ny - 1.0), min(max(z, 0.0), nz - 1.0)
                if inner_x == x and inner_y == y and inner_z == z:
                    break
                x, y, z = inner_x, inner_y, inner_z
                continue
            left_x, left_y, left_z = ends[p, 0] - x - u, ends[p, 1] - y - v, ends[p, 2] - z - w
            found = max(abs(left_x), abs(left_y), abs(left_z)) <= tolerance
            if found:
                break
            x, y, z = x + DAMPING * left_x, y + DAMPING * left_y, z + DAMPING * left_z
        starts[p, 0] = x if found else np.nan
        starts[p, 1] = y if found else np.nan
        starts[p, 2] = z if found else np.nan
