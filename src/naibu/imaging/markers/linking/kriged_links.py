"""Links predicted by kriging: dropped and added in turn, and grown into places that the motion of their surroundings does not foretell.

A link is made where it is more likely than chance, by how far the point is from its prediction, how exact that is, and how many points have
no link there. Holes, where points of both states are left over, are motions that change within a few points: predictions there are taken
for rougher from round to round, so that links grow in from the rim.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.imaging.markers.linking._point_matching_kernels import settle
from naibu.imaging.markers.linking.local_kriging import KRIGED, MEDIAN, LocalKriging
from naibu.imaging.markers.linking.point_clouds import NEIGHBOURS, Cloud, State
from naibu.imaging.markers.settings import LinkSettings

# Empirical values, judged by tests/imaging/markers/test_point_matching.py, benchmarks/particle_gels.py and benchmarks/traction_gels.py.
ROUNDS, STEADY = 16, 0.0005  # rounds at most, and fraction of the points whose links change from which on one is the last
WHOLE = 2  # rounds in which all points are predicted; afterwards those around a change
DOUBT = 0.7  # how much more likely than chance a link must be to be made, or kept, until all are judged
SUSPECT = 2.5  # standard deviations of its residual from which on a link tells less of those around
REWEIGHTED = 1.2  # ratio of weights from which on predictions are made anew
HOLE = (2.0, 0.1)  # fraction of the points without link in a hole: so many times that of all, and so much more
RAISED, ROUGHER = 4, 5.0  # rounds in which the motion in a hole is taken for rougher, and by which factor of its variance
LEAST = 0.01  # least noise, in spacings
AROUND, PRIOR = 24, 6.0  # deformed points around that tell how many are unlinked there, and weight of those everywhere, in points


def kriged_links(cloud: Cloud, state: State, how: LinkSettings) -> tuple[FloatArray, FloatArray]:
    """Drop and add links until hardly one changes; return the predictions (n, d) and their standard deviation (n,) along each axis.

    Parameters
    ----------
    cloud, state : Cloud, State
        Points, deformed ones in the metric of the residuals, and links; the links are changed in place.
    how : LinkSettings
        Limits of the residual.
    """
    n, d = cloud.reference.shape
    tree, process = cKDTree(cloud.deformed), LocalKriging(cloud.reference, cloud.reference_scale)
    noise, rougher, alone = np.ones(n), np.zeros(n, dtype=np.int64), np.ones(n)
    near, some = linked_neighbours(cloud, state, KRIGED[d]), np.arange(n)
    for round_ in range(ROUNDS + 1):
        known, values, linked = state.link >= 0, cloud.deformed[np.maximum(state.link, 0)], state.link.copy()
        process.update(some, near, values, known, noise)
        holes = np.flatnonzero(rougher)
        process.roughen(holes, np.power(ROUGHER, rougher[holes], dtype=float), near, values, noise)
        if round_ == ROUNDS or not len(some):
            break
        focus = np.arange(n) if round_ < WHOLE else np.union1d(_beside(some, near, n), holes)
        sd = np.maximum(process.sd[focus], LEAST * cloud.growth * cloud.reference_scale[focus])
        residual = np.where(known[focus], np.linalg.norm(values[focus] - process.predicted[focus], axis=1), 0.0)
        weight = np.maximum(residual / (SUSPECT * np.sqrt(d) * sd), 1.0) ** 4
        moved = np.zeros(n, dtype=bool)
        moved[focus] = np.maximum(weight / noise[focus], noise[focus] / weight) > REWEIGHTED
        noise[focus] = weight
        free = np.ones(len(cloud.deformed), dtype=bool)
        free[state.link[known]] = False
        nearest = tree.query(process.predicted[focus], workers=-1)
        distance, proposal = np.asarray(nearest[0]), np.asarray(nearest[1], dtype=np.int64)
        alone[focus] = fraction_around(cloud.deformed, free, process.predicted[focus], tree)
        rougher = np.where(~known & (alone > HOLE[0] * free.mean() + HOLE[1]), np.minimum(rougher + 1, RAISED), 0)
        limit = _limit(cloud, sd, alone[focus], focus, proposal, how)
        wrong = focus[known[focus] & (residual > limit)]
        state.owner[state.link[wrong]] = -1
        state.link[wrong], state.residual[wrong] = -1, np.inf
        state.residual[focus] = np.where(state.link[focus] >= 0, residual, np.inf)
        proposal[~(distance <= limit)] = -1
        settle(focus, proposal, distance, state.link, state.owner, state.residual, state.gradients[focus], state.gradients)
        others = state.link != linked
        near, anew = _renewed(cloud, state, near, linked, others)
        moved |= others
        some = np.arange(n) if round_ + 1 < WHOLE else np.flatnonzero(anew | moved | moved[near].any(axis=1))
        if round_ >= WHOLE and others.sum() <= STEADY * n and not ((rougher > 0) & (rougher < RAISED)).any():
            process.update(some, near, cloud.deformed[np.maximum(state.link, 0)], state.link >= 0, noise)
            break
    return process.predicted, np.maximum(process.sd, LEAST * cloud.growth * cloud.reference_scale)


def _limit(cloud: Cloud, sd: FloatArray, alone: FloatArray, focus: IntArray, proposal: IntArray, how: LinkSettings) -> FloatArray:
    """Return the distance (k,) from its prediction within which a point may be linked."""
    d, spacing = cloud.dimensions, cloud.growth * cloud.reference_scale[focus]
    chance = DOUBT * alone * (0.63 / cloud.deformed_scale[proposal]) ** d  # a point has a volume of about (spacing / 0.63)^d
    # where the normal density of a right link falls below that of a link by chance
    likely = sd * np.sqrt(np.maximum(-2.0 * np.log(chance * (np.sqrt(2.0 * np.pi) * sd) ** d), 0.0))
    least, most = (bound * spacing for bound in how.residual_bounds)
    return np.asarray(np.minimum(np.clip(how.residual_factor * MEDIAN[d] * sd, least, most), likely))


def _beside(some: IntArray, near: IntArray, n: int) -> IntArray:
    """Return these points and those that have one of them for a neighbour."""
    among = np.zeros(n, dtype=bool)
    among[some] = True
    return np.flatnonzero(among | among[near].any(axis=1))


def _renewed(cloud: Cloud, state: State, near: IntArray, before: IntArray, others: BoolArray) -> tuple[IntArray, BoolArray]:
    """Return the neighbours after links have changed, and which points have others than before."""
    lost, gained = others & (state.link < 0), np.flatnonzero((before < 0) & (state.link >= 0))
    anew: BoolArray = np.asarray(lost[near].any(axis=1))
    if len(gained):
        farthest = np.linalg.norm(cloud.reference[near[:, -1]] - cloud.reference, axis=1)
        tree = cKDTree(cloud.reference[gained])
        found = tree.query(cloud.reference, k=min(2, len(gained)), workers=-1)
        distance, at = (np.asarray(part).reshape(len(near), -1) for part in found)
        anew |= ((distance <= farthest[:, None]) & (gained[at] != np.arange(len(near))[:, None])).any(axis=1)
    if anew.any():
        near = near.copy()
        near[anew] = linked_neighbours(cloud, state, near.shape[1], np.flatnonzero(anew))
    return near, anew


def linked_neighbours(cloud: Cloud, state: State, most: int | None = None, some: IntArray | None = None) -> IntArray:
    """Return the nearest linked points (n, k) of every reference point, or of some (k,), itself left out."""
    linked, at = np.flatnonzero(state.link >= 0), np.arange(len(cloud.reference)) if some is None else some
    k = min(most or NEIGHBOURS[cloud.dimensions], len(linked) - 1)
    if k < 1:
        return cloud.neighbours[at]
    near = linked[np.asarray(cKDTree(cloud.reference[linked]).query(cloud.reference[at], k=k + 1, workers=-1)[1])]
    left_out = near == at[:, None]
    left_out[~left_out.any(axis=1), -1] = True
    return np.ascontiguousarray(near[~left_out].reshape(len(near), k))


def fraction_around(points: FloatArray, which: BoolArray, at: FloatArray, tree: cKDTree | None = None) -> FloatArray:
    """Return the fraction (k,) of the points (n, d) around `at` (k, d) that `which` (n,) holds for, not below that of all, nor 0 or 1."""
    n = len(points)
    everywhere = (which.sum() + 1.0) / (n + 2.0)
    near = np.asarray((tree or cKDTree(points)).query(at, k=min(AROUND, n), workers=-1)[1]).reshape(len(at), -1)
    here = (which[near].sum(axis=1) + PRIOR * everywhere) / (near.shape[1] + PRIOR)
    return np.asarray(np.maximum(here, everywhere))
