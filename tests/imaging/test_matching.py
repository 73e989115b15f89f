"""Matching and relaxation against brute force in NumPy, and against known correspondence."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import grid, pair, texture

from naibu.core.errors import InputError
from naibu.core.rotation import rotation_matrix
from naibu.core.volume import Volume
from naibu.imaging.features import interest_points
from naibu.imaging.matching import Candidates, candidate_matches
from naibu.imaging.relaxation import STRENGTHS, direction_states, relaxed
from naibu.imaging.resampling import positions, sampled
from naibu.imaging.rigid import RigidMotion

RNG = np.random.default_rng(8)


def noisy(shape: tuple[int, int, int] = (14, 20, 24)) -> tuple[Volume, Volume]:
    frame = grid(shape, (0.8, 1.0, 1.5))
    a = RNG.uniform(0, 200, shape)
    return frame.with_values(a), frame.with_values(0.5 * a + RNG.uniform(0, 100, shape))


def inside_points(volume: Volume, n: int, margin: int = 5) -> np.ndarray:
    size = np.array(volume.shape[::-1])
    low = np.minimum(margin, (size - 1) // 2)
    return volume.to_physical(RNG.integers(low, size - low, (n, 3)))


@pytest.mark.parametrize("shape", [(14, 20, 24), (1, 30, 40)])
def test_scores_are_those_of_numpy(shape: tuple[int, int, int]) -> None:
    before, after = noisy(shape)
    x1, x2 = inside_points(before, 40), inside_points(after, 60)
    search, match = np.array([4, 3, 2]), np.array([2, 3, 1])
    found = candidate_matches(before, after, x1, x2, search=search, match=match, least_score=-1.0)
    i1, i2 = np.rint(before.to_index(x1)).astype(int), np.rint(after.to_index(x2)).astype(int)
    half = np.where(np.array(shape[::-1]) > 1, match, 0)
    expected = {}
    for p in range(len(x1)):
        for q in range(len(x2)):
            if (np.abs(i1[p] - i2[q]) <= search).all():
                boxes = []
                for v, i in ((before, i1[p]), (after, i2[q])):
                    (x, y, z), (m, n, h) = i, half
                    boxes.append(v.values[z - h : z + h + 1, y - n : y + n + 1, x - m : x + m + 1].ravel())
                expected[p, q] = np.corrcoef(*boxes)[0, 1], np.abs(boxes[0] - boxes[1]).mean()
    assert {tuple(pair_) for pair_ in found.pairs.tolist()} == set(expected)
    order = [expected[tuple(pair_)] for pair_ in found.pairs.tolist()]
    np.testing.assert_allclose(found.scores, [v[0] for v in order], atol=1e-5)
    np.testing.assert_allclose(found.residuals, [v[1] for v in order], rtol=1e-5)


def test_turned_boxes_match_what_was_turned() -> None:
    frame = grid((24, 40, 40), (1.0, 1.0, 1.2))
    motion = RigidMotion(rotation_matrix(np.array([0.05, -0.1, 0.5])), np.array([2.0, -3.0, 1.0]), np.zeros(0))
    grey, x = texture(1, (5.0, 12.0)), positions(frame)
    about = frame.to_physical([20, 20, 12])
    motion = RigidMotion(motion.rotation, motion.translation + about - motion.rotation @ about, np.zeros(0))
    before, after = frame.with_values(grey(x)), frame.with_values(grey(motion.inverse().moved(x)))
    points = frame.to_physical(np.array([20, 20, 12]) + RNG.integers(-5, 6, (10, 3)))
    options = {"rigid": motion, "least_score": -1.0, "search": (1, 1, 1)}
    turned = candidate_matches(before, after, points, motion.moved(points), turned_boxes=True, **options)
    straight = candidate_matches(before, after, points, motion.moved(points), **options)
    own = turned.pairs[:, 0] == turned.pairs[:, 1]
    assert turned.scores[own].min() > 0.98
    assert straight.scores[own].mean() < turned.scores[own].mean() - 0.1
    value = np.abs(sampled(after, motion.moved(points)) - sampled(before, points))
    assert value.max() < 8.0
    assert np.nanmax(turned.residuals[own]) < 8.0


def test_the_search_box_grows_away_from_the_middle() -> None:
    before, after = noisy()
    x1, x2 = inside_points(before, 60), inside_points(after, 200)
    small = candidate_matches(before, after, x1, x2, search=(3, 3, 2), match=(2, 2, 1), least_score=-1.0)
    grown = candidate_matches(before, after, x1, x2, search=(3, 3, 2), match=(2, 2, 1), least_score=-1.0, search_growth=1.0)
    assert {tuple(p) for p in small.pairs.tolist()} < {tuple(p) for p in grown.pairs.tolist()}


def test_bad_input_to_the_matching_is_refused() -> None:
    before, after = noisy()
    x = inside_points(before, 5)
    with pytest.raises(InputError, match="no two points look alike"):
        candidate_matches(before, after, x, x + 500.0)
    with pytest.raises(InputError, match="three whole numbers"):
        candidate_matches(before, after, x, x, match=(1.5, 1, 1))
    with pytest.raises(InputError, match="shape"):
        candidate_matches(before, after, x[:, :2], x)
    other = Volume.from_array(after.values, spacing_mm=(1.0, 1.0, 1.0))
    with pytest.raises(InputError, match="voxels differ"):
        candidate_matches(before, other, x, x)


def test_directions_are_rounded_to_the_nearest_of_26() -> None:
    v = RNG.standard_normal((400, 3))
    states = direction_states(v)
    grid26 = np.array([(a, b, c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1) if (a, b, c) != (0, 0, 0)])
    cosine = (v @ grid26.T) / np.linalg.norm(v, axis=1)[:, None] / np.linalg.norm(grid26, axis=1)
    np.testing.assert_array_equal(states, grid26[cosine.argmax(axis=1)])
    assert len(np.unique(states, axis=0)) == 26
    assert len(np.unique(direction_states(v * [1, 1, 0], plane=True), axis=0)) == 8
    assert (direction_states(np.zeros((1, 3))) == 0).all()


def made_up(seed: int, n: int = 30, m: int = 35) -> Candidates:
    """Return candidates of random points that move by about the same displacement, with random scores."""
    rng = np.random.default_rng(seed)
    x1 = rng.uniform(0, 30, (n, 3))
    x2 = np.vstack([x1 + [3.0, 1.0, 0.0] + 0.5 * rng.standard_normal((n, 3)), rng.uniform(0, 30, (m - n, 3))])
    pairs = np.argwhere(np.linalg.norm(x1[:, None] + [3.0, 1.0, 0.0] - x2, axis=-1) < 9.0)
    return Candidates(x1, x2, x1, pairs, rng.uniform(0.5, 1.0, len(pairs)), rng.uniform(5.0, 30.0, len(pairs)))


def strength_of_match(kind: str, c: Candidates, kept: list[int], p: int, alpha: float, radius: float, zeta: np.ndarray) -> float:
    """Return the strength of a pair by the formulas of the report, one neighbour after the other."""
    move = lambda q: c.deformed_mm[c.pairs[q, 1]] - c.projected_mm[c.pairs[q, 0]]  # noqa: E731
    i, j = c.pairs[p]
    near, diff = [], []
    for q in kept:
        k, l = c.pairs[q]  # noqa: E741
        d1, d2 = np.linalg.norm(c.projected_mm[i] - c.projected_mm[k]), np.linalg.norm(c.deformed_mm[j] - c.deformed_mm[l])
        if k != i and l != j and d1 <= radius and d2 <= radius:
            near.append(q)
            diff.append(abs(d1 - d2) / (0.5 * (d1 + d2)))
    if not near:
        return float(c.scores[p])
    eta = np.ones(len(near))
    if kind == "residual":
        z = zeta[near]
        gibbs = np.exp(-((z - z.mean()) ** 2) * z)
        eta = gibbs / gibbs.sum()
    total = 0.0
    for q, d, share in zip(near, diff, eta, strict=True):
        cosine = move(p) @ move(q) / np.linalg.norm(move(p)) / np.linalg.norm(move(q))
        if kind == "chen":
            w = np.exp(-d / 0.3) if d < 0.3 else 0.0
        elif kind == "residual":
            w = share / (1 + d)
        elif kind == "direction":
            w = np.exp(-(1 + 1 / (1 + cosine)) * (1 + d))
        else:
            a, b = direction_states(np.array([move(p), move(q)]))
            angle = 0 if (a == b).all() else (1 if a @ b > 0 else 2 if a @ b == 0 else 3)
            w = np.exp(-d) if angle == 0 else np.exp(-angle / 3 * d)
        total += c.scores[q] * w
    return float(c.scores[p] + (total if kind == "direction" else alpha * total))


def mutual(c: Candidates, values: np.ndarray) -> list[int]:
    best_first = {i: max((q for q in range(len(c)) if c.pairs[q, 0] == i), key=lambda q: values[q]) for i in set(c.pairs[:, 0].tolist())}
    best_second = {j: max((q for q in range(len(c)) if c.pairs[q, 1] == j), key=lambda q: values[q]) for j in set(c.pairs[:, 1].tolist())}
    return sorted(q for q in best_first.values() if best_second[int(c.pairs[q, 1])] == q)


@pytest.mark.parametrize("kind", list(STRENGTHS))
@given(st.integers(0, 10**6))
@settings(max_examples=6, deadline=None)
def test_relaxation_follows_the_pseudo_code(kind: str, seed: int) -> None:
    c, radius, step, top = made_up(seed), 12.0, 0.25, 0.5
    zeta = c.residuals / c.residuals.mean()
    kept, alpha, energies = mutual(c, c.scores), 0.0, []
    history = []
    for _ in range(8):
        values = np.array([strength_of_match(kind, c, kept, p, alpha, radius, zeta) for p in range(len(c))])
        energy = float(values[kept].mean())
        if energies and energy < energies[-1]:
            break
        energies.append(energy)
        history.append(kept)
        after = mutual(c, values)
        grown = 0.0 if kind == "direction" else min(alpha + step, top)
        if grown == alpha and after == kept:
            break
        kept, alpha = after, grown
    found = relaxed(c, strength=kind, radius_mm=radius, alpha_step=step, alpha_max=top, max_iterations=8)
    np.testing.assert_allclose(found.energies, energies, rtol=1e-9)
    np.testing.assert_array_equal(found.counts, [len(k) for k in history])
    assert {tuple(p) for p in found.pairs.tolist()} == {tuple(c.pairs[q].tolist()) for q in history[-1]}


def test_opposite_directions_weigh_nothing() -> None:
    x1 = np.array([[0.0, 0, 0], [4.0, 0, 0]])
    x2 = np.array([[1.0, 0, 0], [3.0, 0, 0]])
    c = Candidates(x1, x2, x1, np.array([[0, 0], [1, 1]]), np.array([0.9, 0.8]), np.ones(2))
    found = relaxed(c, strength="direction", radius_mm=10.0)
    np.testing.assert_allclose(np.sort(found.strengths), [0.8, 0.9])


@pytest.mark.parametrize("kind", list(STRENGTHS))
def test_a_smooth_motion_is_found_among_false_candidates(kind: str) -> None:
    frame = grid((26, 44, 44))

    def motion(x: np.ndarray) -> np.ndarray:
        return np.stack([2.0 + 0.04 * x[..., 1], -1.5 + 0.03 * x[..., 2], 0.8 + 0.02 * x[..., 0]], axis=-1)

    before, after, _ = pair(frame, motion, seed=3, wave_mm=(6.0, 14.0), noise=4.0)
    x1 = interest_points(before, count=150, border=4).points_mm
    x2 = interest_points(after, count=400, border=4).points_mm
    c = candidate_matches(before, after, x1, x2, search=(7, 7, 5), match=(2, 2, 2), least_score=0.3)
    found = relaxed(c, strength=kind)
    # points are voxels in both volumes: two of them are right when they differ by rounding
    error = np.linalg.norm(found.deformed_mm - found.initial_mm - motion(found.initial_mm), axis=1)
    all_errors = np.linalg.norm(x2[c.pairs[:, 1]] - x1[c.pairs[:, 0]] - motion(x1[c.pairs[:, 0]]), axis=1)
    assert (all_errors < 2.0).mean() < 0.6
    assert len(found) > 60 and (error < 2.0).mean() > 0.9
    assert (np.diff(found.energies) >= 0).all()


def test_relaxation_refuses_what_it_does_not_know() -> None:
    with pytest.raises(InputError, match="strength must be"):
        relaxed(made_up(0), strength="best")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="radius"):
        relaxed(made_up(0), radius_mm=0.0)
