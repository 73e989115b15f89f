"""Relaxation labelling: against the report's pseudo code and formulas written out, one pair after the other, and among false candidates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import grid, pair

from naibu.core.errors import InputError
from naibu.imaging.feature_matching.correlation_matching import Candidates, candidate_matches
from naibu.imaging.feature_matching.harris import interest_points
from naibu.imaging.feature_matching.relaxation_labelling import STRENGTHS, direction_states, relaxed

DIMENSIONS = [2, 3]
RNG = np.random.default_rng(8)


def flat(points: np.ndarray, dimension: int) -> np.ndarray:
    """Return points in the plane z = 0 where there are two dimensions."""
    return points * (np.arange(3) < dimension)


def made_up(seed: int, dimension: int, n: int = 30, m: int = 35) -> Candidates:
    """Return candidates of random points that move by about the same displacement, with random scores."""
    rng = np.random.default_rng(seed)
    x1 = flat(rng.uniform(0, 30, (n, 3)), dimension)
    others = rng.uniform(0, 30, (m - n, 3))
    x2 = flat(np.vstack([x1 + [3.0, 1.0, 0.0] + 0.5 * rng.standard_normal((n, 3)), others]), dimension)
    pairs = np.argwhere(np.linalg.norm(x1[:, None] + [3.0, 1.0, 0.0] - x2, axis=-1) < 9.0)
    return Candidates(x1, x2, x1, pairs, rng.uniform(0.5, 1.0, len(pairs)), rng.uniform(5.0, 30.0, len(pairs)))


def state(v: np.ndarray, dimension: int) -> tuple[int, ...]:
    """Return the direction among 8, by its angle in steps of 45 degrees, or among 26, by the largest cosine."""
    if dimension == 2:
        angle = np.round(np.arctan2(v[1], v[0]) / (np.pi / 4)) * np.pi / 4
        return int(np.round(np.cos(angle))), int(np.round(np.sin(angle))), 0
    around = [(a, b, c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1) if (a, b, c) != (0, 0, 0)]
    return max(around, key=lambda s: float(np.dot(s, v)) / np.linalg.norm(s))


def weight(kind: str, diff: float, first: np.ndarray, second: np.ndarray, dimension: int) -> float:
    """Return what a neighbour's correlation counts for a pair, by the displacements of both, but for its grey residual."""
    cosine = float(first @ second / np.linalg.norm(first) / np.linalg.norm(second))
    if kind == "chen":
        return float(np.exp(-diff / 0.3)) if diff < 0.3 else 0.0
    if kind == "residual":
        return 1.0 / (1.0 + diff)
    if kind == "direction":
        return float(np.exp(-(1.0 + 1.0 / (1.0 + cosine)) * (1.0 + diff)))
    a, b = np.array(state(first, dimension)), np.array(state(second, dimension))
    angle = 0 if (a == b).all() else (1 if a @ b > 0 else 2 if a @ b == 0 else 3)
    return float(np.exp(-diff) if angle == 0 else np.exp(-angle / 3 * diff))


def strength_of_match(kind: str, c: Candidates, kept: list[int], p: int, alpha: float, radius: float, dimension: int) -> float:
    """Return the strength of a pair by the formulas of the report, one neighbour after the other."""
    zeta = c.residuals / c.residuals.mean()
    move = lambda q: c.deformed_mm[c.pairs[q, 1]] - c.projected_mm[c.pairs[q, 0]]  # noqa: E731
    i, j = c.pairs[p]
    near, weights = [], []
    for q in kept:
        k, l = c.pairs[q]  # noqa: E741
        d1, d2 = np.linalg.norm(c.projected_mm[i] - c.projected_mm[k]), np.linalg.norm(c.deformed_mm[j] - c.deformed_mm[l])
        if k != i and l != j and d1 <= radius and d2 <= radius:
            near.append(q)
            weights.append(weight(kind, abs(d1 - d2) / (0.5 * (d1 + d2)), move(p), move(q), dimension))
    if not near:
        return float(c.scores[p])
    if kind == "residual":
        gibbs = np.exp(-((zeta[near] - zeta[near].mean()) ** 2) * zeta[near])
        weights = list(np.array(weights) * gibbs / gibbs.sum())
    total = sum(c.scores[q] * w for q, w in zip(near, weights, strict=True))
    return float(c.scores[p] + (total if kind == "direction" else alpha * total))


def mutual(c: Candidates, values: np.ndarray) -> list[int]:
    """Return the pairs that are the best of both their points."""
    best_first = {i: max((q for q in range(len(c)) if c.pairs[q, 0] == i), key=lambda q: values[q]) for i in set(c.pairs[:, 0].tolist())}
    best_second = {j: max((q for q in range(len(c)) if c.pairs[q, 1] == j), key=lambda q: values[q]) for j in set(c.pairs[:, 1].tolist())}
    return sorted(q for q in best_first.values() if best_second[int(c.pairs[q, 1])] == q)


@pytest.mark.parametrize("dimension", DIMENSIONS)
@pytest.mark.parametrize("kind", list(STRENGTHS))
@given(st.integers(0, 10**6))
@settings(max_examples=4, deadline=None)
def test_relaxation_follows_the_pseudo_code(kind: str, dimension: int, seed: int) -> None:
    c, radius, step, top = made_up(seed, dimension), 12.0, 0.25, 0.5
    kept, alpha, energies = mutual(c, c.scores), 0.0, []
    history = []
    for _ in range(6):
        values = np.array([strength_of_match(kind, c, kept, p, alpha, radius, dimension) for p in range(len(c))])
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
    found = relaxed(c, strength=kind, radius_mm=radius, alpha_step=step, alpha_max=top, max_iterations=6)  # type: ignore[arg-type]
    np.testing.assert_allclose(found.energies, energies, rtol=1e-9)
    np.testing.assert_array_equal(found.counts, [len(k) for k in history])
    assert {tuple(p) for p in found.pairs.tolist()} == {tuple(c.pairs[q].tolist()) for q in history[-1]}


def test_directions_are_rounded_to_the_nearest_of_26() -> None:
    v = RNG.standard_normal((400, 3))
    np.testing.assert_array_equal(direction_states(v), [state(x, 3) for x in v])
    assert len(np.unique(direction_states(v), axis=0)) == 26
    plane = flat(v, 2)
    np.testing.assert_array_equal(direction_states(plane, plane=True), [state(x, 2) for x in plane])
    assert len(np.unique(direction_states(plane, plane=True), axis=0)) == 8
    assert (direction_states(np.zeros((1, 3))) == 0).all()


def test_opposite_directions_weigh_nothing() -> None:
    x1 = np.array([[0.0, 0, 0], [4.0, 0, 0]])
    x2 = np.array([[1.0, 0, 0], [3.0, 0, 0]])
    c = Candidates(x1, x2, x1, np.array([[0, 0], [1, 1]]), np.array([0.9, 0.8]), np.ones(2))
    found = relaxed(c, strength="direction", radius_mm=10.0)
    np.testing.assert_allclose(np.sort(found.strengths), [0.8, 0.9])


def misled(seed: int, dimension: int, n: int = 300) -> Candidates:
    """Return candidates number i, i of a smooth motion, each among two false ones, of which many look more alike."""
    rng = np.random.default_rng(seed)
    side = 40.0 if dimension == 3 else 90.0
    x1 = flat(rng.uniform(0, side, (n, 3)), dimension)
    x2 = x1 + flat(np.stack([4.0 + 0.1 * x1[:, 1], -3.0 + 0.05 * x1[:, 0], 2.0 - 0.05 * x1[:, 2]], axis=1), dimension)
    # two points of noise about every point: candidates of that one alone
    noise = np.repeat(x2, 2, axis=0) + flat(rng.uniform(-8.0, 8.0, (2 * n, 3)), dimension)
    true = np.column_stack([np.arange(n), np.arange(n)])
    false = np.column_stack([np.repeat(np.arange(n), 2), n + np.arange(2 * n)])
    pairs = np.vstack([true, false])
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    right = pairs[:, 0] == pairs[:, 1]
    scores = np.where(right, rng.uniform(0.7, 0.95, len(pairs)), rng.uniform(0.6, 0.95, len(pairs)))
    residuals = np.where(right, rng.uniform(5.0, 15.0, len(pairs)), rng.uniform(5.0, 30.0, len(pairs)))
    return Candidates(x1, np.vstack([x2, noise]), x1, pairs, scores, residuals)


@pytest.mark.parametrize("dimension", DIMENSIONS)
@pytest.mark.parametrize("kind", list(STRENGTHS))
def test_false_matches_are_removed_while_the_energy_grows(kind: str, dimension: int) -> None:
    c = misled(1, dimension)
    by_score = np.array(mutual(c, c.scores))
    found = relaxed(c, strength=kind)  # type: ignore[arg-type]
    wrong_before = (c.pairs[by_score, 0] != c.pairs[by_score, 1]).sum()
    wrong = (found.pairs[:, 0] != found.pairs[:, 1]).sum()
    assert wrong_before > 0.3 * len(by_score)
    # intensity residuals repeat the information of the correlation: the report finds this strength the weakest
    assert wrong < (0.4 if kind == "residual" else 0.2) * wrong_before
    assert len(found) == len(c.reference_mm)
    assert len(found.energies) > 2 and (np.diff(found.energies) >= 0.0).all()
    assert found.energies[-1] > found.energies[0]
    # the energy is the mean strength of what is returned
    np.testing.assert_allclose(found.strengths.mean(), found.energies[-1])


@pytest.mark.parametrize("kind", list(STRENGTHS))
@pytest.mark.parametrize("shape", [(26, 44, 44), (1, 120, 120)])
def test_a_smooth_motion_is_found_in_volumes_and_images(kind: str, shape: tuple[int, int, int]) -> None:
    frame = grid(shape)
    plane = shape[0] == 1

    def motion(x: np.ndarray) -> np.ndarray:
        out = np.stack([2.0 + 0.04 * x[..., 1], -1.5 + 0.03 * x[..., 0], 0.8 + 0.02 * x[..., 0]], axis=-1)
        return out * [1, 1, 0] if plane else out

    before, after, _ = pair(frame, motion, seed=3, wave_mm=(6.0, 14.0), noise=4.0)
    x1 = interest_points(before, count=150, border=4).points_mm
    x2 = interest_points(after, count=400, border=4).points_mm
    c = candidate_matches(before, after, x1, x2, search=(7, 7, 5), match=(2, 2, 2), least_score=0.3)
    found = relaxed(c, strength=kind)  # type: ignore[arg-type]
    # points are voxels in both volumes: two of them are right when they differ by rounding
    error = np.linalg.norm(found.deformed_mm - found.reference_mm - motion(found.reference_mm), axis=1)
    all_errors = np.linalg.norm(x2[c.pairs[:, 1]] - x1[c.pairs[:, 0]] - motion(x1[c.pairs[:, 0]]), axis=1)
    assert (all_errors < 2.0).mean() < 0.8
    assert len(found) > 60 and (error < 2.0).mean() > 0.9
    assert (np.diff(found.energies) >= 0).all()


def test_relaxation_refuses_what_it_does_not_know() -> None:
    with pytest.raises(InputError, match="strength must be"):
        relaxed(made_up(0, 3), strength="best")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="radius"):
        relaxed(made_up(0, 3), radius_mm=0.0)
    for arguments, words in (
        ({"neighbours": 0}, "neighbours must be 1 or more"),
        ({"alpha_step": -0.1}, "alpha_step must be 0 or more"),
        ({"alpha_max": -1.0}, "alpha_max must be 0 or more"),
        ({"distance_tolerance": 0.0}, "distance_tolerance must be positive"),
    ):
        with pytest.raises(InputError, match=words):
            relaxed(made_up(0, 3), **arguments)
    with pytest.raises(InputError, match="max_iterations"):
        relaxed(made_up(0, 3), max_iterations=0)
