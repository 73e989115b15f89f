"""Point matching: links between the markers of two states, by their arrangement and a locally affine motion.

The motion is assumed to be nearly affine over a few spacings. A guess pairs a reference with a deformed point, and is accepted if the
neighbours of the one are found again around the other under one affine motion, so that displacements of many spacings are found. From
there links grow, each predicted by those around it, and at last every link must agree with the affine fit to its neighbours, itself left
out. In lattices, where all surroundings are similar, several guesses grow, and the one that links most markers is taken. Up to a few
hundred markers are assigned at once instead (`naibu.imaging.markers.linking.thin_plate_assignment`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from naibu.core.arrays import FloatArray, IntArray, as_points, require_finite, require_shape
from naibu.core.errors import InputError
from naibu.imaging.markers.linking._point_matching_kernels import frontier, settle, try_guesses
from naibu.imaging.markers.linking.link_refinement import RefinedLinks, probability, refined
from naibu.imaging.markers.linking.motion_coherence import coherence_of_links
from naibu.imaging.markers.linking.point_clouds import FEW, Cloud, State, local_spacing, prepared, proposed
from naibu.imaging.markers.linking.thin_plate_assignment import ENOUGH, assigned, exchanged, residuals
from naibu.imaging.markers.settings import LinkSettings

# Empirical values, judged by tests/imaging/markers/test_point_matching.py and benchmarks/sense_markers.py, unless said otherwise.
FEWEST = 3  # points that have an arrangement
# where all are assigned at once: seeds, and targets near each of them for which the translation is tried
SHIFT_SEEDS, SHIFTS = 3, 30
# spacings within which a neighbour counts as found again, and within which a link may grow
TIGHT, GROWING = 0.25, 0.45
# fraction of the neighbours found again beyond which guesses of several seeds grow together
SURE = 0.75
SEEDS = 8  # reference points from which guesses start; as many again where the deformed points are densest
GUESSES_AT_ONCE = 200_000  # bounds the memory of a search
# guesses that grow before the best is taken; fraction of the points that ends the search; waves after which growth ends with fewer links
GROWN, NEARLY_ALL, PROBATION = 30, 0.985, (5, 24)
# bounds of the time: failed proposals of a point, and waves of growth
MOST_TRIES, MOST_WAVES = 4, 400

# links from which on their mean probability is judged; of fewer, this fraction of the markers must be linked
FEW_LINKS, FEW_LINKED = 8, 0.5
LEAST_LINKED = 0.1  # fraction of the markers that links which have grown must reach
UNEVEN = 3.0  # degrees of freedom of residuals that are compared with those of all links, not with those around
LIKELY = 2.0 / 3.0  # probability below which a link that has grown is dropped: it is not twice as probably right as wrong


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Pairs of a reference and a deformed point, at most one for each.

    Attributes
    ----------
    pairs : ndarray, shape (k, 2), int64
        Index of the reference point, index of the deformed point; sorted by the former.
    confidence : ndarray, shape (k,)
        Probability that the link is right, from its residual and the density of unlinked points.
    residual_mm : ndarray, shape (k,)
        Residual from the local affine fit: distance of the deformed point from its position predicted by the links around it, mm; from the
        thin-plate spline through all others where all are assigned at once.
    unmatched_reference, unmatched_deformed : ndarray, int64
        Points without a link: vanished, appeared, or ambiguous.
    """

    pairs: IntArray
    confidence: FloatArray
    residual_mm: FloatArray
    unmatched_reference: IntArray
    unmatched_deformed: IntArray

    def __len__(self) -> int:
        return len(self.pairs)


@dataclass(frozen=True, slots=True, eq=False)
class _Guess:
    """A reference and a deformed point that may be the same, the agreement of their neighbours, and its gradient (d, d)."""

    seed: int
    target: int
    score: float
    gradient: FloatArray
    away: float  # distance from the position expected from the motion of the whole clouds, in spacings


def link_markers(
    reference_points: ArrayLike,
    deformed_points: ArrayLike,
    *,
    predicted: ArrayLike | None = None,
    seed: int = 0,
    settings: LinkSettings | None = None,
) -> Links:
    """Link the markers of two states.

    Parameters
    ----------
    reference_points : array_like, shape (n, d)
        Markers of the first state, mm, in two or three dimensions.
    deformed_points : array_like, shape (m, d)
        Markers of the second state, mm, in any order; some may be missing, some new.
    predicted : array_like, shape (n, d), optional
        Expected positions of the reference points in the second state, mm (from an earlier state or another registration).
    seed : int
        Of the random choice of the points from which links grow.
    settings : LinkSettings, optional
        How guesses are searched for, and which residuals are accepted.

    Returns
    -------
    Links
        Pairs, their confidence, and the points that have none.

    Raises
    ------
    InputError
        Fewer than three points, shapes that do not match, coordinates that are not finite, two clouds without common structure, or links
        that no soft body allows: lengths in other units, or a mirror image.
    """
    how = settings if settings is not None else LinkSettings()
    reference, deformed = _checked(reference_points, "reference_points"), _checked(deformed_points, "deformed_points")
    if reference.shape[1] != deformed.shape[1]:
        raise InputError(f"points must have the same dimension: reference_points is {reference.shape}, deformed_points {deformed.shape}")
    if predicted is not None:
        expected = np.array(predicted, dtype=float)
        require_shape("predicted", expected, reference.shape)
        reference = require_finite("predicted", expected)
    stretch = np.eye(reference.shape[1]) if predicted is not None else _overall_stretch(reference, deformed)
    # the deformed points are stretched back as a whole, so that neighbours are about as far apart along every axis
    moved_back = (deformed - deformed.mean(axis=0)) @ np.linalg.inv(stretch).T + reference.mean(axis=0) if predicted is None else deformed
    cloud = prepared(reference, np.ascontiguousarray(moved_back))
    rng = np.random.default_rng(seed)
    whole = max(len(reference), len(deformed)) <= how.assign_up_to
    if whole:
        link = _assigned(cloud, rng, stretch, how)
        found = _of_assignment(link, residuals(reference, deformed, link), deformed)
    else:
        grown = refined(cloud, _best_grown(cloud, rng, stretch, how), how)
        found = replace(grown, vectors=grown.vectors @ stretch.T, volume=grown.volume * float(np.linalg.det(stretch)))
    links = _reported(found, reference, deformed)
    right = coherence_of_links(reference[links.pairs[:, 0]], deformed[links.pairs[:, 1]])
    # links that have grown are judged by residuals around each, which tell noise from chance; where all are assigned at once nothing does
    links = replace(links, confidence=(right if whole else float(right > 0.0)) * links.confidence)
    smaller, sure = min(len(reference), len(deformed)), float(links.confidence.mean()) if len(links) else 0.0
    kept = links if whole else _likely(links)
    chance = sure < how.min_mean_confidence if len(links) >= FEW_LINKS else len(links) < FEW_LINKED * smaller
    if chance or (not whole and len(kept) < LEAST_LINKED * smaller):
        raise InputError(
            f"no common structure in {len(reference)} and {len(deformed)} markers: {len(links)} fit one smooth motion, with a mean "
            f"probability of {sure:.2f}, as by chance. Check that both are in mm and of one object"
        )
    return kept


def _checked(points: ArrayLike, name: str) -> FloatArray:
    p = as_points(name, points, least=FEWEST)
    if not np.ptp(p, axis=0).any():
        raise InputError(f"all {len(p)} markers of {name} lie at {p[0].tolist()}; there is no structure to link")
    return p


def _assigned(cloud: Cloud, rng: np.random.Generator, stretch: FloatArray, how: LinkSettings) -> IntArray:
    """Assign few markers: from translations of the whole cloud, and if these do not suffice, from links that have grown."""
    best = assigned(cloud.reference, cloud.deformed, _shifted(cloud, rng, stretch), cloud.deformed_scale, how)
    if best.quality < ENOUGH * min(len(cloud.reference), len(cloud.deformed)):
        positions = []
        for g in _guesses(cloud, _seeds(cloud, rng), stretch, np.inf, how, wide=False)[:SHIFTS]:
            state = _grown(cloud, [g])
            if state.count > cloud.dimensions + 1:
                position = np.full_like(cloud.reference, np.nan)
                position[state.link >= 0] = cloud.deformed[state.link[state.link >= 0]]
                positions.append(position)
        if positions:
            best = max(
                best, assigned(cloud.reference, cloud.deformed, positions, cloud.deformed_scale, how, worth=0.0), key=lambda a: a.quality
            )
        best = exchanged(cloud.reference, cloud.deformed, best, cloud.deformed_scale, how)
    return best.link


def _shifted(cloud: Cloud, rng: np.random.Generator, stretch: FloatArray) -> list[FloatArray]:
    """Return predicted positions of all reference points: as they are, and by translations that map a seed to a deformed point."""
    starts = [cloud.reference]
    for chosen in _seeds(cloud, rng)[:SHIFT_SEEDS]:
        targets = np.argsort(np.linalg.norm(cloud.deformed - cloud.reference[chosen], axis=1))[:SHIFTS]
        for gradient in (np.eye(cloud.dimensions), np.linalg.inv(stretch)):
            turned = (cloud.reference - cloud.reference[chosen]) @ gradient.T
            starts += [turned + cloud.deformed[t] for t in targets]
    return starts


def _best_grown(cloud: Cloud, rng: np.random.Generator, stretch: FloatArray, how: LinkSettings) -> State:
    """Grow links from the best guesses until one links nearly all points; return the one that links most."""
    smaller = min(len(cloud.reference), len(cloud.deformed))
    best: tuple[float, State] | None = None
    most_seen = 0.0
    # near their expected position, at first from few deformation gradients, and from other seeds each time
    for radius, wide in [(r, w) for r in how.search_radii for w in (False, True) if np.isfinite(r) or not w]:
        seeds = _seeds(cloud, rng)
        guesses = _guesses(cloud, seeds[::2] if wide else seeds, stretch, radius, how, wide=wide)
        most_seen = max([most_seen, *(g.score for g in guesses)])
        families = _families(guesses)
        for together in families[:GROWN]:
            state = _grown(cloud, together)
            quality = state.count - 1e-3 * float(np.mean([g.away for g in together]))
            if best is None or quality > best[0]:
                best = quality, state
            if best[1].count >= NEARLY_ALL * smaller or (len(together) > 1 and state.count >= 0.5 * smaller):
                return best[1]
        if best is not None and best[1].count >= 0.5 * smaller:
            return best[1]
    if best is None or best[1].count < max(FEWEST, LEAST_LINKED * smaller):
        raise InputError(
            f"no common structure in {len(cloud.reference)} and {len(cloud.deformed)} markers: at best {100.0 * most_seen:.0f} % of the "
            "neighbours "
            "of a marker are found again under one affine motion. Check that both are in mm and of one object"
        )
    return best[1]


def _guesses(cloud: Cloud, seeds: IntArray, stretch: FloatArray, radius: float, how: LinkSettings, *, wide: bool) -> list[_Guess]:
    """Try seeds against targets within `radius` spacings of their expected position; return the accepted ones, best first."""
    tree, typical = cKDTree(cloud.deformed), float(np.mean(cloud.deformed_scale))
    starts, kept = _starts(stretch, wide=wide), []
    for chosen in seeds:
        expected = cloud.reference[chosen]
        near = tree.query_ball_point(expected, radius * typical) if np.isfinite(radius) else range(len(cloud.deformed))
        targets = np.array(near, dtype=np.int64)
        if len(targets):
            kept += _tried(cloud, int(chosen), targets, starts, expected, typical, 0.7 * how.min_agreement)
    return sorted((g for g in kept if g.score >= how.min_agreement), key=lambda g: (-round(g.score, 1), g.away))


def _seeds(cloud: Cloud, rng: np.random.Generator) -> IntArray:
    """Choose reference points with neighbours all around.

    Some lie near the centre, where a rotation of the whole moves least, some anywhere, and some where most points seem to be found again,
    since loss may depend on the place.
    """
    n = len(cloud.reference)
    drawn = rng.choice(n, size=min(n, 20 * SEEDS), replace=False)
    around = cloud.reference[cloud.neighbours[drawn]]
    off_centre = np.linalg.norm(around.mean(axis=1) - cloud.reference[drawn], axis=1)
    far = np.linalg.norm(around - cloud.reference[drawn][:, None], axis=2).max(axis=1)
    inner = drawn[np.argsort(off_centre / np.maximum(far, 1e-300), kind="stable")[: 5 * SEEDS]]
    middle = inner[np.argsort(np.linalg.norm(cloud.reference[inner] - cloud.reference.mean(axis=0), axis=1), kind="stable")]
    others = [i for i in inner if i not in set(middle[: SEEDS // 2])]
    chosen = [*middle[: SEEDS // 2], *others[: SEEDS - SEEDS // 2]]
    amid = drawn[np.argsort(off_centre / np.maximum(far, 1e-300), kind="stable")[: len(drawn) // 2]]
    there = np.asarray(cKDTree(cloud.deformed).query(cloud.reference[amid])[1])
    thinned = cloud.deformed_scale[there] / cloud.reference_scale[amid]
    dense = [i for i in amid[np.argsort(thinned, kind="stable")] if i not in set(chosen)]
    return np.asarray([*chosen, *dense[:SEEDS]], dtype=np.int64)


def _overall_stretch(reference: FloatArray, deformed: FloatArray) -> FloatArray:
    """Return the stretch (d, d) without rotation that maps the covariance of one cloud to that of the other."""
    d = reference.shape[1]
    a, b = reference - reference.mean(axis=0), deformed - deformed.mean(axis=0)
    thin = 0.02 * np.eye(d)  # a cloud in a plane or on a line keeps its extent across
    ca, cb = a.T @ a / len(a), b.T @ b / len(b)
    common = min(float(np.trace(ca)), float(np.trace(cb)))
    ca, cb = ca + common * thin, cb + common * thin
    root = _square_root(ca)
    inverse = np.linalg.inv(root)
    return np.asarray(inverse @ _square_root(root @ cb @ root) @ inverse)


def _square_root(matrix: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _starts(stretch: FloatArray, *, wide: bool) -> FloatArray:
    """Return initial deformation gradients (f, d, d), after the overall stretch: that or none, and for a wide search others."""
    d = len(stretch)
    back = np.linalg.inv(stretch)
    starts = [np.eye(d), back]
    if wide:
        for axis in range(d):
            for factor in (0.55, 0.75, 1.3):
                one = np.full(d, factor ** (-1.0 / (d - 1)))
                one[axis] = factor
                starts.append(np.diag(one) @ back)
        for angle in np.radians((-40.0, -20.0, -10.0, 10.0, 20.0, 40.0)):
            for i, j in ((0, 1), (0, 2), (1, 2)) if d == 3 else ((0, 1),):
                turn = np.eye(d)
                turn[i, i] = turn[j, j] = np.cos(angle)
                turn[i, j], turn[j, i] = -np.sin(angle), np.sin(angle)
                starts += [back @ turn, back @ turn @ stretch]
    return np.array(starts)


def _tried(
    cloud: Cloud, chosen: int, targets: IntArray, starts: FloatArray, expected: FloatArray, typical: float, least: float
) -> list[_Guess]:
    """Return the best start for every target of one seed."""
    f = len(starts)
    away = np.linalg.norm(cloud.deformed[targets] - expected, axis=1) / typical
    targets = targets[np.argsort(away, kind="stable")][: GUESSES_AT_ONCE // f]
    away = np.sort(away)[: len(targets)]
    wanted, gradients = np.repeat(targets, f), np.tile(starts, (len(targets), 1, 1))
    score, found = np.empty(len(wanted)), np.empty_like(gradients)
    seeds = np.full(len(wanted), chosen, dtype=np.int64)
    try_guesses(
        cloud.reference, cloud.neighbours, cloud.deformed, *cloud.grid, cloud.deformed_scale[wanted], seeds, wanted, gradients, TIGHT,
        score, found,
    )  # fmt: skip
    best = np.argmax(score.reshape(-1, f), axis=1) + f * np.arange(len(targets))
    good = np.flatnonzero(score[best] >= least)
    return [_Guess(chosen, int(targets[i]), float(score[best[i]]), found[best[i]], float(away[i])) for i in good]


def _families(guesses: list[_Guess]) -> list[list[_Guess]]:
    """Group guesses that grow together: those of all seeds with one clear best; and each guess alone."""
    of_seed: dict[int, list[_Guess]] = {}
    for g in guesses:
        of_seed.setdefault(g.seed, []).append(g)
    clear = [max(gs, key=lambda g: g.score) for gs in of_seed.values() if sum(g.score > 0.8 * max(h.score for h in gs) for g in gs) == 1]
    sure = [g for g in clear if g.score >= SURE]
    return ([sure] if len(sure) > 1 else []) + [[g] for g in guesses]


def _grown(cloud: Cloud, guesses: list[_Guess]) -> State:
    """Grow links from guesses, wave by wave."""
    n, d = cloud.reference.shape
    link, owner = np.full(n, -1, dtype=np.int64), np.full(len(cloud.deformed), -1, dtype=np.int64)
    state = State(link, owner, np.full(n, np.inf), np.tile(np.eye(d), (n, 1, 1)))
    for g in guesses:
        if owner[g.target] < 0:
            link[g.seed], owner[g.target], state.residual[g.seed] = g.target, g.seed, 0.0
            state.gradients[g.seed] = g.gradient
    tries, active = np.zeros(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    reach = GROWING * cloud.growth * cloud.reference_scale
    for wave in range(MOST_WAVES):
        if wave == PROBATION[0] and n > FEW and state.count < PROBATION[1]:
            break
        count = frontier(cloud.neighbours, link, tries, MOST_TRIES, 4 * d, active)
        if count == 0:
            break
        some = active[:count].copy()
        tries[some] += 1
        _, proposal, distance, fitted = proposed(cloud, state, some, reach, robust=False)
        settle(some, proposal, distance, link, owner, state.residual, fitted, state.gradients)
    return state


def _of_assignment(link: IntArray, residual: FloatArray, deformed: FloatArray) -> RefinedLinks:
    """Return the links of an assignment, whose residuals (n,), mm, are compared with those of all links."""
    linked = link >= 0
    typical = float(np.median(residual[linked])) / np.sqrt(deformed.shape[1]) if linked.any() else 0.0
    sd = np.maximum(typical, 0.01 * local_spacing(deformed)[link])
    return RefinedLinks(link, np.where(linked, residual, np.nan)[:, None], residual / sd, sd ** deformed.shape[1], UNEVEN)


def _reported(found: RefinedLinks, reference_points: FloatArray, deformed: FloatArray) -> Links:
    """Return the links with the probability that each is right."""
    reference = np.flatnonzero(found.link >= 0)
    partner = found.link[reference]
    confidence = probability(found, reference_points, deformed)[reference]
    residual = np.linalg.norm(found.vectors[reference], axis=1)
    free = np.setdiff1d(np.arange(len(deformed)), partner)
    return Links(np.stack([reference, partner], axis=1), confidence, residual, np.flatnonzero(found.link < 0), free)


def _likely(links: Links) -> Links:
    """Return the links that are at least twice as probably right as wrong."""
    kept = links.confidence >= LIKELY
    reference, deformed = links.pairs[~kept].T
    return Links(
        links.pairs[kept],
        links.confidence[kept],
        links.residual_mm[kept],
        np.union1d(links.unmatched_reference, reference),
        np.union1d(links.unmatched_deformed, deformed),
    )
