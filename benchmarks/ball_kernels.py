"""Intensities of the textured ball of `large_volumes.py`, compiled: a volume of 1024^3 is generated in minutes, chunk by chunk."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from naibu._numba.compilation import njit

Array = NDArray[Any]


@njit(cache=True, fastmath=True, error_model="numpy")
def _spline(c: Array, x: float, y: float, z: float) -> float:
    """Return the value of a periodic cubic B-spline."""
    n, at, w = c.shape[0], (z, y, x), np.empty((3, 4))
    first = np.empty(3, np.int64)
    for a in range(3):
        i = int(np.floor(at[a]))
        f = at[a] - i
        g = 1.0 - f
        w[a, 0], w[a, 3] = g * g * g / 6.0, f * f * f / 6.0
        w[a, 1], w[a, 2] = (3.0 * f * f * f - 6.0 * f * f + 4.0) / 6.0, (3.0 * g * g * g - 6.0 * g * g + 4.0) / 6.0
        first[a] = i - 1
    total = 0.0
    for k in range(4):
        for j in range(4):
            line = 0.0
            for i in range(4):
                line += w[2, i] * c[(first[0] + k) % n, (first[1] + j) % n, (first[2] + i) % n]
            total += w[0, k] * w[1, j] * line
    return total


@njit(cache=True, fastmath=True, error_model="numpy")
def _moved(x: float, y: float, z: float, size: int) -> tuple[float, float, float]:
    """Return the displacement of a material point, as `ball_case.moved`."""
    wave = 2.0 * np.pi * 1.5 / size
    u = 2.5 * np.sin(wave * y + 0.4) + 3.0
    v = 2.5 * np.sin(wave * z + 1.3) - 2.0
    w = 2.5 * np.sin(wave * x + 2.1) + 1.5 - 0.05 * (z - 0.5 * (size - 1))
    return u, v, w


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def ball_intensities(
    low: Array, size: int, deformed: bool, fine: Array, fine_step: float, coarse: Array, coarse_step: float, out: Array
) -> None:
    """Fill out (nz, ny, nx) with the intensities of voxels from `low` (z, y, x) on, before or after the motion."""
    middle, radius = 0.5 * (size - 1), 0.4 * size
    for k in prange(out.shape[0]):
        for j in range(out.shape[1]):
            for i in range(out.shape[2]):
                x0, y0, z0 = float(low[2] + i), float(low[1] + j), float(low[0] + k)
                x, y, z = x0, y0, z0
                # the motion is less than 20 voxels
                if (x - middle) ** 2 + (y - middle) ** 2 + (z - middle) ** 2 > (1.05 * radius + 20.0) ** 2:
                    out[k, j, i] = 0.0
                    continue
                for _ in range(60 if deformed else 0):
                    u, v, w = _moved(x, y, z, size)
                    off = abs(x0 - u - x) + abs(y0 - v - y) + abs(z0 - w - z)
                    x, y, z = x0 - u, y0 - v, z0 - w
                    if off < 1e-7:
                        break
                depth = radius - np.sqrt((x - middle) ** 2 + (y - middle) ** 2 + (z - middle) ** 2)
                if depth <= -4.0:
                    out[k, j, i] = 0.0
                    continue
                value = _spline(fine, x / fine_step, y / fine_step, z / fine_step)
                value += _spline(coarse, x / coarse_step, y / coarse_step, z / coarse_step)
                out[k, j, i] = (400.0 + 50.0 * value) / (1.0 + np.exp(-3.0 * depth))
