# mypy: disallow-untyped-decorators=False
"""Numba kernel for `naibu.imaging.feature_matching.scattered_interpolation`: linear interpolation in Delaunay simplices."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray, BoolArray

# tolerance of a shape function, far above rounding: a voxel on a face belongs to one of its simplices
ON_FACE = 1e-9


@njit(cache=True)
def fill_simplices(corners: AnyArray, inverses: AnyArray, values: AnyArray, out: AnyArray, done: BoolArray) -> None:
    """Fill out (nz, ny, nx, c) at the voxels inside simplices by linear interpolation of the values at their vertices.

    Vertices `corners` (m, d + 1, d) are in indices x, y (, z); inverses (m, d, d) of the edges from the first one; values (m, d + 1, c).
    """
    m, k, d = corners.shape
    n_components = values.shape[2]
    size = np.array([out.shape[2], out.shape[1], out.shape[0]])
    low, high = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    shape, at = np.empty(k), np.zeros(3)
    for s in range(m):
        for a in range(3):
            low[a], high[a] = 0, 0
        for a in range(d):
            least, most = corners[s, :, a].min(), corners[s, :, a].max()
            low[a] = max(int(np.ceil(least - 1e-9)), 0)
            high[a] = min(int(np.floor(most + 1e-9)), size[a] - 1)
        for z in range(low[2], high[2] + 1):
            for y in range(low[1], high[1] + 1):
                for x in range(low[0], high[0] + 1):
                    if done[z, y, x]:
                        continue
                    at[0], at[1], at[2] = x, y, z
                    shape[0] = 1.0
                    for i in range(d):
                        shape[i + 1] = 0.0
                        for a in range(d):
                            shape[i + 1] += inverses[s, i, a] * (at[a] - corners[s, 0, a])
                        shape[0] -= shape[i + 1]
                    if shape.min() < -ON_FACE:
                        continue
                    for c in range(n_components):
                        out[z, y, x, c] = 0.0
                        for i in range(k):
                            out[z, y, x, c] += shape[i] * values[s, i, c]
                    done[z, y, x] = True
