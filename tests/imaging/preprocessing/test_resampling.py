"""Interpolation is exact where theory says so, and keeps geometry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import grid, texture

from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform, rotation_matrix
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.resampling import (
    covered,
    cropped_to_mask,
    masked,
    positions,
    resampled_to_grid,
    resampled_to_spacing,
    sampled,
    warped,
    with_slices,
    with_slices_between,
)

TURN = rotation_matrix(np.array([0.2, -0.1, 0.4]))


def linear(x: np.ndarray) -> np.ndarray:
    return 3.0 + x @ np.array([0.5, -1.25, 2.0])


def test_a_slice_between_two_is_their_weighted_mean() -> None:
    volume = Volume.from_array(np.arange(24, dtype="i2").reshape(2, 3, 4) ** 2, spacing_mm=(0.8, 0.8, 2.0))
    dense = with_slices_between(volume, 3)
    assert dense.shape == (5, 3, 4)
    np.testing.assert_allclose(dense.spacing_mm, [0.8, 0.8, 0.5])
    for k, a in enumerate([0.0, 0.25, 0.5, 0.75, 1.0]):
        np.testing.assert_allclose(dense.values[k], (1 - a) * volume.values[0] + a * volume.values[1], rtol=1e-6)


def test_the_report_makes_forty_slices_of_twenty() -> None:
    volume = Volume.from_array(np.random.default_rng(0).uniform(0, 255, (20, 3, 4)), spacing_mm=(0.8, 0.8, 2.0))
    dense = with_slices(volume, 40)
    assert dense.shape == (40, 3, 4)
    np.testing.assert_allclose(dense.to_physical([0, 0, 39]), volume.to_physical([0, 0, 19]))
    np.testing.assert_allclose(dense.values[[0, -1]], volume.values[[0, -1]])
    with pytest.raises(InputError, match="from 1"):
        with_slices(volume.cropped((0, 0, 0), (4, 3, 1)), 4)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("direction", [None, TURN])
def test_a_linear_function_is_kept_by_any_grid(interpolation: str, direction: np.ndarray | None) -> None:
    frame = grid((12, 14, 16), (0.8, 1.1, 1.7), direction)
    volume = frame.with_values(linear(positions(frame)))
    other = Volume.from_array(
        np.zeros((9, 10, 11)), spacing_mm=(0.9, 0.7, 1.3), origin_mm=frame.to_physical([3.3, 3.1, 2.2]), direction=TURN.T
    )
    found = resampled_to_grid(volume, other, interpolation=interpolation, outside=np.nan)
    inside = covered(volume, other)
    np.testing.assert_array_equal(np.isfinite(found.values), inside)
    deep = ((volume.to_index(positions(other)) > 4) & (volume.to_index(positions(other)) < np.array(volume.shape[::-1]) - 5)).all(axis=-1)
    check = inside if interpolation == "linear" else deep
    np.testing.assert_allclose(found.values[check], linear(positions(other))[check], atol=1e-9 if interpolation == "linear" else 0.05)


def test_a_smooth_function_is_met_with_the_order_of_the_interpolation() -> None:
    pattern = texture(3, (15.0, 25.0))
    errors: dict[str, list[float]] = {"linear": [], "cubic": []}
    points = np.random.default_rng(1).uniform(12, 28, (500, 3))
    for h in (2.0, 1.0):
        frame = Volume.from_array(np.zeros((int(40 / h),) * 3), spacing_mm=(h, h, h))
        volume = frame.with_values(pattern(positions(frame)))
        for kind, found in errors.items():
            found.append(float(np.abs(sampled(volume, points, interpolation=kind) - pattern(points)).max()))
    assert np.log2(errors["linear"][0] / errors["linear"][1]) == pytest.approx(2.0, abs=0.3)
    assert np.log2(errors["cubic"][0] / errors["cubic"][1]) > 3.5


@given(st.integers(0, 10**6))
@settings(max_examples=25, deadline=None)
def test_a_volume_moved_rigidly_and_brought_back_is_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame = grid((10, 11, 12), (0.9, 1.2, 1.5), rotation_matrix(rng.standard_normal(3)))
    motion = RigidTransform.of(rotation_matrix(0.3 * rng.standard_normal(3)), rng.standard_normal(3))
    moved = Volume(frame.values, frame.spacing_mm, motion.applied(frame.origin_mm), motion.rotation @ frame.direction)
    volume = moved.with_values(rng.uniform(0, 100, frame.shape))
    np.testing.assert_allclose(resampled_to_grid(volume, frame, through=motion.applied).values, volume.values, atol=1e-3)


def test_a_coarser_grid_takes_the_mean_and_keeps_its_place() -> None:
    frame = grid((16, 16, 16), (1.0, 1.0, 1.0))
    volume = frame.with_values(linear(positions(frame)))
    coarse = resampled_to_spacing(volume, 2.0)
    np.testing.assert_allclose(coarse.origin_mm, frame.origin_mm)
    np.testing.assert_allclose(coarse.values[2:-2, 2:-2, 2:-2], linear(positions(coarse))[2:-2, 2:-2, 2:-2], rtol=1e-5)
    noise = frame.with_values(np.random.default_rng(0).standard_normal(frame.shape))
    assert resampled_to_spacing(noise, 2.0).values.std() < 0.6 * resampled_to_spacing(noise, 2.0, averaged=False).values.std()


def test_warping_by_a_known_displacement_undoes_it() -> None:
    frame = grid((12, 14, 16))
    shift = np.array([1.5, -0.75, 2.25])
    volume = frame.with_values(linear(positions(frame) - shift))
    back = warped(volume, np.broadcast_to(shift, (*frame.shape, 3)), frame)
    np.testing.assert_allclose(back[:9, 1:, :13], linear(positions(frame))[:9, 1:, :13], atol=1e-9)
    assert np.isnan(back[-1]).all()


def test_volumes_apart_and_masks_without_a_voxel_are_refused() -> None:
    frame = grid((4, 5, 6))
    away = Volume.from_array(np.ones((4, 5, 6)), spacing_mm=(1, 1, 1), origin_mm=(1000.0, 0.0, 0.0))
    with pytest.raises(InputError, match="do not overlap"):
        resampled_to_grid(away, frame)
    with pytest.raises(InputError, match="empty"):
        masked(frame, np.zeros(frame.shape, dtype=bool))
    with pytest.raises(InputError, match="shape"):
        masked(frame, np.zeros((5, 5, 6), dtype=bool))
    with pytest.raises(InputError, match="positive"):
        resampled_to_spacing(frame, 0.0)


def test_a_crop_around_a_mask_has_its_margin() -> None:
    frame = grid((8, 9, 10), (1.0, 2.0, 0.5))
    mask = np.zeros(frame.shape, dtype=bool)
    mask[3:5, 4, 5:7] = True
    part = cropped_to_mask(frame, mask, margin_mm=1.0)
    assert part.shape == (2 + 4, 1 + 2, 2 + 2)
    np.testing.assert_allclose(part.origin_mm, frame.to_physical([4, 3, 1]))
