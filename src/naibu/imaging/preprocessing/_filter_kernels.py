# mypy: disallow-untyped-decorators=False
"""Numba kernels of image filters: convolution along an axis, central differences, structure tensor products, median."""

from __future__ import annotations

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray


@njit(cache=True, parallel=True, fastmath=True)
def convolve_middle(v: AnyArray, weights: AnyArray, out: AnyArray) -> None:
    """Convolve v (a, n, b) along its middle axis; beyond the ends the last value is repeated."""
    a, n, b = v.shape
    r = len(weights) // 2
    for row in prange(a * n):
        o, i = row // n, row % n
        for x in range(b):
            out[o, i, x] = 0.0
        for k in range(-r, r + 1):
            at = min(max(i + k, 0), n - 1)
            w = weights[k + r]
            for x in range(b):
                out[o, i, x] += w * v[o, at, x]


@njit(cache=True, parallel=True, fastmath=True)
def convolve_last(v: AnyArray, weights: AnyArray, out: AnyArray) -> None:
    """Convolve v (m, n) along its last axis; beyond the ends the last value is repeated."""
    m, n = v.shape
    r = len(weights) // 2
    for row in prange(m):
        padded = np.empty(n + 2 * r, dtype=v.dtype)
        for x in range(n + 2 * r):
            padded[x] = v[row, min(max(x - r, 0), n - 1)]
        for x in range(n):
            out[row, x] = 0.0
        for k in range(2 * r + 1):
            w = weights[k]
            for x in range(n):
                out[row, x] += w * padded[x + k]


@njit(cache=True, parallel=True)
def differences(v: AnyArray, per_step: AnyArray, out: AnyArray) -> None:
    """Fill out (3, nz, ny, nx) with central differences along x, y, z times per_step (3,); one-sided at the ends, zero on one slice."""
    nz, ny, nx = v.shape
    for row in prange(nz * ny):
        k, j = row // ny, row % ny
        k0, k1, j0, j1 = max(k - 1, 0), min(k + 1, nz - 1), max(j - 1, 0), min(j + 1, ny - 1)
        along_y, along_z = per_step[1] / max(j1 - j0, 1), per_step[2] / max(k1 - k0, 1)
        for i in range(nx):
            i0, i1 = max(i - 1, 0), min(i + 1, nx - 1)
            out[0, k, j, i] = (v[k, j, i1] - v[k, j, i0]) * per_step[0] / max(i1 - i0, 1)
            out[1, k, j, i] = (v[k, j1, i] - v[k, j0, i]) * along_y
            out[2, k, j, i] = (v[k1, j, i] - v[k0, j, i]) * along_z


@njit(cache=True, parallel=True)
def products(gradient: AnyArray, out: AnyArray) -> None:
    """Fill out (6, nz, ny, nx) with the products xx, yy, zz, xy, xz, yz of a gradient (3, nz, ny, nx)."""
    _, nz, ny, nx = gradient.shape
    for row in prange(nz * ny):
        k, j = row // ny, row % ny
        for i in range(nx):
            x, y, z = gradient[0, k, j, i], gradient[1, k, j, i], gradient[2, k, j, i]
            out[0, k, j, i], out[1, k, j, i], out[2, k, j, i] = x * x, y * y, z * z
            out[3, k, j, i], out[4, k, j, i], out[5, k, j, i] = x * y, x * z, y * z


@njit(cache=True)
def _sorted_column(v: AnyArray, k: int, j: int, i: int, out: AnyArray) -> int:
    """Fill out with the sorted values of the neighbours along y and z, and return their number."""
    nz, ny, _ = v.shape
    n = 0
    for z in range(max(k - 1, 0), min(k + 2, nz)):
        for y in range(max(j - 1, 0), min(j + 2, ny)):
            value = v[z, y, i]
            at = n
            while at > 0 and out[at - 1] > value:
                out[at] = out[at - 1]
                at -= 1
            out[at] = value
            n += 1
    return n


@njit(cache=True, parallel=True)
def median(v: AnyArray, out: AnyArray) -> None:
    """Fill out (nz, ny, nx) with the median of every voxel and its neighbours; at the faces there are fewer."""
    nz, ny, nx = v.shape
    for row in prange(nz * ny):
        k, j = row // ny, row % ny
        # sorted columns of nine serve three voxels each; their median comes out of merging three of them half way
        columns = np.full((3, 10), np.inf, dtype=v.dtype)
        n = _sorted_column(v, k, j, 0, columns[0])
        for i in range(nx):
            if i + 1 < nx:
                _sorted_column(v, k, j, i + 1, columns[(i + 1) % 3])
            before, here, after = columns[(i - 1) % 3], columns[i % 3], columns[(i + 1) % 3]
            a, b, c = (0 if i > 0 else n), 0, (0 if i + 1 < nx else n)
            value = here[0]
            for _ in range((3 * n - a - c) // 2 + 1):
                x = before[a] if a < n else np.inf
                y = here[b] if b < n else np.inf
                z = after[c] if c < n else np.inf
                if x <= y and x <= z:
                    value, a = x, a + 1
                elif y <= z:
                    value, b = y, b + 1
                else:
                    value, c = z, c + 1
            out[k, j, i] = value
