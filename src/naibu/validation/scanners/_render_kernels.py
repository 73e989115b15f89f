# mypy: disallow-untyped-decorators=False
"""Numba kernels for `naibu.validation.scanners`: voxel fractions filled by markers, parallel projections :cite:p:`kak1988`, echoes."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray, FloatArray, IntArray

# a pixel is projected as so many by so many points, or rays would leave gaps on the detector
_SPLIT = 3


@njit(cache=True, inline="always")
def _covered(distance: float, width: float) -> float:
    """Return the fraction of a cell of this width on the near side of a face at this distance from its centre."""
    return min(max(distance / width + 0.5, 0.0), 1.0)


@njit(cache=True)
def _covered_by_marker(x: FloatArray, cell: FloatArray, normal: FloatArray, shape: FloatArray) -> float:
    """Return the fraction of a cell (3,), mm, at x (3,) from the centre of a marker inside it; see `fill_markers` for its shape."""
    outer, inner, half = 0.5 * shape[0], 0.5 * shape[1], 0.5 * shape[2]
    along, slab = 0.0, 1.0
    if half > 0.0:
        along = x[0] * normal[0] + x[1] * normal[1] + x[2] * normal[2]
        thick = abs(normal[0]) * cell[0] + abs(normal[1]) * cell[1] + abs(normal[2]) * cell[2]
        slab = _covered(half - along, thick) - _covered(-half - along, thick)
        if slab <= 0.0:
            return 0.0
    square, width = 0.0, 0.0
    for a in range(3):
        square += (x[a] - along * normal[a]) ** 2
    radius = np.sqrt(square)
    for a in range(3):
        width += abs(x[a] - along * normal[a]) * cell[a]
    width = width / radius if radius > 0.0 else cell[0]
    disc = _covered(outer - radius, width)
    if inner > 0.0:
        disc -= _covered(inner - radius, width)
    overlap: float = slab * disc
    return overlap


@njit(cache=True)
def fill_markers(
    fraction: AnyArray, spacing: FloatArray, centres: FloatArray, normals: FloatArray, shape: FloatArray, parts: IntArray
) -> None:
    """Add to fraction (nz, ny, nx) that of every voxel inside rigid markers.

    Parameters
    ----------
    fraction : ndarray, shape (nz, ny, nx)
        Changed in place; at most 1 where markers overlap.
    spacing : ndarray, shape (3,)
        Of voxels along x, y, z, mm.
    centres, normals : ndarray, shape (k, 3)
        Index times spacing, mm, and unit vectors; normals of balls are not used.
    shape : ndarray, shape (3,)
        Outer diameter, diameter of the hole, and thickness, mm; thickness 0 for a ball.
    parts : ndarray, shape (3,)
        Cells per voxel along x, y, z; in each, faces are taken as flat.
    """
    nz, ny, nx = fraction.shape
    outer, half = 0.5 * shape[0], 0.5 * shape[2]
    reach = np.sqrt(outer * outer + half * half)
    size = np.array([nx, ny, nz])
    low, high = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    x = np.zeros(3)
    cell = spacing / parts
    for m in range(len(centres)):
        for a in range(3):
            low[a] = max(int(np.floor((centres[m, a] - reach) / spacing[a] + 0.5)), 0)
            high[a] = min(int(np.floor((centres[m, a] + reach) / spacing[a] + 0.5)) + 1, size[a])
        for k in range(low[2], high[2]):
            for j in range(low[1], high[1]):
                for i in range(low[0], high[0]):
                    filled = 0.0
                    for c in range(parts[2]):
                        x[2] = (k + (c + 0.5) / parts[2] - 0.5) * spacing[2] - centres[m, 2]
                        for b in range(parts[1]):
                            x[1] = (j + (b + 0.5) / parts[1] - 0.5) * spacing[1] - centres[m, 1]
                            for a in range(parts[0]):
                                x[0] = (i + (a + 0.5) / parts[0] - 0.5) * spacing[0] - centres[m, 0]
                                filled += _covered_by_marker(x, cell, normals[m], shape)
                    fraction[k, j, i] = min(fraction[k, j, i] + filled / (parts[0] * parts[1] * parts[2]), 1.0)


@njit(cache=True)
def projected(fraction: AnyArray, dx: float, dy: float, angles: FloatArray, step: float, out: FloatArray) -> None:
    """Add to out (views, n) the length, mm, of the rays of parallel views inside a material.

    It fills a fraction (ny, nx) of the pixels. The detector is centred on the slice, its elements are `step` mm apart.
    """
    ny, nx = fraction.shape
    middle = out.shape[1] // 2
    for j in range(ny):
        for i in range(nx):
            if fraction[j, i] == 0.0:
                continue
            length = fraction[j, i] * dx * dy / (step * _SPLIT * _SPLIT)
            for part in range(_SPLIT * _SPLIT):
                x = (i - 0.5 * (nx - 1) + (part % _SPLIT + 0.5) / _SPLIT - 0.5) * dx
                y = (j - 0.5 * (ny - 1) + (part // _SPLIT + 0.5) / _SPLIT - 0.5) * dy
                for v in range(len(angles)):
                    t = (x * np.cos(angles[v]) + y * np.sin(angles[v])) / step + middle
                    n = int(np.floor(t))
                    out[v, n] += length * (n + 1 - t)
                    out[v, n + 1] += length * (t - n)


@njit(cache=True)
def back_projected(filtered: FloatArray, dx: float, dy: float, angles: FloatArray, step: float, out: AnyArray) -> None:
    """Fill out (ny, nx) with the mean over all views of filtered projections (views, n), times pi."""
    ny, nx = out.shape
    middle = filtered.shape[1] // 2
    cosines, sines = np.cos(angles) * dx / step, np.sin(angles) * dy / step
    for j in range(ny):
        for i in range(nx):
            x, y = i - 0.5 * (nx - 1), j - 0.5 * (ny - 1)
            total = 0.0
            for v in range(len(angles)):
                t = x * cosines[v] + y * sines[v] + middle
                n = int(t)
                total += filtered[v, n] * (n + 1 - t) + filtered[v, n + 1] * (t - n)
            out[j, i] = total * np.pi / len(angles)


@njit(cache=True)
def add_echoes(
    real: FloatArray,
    imaginary: FloatArray,
    spacing: FloatArray,
    positions: FloatArray,
    strengths: FloatArray,
    spread: FloatArray,
    axis: int,
    turns: float,
) -> None:
    """Add the echoes of points to a complex field (nz, ny, nx).

    Parameters
    ----------
    real, imaginary : ndarray, shape (nz, ny, nx)
        The field, changed in place.
    spacing : ndarray, shape (3,)
        Of voxels along x, y, z, mm.
    positions : ndarray, shape (n, 3)
        Index times spacing, mm.
    strengths : ndarray, shape (n,)
        Amplitudes at the centre of an echo.
    spread : ndarray, shape (3,)
        Standard deviation of the amplitude along x, y, z, mm.
    axis : int
        Along which the beam runs: 0 for x, 1 for y, 2 for z.
    turns : float
        Cycles of the phase per mm along it.
    """
    nz, ny, nx = real.shape
    size = np.array([nx, ny, nz])
    most = int(np.ceil((6.0 * spread / spacing).max())) + 3
    weight = np.empty((3, most))
    low, high = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    for p in range(len(positions)):
        if strengths[p] == 0.0:
            continue
        for a in range(3):
            low[a] = max(int(np.ceil((positions[p, a] - 3.0 * spread[a]) / spacing[a])), 0)
            high[a] = min(int(np.floor((positions[p, a] + 3.0 * spread[a]) / spacing[a])) + 1, size[a])
            for i in range(low[a], high[a]):
                weight[a, i - low[a]] = np.exp(-0.5 * ((i * spacing[a] - positions[p, a]) / spread[a]) ** 2)
        phase = 2.0 * np.pi * turns * positions[p, axis]
        re, im = strengths[p] * np.cos(phase), -strengths[p] * np.sin(phase)
        for k in range(low[2], high[2]):
            for j in range(low[1], high[1]):
                w = weight[2, k - low[2]] * weight[1, j - low[1]]
                for i in range(low[0], high[0]):
                    real[k, j, i] += re * w * weight[0, i - low[0]]
                    imaginary[k, j, i] += im * w * weight[0, i - low[0]]
