# mypy: disallow-untyped-decorators=False
"""Numba kernels for `naibu.imaging.dense_matching.optical_flow` :cite:p:`horn1981,lucas1981`.

Displacements (3, nz, ny, nx) are in mm along the axes of the grid.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray, BoolArray
from naibu.imaging.preprocessing._interpolation_kernels import interpolate


@njit(cache=True, parallel=True)
def linearize(a: AnyArray, b: AnyArray, per_step: AnyArray, u: AnyArray, wanted: BoolArray, gradients: AnyArray, rest: AnyArray) -> None:
    """Fill gradients (3, nz, ny, nx), intensity/mm, and rest: ``gradients . u' + rest`` is the intensity difference at displacement u'.

    The gradients are the mean of those of the reference a and of b warped by u; both are zero outside b and where `wanted` is false.
    """
    nz, ny, nx = a.shape
    warped = np.empty_like(a)
    for row in prange(nz * ny):
        k, j = row // ny, row % ny
        for i in range(nx):
            x, y, z = i + u[0, k, j, i] * per_step[0], j + u[1, k, j, i] * per_step[1], k + u[2, k, j, i] * per_step[2]
            warped[k, j, i] = interpolate(b, x, y, z)
    for row in prange(nz * ny):
        k, j = row // ny, row % ny
        k0, k1, j0, j1 = max(k - 1, 0), min(k + 1, nz - 1), max(j - 1, 0), min(j + 1, ny - 1)
        along_y, along_z = 0.5 * per_step[1] / max(j1 - j0, 1), 0.5 * per_step[2] / max(k1 - k0, 1)
        for i in range(nx):
            i0, i1 = max(i - 1, 0), min(i + 1, nx - 1)
            along_x = 0.5 * per_step[0] / max(i1 - i0, 1)
            gx = (a[k, j, i1] - a[k, j, i0] + warped[k, j, i1] - warped[k, j, i0]) * along_x
            gy = (a[k, j1, i] - a[k, j0, i] + warped[k, j1, i] - warped[k, j0, i]) * along_y
            gz = (a[k1, j, i] - a[k0, j, i] + warped[k1, j, i] - warped[k0, j, i]) * along_z
            change = warped[k, j, i] - a[k, j, i] + gx + gy + gz
            if np.isnan(change) or not wanted[k, j, i]:
                gx, gy, gz, rest[k, j, i] = 0.0, 0.0, 0.0, 0.0
            else:
                known = gx * u[0, k, j, i] + gy * u[1, k, j, i] + gz * u[2, k, j, i]
                rest[k, j, i] = warped[k, j, i] - a[k, j, i] - known
            gradients[0, k, j, i], gradients[1, k, j, i], gradients[2, k, j, i] = gx, gy, gz


@njit(cache=True, fastmath=True)
def _row_mean(row: AnyArray, up: AnyArray, down: AnyArray, front: AnyArray, back: AnyArray, weights: AnyArray, out: AnyArray) -> None:
    """Fill out (n,) with the weighted mean of the neighbours along x, y, z; at the ends a value is its own neighbour."""
    n = len(out)
    sx, sy, sz = weights[0], weights[1], weights[2]
    for x in range(n):
        out[x] = sy * (up[x] + down[x]) + sz * (front[x] + back[x])
    if n > 1:
        inner, left, right = out[1 : n - 1], row[: n - 2], row[2:]
        for x in range(len(inner)):
            inner[x] += sx * (left[x] + right[x])
        out[0] += sx * (row[0] + row[1])
        out[n - 1] += sx * (row[n - 2] + row[n - 1])
    else:
        out[0] += 2.0 * sx * row[0]


@njit(cache=True, fastmath=True)
def _row_update(
    mx: AnyArray,
    my: AnyArray,
    mz: AnyArray,
    gx: AnyArray,
    gy: AnyArray,
    gz: AnyArray,
    rest: AnyArray,
    weight: float,
    stride: float,
    ox: AnyArray,
    oy: AnyArray,
    oz: AnyArray,
) -> None:
    w, one, s = np.float32(weight), np.float32(1.0), np.float32(stride)
    for x in range(len(rest)):
        a, b, c = gx[x], gy[x], gz[x]
        f = w * (a * mx[x] + b * my[x] + c * mz[x] + rest[x]) / (one + w * (a * a + b * b + c * c))
        ox[x] += s * (mx[x] - f * a - ox[x])
        oy[x] += s * (my[x] - f * b - oy[x])
        oz[x] += s * (mz[x] - f * c - oz[x])


@njit(cache=True, parallel=True)
def horn_schunck_step(
    u: AnyArray, gradients: AnyArray, rest: AnyArray, weight: float, weights: AnyArray, stride: float, out: AnyArray
) -> None:
    """Relax out by `stride` towards a Horn-Schunck step, (3.56) and (3.57) of the report, from u."""
    _, nz, ny, nx = u.shape
    for row in prange(nz * ny):
        k, j = row // ny, row % ny
        k0, k1, j0, j1 = max(k - 1, 0), min(k + 1, nz - 1), max(j - 1, 0), min(j + 1, ny - 1)
        mean = np.empty((3, nx), dtype=u.dtype)
        for a in range(3):
            _row_mean(u[a, k, j], u[a, k, j0], u[a, k, j1], u[a, k0, j], u[a, k1, j], weights, mean[a])
        _row_update(
            mean[0],
            mean[1],
            mean[2],
            gradients[0, k, j],
            gradients[1, k, j],
            gradients[2, k, j],
            rest[k, j],
            weight,
            stride,
            out[0, k, j],
            out[1, k, j],
            out[2, k, j],
        )


@njit(cache=True)
def _least_eigenvalue(a: float, b: float, c: float, d: float, e: float, f: float, plane: bool) -> float:
    """Return the smallest eigenvalue of the symmetric matrix ((a, d, e), (d, b, f), (e, f, c)), or of its part in the plane."""
    if plane:
        return float(0.5 * (a + b) - np.sqrt(0.25 * (a - b) ** 2 + d * d))
    q = (a + b + c) / 3.0
    p = float(np.sqrt(((a - q) ** 2 + (b - q) ** 2 + (c - q) ** 2 + 2.0 * (d * d + e * e + f * f)) / 6.0))
    if p == 0.0:
        return q
    aa, bb, cc, dd, ee, ff = (a - q) / p, (b - q) / p, (c - q) / p, d / p, e / p, f / p
    half = 0.5 * (aa * (bb * cc - ff * ff) - dd * (dd * cc - ff * ee) + ee * (dd * ff - bb * ee))
    angle = np.arccos(min(max(half, -1.0), 1.0)) / 3.0
    return float(q + 2.0 * p * np.cos(angle + 2.0 * np.pi / 3.0))


@njit(cache=True, parallel=True)
def lucas_kanade_step(
    tensor: AnyArray, right: AnyArray, least: float, damping: float, plane: bool, longest: float, u: AnyArray, eigenvalue: AnyArray
) -> None:
    """Move u to the Lucas-Kanade solution, (3.60) of the report, of every voxel; fill eigenvalue with the smallest one of its matrix.

    tensor (6, nz, ny, nx) holds the window means xx, yy, zz, xy, xz, yz of the products of intensity gradients, right (3, ...) those of
    gradients times the intensity difference at zero displacement. Where the smallest eigenvalue is below `least`, u is kept; elsewhere the
    step along an eigenvector is scaled by its eigenvalue over that plus `damping`, and its length is limited to `longest`, mm.
    """
    _, nz, ny, nx = tensor.shape
    for row in prange(nz * ny):
        k, j = row // ny, row % ny
        for i in range(nx):
            a, b, c = np.float64(tensor[0, k, j, i]), np.float64(tensor[1, k, j, i]), np.float64(tensor[2, k, j, i])
            d, e, f = np.float64(tensor[3, k, j, i]), np.float64(tensor[4, k, j, i]), np.float64(tensor[5, k, j, i])
            small = _least_eigenvalue(a, b, c, d, e, f, plane)
            eigenvalue[k, j, i] = small
            if small < least or (damping == 0.0 and not small > 1e-9 * (a + b + c)):
                continue
            if plane:
                # no third direction: it must not make the matrix singular
                c, e, f = np.float64(1.0), np.float64(0.0), np.float64(0.0)
            p = damping * u[0, k, j, i] - right[0, k, j, i]
            q = damping * u[1, k, j, i] - right[1, k, j, i]
            r = 0.0 if plane else damping * u[2, k, j, i] - right[2, k, j, i]
            a, b, c = a + damping, b + damping, c + damping
            det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
            x = (p * (b * c - f * f) - d * (q * c - f * r) + e * (q * f - b * r)) / det - u[0, k, j, i]
            y = (a * (q * c - f * r) - p * (d * c - f * e) + e * (d * r - q * e)) / det - u[1, k, j, i]
            z = (a * (b * r - q * f) - d * (d * r - q * e) + p * (d * f - b * e)) / det - u[2, k, j, i]
            length = np.sqrt(x * x + y * y + z * z)
            scale = 1.0 if length <= longest else longest / length
            u[0, k, j, i] += scale * x
            u[1, k, j, i] += scale * y
            u[2, k, j, i] += scale * z
