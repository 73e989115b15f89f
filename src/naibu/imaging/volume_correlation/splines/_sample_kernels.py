# mypy: disallow-untyped-decorators=False
"""Numba kernels of several right sides at once, for random samples of the error of digital volume correlation.

Right sides lie next to each other, `WIDTH` of them in a vector.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu._numba.intrinsics.simd import WIDTH, load, splat, store
from naibu.core.arrays import AnyArray
from naibu.imaging.volume_correlation.splines._spline_kernels import CHUNKS, add_scaled, clear, scatter

F = np.float32


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def products_of_many(big: AnyArray, neighbours: AnyArray, x: AnyArray, y: AnyArray) -> None:
    """Fill y (n, 3, s) with A x of s vectors at once, s a multiple of `WIDTH`; x (n + 1, 3, s) ends in zeros."""
    n, samples = big.shape[0], x.shape[2]
    flat = x.reshape(x.size)
    for t in prange(CHUNKS):
        for p in range(t * n // CHUNKS, (t + 1) * n // CHUNKS):
            sums = y[p].reshape(3 * samples)
            first = np.int64(0)
            while first + 2 * WIDTH <= samples:
                _two_columns(big[p], neighbours[p], flat, samples, first, sums)
                first += 2 * WIDTH
            if first < samples:
                _one_column(big[p], neighbours[p], flat, samples, first, sums)


@njit(cache=True, fastmath=True, error_model="numpy")
def _two_columns(rows: AnyArray, neighbours: AnyArray, x: AnyArray, samples: int, first: int, sums: AnyArray) -> None:
    """Fill 2 `WIDTH` numbers of each third of sums (3 s,) with the products of three rows (3, 1029); x is flat."""
    zero = splat(F(0))
    a0, a1, a2, b0, b1, b2 = zero, zero, zero, zero, zero, zero
    for o in range(len(neighbours)):
        at = 3 * samples * neighbours[o] + first
        for j in range(3):
            u, v = load(x, at), load(x, at + WIDTH)
            r0, r1, r2 = splat(rows[0, 3 * o + j]), splat(rows[1, 3 * o + j]), splat(rows[2, 3 * o + j])
            a0, a1, a2 = a0 + r0 * u, a1 + r1 * u, a2 + r2 * u
            b0, b1, b2 = b0 + r0 * v, b1 + r1 * v, b2 + r2 * v
            at += samples
    store(sums, first, a0)
    store(sums, first + WIDTH, b0)
    store(sums, samples + first, a1)
    store(sums, samples + first + WIDTH, b1)
    store(sums, 2 * samples + first, a2)
    store(sums, 2 * samples + first + WIDTH, b2)


@njit(cache=True, fastmath=True, error_model="numpy")
def _one_column(rows: AnyArray, neighbours: AnyArray, x: AnyArray, samples: int, first: int, sums: AnyArray) -> None:
    """Do what `_two_columns` does, for `WIDTH` numbers."""
    zero = splat(F(0))
    a0, a1, a2 = zero, zero, zero
    for o in range(len(neighbours)):
        at = 3 * samples * neighbours[o] + first
        for j in range(3):
            u = load(x, at)
            a0, a1, a2 = a0 + splat(rows[0, 3 * o + j]) * u, a1 + splat(rows[1, 3 * o + j]) * u, a2 + splat(rows[2, 3 * o + j]) * u
            at += samples
    store(sums, first, a0)
    store(sums, samples + first, a1)
    store(sums, 2 * samples + first, a2)


@njit(cache=True, fastmath=True, error_model="numpy")
def _random_line(
    sensitivity: AnyArray, random: AnyArray, which: AnyArray, z: int, y: int, box: AnyArray, wx: AnyArray, f1: AnyArray
) -> bool:
    """Fill f1 (12 WIDTH,) with the sums over a line of voxels of weights times sensitivity times random numbers."""
    found = False
    zero = splat(F(0))
    x0, y0, z0, x1, y1, z1 = zero, zero, zero, zero, zero, zero
    x2, y2, z2, x3, y3, z3 = zero, zero, zero, zero, zero, zero
    for x in range(box[0], box[1]):
        p = which[z, y, x]
        if p < 0:
            continue
        found = True
        r = load(random, WIDTH * p)
        u, v, w = r * splat(sensitivity[p, 0]), r * splat(sensitivity[p, 1]), r * splat(sensitivity[p, 2])
        w0, w1, w2, w3 = splat(wx[x, 0]), splat(wx[x, 1]), splat(wx[x, 2]), splat(wx[x, 3])
        x0, y0, z0 = x0 + w0 * u, y0 + w0 * v, z0 + w0 * w
        x1, y1, z1 = x1 + w1 * u, y1 + w1 * v, z1 + w1 * w
        x2, y2, z2 = x2 + w2 * u, y2 + w2 * v, z2 + w2 * w
        x3, y3, z3 = x3 + w3 * u, y3 + w3 * v, z3 + w3 * w
    store(f1, 0, x0)
    store(f1, WIDTH, y0)
    store(f1, 2 * WIDTH, z0)
    store(f1, 3 * WIDTH, x1)
    store(f1, 4 * WIDTH, y1)
    store(f1, 5 * WIDTH, z1)
    store(f1, 6 * WIDTH, x2)
    store(f1, 7 * WIDTH, y2)
    store(f1, 8 * WIDTH, z2)
    store(f1, 9 * WIDTH, x3)
    store(f1, 10 * WIDTH, y3)
    store(f1, 11 * WIDTH, z3)
    return found


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def add_random_forces(
    loads: AnyArray,
    tasks: AnyArray,
    cells: AnyArray,
    slot: AnyArray,
    sensitivity: AnyArray,
    random: AnyArray,
    which: AnyArray,
    starts: Any,
    weights: Any,
) -> None:
    """Add the loads of forces ``sensitivity[p] * random[p]`` to loads (n, 3 WIDTH); sensitivity (voxels, 3), random (voxels, WIDTH)."""
    flat = random.reshape(random.size)
    for colour in range(len(tasks) - 1):
        for task in prange(tasks[colour], tasks[colour + 1]):
            f1, f2 = np.empty(12 * WIDTH, F), np.empty((4, 12 * WIDTH), F)
            sums, box = np.empty((4, 48 * WIDTH), F), np.empty(6, np.int64)
            for m in range(cells[task, 0], cells[task, 1]):
                cell = cells[m]
                for a in range(3):
                    box[2 * a], box[2 * a + 1] = starts[a][cell[4 - a]], starts[a][cell[4 - a] + 1]
                clear(sums)
                for z in range(box[4], box[5]):
                    clear(f2)
                    for y in range(box[2], box[3]):
                        if _random_line(sensitivity, flat, which, z, y, box, weights[0], f1):
                            for a in range(4):
                                add_scaled(weights[1][y, a], f1, f2[a])
                    for a in range(4):
                        add_scaled(weights[2][z, a], f2.reshape(48 * WIDTH), sums[a])
                scatter(sums.reshape(64, 3 * WIDTH), cell, slot, loads)
