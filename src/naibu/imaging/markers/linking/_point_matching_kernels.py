# mypy: disallow-untyped-decorators=False
"""Numba kernels for `naibu.imaging.markers.linking.point_matching`: nearest points, local affine fits, guesses, and growth of links."""

from __future__ import annotations

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, IntArray

# weight of the prior on a local deformation gradient: that of this many neighbours at a distance of one spacing; empirical
PRIOR = 0.5


@njit(cache=True)
def _cell(points: FloatArray, p: int, origin: FloatArray, width: float, dims: IntArray) -> int:
    number = 0
    for a in range(points.shape[1]):
        at = int((points[p, a] - origin[a]) / width)
        number = number * dims[a] + min(max(at, 0), dims[a] - 1)
    return number


@njit(cache=True)
def fill_grid(points: FloatArray, origin: FloatArray, width: float, dims: IntArray, starts: IntArray, members: IntArray) -> None:
    """Sort points (m, d) into cells: those of cell c are ``members[starts[c] : starts[c + 1]]``; starts has two entries more than cells."""
    m = len(points)
    for p in range(m):
        starts[_cell(points, p, origin, width, dims) + 2] += 1
    for c in range(2, len(starts)):
        starts[c] += starts[c - 1]
    for p in range(m):
        c = _cell(points, p, origin, width, dims) + 1
        members[starts[c]] = p
        starts[c] += 1


@njit(cache=True)
def _nearest(
    points: FloatArray, origin: FloatArray, width: float, dims: IntArray, starts: IntArray, members: IntArray, at: FloatArray, reach: float
) -> tuple[int, float]:
    """Return the point nearest to `at` (d,) and its distance; -1 where there is none within reach, which is at most the width of a cell."""
    d = points.shape[1]
    low, high = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    for a in range(d):
        low[a] = max(int(np.floor((at[a] - reach - origin[a]) / width)), 0)
        high[a] = min(int(np.floor((at[a] + reach - origin[a]) / width)), dims[a] - 1)
    best, found = reach * reach, -1
    for i in range(low[0], high[0] + 1):
        for j in range(low[1], high[1] + 1):
            for k in range(low[2], high[2] + 1):
                c = (i * dims[1] + j) * dims[2] + k if d == 3 else i * dims[1] + j
                for s in range(starts[c], starts[c + 1]):
                    p = members[s]
                    square = 0.0
                    for a in range(d):
                        square += (points[p, a] - at[a]) ** 2
                    if square < best:
                        best, found = square, p
    return found, np.sqrt(best)


@njit(cache=True)
def _solve(matrix: FloatArray, right: FloatArray) -> None:
    """Solve for the columns of `right` in place by Cholesky factorization; of `matrix` the lower triangle is used, and overwritten."""
    n = len(matrix)
    for j in range(n):
        for i in range(j, n):
            left = matrix[i, j]
            for k in range(j):
                left -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(max(left, 1e-300)) if i == j else left / matrix[j, j]
    for c in range(right.shape[1]):
        for i in range(n):
            for k in range(i):
                right[i, c] -= matrix[i, k] * right[k, c]
            right[i, c] /= matrix[i, i]
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                right[i, c] -= matrix[k, i] * right[k, c]
            right[i, c] /= matrix[i, i]


@njit(cache=True)
def _affine(
    x: FloatArray, y: FloatArray, w: FloatArray, count: int, expected: FloatArray, scale: float, value: FloatArray, gradient: FloatArray
) -> None:
    """Fit y = value + gradient x, weighted, with a prior on the gradient; x (c, d) are offsets, y (c, d) positions."""
    d = x.shape[1]
    matrix, right = np.zeros((d + 1, d + 1)), np.zeros((d + 1, d))
    for c in range(count):
        for a in range(d + 1):
            xa = w[c] * (1.0 if a == 0 else x[c, a - 1])
            for b in range(a + 1):
                matrix[a, b] += xa * (1.0 if b == 0 else x[c, b - 1])
            for b in range(d):
                right[a, b] += xa * y[c, b]
    hold = PRIOR * scale * scale
    for a in range(d):
        matrix[a + 1, a + 1] += hold
        for b in range(d):
            right[a + 1, b] += hold * expected[b, a]
    matrix[0, 0] += 1e-12
    _solve(matrix, right)
    for a in range(d):
        value[a] = right[0, a]
        for b in range(d):
            gradient[a, b] = right[b + 1, a]


@njit(cache=True)
def _aligned_once(
    x: FloatArray, deformed: FloatArray, origin: FloatArray, width: float, dims: IntArray, starts: IntArray, members: IntArray,
    k: int, reach: float, scale: float, start: FloatArray, anchor: FloatArray, value: FloatArray, gradient: FloatArray, seen: FloatArray,
) -> int:  # fmt: skip
    """Pair the first k offsets x with the nearest deformed points within reach and refit; return the number of pairs; fill distances."""
    d = x.shape[1]
    offsets, targets, weights, at = np.empty((k + 1, d)), np.empty((k + 1, d)), np.ones(k + 1), np.empty(d)
    offsets[0], targets[0] = 0.0, anchor
    count = 1
    for c in range(k):
        for a in range(d):
            at[a] = value[a]
            for b in range(d):
                at[a] += gradient[a, b] * x[c, b]
        p, distance = _nearest(deformed, origin, width, dims, starts, members, at, reach)
        seen[c] = distance if p >= 0 else np.inf
        if p >= 0:
            offsets[count], targets[count] = x[c], deformed[p]
            count += 1
    _affine(offsets, targets, weights, count, start, scale, value, gradient)
    return count - 1


@njit(cache=True, parallel=True)
def try_guesses(
    reference: FloatArray,
    neighbours: IntArray,
    deformed: FloatArray,
    origin: FloatArray,
    width: float,
    dims: IntArray,
    starts: IntArray,
    members: IntArray,
    scales: FloatArray,
    seeds: IntArray,
    targets: IntArray,
    gradients: FloatArray,
    tight: float,
    score: FloatArray,
    found: FloatArray,
) -> None:
    """Try whether the neighbours of a reference point are found again around a deformed one under an affine motion.

    Parameters
    ----------
    reference, neighbours : ndarray, shape (n, d), (n, k)
        Points, and the nearest ones around each, the closest first.
    deformed, origin, width, dims, starts, members
        Points (m, d) and the grid that holds them.
    scales : ndarray, shape (g,)
        Typical distance of neighbours among the deformed points there.
    seeds, targets, gradients : ndarray, shape (g,), (g,), (g, d, d)
        Guesses: a reference point, the deformed point that it may be, and the initial deformation gradient.
    tight : float
        Distance, in scales, within which a neighbour counts as found.
    score, found : ndarray, shape (g,), (g, d, d)
        Filled with the fraction of neighbours found again, and the gradient that found them.
    """
    d, k = reference.shape[1], neighbours.shape[1]
    for g in prange(len(seeds)):
        x = np.empty((k, d))
        for c in range(k):
            for a in range(d):
                x[c, a] = reference[neighbours[seeds[g], c], a] - reference[seeds[g], a]
        value, gradient, seen = deformed[targets[g]].copy(), gradients[g].copy(), np.empty(k)
        anchor, few = deformed[targets[g]].copy(), min(k, 3 * d - 1)
        scale = scales[g]
        score[g] = 0.0
        found[g] = gradient
        if (
            2
            * _aligned_once(
                x, deformed, origin, width, dims, starts, members, few, 0.45 * scale, scale, gradients[g], anchor, value, gradient, seen
            )
            < few
        ):
            continue
        for some, reach in ((few, 0.4), (min(k, 5 * d), 0.4), (k, 0.35), (k, 0.3), (k, 0.3)):
            _aligned_once(
                x, deformed, origin, width, dims, starts, members, some, reach * scale, scale, gradients[g], anchor, value, gradient, seen
            )
        _aligned_once(x, deformed, origin, width, dims, starts, members, k, 0.3 * scale, scale, gradients[g], anchor, value, gradient, seen)
        ratio = abs(np.linalg.det(gradient)) / max(abs(np.linalg.det(gradients[g])), 1e-12)
        if 0.4 < ratio < 2.5:
            hits = 0.0
            for c in range(k):
                hits += 1.0 if seen[c] < tight * scale else 0.0
            score[g] = hits / k
            found[g] = gradient


@njit(cache=True)
def _predicted(
    p: int,
    reference: FloatArray,
    neighbours: IntArray,
    deformed: FloatArray,
    link: IntArray,
    gradients: FloatArray,
    scale: float,
    most: int,
    robust: bool,
    value: FloatArray,
    gradient: FloatArray,
) -> int:
    """Predict the deformed position of a point from up to `most` linked neighbours, itself left out; return their number."""
    d = reference.shape[1]
    x, y, w, expected = np.empty((most, d)), np.empty((most, d)), np.empty(most), np.zeros((d, d))
    count, total = 0, 0.0
    for c in range(neighbours.shape[1]):
        q = neighbours[p, c]
        if link[q] < 0 or count == most:
            continue
        square = 0.0
        for a in range(d):
            x[count, a] = reference[q, a] - reference[p, a]
            y[count, a] = deformed[link[q], a]
            square += x[count, a] ** 2
        w[count] = 1.0 / (square / (scale * scale) + 0.5)
        expected += w[count] * gradients[q]
        total += w[count]
        count += 1
    if count == 0:
        return 0
    expected /= total
    _affine(x, y, w, count, expected, scale, value, gradient)
    if robust and count > d + 2:
        left = np.empty(count)
        for _ in range(2):
            for c in range(count):
                square = 0.0
                for a in range(d):
                    at = value[a]
                    for b in range(d):
                        at += gradient[a, b] * x[c, b]
                    square += (y[c, a] - at) ** 2
                left[c] = np.sqrt(square)
            typical = max(np.median(left), 1e-9 * scale)
            weights = w[:count] / np.maximum(left / (2.5 * typical), 1.0) ** 2
            _affine(x, y, weights, count, expected, scale, value, gradient)
    return count


@njit(cache=True)
def _propose_one(
    t: int,
    reference: FloatArray,
    neighbours: IntArray,
    deformed: FloatArray,
    origin: FloatArray,
    width: float,
    dims: IntArray,
    starts: IntArray,
    members: IntArray,
    scales: FloatArray,
    active: IntArray,
    link: IntArray,
    gradients: FloatArray,
    reach: FloatArray,
    most: int,
    robust: bool,
    predicted: FloatArray,
    proposal: IntArray,
    distance: FloatArray,
    fitted: FloatArray,
) -> None:
    d, p = reference.shape[1], active[t]
    value, gradient = np.zeros(d), np.zeros((d, d))
    proposal[t], distance[t] = -1, np.inf
    predicted[t] = np.nan
    if _predicted(p, reference, neighbours, deformed, link, gradients, scales[p], most, robust, value, gradient) > 0:
        predicted[t], fitted[t] = value, gradient
        q, away = _nearest(deformed, origin, width, dims, starts, members, value, reach[p])
        if q >= 0:
            proposal[t], distance[t] = q, away


@njit(cache=True, parallel=True)
def propose(
    reference: FloatArray,
    neighbours: IntArray,
    deformed: FloatArray,
    origin: FloatArray,
    width: float,
    dims: IntArray,
    starts: IntArray,
    members: IntArray,
    scales: FloatArray,
    active: IntArray,
    link: IntArray,
    gradients: FloatArray,
    reach: FloatArray,
    most: int,
    robust: bool,
    predicted: FloatArray,
    proposal: IntArray,
    distance: FloatArray,
    fitted: FloatArray,
) -> None:
    """Propose a deformed point for every active reference point: the nearest one to its position predicted by linked neighbours.

    Fills, for every active point, the prediction (NaN without linked neighbours), the proposal (-1 for none within its `reach`), its
    distance from the prediction, and the local gradient. Other arguments: see `try_guesses`; `link` (n,) and `gradients` (n, d, d) are
    those found so far.
    """
    for t in prange(len(active)):
        _propose_one(
            np.int64(t), reference, neighbours, deformed, origin, width, dims, starts, members, scales, active, link, gradients, reach,
            most, robust, predicted, proposal, distance, fitted,
        )  # fmt: skip


@njit(cache=True)
def propose_few(
    reference: FloatArray,
    neighbours: IntArray,
    deformed: FloatArray,
    origin: FloatArray,
    width: float,
    dims: IntArray,
    starts: IntArray,
    members: IntArray,
    scales: FloatArray,
    active: IntArray,
    link: IntArray,
    gradients: FloatArray,
    reach: FloatArray,
    most: int,
    robust: bool,
    predicted: FloatArray,
    proposal: IntArray,
    distance: FloatArray,
    fitted: FloatArray,
) -> None:
    """Do the same as `propose` in one thread, for few points."""
    for t in range(len(active)):
        _propose_one(
            t, reference, neighbours, deformed, origin, width, dims, starts, members, scales, active, link, gradients, reach, most, robust,
            predicted, proposal, distance, fitted,
        )  # fmt: skip


@njit(cache=True)
def settle(
    active: IntArray,
    proposal: IntArray,
    distance: FloatArray,
    link: IntArray,
    owner: IntArray,
    residual: FloatArray,
    fitted: FloatArray,
    gradients: FloatArray,
) -> int:
    """Accept proposals, the closer one where two share a deformed point; return how many links are new or changed."""
    changed = 0
    for t in range(len(active)):
        p, q = active[t], proposal[t]
        if q < 0:
            continue
        if link[p] == q:
            residual[p], gradients[p] = distance[t], fitted[t]
            continue
        other = owner[q]
        if other >= 0 and residual[other] <= distance[t]:
            continue
        if other >= 0:
            link[other], residual[other] = -1, np.inf
        if link[p] >= 0:
            owner[link[p]] = -1
        link[p], owner[q], residual[p] = q, p, distance[t]
        gradients[p] = fitted[t]
        changed += 1
    return changed


@njit(cache=True)
def frontier(neighbours: IntArray, link: IntArray, tries: IntArray, most: int, near: int, active: IntArray) -> int:
    """List unlinked points with linked nearest neighbours, unless more of these have failed; return their number."""
    count = 0
    for p in range(len(link)):
        if link[p] >= 0 or tries[p] >= most:
            continue
        linked, failed = 0, 0
        for c in range(min(near, neighbours.shape[1])):
            q = neighbours[p, c]
            if link[q] >= 0:
                linked += 1
            elif tries[q] > 0:
                failed += 1
        if linked > 0 and linked >= failed:
            active[count] = p
            count += 1
    return count
