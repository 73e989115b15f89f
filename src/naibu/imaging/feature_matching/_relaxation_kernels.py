# mypy: disallow-untyped-decorators=False
"""Numba kernels for `naibu.imaging.feature_matching.relaxation_labelling` :cite:p:`zhang1995,hirai2008` (chapter 1).

Strength of match of every candidate pair, and mutual best pairs.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray, IntArray

CHEN, RESIDUAL, DIRECTION, DIRECTION26 = range(4)
STILL = 1e-9  # displacements shorter than this, mm, have no direction


@njit(cache=True)
def mutual_best(pairs: IntArray, values: AnyArray, n_first: int, n_second: int) -> IntArray:
    """Return the indices of the pairs that are the best of both their points."""
    best_first, best_second = np.full(n_first, -1), np.full(n_second, -1)
    for p in range(len(pairs)):
        i, j = pairs[p, 0], pairs[p, 1]
        if best_first[i] < 0 or values[p] > values[best_first[i]]:
            best_first[i] = p
        if best_second[j] < 0 or values[p] > values[best_second[j]]:
            best_second[j] = p
    out = np.empty(n_first, dtype=np.int64)
    n = 0
    for i in range(n_first):
        p = best_first[i]
        if p >= 0 and best_second[pairs[p, 1]] == p:
            out[n] = p
            n += 1
    return out[:n]


@njit(cache=True)
def _angle_class(a: AnyArray, b: AnyArray) -> int:
    """Return 0 for equal directions, 1, 2, 3 for angles below, equal to and above 90 degrees, of vectors of whole numbers."""
    dot, same = 0, True
    for c in range(3):
        dot += a[c] * b[c]
        same &= a[c] == b[c]
    if same:
        return 0
    return 1 if dot > 0 else (2 if dot == 0 else 3)


@njit(cache=True)
def _cosine(a: AnyArray, b: AnyArray) -> float:
    ab, aa, bb = 0.0, 0.0, 0.0
    for c in range(3):
        ab += a[c] * b[c]
        aa += a[c] * a[c]
        bb += b[c] * b[c]
    if aa < STILL * STILL and bb < STILL * STILL:
        return 1.0
    if aa < STILL * STILL or bb < STILL * STILL:
        return 0.0
    return float(min(max(ab / np.sqrt(aa * bb), -1.0), 1.0))


@njit(cache=True)
def _weight(kind: int, difference: float, tolerance: float, p: int, q: int, moves: AnyArray, states: IntArray) -> float:
    """Return the weight, without its correlation, of the support of a neighbour pair q for a pair p."""
    if kind == CHEN:
        return float(np.exp(-difference / tolerance)) if difference < tolerance else 0.0
    if kind == DIRECTION:
        cosine = _cosine(moves[p], moves[q])
        return float(np.exp(-(1.0 + 1.0 / (1.0 + cosine)) * (1.0 + difference))) if cosine > -1.0 else 0.0
    if kind == DIRECTION26:
        order = _angle_class(states[p], states[q]) / 3.0
        return float(np.exp(-difference) if order == 0.0 else np.exp(-order * difference))
    return float(1.0 / (1.0 + difference))


@njit(cache=True)
def strengths(
    kind: int,
    alpha: float,
    tolerance: float,
    pairs: IntArray,
    scores: AnyArray,
    residuals: AnyArray,
    first: AnyArray,
    second: AnyArray,
    moves: AnyArray,
    states: IntArray,
    start: IntArray,
    near: IntArray,
    match_of: IntArray,
    radius: float,
    out: AnyArray,
) -> None:
    """Fill out (c,) with the strength of match of every pair.

    `near[start[i]:start[i + 1]]` are the reference points about point i; `match_of` is the potential match of a reference point, or -1.
    Neighbours whose relative difference of distances exceeds `tolerance` give no support for the kind `CHEN`.
    """
    most = 0
    for i in range(len(start) - 1):
        most = max(most, start[i + 1] - start[i])
    who, weights = np.empty(most, dtype=np.int64), np.empty(most)
    for p in range(len(pairs)):
        i, j = pairs[p, 0], pairs[p, 1]
        n = 0
        for at in range(start[i], start[i + 1]):
            k = near[at]
            q = match_of[k]
            if k == i or q < 0 or pairs[q, 1] == j:
                continue
            d1, d2 = 0.0, 0.0
            for c in range(3):
                d1 += (first[i, c] - first[k, c]) ** 2
                d2 += (second[j, c] - second[pairs[q, 1], c]) ** 2
            if d2 > radius * radius or d1 == 0.0:
                continue
            d1, d2 = np.sqrt(d1), np.sqrt(d2)
            who[n], weights[n] = q, _weight(kind, 2.0 * abs(d1 - d2) / (d1 + d2), tolerance, p, q, moves, states)
            n += 1
        if kind == RESIDUAL:
            _apportion(residuals, who, weights, n)
        support = 0.0
        for s in range(n):
            support += scores[who[s]] * weights[s]
        out[p] = scores[p] + (support if kind == DIRECTION else alpha * support)


@njit(cache=True)
def _apportion(residuals: AnyArray, who: IntArray, weights: AnyArray, n: int) -> None:
    """Multiply weights by the Gibbs distribution, of sum one, of the residuals of the neighbour pairs."""
    if n == 0:
        return
    mean = 0.0
    for s in range(n):
        mean += residuals[who[s]] / n
    least = np.inf
    for s in range(n):
        zeta = residuals[who[s]]
        least = min(least, (zeta - mean) ** 2 * zeta)
    total = 0.0
    for s in range(n):
        zeta = residuals[who[s]]
        total += np.exp(least - (zeta - mean) ** 2 * zeta)
    for s in range(n):
        zeta = residuals[who[s]]
        weights[s] *= np.exp(least - (zeta - mean) ** 2 * zeta) / total
