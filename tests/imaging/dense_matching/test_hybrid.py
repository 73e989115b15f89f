"""The hybrid: each voxel has the answer of the method that its contrast calls for, and loses to neither in an image that has both."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import grid, inner, pair, texture

from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.dense_matching.block_matching import block_matching, intensity_range
from naibu.imaging.dense_matching.hybrid import hybrid_flow
from naibu.imaging.dense_matching.optical_flow import AS_REPORTED, horn_schunck
from naibu.imaging.preprocessing.resampling import positions


def motion(x: np.ndarray) -> np.ndarray:
    return np.stack([1.2 + 0 * x[..., 0], 0.5 + 0.02 * x[..., 0], 0 * x[..., 0]], axis=-1)


def ranges(volume: Volume, half: tuple[int, int, int]) -> np.ndarray:
    """Return the intensity range of the block about every voxel, in the order z, y, x, voxel by voxel."""
    v = volume.values
    out = np.empty(v.shape)
    for index in np.ndindex(v.shape):
        box = tuple(slice(max(i - h, 0), i + h + 1) for i, h in zip(index, half, strict=True))
        out[index] = v[box].max() - v[box].min()
    return out


@pytest.mark.parametrize("shape", [(8, 36, 40), (1, 40, 44)])
def test_blocks_answer_where_they_have_contrast_and_flow_elsewhere(shape: tuple[int, int, int]) -> None:
    frame = grid(shape)
    before, after, _ = pair(frame, motion, seed=6, wave_mm=(10.0, 25.0))
    half = (min(1, shape[0] - 1), 1, 1)
    range_of_block = ranges(before, half)
    limit = float(np.median(range_of_block))
    options = {"search": (3, 3, 1), "least_range": limit}
    found = hybrid_flow(before, after, **options, data_weight=0.01)
    blocks, flow = block_matching(before, after, **options), horn_schunck(before, after, data_weight=0.01)
    # but for blocks that leave the volume, contrast alone decides
    inside = (slice(1, -1) if shape[0] > 1 else slice(None), *inner(shape, 5)[1:])
    np.testing.assert_array_equal(blocks.valid[inside], range_of_block[inside] > limit)
    assert 0.2 < blocks.valid.mean() < 0.8
    np.testing.assert_array_equal(found.vectors[blocks.valid], blocks.vectors[blocks.valid])
    np.testing.assert_array_equal(found.vectors[~blocks.valid], flow.vectors[~blocks.valid])
    np.testing.assert_array_equal(found.valid, blocks.valid | flow.valid)


def test_the_hybrid_of_the_report_has_one_grid_and_one_warp() -> None:
    frame = grid((6, 30, 34))
    before, after, _ = pair(frame, lambda x: 0.3 * motion(x), seed=2, wave_mm=(8.0, 16.0))
    reported = {k: AS_REPORTED[k] for k in ("data_weight", "iterations", "warps", "levels")}
    found = hybrid_flow(before, after, least_range=60.0, search=(3, 3, 1), **reported)
    flow = horn_schunck(before, after, **reported)
    low = intensity_range(before, (3, 3, 3)) <= 60.0
    assert 0.02 < low.mean() < 0.98
    np.testing.assert_array_equal(found.vectors[low], flow.vectors[low])


def test_each_method_fails_where_the_other_helps() -> None:
    """Half of the image has fine texture and moves far, which a single grid of gradients misses; the other half is faint."""
    frame = grid((1, 48, 80))
    x = positions(frame)
    shift = np.array([4.0, -2.0, 0.0])
    fine, faint = texture(4, (3.0, 6.0)), texture(5, (14.0, 30.0))

    def intensity(p: np.ndarray) -> np.ndarray:
        textured = p[..., 0] < 43.0
        return np.where(textured, fine(p), 100.0 + 0.08 * (faint(p) - 100.0))

    rng = np.random.default_rng(0)
    before, after = (frame.with_values(intensity(p) + 0.4 * rng.standard_normal(frame.shape)) for p in (x, x - shift))
    start = {"data_weight": 0.2, "full_scale": 40.0}
    options = {"block": (5, 5, 1), "search": (6, 6, 0), "least_range": 20.0}
    hybrid = hybrid_flow(before, after, **options, **start)
    blocks = block_matching(before, after, **{**options, "least_range": 0.0})
    flow = horn_schunck(before, after, **start)
    inside = inner(frame.shape, 10)
    hybrid_error, blocks_error, flow_error = (np.linalg.norm((f.vectors - shift)[inside], axis=-1).mean() for f in (hybrid, blocks, flow))
    assert hybrid_error < 0.5 * blocks_error and hybrid_error < 0.9 * flow_error


def test_an_image_without_contrast_is_refused() -> None:
    frame = grid((6, 20, 24))
    volume = frame.with_values(texture()(positions(frame)))
    with pytest.raises(InputError, match="lower least_range"):
        hybrid_flow(volume, volume, least_range=1e4)
