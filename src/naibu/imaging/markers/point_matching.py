"""Which marker is which: links between the markers of two states, by structure and a smooth motion (spec S9).

Nothing is assumed about the motion but that it is nearly affine over a few spacings. Somewhere a point is guessed to be one of the others,
and the guess is believed if the neighbours of the one are found around the other under one affine motion: that is how displacements of many
spacings are found. From there links grow, each predicted by those around it, and at last every link must agree with the affine motion of
its neighbours, itself left out. In lattices, where all surroundings look alike, several guesses grow, and the one that links most markers
is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.imaging.markers._point_matching_kernels import fill_grid, frontier, propose, propose_few, settle, try_guesses
from naibu.imaging.markers.thin_plate_assignment import ENOUGH, assigned, departures, exchanged

FEWEST = 3
# up to so many markers all are assigned at once; of so many targets near each of some seeds the translation is tried
FEW, SHIFT_SEEDS, SHIFTS = 600, 3, 30
# neighbours that are looked at, in two and three dimensions
NEIGHBOURS = {2: 12, 3: 20}
# a spacing, by which all distances are measured, in mean distances of nearest neighbours
SPACING = 1.15
# spacings within which a neighbour counts as found again, and within which a link may grow
TIGHT, GROWING = 0.25, 0.45
# share of the neighbours found again that makes a guess worth growing, and one that needs no rival
LIKELY, SURE = 0.55, 0.75
# reference points from which guesses start; spacings around their expected place within which targets are tried in turn, and whether from
# many deformation gradients
SEEDS = 8
SEARCHES = ((4.0, False), (4.0, True), (8.0, False), (8.0, True), (16.0, False), (16.0, True), (np.inf, False))
GUESSES_AT_ONCE = 200_000
# guesses that grow before the best is taken; share of the points that ends the search; links after so many waves without which growth ends
GROWN, NEARLY_ALL, PROBATION = 30, 0.985, (5, 24)
MOST_TRIES, MOST_WAVES, REFINEMENTS = 4, 400, 6
# a link departs from its neighbours' motion by at most so many medians of that departure, within these bounds in spacings
DEPARTURE, DEPARTURE_BOUNDS = 4.5, (0.15, 0.8)

# links among strangers have a mean probability below the first; of fewer than the second, the last share of the markers must have one
BY_CHANCE = (0.7, 8, 0.5)


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Pairs of a reference and a moving point, at most one for each.

    Attributes
    ----------
    pairs : ndarray, shape (k, 2), int64
        Index of the reference point, index of the moving point; sorted by the former.
    confidence : ndarray, shape (k,)
        Probability that the link is right, from how well it agrees with its neighbours' motion and how many strangers are about.
    departure_mm : ndarray, shape (k,)
        Distance of the moving point from where the links around it, without it, predict it.
    unmatched_reference, unmatched_moving : ndarray, int64
        Points without a link: vanished, appeared, or not to be told.
    """

    pairs: IntArray
    confidence: FloatArray
    departure_mm: FloatArray
    unmatched_reference: IntArray
    unmatched_moving: IntArray

    def __len__(self) -> int:
        return len(self.pairs)


@dataclass(frozen=True, slots=True, eq=False)
class _Cloud:
    """Reference points with their neighbours, moving points in a grid, and the spacings of both."""

    reference: FloatArray
    neighbours: IntArray
    reference_scale: FloatArray
    moving: FloatArray
    moving_scale: FloatArray
    grid: tuple[FloatArray, float, IntArray, IntArray, IntArray]  # origin, width, dims, starts, members
    growth: float  # spacing of the moving points by that of the reference points

    @property
    def dimensions(self) -> int:
        return int(self.reference.shape[1])


@dataclass(slots=True, eq=False)
class _State:
    """Links while they grow: moving point of every reference point and the other way round (-1: none), departures, local gradients."""

    link: IntArray
    owner: IntArray
    residual: FloatArray
    gradients: FloatArray

    @property
    def count(self) -> int:
        return int((self.link >= 0).sum())


@dataclass(frozen=True, slots=True, eq=False)
class _Guess:
    """A reference point that may be a moving point, how well their surroundings agree, and the gradient (d, d) that says so."""

    seed: int
    target: int
    score: float
    gradient: FloatArray
    away: float  # from where the whole clouds would put it, in spacings


def link_markers(reference_points: ArrayLike, moving_points: ArrayLike, *, predicted: ArrayLike | None = None, seed: int = 0) -> Links:
    """Link the markers of two states.

    Parameters
    ----------
    reference_points : array_like, shape (n, d)
        Markers of the first state, mm, in two or three dimensions.
    moving_points : array_like, shape (m, d)
        Markers of the second state, mm, in any order; some may be missing, some new.
    predicted : array_like, shape (n, d), optional
        Where the reference points are expected in the second state, mm (from an earlier state or another registration).
    seed : int
        Of the draw of the points from which links grow.

    Returns
    -------
    Links
        Pairs, their confidence, and the points that have none.

    Raises
    ------
    InputError
        Fewer than three points, shapes that do not fit, coordinates that are not finite, or two clouds without common structure.
    """
    reference, moving = _checked(reference_points, "reference_points"), _checked(moving_points, "moving_points")
    if reference.shape[1] != moving.shape[1]:
        raise InputError(f"points must have the same dimension: reference_points is {reference.shape}, moving_points {moving.shape}")
    if predicted is not None:
        expected = np.asarray(predicted, dtype=float)
        if expected.shape != reference.shape or not np.isfinite(expected).all():
            raise InputError(f"predicted must be finite and have the shape {reference.shape} of the reference points, not {expected.shape}")
        reference = np.ascontiguousarray(expected)
    stretch = np.eye(reference.shape[1]) if predicted is not None else _overall_stretch(reference, moving)
    # links are sought where the moving points are stretched back as a whole, so that neighbours are about as far apart along every axis
    moved_back = (moving - moving.mean(axis=0)) @ np.linalg.inv(stretch).T + reference.mean(axis=0) if predicted is None else moving
    cloud = _prepared(reference, np.ascontiguousarray(moved_back))
    rng = np.random.default_rng(seed)
    if max(len(reference), len(moving)) <= FEW:
        link = _assigned(cloud, rng, stretch)
        departure = departures(reference, moving, link)
    else:
        state = _best_grown(cloud, rng, stretch)
        link, departure = state.link, _refined(cloud, state) * float(np.linalg.det(stretch)) ** (1.0 / reference.shape[1])
    links = _reported(_spacing(moving), link, departure, reference.shape[1])
    smaller, sure = min(len(reference), len(moving)), float(links.confidence.mean()) if len(links) else 0.0
    if sure < BY_CHANCE[0] if len(links) >= BY_CHANCE[1] else len(links) < BY_CHANCE[2] * smaller:
        raise InputError(
            f"no common structure in {len(reference)} and {len(moving)} markers: {len(links)} fit under one smooth motion, right with "
            f"a probability of {sure:.2f}, as among strangers. Check that both are in mm and of one object, or give `predicted`"
        )
    return links


def _checked(points: ArrayLike, name: str) -> FloatArray:
    p = np.ascontiguousarray(points, dtype=float)
    if p.ndim != 2 or p.shape[1] not in (2, 3):
        raise InputError(f"{name} must have shape (n, 2) or (n, 3), mm, not {p.shape}")
    if len(p) < FEWEST:
        raise InputError(f"{name} holds {len(p)} markers; at least {FEWEST} are needed to tell them apart")
    if not np.isfinite(p).all():
        bad = int(np.flatnonzero(~np.isfinite(p).all(axis=1))[0])
        raise InputError(f"marker {bad} of {name} is {p[bad].tolist()}: leave incomplete markers out")
    if not np.ptp(p, axis=0).any():
        raise InputError(f"all {len(p)} markers of {name} lie at {p[0].tolist()}; there is no structure to link")
    return p


def _prepared(reference: FloatArray, moving: FloatArray) -> _Cloud:
    d = reference.shape[1]
    k = min(NEIGHBOURS[d], len(reference) - 1)
    tree = cKDTree(reference)
    neighbours = np.ascontiguousarray(np.asarray(tree.query(reference, k=k + 1, workers=-1)[1])[:, 1:], dtype=np.int64)
    reference_scale, moving_scale = _spacing(reference), _spacing(moving)
    width = 0.6 * float(np.mean(moving_scale))
    low, extent = moving.min(axis=0), np.ptp(moving, axis=0)
    width = max(width, float((np.maximum(extent, width).prod() / (4.0 * len(moving) + 64.0)) ** (1.0 / d)))
    dims = (extent / width).astype(np.int64) + 1
    starts, members = np.zeros(int(dims.prod()) + 2, dtype=np.int64), np.empty(len(moving), dtype=np.int64)
    fill_grid(moving, low, width, dims, starts, members)
    grid = (low, width, dims, starts, members)
    return _Cloud(
        reference, neighbours, reference_scale, moving, moving_scale, grid, float(np.mean(moving_scale) / np.mean(reference_scale))
    )


def _spacing(points: FloatArray) -> FloatArray:
    """Return the typical distance of neighbours around every point (n,), mm."""
    distance, index = cKDTree(points).query(points, k=min(9, len(points)), workers=-1)
    nearest = np.asarray(distance)[:, 1]
    local = SPACING * nearest[index].mean(axis=1)
    return np.asarray(np.maximum(local, 0.2 * SPACING * nearest.mean() + 1e-12))


def _assigned(cloud: _Cloud, rng: np.random.Generator, stretch: FloatArray) -> IntArray:
    """Link few markers: from predictions by shifts of the whole, and if those leave something to be wished, from links that have grown."""
    best = assigned(cloud.reference, cloud.moving, _shifted(cloud, rng, stretch), cloud.moving_scale)
    if best.quality < ENOUGH * min(len(cloud.reference), len(cloud.moving)):
        places = []
        for g in _guesses(cloud, _seeds(cloud, rng), stretch, np.inf, wide=False)[:SHIFTS]:
            state = _grown(cloud, [g])
            if state.count > cloud.dimensions + 1:
                place = np.full_like(cloud.reference, np.nan)
                place[state.link >= 0] = cloud.moving[state.link[state.link >= 0]]
                places.append(place)
        if places:
            best = max(best, assigned(cloud.reference, cloud.moving, places, cloud.moving_scale, worth=0.0), key=lambda a: a.quality)
        best = exchanged(cloud.reference, cloud.moving, best, cloud.moving_scale)
    return best.link


def _shifted(cloud: _Cloud, rng: np.random.Generator, stretch: FloatArray) -> list[FloatArray]:
    """Return predictions of where all reference points went: by the spread of the clouds, and by shifts that put one on another."""
    starts = [cloud.reference]
    for chosen in _seeds(cloud, rng)[:SHIFT_SEEDS]:
        targets = np.argsort(np.linalg.norm(cloud.moving - cloud.reference[chosen], axis=1))[:SHIFTS]
        for gradient in (np.eye(cloud.dimensions), np.linalg.inv(stretch)):
            turned = (cloud.reference - cloud.reference[chosen]) @ gradient.T
            starts += [turned + cloud.moving[t] for t in targets]
    return starts


def _best_grown(cloud: _Cloud, rng: np.random.Generator, stretch: FloatArray) -> _State:
    """Grow the likely guesses until one links nearly all that can be linked; return the one that links most."""
    smaller = min(len(cloud.reference), len(cloud.moving))
    best: tuple[float, _State] | None = None
    most_seen = 0.0
    seeds = _seeds(cloud, rng)
    for radius, wide in SEARCHES:
        guesses = _guesses(cloud, seeds[: SEEDS // 2] if wide else seeds, stretch, radius, wide=wide)
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
    if best is None or best[1].count < max(FEWEST, 0.1 * smaller):
        raise InputError(
            f"no common structure in {len(cloud.reference)} and {len(cloud.moving)} markers: at best {most_seen:.0%} of the neighbours of "
            "a marker are found again under one affine motion. Check that both are in mm and of one object, or give `predicted`"
        )
    return best[1]


def _guesses(cloud: _Cloud, seeds: IntArray, stretch: FloatArray, radius: float, *, wide: bool) -> list[_Guess]:
    """Try seeds against targets within `radius` spacings of their expected place; return the likely ones, best first."""
    tree, typical = cKDTree(cloud.moving), float(np.mean(cloud.moving_scale))
    starts, kept = _starts(stretch, wide=wide), []
    for chosen in seeds:
        expected = cloud.reference[chosen]
        near = tree.query_ball_point(expected, radius * typical) if np.isfinite(radius) else range(len(cloud.moving))
        targets = np.array(near, dtype=np.int64)
        if len(targets):
            kept += _tried(cloud, int(chosen), targets, starts, expected, typical)
    return sorted((g for g in kept if g.score >= LIKELY), key=lambda g: (-round(g.score, 1), g.away))


def _seeds(cloud: _Cloud, rng: np.random.Generator) -> IntArray:
    """Draw reference points with neighbours all around, half of them near the middle, where a turn of the whole moves least."""
    n = len(cloud.reference)
    drawn = rng.choice(n, size=min(n, 20 * SEEDS), replace=False)
    around = cloud.reference[cloud.neighbours[drawn]]
    off_centre = np.linalg.norm(around.mean(axis=1) - cloud.reference[drawn], axis=1)
    far = np.linalg.norm(around - cloud.reference[drawn][:, None], axis=2).max(axis=1)
    inner = drawn[np.argsort(off_centre / np.maximum(far, 1e-300), kind="stable")[: 5 * SEEDS]]
    middle = inner[np.argsort(np.linalg.norm(cloud.reference[inner] - cloud.reference.mean(axis=0), axis=1), kind="stable")]
    others = [i for i in inner if i not in set(middle[: SEEDS // 2])]
    return np.asarray([*middle[: SEEDS // 2], *others[: SEEDS - SEEDS // 2]], dtype=np.int64)


def _overall_stretch(reference: FloatArray, moving: FloatArray) -> FloatArray:
    """Return the stretch (d, d) that turns the spread of one cloud into that of the other without rotation."""
    d = reference.shape[1]
    a, b = reference - reference.mean(axis=0), moving - moving.mean(axis=0)
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
    """Return deformation gradients (f, d, d), after the stretch as a whole, to start from: that or none, and for a wide search others."""
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


def _tried(cloud: _Cloud, chosen: int, targets: IntArray, starts: FloatArray, expected: FloatArray, typical: float) -> list[_Guess]:
    """Return the best start for every target of one seed."""
    f = len(starts)
    away = np.linalg.norm(cloud.moving[targets] - expected, axis=1) / typical
    targets = targets[np.argsort(away, kind="stable")][: GUESSES_AT_ONCE // f]
    away = np.sort(away)[: len(targets)]
    wanted, gradients = np.repeat(targets, f), np.tile(starts, (len(targets), 1, 1))
    score, found = np.empty(len(wanted)), np.empty_like(gradients)
    seeds = np.full(len(wanted), chosen, dtype=np.int64)
    try_guesses(
        cloud.reference,
        cloud.neighbours,
        cloud.moving,
        *cloud.grid,
        cloud.moving_scale[wanted],
        seeds,
        wanted,
        gradients,
        TIGHT,
        score,
        found,
    )
    best = np.argmax(score.reshape(-1, f), axis=1) + f * np.arange(len(targets))
    good = np.flatnonzero(score[best] >= 0.7 * LIKELY)
    return [_Guess(chosen, int(targets[i]), float(score[best[i]]), found[best[i]], float(away[i])) for i in good]


def _families(guesses: list[_Guess]) -> list[list[_Guess]]:
    """Group guesses that grow together: all seeds that have one clear winner; and each guess alone."""
    of_seed: dict[int, list[_Guess]] = {}
    for g in guesses:
        of_seed.setdefault(g.seed, []).append(g)
    clear = [max(gs, key=lambda g: g.score) for gs in of_seed.values() if sum(g.score > 0.8 * max(h.score for h in gs) for g in gs) == 1]
    sure = [g for g in clear if g.score >= SURE]
    return ([sure] if len(sure) > 1 else []) + [[g] for g in guesses]


def _grown(cloud: _Cloud, guesses: list[_Guess]) -> _State:
    """Let links grow from guesses, wave by wave."""
    n, d = cloud.reference.shape
    link, owner = np.full(n, -1, dtype=np.int64), np.full(len(cloud.moving), -1, dtype=np.int64)
    state = _State(link, owner, np.full(n, np.inf), np.tile(np.eye(d), (n, 1, 1)))
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
        _, proposal, distance, fitted = _proposed(cloud, state, some, reach, robust=False)
        settle(some, proposal, distance, link, owner, state.residual, fitted, state.gradients)
    return state


def _proposed(
    cloud: _Cloud, state: _State, active: IntArray, reach: FloatArray, *, robust: bool
) -> tuple[FloatArray, IntArray, FloatArray, FloatArray]:
    """Return predictions, proposals, distances and local gradients of active reference points."""
    d, count = cloud.dimensions, len(active)
    predicted, proposal, distance = np.empty((count, d)), np.empty(count, dtype=np.int64), np.empty(count)
    fitted = np.zeros((count, d, d))
    (propose if count > FEW else propose_few)(
        cloud.reference, cloud.neighbours, cloud.moving, *cloud.grid, cloud.reference_scale, active, state.link, state.gradients, reach,
        NEIGHBOURS[d], robust, predicted, proposal, distance, fitted,
    )  # fmt: skip
    return predicted, proposal, distance, fitted


def _refined(cloud: _Cloud, state: _State) -> FloatArray:
    """Predict every point from its neighbours, drop links that depart and add those that fit, in turn; return the departures."""
    everyone = np.arange(len(cloud.reference))
    spacing = cloud.growth * cloud.reference_scale
    departure = np.full(len(everyone), np.inf)
    for _ in range(REFINEMENTS):
        predicted, _, _, _ = _proposed(cloud, state, everyone, np.zeros(len(everyone)), robust=True)
        departure = _departures(cloud, state, predicted)
        linked = state.link >= 0
        typical = float(np.median(departure[linked & np.isfinite(departure)])) if (linked & np.isfinite(departure)).any() else 0.0
        limit = np.clip(DEPARTURE * typical, DEPARTURE_BOUNDS[0] * spacing, DEPARTURE_BOUNDS[1] * spacing)
        wrong = linked & ~(departure <= limit)
        state.owner[state.link[wrong]] = -1
        state.link[wrong], state.residual[wrong] = -1, np.inf
        state.residual[state.link >= 0] = departure[state.link >= 0]
        predicted, proposal, distance, fitted = _proposed(cloud, state, everyone, limit, robust=True)
        changed = settle(everyone, proposal, distance, state.link, state.owner, state.residual, fitted, state.gradients)
        departure = _departures(cloud, state, predicted)
        if not changed and not wrong.any():
            break
    return departure


def _departures(cloud: _Cloud, state: _State, predicted: FloatArray) -> FloatArray:
    return np.asarray(np.where(state.link >= 0, np.linalg.norm(cloud.moving[np.maximum(state.link, 0)] - predicted, axis=1), np.inf))


def _reported(spacing: FloatArray, link: IntArray, departure: FloatArray, d: int) -> Links:
    """Return the links with the probability that each is right; `spacing` (m,) is that of the moving points, mm."""
    reference = np.flatnonzero(link >= 0)
    moving = link[reference]
    left, free = departure[reference], np.setdiff1d(np.arange(len(spacing)), moving)
    sd = np.maximum(float(np.median(left)) / np.sqrt(d) if len(left) else 0.0, 0.01 * spacing[moving])
    # a spacing is 0.63 of the d-th root of the room of a point
    strangers = (len(free) + 1.0) / (len(spacing) + 1.0) * (0.63 / spacing[moving]) ** d
    # departures have longer tails than a normal variable: Student's, three degrees of freedom
    right = (1.0 + (left / sd) ** 2 / 3.0) ** (-0.5 * (3.0 + d)) / (4.0 * sd) ** d
    confidence = right / np.maximum(right + strangers, 1e-300)
    return Links(np.stack([reference, moving], axis=1), confidence, left, np.flatnonzero(link < 0), free)
