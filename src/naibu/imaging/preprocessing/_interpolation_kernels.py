# mypy: disallow-untyped-decorators=False
"""Numba kernels of trilinear interpolation, for resampling and for the warps of optical flow."""

from __future__ import annotations

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray, FloatArray, IntArray

# voxels: positions outside by no more than rounding count as inside
EDGE = 1e-6


@njit(cache=True, inline="always")
def interpolate(v: AnyArray, x: float, y: float, z: float) -> float:
    """Return the trilinear value at continuous indices inside the volume; NaN outside."""
    nz, ny, nx = v.shape
    if not (-EDGE <= x <= nx - 1 + EDGE and -EDGE <= y <= ny - 1 + EDGE and -EDGE <= z <= nz - 1 + EDGE):
        return np.nan
    i, j, k = min(max(int(x), 0), max(nx - 2, 0)), min(max(int(y), 0), max(ny - 2, 0)), min(max(int(z), 0), max(nz - 2, 0))
    i1, j1, k1 = min(i + 1, nx - 1), min(j + 1, ny - 1), min(k + 1, nz - 1)
    a, b, c = x - i, y - j, z - k
    front = (v[k, j, i] * (1.0 - a) + v[k, j, i1] * a) * (1.0 - b) + (v[k, j1, i] * (1.0 - a) + v[k, j1, i1] * a) * b
    back = (v[k1, j, i] * (1.0 - a) + v[k1, j, i1] * a) * (1.0 - b) + (v[k1, j1, i] * (1.0 - a) + v[k1, j1, i1] * a) * b
    return float(front * (1.0 - c) + back * c)


@njit(cache=True, parallel=True)
def sample(v: AnyArray, index: FloatArray, out: FloatArray) -> None:
    """Fill out (n,) with the values at continuous indices (n, 3) in the order x, y, z; NaN outside."""
    for p in prange(len(index)):
        out[p] = interpolate(v, index[p, 0], index[p, 1], index[p, 2])


@njit(cache=True, parallel=True)
def sample_affine(v: AnyArray, matrix: FloatArray, shift: FloatArray, out: AnyArray) -> None:
    """Fill out (nz, ny, nx) with the values at indices ``matrix @ (x, y, z) + shift``; NaN outside."""
    nz, ny, nx = out.shape
    for row in prange(nz * ny):
        k, j = row // ny, row % ny
        for i in range(nx):
            x = matrix[0, 0] * i + matrix[0, 1] * j + matrix[0, 2] * k + shift[0]
            y = matrix[1, 0] * i + matrix[1, 1] * j + matrix[1, 2] * k + shift[1]
            z = matrix[2, 0] * i + matrix[2, 1] * j + matrix[2, 2] * k + shift[2]
            out[k, j, i] = interpolate(v, x, y, z)


@njit(cache=True, parallel=True)
def warp(v: AnyArray, move: AnyArray, out: AnyArray) -> None:
    """Fill out (nz, ny, nx) with the values at the indices of its voxels plus move (3, nz, ny, nx), along x, y, z; NaN outside."""
    nz, ny, nx = out.shape
    for row in prange(nz * ny):
        k, j = row // ny, row % ny
        for i in range(nx):
            out[k, j, i] = interpolate(v, i + move[0, k, j, i], j + move[1, k, j, i], k + move[2, k, j, i])


@njit(cache=True, parallel=True)
def refine(coarse: AnyArray, factor: IntArray, scale: FloatArray, out: AnyArray) -> None:
    """Fill out (3, nz, ny, nx) with a field on a grid coarser by factor (x, y, z), whose first voxel is the same, times scale (3,)."""
    _, nz, ny, nx = out.shape
    _, mz, my, mx = coarse.shape
    for row in prange(nz * ny):
        k, j = row // ny, row % ny
        z, y = min(k / factor[2], mz - 1.0), min(j / factor[1], my - 1.0)
        for i in range(nx):
            x = min(i / factor[0], mx - 1.0)
            for a in range(3):
                out[a, k, j, i] = scale[a] * interpolate(coarse[a], x, y, z)
