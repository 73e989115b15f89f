# mypy: disallow-untyped-decorators=False
"""Numba kernels of intensity residuals: cubic B-spline interpolation of images :cite:p:`unser1999`, robust weights, local gain."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray, IntArray

# Threads that wait sleep, as in the kernels of finite elements: between two kernels there is single-threaded work here, during which the
# others would spin, at the cost of a third of the processor time where another program needs the core. Read when Numba starts its threads.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

F = np.float32
# intensity of a voxel that has moved out of the volume; NaN does not survive fastmath
OUTSIDE = -1e30
FEW = 20000  # points below which one thread is faster than several
LEAST_DETERMINANT = 0.2  # bounds the pushed-forward gradient where the field folds during the iterations


@njit(cache=True, inline="always")
def cubic(f: Any) -> Any:
    """Return the four cubic B-spline weights at a fraction of a cell."""
    g = F(1) - f
    return (
        g * g * g * F(1 / 6),
        (F(3) * f * f * f - F(6) * f * f + F(4)) * F(1 / 6),
        (F(3) * g * g * g - F(6) * g * g + F(4)) * F(1 / 6),
        f * f * f * F(1 / 6),
    )


@njit(cache=True, inline="always")
def cubic_derivatives(f: Any) -> Any:
    """Return the derivatives of the four weights, per cell."""
    g = F(1) - f
    return -g * g * F(0.5), (F(1.5) * f - F(2)) * f, (F(2) - F(1.5) * g) * g, f * f * F(0.5)


@njit(cache=True, fastmath=True, error_model="numpy")
def spline_value(c: AnyArray, x: Any, y: Any, z: Any) -> Any:
    """Return value and gradient, per voxel, of cubic coefficients that are padded by one before and two after."""
    i, j, k = int(x), int(y), int(z)
    ux, vx = cubic(F(x - i)), cubic_derivatives(F(x - i))
    uy, vy = cubic(F(y - j)), cubic_derivatives(F(y - j))
    uz, vz = cubic(F(z - k)), cubic_derivatives(F(z - k))
    v, gx, gy, gz = F(0), F(0), F(0), F(0)
    for dk in range(4):
        pv, px, py = F(0), F(0), F(0)
        for dj in range(4):
            r0, r1, r2, r3 = c[k + dk, j + dj, i], c[k + dk, j + dj, i + 1], c[k + dk, j + dj, i + 2], c[k + dk, j + dj, i + 3]
            q = ux[0] * r0 + ux[1] * r1 + ux[2] * r2 + ux[3] * r3
            pv += uy[dj] * q
            py += vy[dj] * q
            px += uy[dj] * (vx[0] * r0 + vx[1] * r1 + vx[2] * r2 + vx[3] * r3)
        v += uz[dk] * pv
        gz += vz[dk] * pv
        gx += uz[dk] * px
        gy += uz[dk] * py
    return v, gx, gy, gz


@njit(cache=True, inline="always")
def _sample(c: AnyArray, points: AnyArray, p: int, value: AnyArray, gradient: AnyArray) -> None:
    nz, ny, nx = c.shape[0] - 3, c.shape[1] - 3, c.shape[2] - 3
    x, y, z = points[p, 0], points[p, 1], points[p, 2]
    if x >= 0 and y >= 0 and z >= 0 and x <= nx - 1 and y <= ny - 1 and z <= nz - 1:
        value[p], gradient[p, 0], gradient[p, 1], gradient[p, 2] = spline_value(c, x, y, z)
    else:
        value[p] = F(OUTSIDE)
        gradient[p] = F(0)


@njit(cache=True, fastmath=True, error_model="numpy")
def _sample_few(c: AnyArray, points: AnyArray, value: AnyArray, gradient: AnyArray) -> None:
    for p in range(len(points)):
        _sample(c, points, p, value, gradient)


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def _sample_many(c: AnyArray, points: AnyArray, value: AnyArray, gradient: AnyArray) -> None:
    for p in prange(len(points)):
        _sample(c, points, p, value, gradient)


def sample_spline(c: AnyArray, points: AnyArray, value: AnyArray, gradient: AnyArray) -> None:
    """Fill value (n,) and gradient (n, 3), per voxel, at indices (n, 3); OUTSIDE and zero outside."""
    (_sample_few if len(points) < FEW else _sample_many)(c, points, value, gradient)


@njit(cache=True, fastmath=True, error_model="numpy")
def pushed_forward(j: AnyArray, g: AnyArray, out: AnyArray) -> None:
    """Fill out with the inverse transpose of a matrix times a vector, its determinant limited from below."""
    c00, c01, c02 = j[1, 1] * j[2, 2] - j[1, 2] * j[2, 1], j[1, 2] * j[2, 0] - j[1, 0] * j[2, 2], j[1, 0] * j[2, 1] - j[1, 1] * j[2, 0]
    c10, c11, c12 = j[2, 1] * j[0, 2] - j[2, 2] * j[0, 1], j[2, 2] * j[0, 0] - j[2, 0] * j[0, 2], j[2, 0] * j[0, 1] - j[2, 1] * j[0, 0]
    c20, c21, c22 = j[0, 1] * j[1, 2] - j[0, 2] * j[1, 1], j[0, 2] * j[1, 0] - j[0, 0] * j[1, 2], j[0, 0] * j[1, 1] - j[0, 1] * j[1, 0]
    s = F(1) / max(j[0, 0] * c00 + j[0, 1] * c01 + j[0, 2] * c02, F(LEAST_DETERMINANT))
    out[0] = s * (c00 * g[0] + c01 * g[1] + c02 * g[2])
    out[1] = s * (c10 * g[0] + c11 * g[1] + c12 * g[2])
    out[2] = s * (c20 * g[0] + c21 * g[1] + c22 * g[2])


@njit(cache=True, fastmath=True, error_model="numpy")
def collapse(c: AnyArray, row: AnyArray, az: int, ay: int, wz: AnyArray, dz: AnyArray, wy: AnyArray, dy: AnyArray) -> None:
    """Fill row (3, n, 3) with coefficients along x in a line of voxels, and with their derivatives along y and z."""
    row[:] = F(0)
    for a in range(4):
        for b in range(4):
            w, w_y, w_z = wz[a] * wy[b], wz[a] * dy[b], dz[a] * wy[b]
            for i in range(c.shape[2]):
                for k in range(3):
                    v = c[az + a, ay + b, i, k]
                    row[0, i, k] += w * v
                    row[1, i, k] += w_y * v
                    row[2, i, k] += w_z * v


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def warp_voxels(
    c: AnyArray, runs: IntArray, cells: Any, weights: Any, derivatives: Any, low: AnyArray, per_mm: AnyArray, image: AnyArray,
    given: AnyArray,    value: AnyArray, reference_gradient: AnyArray, gradient: AnyArray, displacement: AnyArray,
) -> None:  # fmt: skip
    """Fill displacement, intensity and intensity gradients of the listed voxels.

    c (NZ, NY, NX, 3) mm; runs (m, 5): z, y, first x, x after the last, number in the list; cells, weights, derivatives along x, y, z;
    low (3,) index of the first voxel; image: coefficients of the deformed volume; given (n, 3): gradient of the reference, per mm.
    value (n,); reference_gradient (n, 3): that gradient pushed forward, per mm; gradient (n, 3): of the deformed volume, per mm;
    displacement (n, 3), mm.
    """
    nz, ny, nx = image.shape[0] - 3, image.shape[1] - 3, image.shape[2] - 3
    for r in prange(len(runs)):
        z, y, x0, x1, p0 = runs[r, 0], runs[r, 1], runs[r, 2], runs[r, 3], runs[r, 4]
        row = np.empty((3, c.shape[2], 3), F)
        collapse(c, row, cells[2][z], cells[1][y], weights[2][z], derivatives[2][z], weights[1][y], derivatives[1][y])
        u, j = np.empty(3, F), np.empty((3, 3), F)
        for x in range(x0, x1):
            p, t = p0 + x - x0, cells[0][x]
            for k in range(3):
                u[k] = F(0)
                j[k] = F(0)
                for a in range(4):
                    w = weights[0][x, a]
                    u[k] += w * row[0, t + a, k]
                    j[k, 0] += derivatives[0][x, a] * row[0, t + a, k]
                    j[k, 1] += w * row[1, t + a, k]
                    j[k, 2] += w * row[2, t + a, k]
                j[k, k] += F(1)
                displacement[p, k] = u[k]
            px, py, pz = low[0] + x + u[0] * per_mm[0], low[1] + y + u[1] * per_mm[1], low[2] + z + u[2] * per_mm[2]
            if px >= 0 and py >= 0 and pz >= 0 and px <= nx - 1 and py <= ny - 1 and pz <= nz - 1:
                v, a_, b_, c_ = spline_value(image, px, py, pz)
                value[p] = v
                gradient[p, 0], gradient[p, 1], gradient[p, 2] = a_ * per_mm[0], b_ * per_mm[1], c_ * per_mm[2]
                pushed_forward(j, given[p], reference_gradient[p])
            else:
                value[p] = F(OUTSIDE)
                gradient[p] = F(0)
                reference_gradient[p] = F(0)


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def weighted_residuals(
    intensity: AnyArray, value: AnyArray, gain: AnyArray, offset: AnyArray, reference_gradient: AnyArray, gradient: AnyArray,
    scalars: AnyArray,    products: AnyArray, force: AnyArray, weight: AnyArray, residual: AnyArray, agreement: AnyArray,
) -> None:  # fmt: skip
    """Fill residual, weight, weighted products of gradients (n, 6: xx xy xz yy yz zz) and force (n, 3) of the listed voxels.

    scalars: precision of the residual; variance of the sub-voxel jitter, mm^2; 1 / (residual, in residual SD, where the robust weight is
    1/4)^2; fraction of the gradient that is taken from the reference. gradient (n, 3) is replaced by the one that was used. agreement
    (n, 12): symmetric products xx xy xz yy yz zz of both gradients, to which noise does not contribute on average, and of the one that was
    used with itself, both times the weight. The robust weight is that of :cite:t:`geman1987`.
    """
    precision, jitter, robust, fraction = scalars[0], scalars[1], scalars[2], scalars[3]
    for p in prange(len(intensity)):
        if value[p] < F(0.9 * OUTSIDE):
            products[p] = F(0)
            force[p] = F(0)
            weight[p] = F(0)
            residual[p] = F(0)
            agreement[p] = F(0)
            continue
        r = intensity[p] - gain[p] * value[p] - offset[p]
        residual[p] = r
        rest = (F(1) - fraction) * gain[p]
        fx, fy, fz = reference_gradient[p, 0], reference_gradient[p, 1], reference_gradient[p, 2]
        both = gain[p] * (fx * gradient[p, 0] + fy * gradient[p, 1] + fz * gradient[p, 2])
        x, y, z = fraction * fx + rest * gradient[p, 0], fraction * fy + rest * gradient[p, 1], fraction * fz + rest * gradient[p, 2]
        iv = precision / (F(1) + precision * jitter * max(F(0), both))
        q = F(1) / (F(1) + r * r * iv * robust)
        w = iv * q * q
        weight[p] = w
        dx, dy, dz = w * gain[p] * gradient[p, 0], w * gain[p] * gradient[p, 1], w * gain[p] * gradient[p, 2]
        agreement[p, 0], agreement[p, 3], agreement[p, 5] = fx * dx, fy * dy, fz * dz
        agreement[p, 1], agreement[p, 2] = F(0.5) * (fx * dy + fy * dx), F(0.5) * (fx * dz + fz * dx)
        agreement[p, 4] = F(0.5) * (fy * dz + fz * dy)
        agreement[p, 6], agreement[p, 7], agreement[p, 8] = w * x * x, w * x * y, w * x * z
        agreement[p, 9], agreement[p, 10], agreement[p, 11] = w * y * y, w * y * z, w * z * z
        gradient[p, 0], gradient[p, 1], gradient[p, 2] = x, y, z
        force[p, 0], force[p, 1], force[p, 2] = w * r * x, w * r * y, w * r * z
        products[p, 0], products[p, 1], products[p, 2] = w * x * x, w * x * y, w * x * z
        products[p, 3], products[p, 4], products[p, 5] = w * y * y, w * y * z, w * z * z


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def shrink_gradients(
    reliability: AnyArray, cell: IntArray, weight: AnyArray, residual: AnyArray, gradient: AnyArray, products: AnyArray, force: AnyArray
) -> None:
    """Multiply gradients (n, 3) by the reliability (m, 3, 3) of their cell (n,), and renew weighted products (n, 6) and force (n, 3)."""
    for p in prange(len(weight)):
        w, r, m = weight[p], residual[p], reliability[cell[p]]
        gx, gy, gz = gradient[p, 0], gradient[p, 1], gradient[p, 2]
        x = m[0, 0] * gx + m[0, 1] * gy + m[0, 2] * gz
        y = m[1, 0] * gx + m[1, 1] * gy + m[1, 2] * gz
        z = m[2, 0] * gx + m[2, 1] * gy + m[2, 2] * gz
        gradient[p, 0], gradient[p, 1], gradient[p, 2] = x, y, z
        force[p, 0], force[p, 1], force[p, 2] = w * r * x, w * r * y, w * r * z
        products[p, 0], products[p, 1], products[p, 2] = w * x * x, w * x * y, w * x * z
        products[p, 3], products[p, 4], products[p, 5] = w * y * y, w * y * z, w * z * z


@njit(cache=True)
def add_to_cells(cell: IntArray, values: AnyArray, sums: AnyArray) -> None:
    """Add values (n, k) of voxels to the sums (m, k) of their cells (n,)."""
    for p in range(len(cell)):
        for k in range(values.shape[1]):
            sums[cell[p], k] += values[p, k]


@njit(cache=True, inline="always")
def _corners(x: Any, y: Any, z: Any, low: AnyArray, step: AnyArray, n: IntArray, ids: IntArray, w: AnyArray) -> None:
    px, py, pz = (x - low[0]) / step[0], (y - low[1]) / step[1], (z - low[2]) / step[2]
    i, j, k = max(min(int(px), n[0] - 2), 0), max(min(int(py), n[1] - 2), 0), max(min(int(pz), n[2] - 2), 0)
    fx, fy, fz = px - i, py - j, pz - k
    for q in range(8):
        a, b, c = q & 1, (q >> 1) & 1, q >> 2
        ids[q] = ((k + c) * n[1] + j + b) * n[0] + i + a
        w[q] = (fx if a else 1 - fx) * (fy if b else 1 - fy) * (fz if c else 1 - fz)


@njit(cache=True, fastmath=True, error_model="numpy")
def _add_line(sums: AnyArray, i: int, y: Any, z: Any, low: AnyArray, step: AnyArray, n: IntArray, left: AnyArray, right: AnyArray) -> None:
    """Add the sums (15,) over voxels of a line in cell i along x to the normal equations, and clear them.

    Weighted squares of the value, values, and ones, for the pairs of the two weights along x; then for each of these weights products of
    value and intensity, intensities, and their squares.
    """
    py, pz = (y - low[1]) / step[1], (z - low[2]) / step[2]
    j, k = max(min(int(py), n[1] - 2), 0), max(min(int(pz), n[2] - 2), 0)
    fy, fz = py - j, pz - k
    for q in range(4):
        wq = (fy if q & 1 else 1 - fy) * (fz if q >> 1 else 1 - fz)
        node = ((k + (q >> 1)) * n[1] + j + (q & 1)) * n[0] + i
        row = 2 * node
        for a in range(2):
            for b in range(3):
                right[node + a, b] += wq * sums[9 + 3 * a + b]
            for r in range(4):
                w = wq * (fy if r & 1 else 1 - fy) * (fz if r >> 1 else 1 - fz)
                column = 2 * (((k + (r >> 1)) * n[1] + j + (r & 1)) * n[0] + i)
                for b in range(2):
                    s = 3 * (a + b)
                    left[row + 2 * a, column + 2 * b] += w * sums[s]
                    left[row + 2 * a, column + 2 * b + 1] += w * sums[s + 1]
                    left[row + 2 * a + 1, column + 2 * b] += w * sums[s + 1]
                    left[row + 2 * a + 1, column + 2 * b + 1] += w * sums[s + 2]
    for b in range(15):
        sums[b] = 0.0


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def gain_normal_equations(
    intensity: AnyArray,
    value: AnyArray,
    weight: AnyArray,
    index: AnyArray,
    low: AnyArray,
    step: AnyArray,
    n: IntArray,
    left: AnyArray,
    right: AnyArray,
) -> None:
    """Add the normal equations of ``intensity = gain value + offset``, trilinear on a lattice, to left and right, one for each thread.

    Voxels are listed along lines, over which sums are taken before they go to the corners of a cell of the lattice. left (t, 2 k, 2 k) is
    their matrix; right (t, k, 3) are sums of value times intensity, intensity, and squared intensity.
    """
    parts = len(left)
    for t in prange(parts):
        # not a literal, for which `_add_line` would be compiled once more
        sums, i, y, z = np.zeros(15), np.int64(0), F(0), F(0)
        for p in range(t * len(intensity) // parts, (t + 1) * len(intensity) // parts):
            if value[p] < F(0.9 * OUTSIDE) or weight[p] <= 0:
                continue
            px = (index[p, 0] - low[0]) / step[0]
            here = max(min(int(px), n[0] - 2), 0)
            if here != i or index[p, 1] != y or index[p, 2] != z:
                _add_line(sums, i, y, z, low, step, n, left[t], right[t])
                i, y, z = here, index[p, 1], index[p, 2]
            f, g, w = px - i, float(value[p]), float(weight[p])
            w0, w1 = w * (1 - f), w * f
            w00, w01, w11 = w0 * (1 - f), w0 * f, w1 * f
            sums[0] += w00 * g * g
            sums[1] += w00 * g
            sums[2] += w00
            sums[3] += w01 * g * g
            sums[4] += w01 * g
            sums[5] += w01
            sums[6] += w11 * g * g
            sums[7] += w11 * g
            sums[8] += w11
            t0, t1 = w0 * intensity[p], w1 * intensity[p]
            sums[9] += t0 * g
            sums[10] += t0
            sums[11] += t0 * intensity[p]
            sums[12] += t1 * g
            sums[13] += t1
            sums[14] += t1 * intensity[p]
        _add_line(sums, i, y, z, low, step, n, left[t], right[t])


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def gain_values(solution: AnyArray, index: AnyArray, low: AnyArray, step: AnyArray, n: IntArray, gain: AnyArray, offset: AnyArray) -> None:
    """Fill gain and offset (n,) at voxels from their values on the lattice."""
    for p in prange(len(index)):
        ids, w8 = np.empty(8, np.int64), np.empty(8)
        _corners(index[p, 0], index[p, 1], index[p, 2], low, step, n, ids, w8)
        a, b = 0.0, 0.0
        for q in range(8):
            a += w8[q] * solution[2 * ids[q]]
            b += w8[q] * solution[2 * ids[q] + 1]
        gain[p], offset[p] = a, b
