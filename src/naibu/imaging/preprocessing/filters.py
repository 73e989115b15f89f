"""Gaussian smoothing, box means and image intensity gradients in single precision; volumes of one slice are treated as images."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import Float32Array, FloatArray
from naibu.imaging.preprocessing._filter_kernels import convolve_last, convolve_middle, differences

# standard deviations at which a Gaussian is truncated: 0.3 % of it lie beyond
REACH = 3.0


def smoothed(values: Float32Array, sigma: ArrayLike) -> Float32Array:
    """Return values (nz, ny, nx) convolved with a Gaussian.

    Parameters
    ----------
    values : ndarray, shape (nz, ny, nx), float32
        Intensities; beyond the edges the last one is repeated.
    sigma : array_like, shape (3,)
        Standard deviation along x, y, z, voxels; 0 leaves an axis alone.
    """
    out = values
    for axis, s in zip((2, 1, 0), np.asarray(sigma, dtype=float), strict=True):
        if s > 0.0 and values.shape[axis] > 1:
            out = convolved(out, gaussian_weights(float(s)), axis)
    return out


def box_mean(values: Float32Array, half: ArrayLike) -> Float32Array:
    """Return the mean of values over boxes of ``2 half + 1`` voxels, half given along x, y, z."""
    out = values
    for axis, h in zip((2, 1, 0), np.asarray(half, dtype=int), strict=True):
        if h > 0 and values.shape[axis] > 1:
            out = convolved(out, np.full(2 * int(h) + 1, 1.0 / (2 * int(h) + 1)), axis)
    return out


def convolved(values: Float32Array, weights: ArrayLike, axis: int) -> Float32Array:
    """Return values (nz, ny, nx) convolved with symmetric weights (2 r + 1,) along one axis."""
    v, w = np.ascontiguousarray(values, dtype=np.float32), np.asarray(weights, dtype=np.float32)
    out = np.empty_like(v)
    if axis == 2:
        convolve_last(v.reshape(-1, v.shape[2]), w, out.reshape(-1, v.shape[2]))
    else:
        outer = v.shape[0] if axis == 1 else 1
        inner = v.shape[2] if axis == 1 else v.shape[1] * v.shape[2]
        convolve_middle(v.reshape(outer, v.shape[axis], inner), w, out.reshape(outer, v.shape[axis], inner))
    return out


def gaussian_weights(sigma: float) -> FloatArray:
    """Return the weights (2 r + 1,) of a Gaussian of standard deviation `sigma`, voxels; their sum is one."""
    r = max(1, int(np.ceil(REACH * sigma)))
    w = np.exp(-0.5 * (np.arange(-r, r + 1) / sigma) ** 2)
    return np.asarray(w / w.sum())


def gradient(values: Float32Array, step: ArrayLike) -> Float32Array:
    """Return the intensity gradient (3, nz, ny, nx) along x, y, z by central differences, per unit of `step`.

    Parameters
    ----------
    values : ndarray, shape (nz, ny, nx), float32
        Intensities.
    step : array_like, shape (3,)
        Voxel spacing along x, y, z.
    """
    v = np.ascontiguousarray(values, dtype=np.float32)
    out = np.empty((3, *v.shape), dtype=np.float32)
    differences(v, (1.0 / np.asarray(step, dtype=float)).astype(np.float32), out)
    return out
