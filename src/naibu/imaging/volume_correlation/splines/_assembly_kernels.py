# mypy: disallow-untyped-decorators=False
"""Numba kernels that assemble the normal equations of digital volume correlation on a grid of cubic B-splines :cite:p:`unser1999`.

Sums over voxels are taken along x first, then along y, then along z: a cell needs them for all pairs of its 64 splines, which are products
of ten pairs along every axis. Arrays are flat and padded so that vectors of `WIDTH` numbers are whole.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu._numba.intrinsics.simd import WIDTH, load, splat, store, total
from naibu.core.arrays import AnyArray
from naibu.imaging.volume_correlation.splines._spline_kernels import clear, cofactor, gather

F = np.float32
ALONG = 16  # numbers of a voxel along x: ten pairs of weights, the four weights, and two zeros
PRODUCTS, LINE = 6, 64  # products of gradients; sums of a line over products and pairs, of which the last four are none
SLICE, CELL = 10 * LINE, 100 * LINE  # sums of a slice and of a cell
LINE_FORCE, SLICE_FORCE = 3 * 8, 12 * 8  # sums of forces: three components of a half of `ALONG`, in which the weights stand from the third
WEIGHT = 2  # place of the first weight in that half


@njit(cache=True, fastmath=True, error_model="numpy")
def _line(
    products: AnyArray, force: AnyArray, which: AnyArray, z: int, y: int, box: AnyArray, along: AnyArray, rest: AnyArray, m1: AnyArray,
    f1: AnyArray,
) -> bool:  # fmt: skip
    """Fill m1 with the sums over a line of voxels of pairs of weights times products, and f1 with those of weights times forces.

    In m1 eight pairs stand together for each product, and then the other two, whose vectors `rest` holds in between.
    """
    found = False
    for x in range(box[0], box[1]):
        found = found or which[z, y, x] >= 0
    if not found:
        return False
    zero = splat(F(0))
    for o in range(0, 8, WIDTH):
        a0, a1, a2, a3, a4, a5 = zero, zero, zero, zero, zero, zero
        b0, b1, b2, b3, b4, b5 = zero, zero, zero, zero, zero, zero
        f, g, h = zero, zero, zero
        for x in range(box[0], box[1]):
            p = which[z, y, x]
            if p < 0:
                continue
            u, v = load(along, ALONG * x + o), load(along, ALONG * x + 8 + o)
            p0, p1, p2 = splat(products[p, 0]), splat(products[p, 1]), splat(products[p, 2])
            a0, a1, a2, b0, b1, b2 = a0 + p0 * u, a1 + p1 * u, a2 + p2 * u, b0 + p0 * v, b1 + p1 * v, b2 + p2 * v
            p0, p1, p2 = splat(products[p, 3]), splat(products[p, 4]), splat(products[p, 5])
            a3, a4, a5, b3, b4, b5 = a3 + p0 * u, a4 + p1 * u, a5 + p2 * u, b3 + p0 * v, b4 + p1 * v, b5 + p2 * v
            f, g, h = f + splat(force[p, 0]) * v, g + splat(force[p, 1]) * v, h + splat(force[p, 2]) * v
        store(m1, o, a0)
        store(m1, 8 + o, a1)
        store(m1, 16 + o, a2)
        store(m1, 24 + o, a3)
        store(m1, 32 + o, a4)
        store(m1, 40 + o, a5)
        store(rest, o, b0)
        store(rest, 8 + o, b1)
        store(rest, 16 + o, b2)
        store(rest, 24 + o, b3)
        store(rest, 32 + o, b4)
        store(rest, 40 + o, b5)
        store(f1, o, f)
        store(f1, 8 + o, g)
        store(f1, 16 + o, h)
    for k in range(PRODUCTS):
        m1[48 + k], m1[48 + PRODUCTS + k] = rest[8 * k], rest[8 * k + 1]
    return True


@njit(cache=True, fastmath=True, error_model="numpy")
def _add_vectors(w: Any, x: AnyArray, size: int, y: AnyArray, first: int) -> None:
    """Add w x to `size` numbers of y from the first."""
    factor = splat(w)
    for o in range(0, size, WIDTH):
        store(y, first + o, load(y, first + o) + factor * load(x, o))


@njit(cache=True, fastmath=True, error_model="numpy")
def _moments(
    products: AnyArray,
    force: AnyArray,
    which: AnyArray,
    box: AnyArray,
    along: AnyArray,
    wy: AnyArray,
    wz: AnyArray,
    m1: AnyArray,
    m2: AnyArray,
    m3: AnyArray,
    loads: AnyArray,
) -> bool:
    """Fill m3 with the sums over the voxels of a cell of pairs of weights times products; add forces to loads (64, 3).

    m1 and m2 are work space. Pairs along z, y stand in m3 as `_line` leaves those along x.
    """
    rest, f1, f2 = np.empty(48, F), np.empty(LINE_FORCE, F), np.empty(4 * LINE_FORCE, F)
    found = False
    clear(m3)
    for z in range(box[4], box[5]):
        clear(m2)
        clear(f2)
        in_slice = False
        for y in range(box[2], box[3]):
            if not _line(products, force, which, z, y, box, along, rest, m1, f1):
                continue
            in_slice = True
            m = 0
            for a in range(4):
                for b in range(a, 4):
                    _add_vectors(wy[y, a] * wy[y, b], m1, LINE, m2, LINE * m)
                    m += 1
                _add_vectors(wy[y, a], f1, LINE_FORCE, f2, LINE_FORCE * a)
        if not in_slice:
            continue
        found = True
        m = 0
        for a in range(4):
            for b in range(a, 4):
                _add_vectors(wz[z, a] * wz[z, b], m2, SLICE, m3, SLICE * m)
                m += 1
            for c in range(4):
                for d in range(4):
                    for k in range(3):
                        loads[16 * a + 4 * c + d, k] += wz[z, a] * f2[LINE_FORCE * c + 8 * k + WEIGHT + d]
    return found


@njit(cache=True, fastmath=True, error_model="numpy")
def _dilatation_gradients(
    local: AnyArray, gradients: AnyArray, ratio: Any, weight: Any, loads: AnyArray, v: AnyArray, cof: AnyArray
) -> Any:
    """Fill v (8 * 192,) with the derivatives of det(I + grad u) at the Gauss points times sqrt(weight), and add to loads (64, 3).

    Returns the sum of (J - ratio)^2, twice the penalty per unit weight.
    """
    square, root = F(0), F(np.sqrt(weight))
    for q in range(gradients.shape[0]):
        e = cofactor(local, gradients, q, cof) - ratio
        square += e * e
        for a in range(64):
            for i in range(3):
                t = root * (cof[i, 0] * gradients[q, 0, a] + cof[i, 1] * gradients[q, 1, a] + cof[i, 2] * gradients[q, 2, a])
                v[192 * q + 3 * a + i] = t
                loads[a, i] -= root * t * e
    return square


@njit(cache=True, fastmath=True, error_model="numpy")
def _add_bending(local: AnyArray, stiffness: AnyArray, weight: AnyArray, loads: AnyArray, energy: AnyArray) -> None:
    """Add the forces of the bending penalty to the loads of a cell, and fill energy (3,), twice the penalty per unit weight.

    stiffness (64 * 64,) is flat.
    """
    turned, zero = np.empty(192, F), splat(F(0))
    for a in range(64):
        turned[a], turned[64 + a], turned[128 + a] = local[a, 0], local[a, 1], local[a, 2]
    clear(energy)
    for a in range(64):
        s0, s1, s2 = zero, zero, zero
        for o in range(0, 64, WIDTH):
            k = load(stiffness, 64 * a + o)
            s0, s1, s2 = s0 + k * load(turned, o), s1 + k * load(turned, 64 + o), s2 + k * load(turned, 128 + o)
        t0, t1, t2 = total(s0), total(s1), total(s2)
        loads[a, 0] -= weight[0] * t0
        loads[a, 1] -= weight[1] * t1
        loads[a, 2] -= weight[2] * t2
        energy[0] += local[a, 0] * t0
        energy[1] += local[a, 1] * t1
        energy[2] += local[a, 2] * t2


@njit(cache=True, fastmath=True, error_model="numpy")
def _row(a: int, stiffness: AnyArray, weight: AnyArray, m3: AnyArray, pairs: AnyArray, with_data: bool, row: AnyArray) -> None:
    """Fill row (3 * 192,) with the matrix of intensities and bending of a cell for its coefficient a.

    pairs (64, 64, 2): where the products of a pair of splines begin in m3, and how far they are apart.
    """
    for b in range(64):
        k = stiffness[64 * a + b]
        k0, k1, k2 = weight[0] * k, weight[1] * k, weight[2] * k
        if with_data:
            q, s = pairs[a, b, 0], pairs[a, b, 1]
            xx, xy, xz, yy, yz, zz = m3[q], m3[q + s], m3[q + 2 * s], m3[q + 3 * s], m3[q + 4 * s], m3[q + 5 * s]
            row[3 * b], row[3 * b + 1], row[3 * b + 2] = k0 + xx, xy, xz
            row[192 + 3 * b], row[193 + 3 * b], row[194 + 3 * b] = xy, k1 + yy, yz
            row[384 + 3 * b], row[385 + 3 * b], row[386 + 3 * b] = xz, yz, k2 + zz
        else:
            row[3 * b], row[3 * b + 1], row[3 * b + 2] = k0, F(0), F(0)
            row[192 + 3 * b], row[193 + 3 * b], row[194 + 3 * b] = F(0), k1, F(0)
            row[384 + 3 * b], row[385 + 3 * b], row[386 + 3 * b] = F(0), F(0), k2


@njit(cache=True, fastmath=True, error_model="numpy")
def _add_dilatation_to_row(a: int, v: AnyArray, row: AnyArray) -> None:
    """Add the products of the gradients v (8 * 192,) to the row (3 * 192,) of coefficient a."""
    for i in range(3):
        k = 3 * a + i
        t0, t1, t2, t3 = splat(v[k]), splat(v[192 + k]), splat(v[384 + k]), splat(v[576 + k])
        t4, t5, t6, t7 = splat(v[768 + k]), splat(v[960 + k]), splat(v[1152 + k]), splat(v[1344 + k])
        for o in range(0, 192, WIDTH):
            first = t0 * load(v, o) + t1 * load(v, 192 + o) + t2 * load(v, 384 + o) + t3 * load(v, 576 + o)
            last = t4 * load(v, 768 + o) + t5 * load(v, 960 + o) + t6 * load(v, 1152 + o) + t7 * load(v, 1344 + o)
            store(row, 192 * i + o, load(row, 192 * i + o) + (first + last))


@njit(cache=True, fastmath=True, error_model="numpy")
def _scatter_row(a: int, n: int, row: AnyArray, big: AnyArray) -> None:
    """Add the row (3 * 192,) of coefficient a of a cell, whose node is n, to the matrix, which is flat."""
    az, ay, ax = a >> 4, (a >> 2) & 3, a & 3
    for i in range(3):
        for b in range(16):
            at = 1029 * (3 * n + i) + 3 * (((b >> 2) - az + 3) * 49 + ((b & 3) - ay + 3) * 7 + (3 - ax))
            k = 192 * i + 12 * b
            for o in range(0, 8, WIDTH):
                store(big, at + o, load(big, at + o) + load(row, k + o))
            big[at + 8] += row[k + 8]
            big[at + 9] += row[k + 9]
            big[at + 10] += row[k + 10]
            big[at + 11] += row[k + 11]


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def assemble(
    big: AnyArray,
    right: AnyArray,
    tasks: AnyArray,
    cells: AnyArray,
    slot: AnyArray,
    c: AnyArray,
    products: AnyArray,
    force: AnyArray,
    which: AnyArray,
    starts: Any,
    along: AnyArray,
    weights: Any,
    bending: AnyArray,
    stiffness: AnyArray,
    dilatation: AnyArray,
    gradients: AnyArray,
    ratio: float,
    pairs: AnyArray,
    bending_energy: AnyArray,
    dilatation_energy: AnyArray,
) -> None:
    """Add intensity data, bending and dilatation of all cells to big and right; fill bending_energy (m, 3) and dilatation_energy (m,)."""
    flat, rigidity = big.reshape(big.size), stiffness.reshape(stiffness.size)
    for colour in range(len(tasks) - 1):
        for task in prange(tasks[colour], tasks[colour + 1]):
            m1, m2, m3, v, row = np.zeros(LINE, F), np.empty(SLICE, F), np.empty(CELL, F), np.empty(8 * 192, F), np.empty(3 * 192, F)
            loads, local, cof, box = np.empty((64, 3), F), np.empty((64, 3), F), np.empty((3, 3), F), np.empty(6, np.int64)
            for m in range(cells[task, 0], cells[task, 1]):
                cell = cells[m]
                for a in range(3):
                    box[2 * a], box[2 * a + 1] = starts[a][cell[4 - a]], starts[a][cell[4 - a] + 1]
                gather(c, cell, local)
                clear(loads)
                found = _moments(products, force, which, box, along, weights[1], weights[2], m1, m2, m3, loads)
                _add_bending(local, rigidity, bending[m], loads, bending_energy[m])
                if dilatation[m] > 0:
                    dilatation_energy[m] = _dilatation_gradients(local, gradients, F(ratio), dilatation[m], loads, v, cof)
                for a in range(64):
                    _row(a, rigidity, bending[m], m3, pairs, found, row)
                    if dilatation[m] > 0:
                        _add_dilatation_to_row(a, v, row)
                    n = slot[cell[2] + (a >> 4), cell[3] + ((a >> 2) & 3), cell[4] + (a & 3)]
                    for i in range(3):
                        right[n, i] += loads[a, i]
                    _scatter_row(a, n, row, flat)
