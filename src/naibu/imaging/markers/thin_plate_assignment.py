"""Links of a few hundred markers: every marker is assigned at once, under one smooth motion that grows from affine to a thin-plate spline.

Alternates between the assignment of least cost (Hungarian, with a cost beyond which a marker rather stays alone) and the fit of the motion
to it; in the end the spline is as stiff as predicts single markers best from the others.
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

# degree of the polynomial motion in turn (0 for the spline), and the distance, in spacings, within which markers are assigned
SCHEDULE = ((1, 1.0), (1, 0.9), (2, 0.8), (2, 0.7), (3, 0.7), (3, 0.6), *([(0, 0.6)] * 12))
# the same where a start knows some markers only: links spread from those to markers within so many spacings, again and again
SPREADING, SPREAD = ((0, 0.6),) * 16, 1.7
PAIRS_PER_TERM = 3.0
LEAST_FOR_SPLINE, HANDFUL = 3, 2  # linked markers, as multiples of the terms of an affine motion
# links beyond so many medians of departure may go over to markers within so many spacings; so many such moves are tried at most
SUSPICIOUS, BESIDE, MOST_MOVES = 4.0, 1.6, 24
# shares of the links, the most departing ones, that are doubted in turn: they and markers left over are linked anew, the latter within so
# many spacings, where that makes the whole better
DOUBTED, LEFT_OVER = (0.0, 0.02, 0.05, 0.1), (0.8, 1.1)
# starts that are followed, those that agree at least so well as a share of the best, and the quality that needs no rival
STARTS, WORTH, ENOUGH = 8, 0.75, 0.985
# stiffness of the spline that is tried, relative to the mean of its kernel
STIFFNESSES = np.logspace(-5.0, 0.0, 8)
# a link is dropped beyond so many medians of the departures, within bounds in spacings
DEPARTURE, DEPARTURE_BOUNDS = 15.0, (0.25, 0.6)


@dataclass(frozen=True, slots=True, eq=False)
class Assignment:
    """Moving marker of every reference marker (n,), -1 for none; departure from the motion without it (n,), mm; how good the whole is."""

    link: IntArray
    departure: FloatArray
    quality: float


class _Motion(NamedTuple):
    """A fitted motion: where it puts all markers (n, d), the linked ones without themselves; how far (k,) those depart from that, mm.

    Of a spline also the matrix (k, k) that turns the places of the linked markers into its weights.
    """

    placed: FloatArray
    departure: FloatArray
    influence: FloatArray | None


def assigned(
    reference: FloatArray, moving: FloatArray, starts: Iterable[FloatArray], spacing: FloatArray, *, worth: float = WORTH
) -> Assignment:
    """Return the best assignment that is reached from predictions of where the reference markers went.

    Parameters
    ----------
    reference, moving : ndarray, shape (n, d), (m, d)
        Markers, mm.
    starts : iterable of ndarray, shape (n, d)
        Predictions, mm; NaN where there is none.
    spacing : ndarray, shape (m,)
        Distance to neighbours around every moving marker, mm.
    worth : float
        Starts that agree worse than this share of the best are not followed.
    """
    tree = cKDTree(moving)
    ranked = sorted(((_agreement(p, tree, spacing), k, p) for k, p in enumerate(starts)), key=lambda one: (-one[0], one[1]))
    best: Assignment | None = None
    tried: list[FloatArray] = []
    for agreement, _, start in ranked:
        if any(_alike(start, other, 0.15 * float(spacing.mean())) for other in tried):
            continue
        if len(tried) == STARTS or agreement < worth * ranked[0][0]:
            break
        tried.append(start)
        found = _settled(reference, moving, start, spacing)
        if best is None or found.quality > best.quality:
            best = found
        if best.quality > ENOUGH * min(len(reference), len(moving)):
            break
    if best is None:
        raise ValueError("at least one start is needed")
    return _improved(reference, moving, best, spacing)


def _alike(one: FloatArray, other: FloatArray, near: float) -> bool:
    """Whether two starts agree where both know something."""
    both = np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)
    few = both.sum() < 0.7 * max(np.isfinite(one).all(axis=1).sum(), np.isfinite(other).all(axis=1).sum())
    return not few and float(np.linalg.norm(one[both] - other[both], axis=1).mean()) < near


def departures(reference: FloatArray, moving: FloatArray, link: IntArray) -> FloatArray:
    """Return how far (n,), mm, every linked marker lies from the spline through the others; infinite where there is no link."""
    out = np.full(len(link), np.inf)
    if (link >= 0).any():
        out[link >= 0] = _motion(reference, moving, link, 0).departure
    return out


def spline_through(reference: FloatArray, known: IntArray, places: FloatArray) -> FloatArray:
    """Return where all reference markers (n, d) are expected if those numbered `known` (k,) went to places (k, d), mm."""
    link = np.full(len(reference), -1, dtype=np.int64)
    link[known] = np.arange(len(known))
    predicted = _motion(reference, places, link, 0).placed
    predicted[known] = places
    return predicted


def _agreement(predicted: FloatArray, tree: cKDTree, spacing: FloatArray) -> float:
    """Say how many predictions have a moving marker near, counting every marker once, the nearer the better."""
    known = np.isfinite(predicted).all(axis=1)
    distance, index = tree.query(predicted[known])
    closeness = np.maximum(1.0 - (distance / (0.6 * spacing[index])) ** 2, 0.0)
    most = np.zeros(tree.n)
    np.maximum.at(most, index, closeness)
    return float(most.sum())


def _settled(reference: FloatArray, moving: FloatArray, start: FloatArray, spacing: FloatArray) -> Assignment:
    """Assign and fit in turn."""
    partial = not np.isfinite(start).all()
    predicted, link, motion = start, np.full(len(reference), -1, dtype=np.int64), None
    near = SPREAD * np.mean(np.asarray(cKDTree(reference).query(reference, k=2)[0])[:, 1])
    for degree, reach in SPREADING if partial else SCHEDULE:
        before, link = link, _assignment(predicted, moving, reach * spacing)
        if degree == 0:
            if np.array_equal(before, link):
                break
            link, motion = _agreeing(reference, moving, link, spacing)
        elif (link >= 0).sum() >= 3:
            motion = _motion(reference, moving, link, degree)
        if (link >= 0).sum() < 3 or motion is None:
            break
        predicted = motion.placed.copy()
        if degree == 0:
            distance, _ = cKDTree(reference[link >= 0]).query(reference)
            predicted[distance > near] = np.nan
    return _checked(reference, moving, link, spacing)


def _improved(reference: FloatArray, moving: FloatArray, best: Assignment, spacing: FloatArray) -> Assignment:
    """Link markers left over, and those of doubtful links anew, where that makes the whole better."""
    for doubted in DOUBTED:
        for loose in LEFT_OVER:
            worst = np.argsort(np.where(best.link >= 0, best.departure, -np.inf))[::-1][: int(np.ceil(doubted * (best.link >= 0).sum()))]
            fewer = best.link.copy()
            fewer[worst] = -1
            found = _completed(reference, moving, fewer, loose * spacing, spacing)
            best = found if found.quality > best.quality else best
    return best


def exchanged(reference: FloatArray, moving: FloatArray, best: Assignment, spacing: FloatArray) -> Assignment:
    """Pass links that depart much on to markers beside theirs that have none, alone or with adjacent ones, where the whole gets better.

    A row at the rim that is linked to the row beside it, which is missing, is consistent in itself: only moving it as one shows the better
    links.
    """
    linked, free = np.flatnonzero(best.link >= 0), np.flatnonzero(best.link < 0)
    if len(linked) < 8 or not len(free):
        return best
    apart = float(np.median(np.asarray(cKDTree(reference).query(reference, k=2)[0])[:, 1]))
    doubtful = linked[best.departure[linked] > SUSPICIOUS * np.median(best.departure[linked])]
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
            found = _completed(reference, moving, _checked(reference, moving, link, spacing).link, LEFT_OVER[0] * spacing, spacing)
            best = found if found.quality > best.quality else best
    return best


def _completed(reference: FloatArray, moving: FloatArray, known: IntArray, reach: FloatArray, spacing: FloatArray) -> Assignment:
    """Assign markers without a link to each other within `reach` (m,); all others may change to what suits them better."""
    if (known >= 0).sum() < 3:
        return _checked(reference, moving, known, spacing)
    predicted = _motion(reference, moving, known, 0).placed
    free = known < 0
    link = _assignment(predicted, moving, 0.5 * spacing)
    rest = np.setdiff1d(np.arange(len(moving)), link[link >= 0])
    alone = np.flatnonzero(free & (link < 0))
    if len(alone) and len(rest):
        more = _assignment(predicted[alone], moving[rest], reach[rest])
        link[alone[more >= 0]] = rest[more[more >= 0]]
    return _checked(reference, moving, link, spacing)


def _assignment(predicted: FloatArray, moving: FloatArray, reach: FloatArray) -> IntArray:
    """Assign markers to predictions, at most one to each, none farther than `reach` (m,)."""
    known = np.asarray(np.isfinite(predicted).all(axis=1))
    square = np.where(known[:, None], cdist(np.nan_to_num(predicted), moving, "sqeuclidean") / reach**2, 4.0)
    rows, columns = linear_sum_assignment(np.minimum(square, 1.0))
    link = np.full(len(predicted), -1, dtype=np.int64)
    near = square[rows, columns] < 1.0
    link[rows[near]] = columns[near]
    return link


def _motion(reference: FloatArray, moving: FloatArray, link: IntArray, degree: int) -> _Motion:
    """Fit a motion to the linked markers: polynomials of that degree, or for 0 a spline."""
    linked = link >= 0
    centre, extent = reference.mean(axis=0), max(float(np.ptp(reference, axis=0).max()), 1e-300)
    x, y = (reference - centre) / extent, moving[link[linked]]
    if degree == 0 and linked.sum() > LEAST_FOR_SPLINE * (x.shape[1] + 1):
        placed, alone, influence = _spline(x, linked, y)
        placed[linked] = y - alone
        return _Motion(placed, np.linalg.norm(alone, axis=1), influence)
    while degree > 1 and linked.sum() < PAIRS_PER_TERM * _terms(x[:1], degree).shape[1]:
        degree -= 1
    terms = _terms(x, max(degree, 1))
    fitted = np.linalg.lstsq(terms[linked], y, rcond=1e-6)[0]
    leverage = np.einsum("ij,ji->i", terms[linked], np.linalg.pinv(terms[linked], rcond=1e-6))
    # of so few that each is an end of the row, what the others say of one tells little: how far it is from all of them counts
    alone_share = 0.1 if linked.sum() > HANDFUL * (x.shape[1] + 1) else 1.0
    alone = (y - terms[linked] @ fitted) / np.maximum(1.0 - leverage, alone_share)[:, None]
    placed = terms @ fitted
    placed[linked] = y - alone
    return _Motion(placed, np.linalg.norm(alone, axis=1), None)


def _terms(x: FloatArray, degree: int) -> FloatArray:
    """Return the monomials of x (n, d) up to a degree."""
    powers = [c for k in range(degree + 1) for c in combinations_with_replacement(range(x.shape[1]), k)]
    return np.column_stack([np.prod(x[:, list(c)], axis=1) if c else np.ones(len(x)) for c in powers])


def _spline(x: FloatArray, linked: BoolArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit a thin-plate spline to linked markers, as stiff as predicts them best from each other.

    Returns all places (n, d), the misses (k, d) of linked markers each left out, and the matrix (k, k) that gives the spline's weights.
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
        alone = (modes @ (parts * inverse[:, None])) / np.maximum(squares @ inverse, 1e-300)[:, None]  # what is missed without the marker
        departure = np.linalg.norm(alone, axis=1)
        error = float(np.mean(np.minimum(departure, 5.0 * np.median(departure)) ** 2))
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


def _checked(reference: FloatArray, moving: FloatArray, link: IntArray, spacing: FloatArray) -> Assignment:
    """Drop links that depart from the motion of the others; return what is left and its quality."""
    link, motion = _agreeing(reference, moving, link, spacing)
    linked, departure = np.flatnonzero(link >= 0), np.full(len(link), np.inf)
    if motion is not None:
        departure[linked] = motion.departure
    share = departure[linked] / (DEPARTURE_BOUNDS[1] * spacing[link[linked]])
    return Assignment(link, departure, float(np.maximum(1.0 - share**2, 0.0).sum()))


def _agreeing(reference: FloatArray, moving: FloatArray, link: IntArray, spacing: FloatArray) -> tuple[IntArray, _Motion | None]:
    """Drop links that depart from the motion of the others, the worst first; return what is left and its motion."""
    link, motion = link.copy(), None
    while (link >= 0).sum() > 3:
        linked = np.flatnonzero(link >= 0)
        motion = _motion(reference, moving, link, 0)
        bad = _departing(motion, moving[link[linked]], spacing[link[linked]])
        if not bad.any():
            break
        link[linked[bad]] = -1
        motion = None
    return link, motion


def _departing(motion: _Motion, places: FloatArray, spacing: FloatArray) -> BoolArray:
    """Tell which linked markers (k,) depart from the motion of the others; with a spline, the worst left out before the next are judged."""
    departure, influence, gone = motion.departure, motion.influence, np.zeros(len(places), dtype=bool)
    while True:
        limit = np.clip(DEPARTURE * np.median(departure[~gone]), DEPARTURE_BOUNDS[0] * spacing, DEPARTURE_BOUNDS[1] * spacing)
        excess = np.where(gone, 0.0, departure / limit)
        bad = excess > max(1.0, 0.7 * float(excess.max()))
        gone |= bad
        if not bad.any() or influence is None or len(places) - gone.sum() <= LEAST_FOR_SPLINE * (places.shape[1] + 1):
            return gone
        # the inverse without those rows and columns
        influence = influence - influence[:, bad] @ np.linalg.solve(influence[np.ix_(bad, bad)], influence[bad])
        departure = np.linalg.norm(influence @ places, axis=1) / np.maximum(np.diag(influence), 1e-300)
