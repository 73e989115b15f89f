"""Linear assignment of markers under a smooth motion, from affine to a thin-plate spline, for up to a few hundred markers.

Alternates between the linear assignment of least cost :cite:p:`crouse2016`, with a cost beyond which a marker stays unlinked, and
the fit of the motion to it, at first a polynomial and then a thin-plate spline :cite:p:`bookstein1989`, as in robust point matching
:cite:p:`chui2003`. The stiffness of the spline minimises the leave-one-out error :cite:p:`wahba1990`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.imaging.markers.settings import LinkSettings

# Empirical values, judged by tests/imaging/markers/test_point_matching.py and benchmarks/sense_markers.py.
# degree of the polynomial motion in turn (0 for the spline), and the distance, in spacings, within which markers are assigned
SCHEDULE = ((1, 1.0), (1, 0.9), (2, 0.8), (2, 0.7), (3, 0.7), (3, 0.6), *([(0, 0.6)] * 12))
# the same where a start predicts some markers only: links spread from those to markers within so many spacings, again and again
SPREADING, SPREAD = ((0, 0.6),) * 16, 1.7
PAIRS_PER_TERM = 3.0  # links per coefficient of a polynomial below which its degree is lowered
LEAST_FOR_SPLINE, HANDFUL = 3, 2  # linked markers, as multiples of the terms of an affine motion
# links with residuals beyond so many medians may pass to markers within so many spacings; so many such moves are tried at most
SUSPICIOUS, BESIDE, MOST_MOVES = 4.0, 1.6, 24
# fractions of the links, those of largest residual, that are removed in turn: their markers and unlinked ones are linked again, the latter
# within so many spacings, where that makes the whole better
DOUBTED, LEFT_OVER = (0.0, 0.02, 0.05, 0.1), (0.8, 1.1)
# starts that are followed, those whose agreement is at least this fraction of the best, and the quality, as a fraction of the markers, at
# which the search ends
STARTS, WORTH, ENOUGH = 8, 0.75, 0.985
# stiffness of the spline that is tried, relative to the mean of its kernel
STIFFNESSES = np.logspace(-5.0, 0.0, 8)


@dataclass(frozen=True, slots=True, eq=False)
class Assignment:
    """Deformed marker of every reference marker (n,), -1 for none; leave-one-out residual (n,), mm; quality of the whole."""

    link: IntArray
    residual: FloatArray
    quality: float


class _Motion(NamedTuple):
    """A fitted motion: predicted positions of all markers (n, d), the linked ones left out in turn; residuals (k,) of those, mm.

    Of a spline also the matrix (k, k) that gives its weights from the positions of the linked markers.
    """

    predicted: FloatArray
    residual: FloatArray
    influence: FloatArray | None


def assigned(
    reference: FloatArray,
    deformed: FloatArray,
    starts: Iterable[FloatArray],
    spacing: FloatArray,
    how: LinkSettings,
    *,
    worth: float = WORTH,
) -> Assignment:
    """Return the best assignment reached from predicted positions of the reference markers.

    Parameters
    ----------
    reference, deformed : ndarray, shape (n, d), (m, d)
        Markers, mm.
    starts : iterable of ndarray, shape (n, d)
        Predictions, mm; NaN where there is none.
    spacing : ndarray, shape (m,)
        Distance to neighbours around every deformed marker, mm.
    how : LinkSettings
        Limits of the residuals.
    worth : float
        Starts whose agreement is below this fraction of the best are not followed.
    """
    tree = cKDTree(deformed)
    ranked = sorted(((_agreement(p, tree, spacing), k, p) for k, p in enumerate(starts)), key=lambda one: (-one[0], one[1]))
    best: Assignment | None = None
    tried: list[FloatArray] = []
    for agreement, _, start in ranked:
        if any(_alike(start, other, 0.15 * float(spacing.mean())) for other in tried):
            continue
        if len(tried) == STARTS or agreement < worth * ranked[0][0]:
            break
        tried.append(start)
        found = _settled(reference, deformed, start, spacing, how)
        if best is None or found.quality > best.quality:
            best = found
        if best.quality > ENOUGH * min(len(reference), len(deformed)):
            break
    if best is None:
        raise ValueError("at least one start is needed")
    return _improved(reference, deformed, best, spacing, how)


def _alike(one: FloatArray, other: FloatArray, near: float) -> bool:
    """Whether two starts agree where both predict."""
    both = np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)
    few = both.sum() < 0.7 * max(np.isfinite(one).all(axis=1).sum(), np.isfinite(other).all(axis=1).sum())
    return not few and float(np.linalg.norm(one[both] - other[both], axis=1).mean()) < near


def residuals(reference: FloatArray, deformed: FloatArray, link: IntArray) -> FloatArray:
    """Return the residual (n,), mm, of every linked marker from the spline through the others; infinite where there is no link."""
    out = np.full(len(link), np.inf)
    if (link >= 0).any():
        out[link >= 0] = _motion(reference, deformed, link, 0).residual
    return out


def spline_through(reference: FloatArray, known: IntArray, positions: FloatArray) -> FloatArray:
    """Return predicted positions (n, d), mm, of all reference markers if those of index `known` (k,) are at `positions` (k, d), mm."""
    link = np.full(len(reference), -1, dtype=np.int64)
    link[known] = np.arange(len(known))
    predicted = _motion(reference, positions, link, 0).predicted
    predicted[known] = positions
    return predicted


def _agreement(predicted: FloatArray, tree: cKDTree, spacing: FloatArray) -> float:
    """Return how many predictions have a deformed marker near, weighted by closeness, each marker counted once."""
    known = np.isfinite(predicted).all(axis=1)
    distance, index = tree.query(predicted[known])
    closeness = np.maximum(1.0 - (distance / (0.6 * spacing[index])) ** 2, 0.0)
    most = np.zeros(tree.n)
    np.maximum.at(most, index, closeness)
    return float(most.sum())


def _settled(reference: FloatArray, deformed: FloatArray, start: FloatArray, spacing: FloatArray, how: LinkSettings) -> Assignment:
    """Alternate between assignment and fit."""
    partial = not np.isfinite(start).all()
    predicted, link, motion = start, np.full(len(reference), -1, dtype=np.int64), None
    near = SPREAD * np.mean(np.asarray(cKDTree(reference).query(reference, k=2)[0])[:, 1])
    for degree, reach in SPREADING if partial else SCHEDULE:
        before, link = link, _assignment(predicted, deformed, reach * spacing)
        if degree == 0:
            if np.array_equal(before, link):
                break
            link, motion = _agreeing(reference, deformed, link, spacing, how)
        elif (link >= 0).sum() >= 3:
            motion = _motion(reference, deformed, link, degree)
        if (link >= 0).sum() < 3 or motion is None:
            break
        predicted = motion.predicted.copy()
        if degree == 0:
            distance, _ = cKDTree(reference[link >= 0]).query(reference)
            predicted[distance > near] = np.nan
    return _checked(reference, deformed, link, spacing, how)


def _improved(reference: FloatArray, deformed: FloatArray, best: Assignment, spacing: FloatArray, how: LinkSettings) -> Assignment:
    """Link unlinked markers, and those of doubtful links again, where that makes the whole better."""
    for doubted in DOUBTED:
        for loose in LEFT_OVER:
            worst = np.argsort(np.where(best.link >= 0, best.residual, -np.inf))[::-1][: int(np.ceil(doubted * (best.link >= 0).sum()))]
            fewer = best.link.copy()
            fewer[worst] = -1
            found = _completed(reference, deformed, fewer, loose * spacing, spacing, how)
            best = found if found.quality > best.quality else best
    return best


def exchanged(reference: FloatArray, deformed: FloatArray, best: Assignment, spacing: FloatArray, how: LinkSettings) -> Assignment:
    """Pass links of large residual to unlinked markers beside theirs, alone or with adjacent ones, where that makes the whole better.

    A row at the rim that is linked to a neighbouring row, which is missing, is consistent in itself: only moving it as one shows the better
    links.
    """
    linked, free = np.flatnonzero(best.link >= 0), np.flatnonzero(best.link < 0)
    if len(linked) < 8 or not len(free):
        return best
    apart = float(np.median(np.asarray(cKDTree(reference).query(reference, k=2)[0])[:, 1]))
    doubtful = linked[best.residual[linked] > SUSPICIOUS * np.median(best.residual[linked])]
    heirs = np.atleast_1d(np.asarray(cKDTree(reference[free]).query_ball_point(reference[doubtful], BESIDE * apart), dtype=object))
    tried: set[frozenset[tuple[int, int]]] = set()
    moves = [(int(j), int(free[i])) for j, some in zip(doubtful, heirs, strict=True) for i in some][:MOST_MOVES]
    step = {move: reference[move[1]] - reference[move[0]] for move in moves}
    for first in moves:
        together = [m for m in moves if np.linalg.norm(step[m] - step[first]) < 0.4 * apart]
        beside = [m for m in together if np.linalg.norm(reference[m[0]] - reference[first[0]]) < BESIDE * apart]
        for group in ([first], beside, together):
            link, key = best.link.copy(), frozenset(group)
            if key in tried or any(link[old] < 0 or link[new] >= 0 for old, new in group) or len({new for _, new in group}) < len(group):
                continue
            tried.add(key)
            for old, new in group:
                link[new], link[old] = link[old], -1
            found = _completed(
                reference, deformed, _checked(reference, deformed, link, spacing, how).link, LEFT_OVER[0] * spacing, spacing, how
            )
            best = found if found.quality > best.quality else best
    return best


def _completed(
    reference: FloatArray, deformed: FloatArray, known: IntArray, reach: FloatArray, spacing: FloatArray, how: LinkSettings
) -> Assignment:
    """Assign markers without a link to each other within `reach` (m,); all others may change to a better link."""
    if (known >= 0).sum() < 3:
        return _checked(reference, deformed, known, spacing, how)
    predicted = _motion(reference, deformed, known, 0).predicted
    free = known < 0
    link = _assignment(predicted, deformed, 0.5 * spacing)
    rest = np.setdiff1d(np.arange(len(deformed)), link[link >= 0])
    alone = np.flatnonzero(free & (link < 0))
    if len(alone) and len(rest):
        more = _assignment(predicted[alone], deformed[rest], reach[rest])
        link[alone[more >= 0]] = rest[more[more >= 0]]
    return _checked(reference, deformed, link, spacing, how)


def _assignment(predicted: FloatArray, deformed: FloatArray, reach: FloatArray) -> IntArray:
    """Assign markers to predictions, at most one to each, none farther than `reach` (m,)."""
    known = np.asarray(np.isfinite(predicted).all(axis=1))
    square = np.where(known[:, None], cdist(np.nan_to_num(predicted), deformed, "sqeuclidean") / reach**2, 4.0)
    rows, columns = linear_sum_assignment(np.minimum(square, 1.0))
    link = np.full(len(predicted), -1, dtype=np.int64)
    near = square[rows, columns] < 1.0
    link[rows[near]] = columns[near]
    return link


def _motion(reference: FloatArray, deformed: FloatArray, link: IntArray, degree: int) -> _Motion:
    """Fit a motion to the linked markers: a polynomial of that degree, or for 0 a thin-plate spline."""
    linked = link >= 0
    centre, extent = reference.mean(axis=0), max(float(np.ptp(reference, axis=0).max()), 1e-300)
    x, y = (reference - centre) / extent, deformed[link[linked]]
    if degree == 0 and linked.sum() > LEAST_FOR_SPLINE * (x.shape[1] + 1):
        predicted, alone, influence = _spline(x, linked, y)
        predicted[linked] = y - alone
        return _Motion(predicted, np.linalg.norm(alone, axis=1), influence)
    while degree > 1 and linked.sum() < PAIRS_PER_TERM * _terms(x[:1], degree).shape[1]:
        degree -= 1
    terms = _terms(x, max(degree, 1))
    fitted = np.linalg.lstsq(terms[linked], y, rcond=1e-6)[0]
    leverage = np.einsum("ij,ji->i", terms[linked], np.linalg.pinv(terms[linked], rcond=1e-6))
    # of few markers, each at the rim, a prediction from the others extrapolates: the residual from the fit to all counts
    least_slack = 0.1 if linked.sum() > HANDFUL * (x.shape[1] + 1) else 1.0
    alone = (y - terms[linked] @ fitted) / np.maximum(1.0 - leverage, least_slack)[:, None]
    predicted = terms @ fitted
    predicted[linked] = y - alone
    return _Motion(predicted, np.linalg.norm(alone, axis=1), None)


def _terms(x: FloatArray, degree: int) -> FloatArray:
    """Return the monomials of x (n, d) up to a degree."""
    powers = [c for k in range(degree + 1) for c in combinations_with_replacement(range(x.shape[1]), k)]
    return np.column_stack([np.prod(x[:, list(c)], axis=1) if c else np.ones(len(x)) for c in powers])


def _spline(x: FloatArray, linked: BoolArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit a thin-plate spline to linked markers, with the stiffness of least leave-one-out error.

    Returns all predicted positions (n, d), the leave-one-out residuals (k, d), and the matrix (k, k) that gives the weights of the spline.
    """
    n = int(linked.sum())
    kernel, linear = _kernel(x[linked], x[linked]), np.column_stack([np.ones(n), x[linked]])
    basis, singular, _ = np.linalg.svd(linear)
    across = basis[:, int((singular > 1e-9 * singular[0]).sum()) :]  # weights of a spline are orthogonal to affine motions
    bending, modes = np.linalg.eigh(across.T @ kernel @ across)
    modes, bending = across @ modes, np.maximum(bending, 0.0)
    parts, squares = modes.T @ y, modes**2
    best: tuple[float, float, FloatArray] | None = None
    for stiffness in STIFFNESSES * float(np.abs(kernel).mean()):
        inverse = 1.0 / (bending + stiffness)
        alone = (modes @ (parts * inverse[:, None])) / np.maximum(squares @ inverse, 1e-300)[:, None]  # leave-one-out residuals
        residual = np.linalg.norm(alone, axis=1)
        error = float(np.mean(np.minimum(residual, 5.0 * np.median(residual)) ** 2))
        if best is None or error < best[0]:
            best = error, float(stiffness), alone
    assert best is not None
    influence = (modes / (bending + best[1])) @ modes.T
    weights = influence @ y
    affine = np.linalg.lstsq(linear, y - kernel @ weights - best[1] * weights, rcond=1e-9)[0]
    return np.column_stack([_kernel(x, x[linked]), np.ones(len(x)), x]) @ np.vstack([weights, affine]), best[2], influence


def _kernel(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the kernel of the thin-plate spline, positive definite on weights that are orthogonal to affine motions."""
    r = cdist(a, b)
    return np.asarray(np.where(r > 0.0, r**2 * np.log(np.maximum(r, 1e-300)), 0.0)) if a.shape[1] == 2 else np.asarray(-r)


def _checked(reference: FloatArray, deformed: FloatArray, link: IntArray, spacing: FloatArray, how: LinkSettings) -> Assignment:
    """Drop links of large residual from the motion of the others; return the assignment with its quality."""
    link, motion = _agreeing(reference, deformed, link, spacing, how)
    linked, residual = np.flatnonzero(link >= 0), np.full(len(link), np.inf)
    if motion is not None:
        residual[linked] = motion.residual
    fraction = residual[linked] / (how.spline_residual_bounds[1] * spacing[link[linked]])
    return Assignment(link, residual, float(np.maximum(1.0 - fraction**2, 0.0).sum()))


def _agreeing(
    reference: FloatArray, deformed: FloatArray, link: IntArray, spacing: FloatArray, how: LinkSettings
) -> tuple[IntArray, _Motion | None]:
    """Drop links of large residual from the motion of the others, the worst first; return the rest and its motion."""
    link, motion = link.copy(), None
    while (link >= 0).sum() > 3:
        linked = np.flatnonzero(link >= 0)
        motion = _motion(reference, deformed, link, 0)
        bad = _outliers(motion, deformed[link[linked]], spacing[link[linked]], how)
        if not bad.any():
            break
        link[linked[bad]] = -1
        motion = None
    return link, motion


def _outliers(motion: _Motion, positions: FloatArray, spacing: FloatArray, how: LinkSettings) -> BoolArray:
    """Tell which linked markers (k,) are outliers; with a spline, the worst are left out before the next are judged."""
    residual, influence, gone = motion.residual, motion.influence, np.zeros(len(positions), dtype=bool)
    while True:
        limit = np.clip(
            how.spline_residual_factor * np.median(residual[~gone]),
            how.spline_residual_bounds[0] * spacing,
            how.spline_residual_bounds[1] * spacing,
        )
        excess = np.where(gone, 0.0, residual / limit)
        bad = excess > max(1.0, 0.7 * float(excess.max()))
        gone |= bad
        if not bad.any() or influence is None or len(positions) - gone.sum() <= LEAST_FOR_SPLINE * (positions.shape[1] + 1):
            return gone
        # the inverse without those rows and columns
        influence = influence - influence[:, bad] @ np.linalg.solve(influence[np.ix_(bad, bad)], influence[bad])
        residual = np.linalg.norm(influence @ positions, axis=1) / np.maximum(np.diag(influence), 1e-300)
