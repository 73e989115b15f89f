# mypy: disallow-untyped-decorators=False
"""Numba kernels for `naibu.imaging.feature_matching.correlation_matching` :cite:p:`zhang1995`.

Normalised cross-correlation and intensity residual of boxes about pairs of points.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray, IntArray
from naibu.imaging.preprocessing._interpolation_kernels import interpolate


@njit(cache=True)
def candidates(
    points: AnyArray, order: IntArray, sorted_x: AnyArray, others: AnyArray, half: AnyArray, first: IntArray, second: IntArray
) -> int:
    """Fill first and second with the pairs of points (n, 3) and others (m, 3) no further apart than half (n, 3), in order of first.

    `order` sorts the others by x, whose values are `sorted_x`. Returns the number of pairs, which may exceed the room for them.
    """
    n = 0
    for p in range(len(points)):
        at = np.searchsorted(sorted_x, points[p, 0] - half[p, 0])
        while at < len(order) and sorted_x[at] <= points[p, 0] + half[p, 0]:
            q = order[at]
            at += 1
            if abs(others[q, 1] - points[p, 1]) <= half[p, 1] and abs(others[q, 2] - points[p, 2]) <= half[p, 2]:
                if n < len(first):
                    first[n], second[n] = p, q
                n += 1
    return n


@njit(cache=True)
def _box(v: AnyArray, centre: AnyArray, turn: AnyArray, half: IntArray, out: AnyArray) -> bool:
    """Fill out (m,) with the intensities about an index, at offsets rotated by a matrix; return whether all lie inside."""
    nz, ny, nx = v.shape
    straight = True
    for a in range(3):
        straight &= centre[a] == np.floor(centre[a])
        for b in range(3):
            straight &= turn[a, b] == (1.0 if a == b else 0.0)
    n = 0
    if straight:
        x, y, z = int(centre[0]), int(centre[1]), int(centre[2])
        if x < half[0] or y < half[1] or z < half[2] or x + half[0] >= nx or y + half[1] >= ny or z + half[2] >= nz:
            return False
        for k in range(z - half[2], z + half[2] + 1):
            for j in range(y - half[1], y + half[1] + 1):
                for i in range(x - half[0], x + half[0] + 1):
                    out[n] = v[k, j, i]
                    n += 1
        return True
    for k in range(-half[2], half[2] + 1):
        for j in range(-half[1], half[1] + 1):
            for i in range(-half[0], half[0] + 1):
                value = interpolate(
                    v,
                    centre[0] + turn[0, 0] * i + turn[0, 1] * j + turn[0, 2] * k,
                    centre[1] + turn[1, 0] * i + turn[1, 1] * j + turn[1, 2] * k,
                    centre[2] + turn[2, 0] * i + turn[2, 1] * j + turn[2, 2] * k,
                )
                if np.isnan(value):
                    return False
                out[n] = value
                n += 1
    return True


@njit(cache=True, parallel=True)
def compare(
    reference: AnyArray,
    deformed: AnyArray,
    at_reference: AnyArray,
    at_deformed: AnyArray,
    pairs: IntArray,
    half: IntArray,
    turn: AnyArray,
    turn_residual: AnyArray,
    scores: AnyArray,
    residuals: AnyArray,
) -> None:
    """Fill scores (n,) with the normalised cross-correlation of boxes about pairs (n, 2), and residuals with their mean difference.

    The box in the deformed volume is rotated by `turn` for the correlation and by `turn_residual` for the residual; both are NaN where a
    box leaves its volume, and the correlation where a box has no contrast.
    """
    m = (2 * half[0] + 1) * (2 * half[1] + 1) * (2 * half[2] + 1)
    same = True
    for r in range(3):
        for c in range(3):
            same &= turn[r, c] == turn_residual[r, c]
    straight = np.eye(3)
    for p in prange(len(pairs)):
        a, b = np.empty(m), np.empty(m)
        scores[p], residuals[p] = np.nan, np.nan
        if not _box(reference, at_reference[pairs[p, 0]], straight, half, a):
            continue
        if _box(deformed, at_deformed[pairs[p, 1]], turn, half, b):
            scores[p] = _correlation(a, b)
        if same or _box(deformed, at_deformed[pairs[p, 1]], turn_residual, half, b):
            residuals[p] = np.abs(a - b).mean()


@njit(cache=True)
def _correlation(a: AnyArray, b: AnyArray) -> float:
    mean_a, mean_b = a.mean(), b.mean()
    ab, aa, bb = 0.0, 0.0, 0.0
    for i in range(len(a)):
        ab += (a[i] - mean_a) * (b[i] - mean_b)
        aa += (a[i] - mean_a) ** 2
        bb += (b[i] - mean_b) ** 2
    return float(ab / np.sqrt(aa * bb)) if aa > 0.0 and bb > 0.0 else np.nan
