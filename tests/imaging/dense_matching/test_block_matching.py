"""Block matching against a plain loop in NumPy, and against known motion."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import grid, inner, pair, texture

from naibu.core.errors import InputError
from naibu.core.rigid_transform import rotation_matrix
from naibu.core.volume import Volume
from naibu.imaging.dense_matching.block_matching import block_matching, intensity_range
from naibu.imaging.preprocessing.resampling import positions

RNG = np.random.default_rng(4)


def by_loops(a: np.ndarray, b: np.ndarray, half: tuple[int, ...], reach: tuple[int, ...], measure: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the best displacement (..., 3) along x, y, z and its cost, NaN where the block leaves the volume."""
    move, cost = np.full((*a.shape, 3), np.nan), np.full(a.shape, np.nan)
    size = np.array(a.shape)
    h = np.array(half[::-1])
    ranges = [range(-r, r + 1) for r in reach[::-1]]
    for at in np.argwhere(np.ones(a.shape, dtype=bool)):
        if (at < h).any() or (at + h >= size).any():
            continue
        block = a[tuple(slice(p - q, p + q + 1) for p, q in zip(at, h, strict=True))]
        for dz in ranges[0]:
            for dy in ranges[1]:
                for dx in ranges[2]:
                    to = at + np.array([dz, dy, dx])
                    if (to < h).any() or (to + h >= size).any():
                        continue
                    other = b[tuple(slice(p - q, p + q + 1) for p, q in zip(to, h, strict=True))]
                    if measure == "sad":
                        value = np.abs(block - other).mean()
                    elif measure == "ssd":
                        value = ((block - other) ** 2).mean()
                    else:
                        value = -np.corrcoef(block.ravel(), other.ravel())[0, 1]
                    if not value >= cost[tuple(at)]:
                        cost[tuple(at)], move[tuple(at)] = value, (dx, dy, dz)
    return move, cost


@pytest.mark.parametrize("measure", ["sad", "ssd", "ncc"])
@pytest.mark.parametrize(
    ("shape", "block", "search"),
    [((7, 9, 11), (3, 3, 3), (2, 3, 1)), ((1, 20, 22), (5, 3, 1), (4, 3, 0)), ((8, 9, 12), (5, 5, 1), (1, 2, 2))],
)
def test_full_search_is_that_of_plain_loops(measure: str, shape: tuple[int, ...], block: tuple[int, ...], search: tuple[int, ...]) -> None:
    frame = grid(shape, (0.8, 1.0, 2.0))
    a, b = RNG.uniform(0, 100, shape), RNG.uniform(0, 100, shape)
    found = block_matching(frame.with_values(a), frame.with_values(b), block=block, search=search, measure=measure, sub_voxel=False)
    move, cost = by_loops(a, b, tuple(n // 2 for n in block), search, measure)
    np.testing.assert_array_equal(found.valid, np.isfinite(cost))
    np.testing.assert_allclose(found.vectors, move * frame.spacing_mm, atol=1e-12)
    np.testing.assert_allclose(found.quality, -cost if measure == "ncc" else cost, rtol=1e-4, atol=1e-4)


def test_a_volume_wider_than_a_chunk_is_searched_the_same_everywhere() -> None:
    frame = grid((5, 70, 90))
    a = RNG.uniform(0, 100, frame.shape)
    b = np.roll(a, (1, -2, 3), (0, 1, 2))
    mask = np.zeros(frame.shape, dtype=bool)
    mask[2, 5:65, 8:80:3] = True
    found = block_matching(frame.with_values(a), frame.with_values(b), search=(4, 3, 1), sub_voxel=False, mask=mask)
    np.testing.assert_array_equal(found.valid, mask)
    np.testing.assert_allclose(found.vectors[mask], np.broadcast_to([3.0, -2.0, 1.0], (mask.sum(), 3)))


@pytest.mark.parametrize("measure", ["sad", "ssd", "ncc"])
def test_a_fraction_of_a_voxel_is_found_between_voxels(measure: str) -> None:
    frame = grid((18, 30, 34), (1.0, 0.8, 1.5))
    shift = np.array([1.3, -0.9, 0.6])
    before, after, truth = pair(frame, lambda x: np.broadcast_to(shift, x.shape), seed=2, wave_mm=(4.0, 8.0))
    options = {"block": (7, 7, 7), "search": (4, 4, 2), "measure": measure}
    found, whole = (block_matching(before, after, sub_voxel=fit, **options) for fit in (True, False))
    inside = inner(frame.shape, 5)
    error, rough = (np.linalg.norm((f.vectors - truth)[inside], axis=-1).mean() for f in (found, whole))
    # whole voxels miss by 0.3, 0.1 and 0.4 of their size
    assert rough > 0.6
    assert error < 0.2 * rough


def test_correlation_is_blind_to_gain_and_offset() -> None:
    frame = grid((10, 20, 24))
    before, after, truth = pair(frame, lambda x: np.broadcast_to([2.0, 1.0, 0.0], x.shape), wave_mm=(5.0, 9.0))
    other = after.with_values(0.4 * after.values + 300.0)
    inside = inner(frame.shape, 4)
    for measure, good in (("ncc", True), ("sad", False)):
        found = block_matching(before, other, search=(4, 4, 1), measure=measure, sub_voxel=False)
        right = np.linalg.norm((found.vectors - truth)[inside], axis=-1) < 1e-9
        assert (right.mean() > 0.95) == good


def test_blocks_without_contrast_are_not_measured() -> None:
    frame = grid((6, 20, 24))
    intensity = texture()(positions(frame))
    intensity[:, :, :12] = 80.0
    volume = frame.with_values(intensity)
    found = block_matching(volume, volume, search=(2, 2, 1), least_range=1.0)
    assert not found.valid[:, :, :11].any() and np.isnan(found.vectors[:, :, :11]).all()
    zero = block_matching(volume, volume, search=(2, 2, 1), least_range=1.0, unmeasured="zero")
    assert (zero.vectors[:, :, :11] == 0.0).all() and not zero.valid[:, :, :11].any()
    block = intensity[1:4, 4:7, 13:16]
    assert intensity_range(volume, (3, 3, 3))[2, 5, 14] == pytest.approx(np.ptp(block))
    with pytest.raises(InputError, match="lower least_range"):
        block_matching(volume, volume, least_range=1e6)


@pytest.mark.parametrize("measure", ["sad", "ncc"])
def test_unknown_voxels_are_neither_matched_nor_measured(measure: str) -> None:
    frame = grid((6, 20, 24))
    before, after, truth = pair(frame, lambda x: np.broadcast_to([1.0, 0.0, 0.0], x.shape), wave_mm=(5.0, 9.0))
    hidden = after.values.copy()
    hidden[:, :, 16:] = np.nan
    found = block_matching(before, after.with_values(hidden), search=(3, 2, 1), sub_voxel=False, measure=measure)
    # blocks end one voxel before the unknown part, wherever they came from
    reached = np.argwhere(found.valid)[:, 2] + found.vectors[found.valid][:, 0]
    assert reached.max() == 14
    deep = found.valid & (np.arange(24) < 13)
    assert np.isclose(found.vectors[deep], truth[deep]).all(axis=-1).mean() > 0.9


def test_axes_may_be_turned() -> None:
    turn = rotation_matrix(np.array([0.4, 0.2, -0.9]))
    frame = grid((10, 20, 24), (0.9, 1.1, 1.4), turn)
    a = RNG.uniform(0, 100, frame.shape)
    found = block_matching(frame.with_values(a), frame.with_values(np.roll(a, (0, 1, -2), (0, 1, 2))), search=(3, 3, 1), sub_voxel=False)
    np.testing.assert_allclose(found.vectors[5, 10, 12], turn @ (np.array([-2.0, 1.0, 0.0]) * frame.spacing_mm), atol=1e-12)


def test_bad_pairs_and_sizes_are_refused() -> None:
    frame = grid((6, 20, 24))
    volume = frame.with_values(texture()(positions(frame)))
    shifted = Volume.from_array(volume.values, spacing_mm=(1, 1, 1), origin_mm=(1, 0, 0))
    tenth = Volume.from_array(volume.values, spacing_mm=(0.1, 0.1, 0.1), origin_mm=volume.origin_mm)
    for other, message in (
        (shifted, "different grids"),
        (tenth, "other units"),
        (frame, "constant"),
        (frame.with_values(np.full(frame.shape, np.nan)), "do not overlap"),
        (frame.with_values(np.where(volume.values > 150, np.inf, volume.values)), "infinite"),
    ):
        with pytest.raises(InputError, match=message):
            block_matching(volume, other)
    for options, message in (
        ({"block": (4, 3, 3)}, "block must be odd"),
        ({"block": (3, 3)}, "three whole numbers"),
        ({"search": (-1, 0, 0)}, "at least 0"),
        ({"block": (3, 3, 9)}, "must fit into the volume"),
        ({"measure": "best"}, "measure must be"),
        ({"mask": np.zeros(frame.shape)}, "empty"),
    ):
        with pytest.raises(InputError, match=message):
            block_matching(volume, volume, **options)
