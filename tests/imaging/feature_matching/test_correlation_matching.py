"""First matching against brute force in NumPy, and on a motion that is known."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import grid, texture

from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform, rotation_matrix
from naibu.core.volume import Volume
from naibu.imaging.feature_matching.correlation_matching import candidate_matches
from naibu.imaging.preprocessing.resampling import positions, sampled

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
    motion = RigidTransform.of(rotation_matrix(np.array([0.05, -0.1, 0.5])), [2.0, -3.0, 1.0])
    intensity, x = texture(1, (5.0, 12.0)), positions(frame)
    about = frame.to_physical([20, 20, 12])
    motion = RigidTransform.of(motion.rotation, motion.translation + about - motion.rotation @ about)
    before, after = frame.with_values(intensity(x)), frame.with_values(intensity(motion.inverse().applied(x)))
    points = frame.to_physical(np.array([20, 20, 12]) + RNG.integers(-5, 6, (10, 3)))
    options = {"rigid": motion, "least_score": -1.0, "search": (1, 1, 1)}
    turned = candidate_matches(before, after, points, motion.applied(points), turned_boxes=True, **options)
    straight = candidate_matches(before, after, points, motion.applied(points), **options)
    own = turned.pairs[:, 0] == turned.pairs[:, 1]
    assert turned.scores[own].min() > 0.98
    assert straight.scores[own].mean() < turned.scores[own].mean() - 0.1
    value = np.abs(sampled(after, motion.applied(points)) - sampled(before, points))
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
    with pytest.raises(InputError, match="no pair of points scores"):
        candidate_matches(before, after, x, x + 500.0)
    with pytest.raises(InputError, match="three whole numbers"):
        candidate_matches(before, after, x, x, match=(1.5, 1, 1))
    with pytest.raises(InputError, match="reference_mm must have shape"):
        candidate_matches(before, after, x[:, :2], x)
    other = Volume.from_array(after.values, spacing_mm=(1.0, 1.0, 1.0))
    with pytest.raises(InputError, match="voxels of reference and deformed differ"):
        candidate_matches(before, other, x, x)
    with pytest.raises(InputError, match="search_growth must be 0 or more"):
        candidate_matches(before, after, x, x, search_growth=-0.5)
    with pytest.raises(InputError, match=r"deformed_mm\[1, 2\] is nan"):
        candidate_matches(before, after, x, np.where(np.arange(15).reshape(5, 3) == 5, np.nan, x))
