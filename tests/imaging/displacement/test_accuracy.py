"""Measures of a displacement field, on fields whose inverse, Jacobian and strain are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import grid, inner, pair, texture
from scipy.spatial.transform import Rotation

from naibu.core.errors import InputError
from naibu.core.rigid_transform import rotation_matrix
from naibu.core.volume import Volume
from naibu.imaging.displacement.accuracy import (
    check_point_errors,
    end_point_error,
    forward_backward_error,
    intensity_rms,
    inverse_displacement,
    moved_back,
)
from naibu.imaging.displacement.strain import (
    displacement_gradient,
    folded_fraction,
    green_lagrange_strain,
    jacobian_determinant,
    small_strain,
)
from naibu.imaging.preprocessing.resampling import positions


def turned_frame(seed: int = 1, shape: tuple[int, int, int] = (12, 16, 18)) -> Volume:
    return grid(shape, (0.9, 1.1, 1.6), rotation_matrix(np.random.default_rng(seed).standard_normal(3)))


@given(st.integers(0, 10**6))
@settings(max_examples=20, deadline=None)
def test_affine_motions_have_the_strain_of_continuum_mechanics(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame = turned_frame(seed, (5, 6, 7))
    f = Rotation.random(rng=rng).as_matrix() @ (np.eye(3) + 0.2 * rng.uniform(-1, 1, (3, 3)))
    u = positions(frame) @ (f - np.eye(3)).T + rng.standard_normal(3)
    np.testing.assert_allclose(displacement_gradient(u, frame), np.broadcast_to(f - np.eye(3), (*frame.shape, 3, 3)), atol=1e-9)
    np.testing.assert_allclose(jacobian_determinant(u, frame), np.linalg.det(f), rtol=1e-9)
    np.testing.assert_allclose(green_lagrange_strain(u, frame)[2, 3, 3], 0.5 * (f.T @ f - np.eye(3)), atol=1e-9)
    g = f - np.eye(3)
    np.testing.assert_allclose(small_strain(u, frame)[2, 3, 3], 0.5 * (g + g.T), atol=1e-9)


def test_a_rotation_is_no_strain_but_for_small_ones() -> None:
    frame = turned_frame()
    turn = rotation_matrix(np.array([0.0, 0.0, 0.5]))
    u = positions(frame) @ (turn - np.eye(3)).T
    assert np.abs(green_lagrange_strain(u, frame)).max() < 1e-12
    # 1 - cos 0.5
    np.testing.assert_allclose(small_strain(u, frame)[3, 3, 3, 0, 0], np.cos(0.5) - 1.0)


def test_folding_is_seen_where_it_is() -> None:
    frame = Volume.from_array(np.zeros((6, 8, 40)), spacing_mm=(1.0, 1.0, 1.0))
    x = positions(frame)
    u = np.zeros((*frame.shape, 3))
    u[..., 0] = 6.0 * np.sin(x[..., 0] / 4.0)
    folded = jacobian_determinant(u, frame) <= 0.0
    # central differences of the sine
    central = 1.0 + 6.0 * np.sin(0.25) * np.cos(x[..., 0] / 4.0)
    np.testing.assert_array_equal(folded[:, :, 1:-1], central[:, :, 1:-1] <= 0.0)
    assert folded_fraction(u, frame) == pytest.approx(folded.mean())
    assert folded_fraction(0.1 * u, frame) == 0.0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_going_there_and_back_ends_where_it_began(seed: int) -> None:
    frame = turned_frame(seed)
    rng = np.random.default_rng(seed)
    middle = positions(frame).mean(axis=(0, 1, 2))
    f = np.eye(3) + 0.15 * rng.uniform(-1, 1, (3, 3))
    u = (positions(frame) - middle) @ (f - np.eye(3)).T + [0.7, -0.4, 0.2]
    back = inverse_displacement(u, frame)
    exact = (positions(frame) - middle - [0.7, -0.4, 0.2]) @ (np.linalg.inv(f) - np.eye(3)).T - [0.7, -0.4, 0.2]
    found = np.isfinite(back).all(axis=-1)
    assert found.mean() > 0.5
    np.testing.assert_allclose(back[found], exact[found], atol=1e-3)
    error = forward_backward_error(u, back, frame)
    assert np.nanmax(error) < 1e-3 and np.isfinite(error).mean() > 0.4
    wrong = forward_backward_error(u, np.where(found[..., None], back + np.array([0.5, 0.0, 0.0]), np.nan), frame)
    np.testing.assert_allclose(wrong[np.isfinite(wrong)], 0.5, atol=2e-3)


def test_strong_stretches_are_inverted() -> None:
    frame = Volume.from_array(np.zeros((4, 5, 80)), spacing_mm=(1.0, 1.0, 1.0))
    x = positions(frame)
    u = np.zeros((*frame.shape, 3))
    u[..., 0] = 6.0 * np.sin(x[..., 0] / 8.0)
    ends = x + u
    starts = moved_back(u, frame, ends[1:3, 1:4, 5:60].reshape(-1, 3)).reshape(2, 3, 55, 3)
    np.testing.assert_allclose(starts, x[1:3, 1:4, 5:60], atol=2e-3)


def test_check_points_are_moved_back_through_the_field() -> None:
    frame = grid((14, 20, 24))
    rng = np.random.default_rng(5)
    u = np.broadcast_to([2.0, -1.0, 0.5], (*frame.shape, 3))
    before = frame.to_physical(rng.uniform(4, 9, (10, 3)))
    off = np.zeros((10, 3))
    off[3] = [0.3, 0.4, 0.0]
    found = check_point_errors(u, frame, before, before + np.array([2.0, -1.0, 0.5]) + off)
    np.testing.assert_allclose(found.errors_mm, np.linalg.norm(off, axis=1), atol=1e-3)
    assert found.rms_mm == pytest.approx(0.5 / np.sqrt(10), abs=1e-3)
    away = before.copy()
    away[0] += 500.0
    assert check_point_errors(u, frame, before, away).coverage == pytest.approx(0.9)
    with pytest.raises(InputError, match="among the check points"):
        check_point_errors(u, frame, before, before + 500.0)


def test_end_point_errors_are_those_of_numpy() -> None:
    rng = np.random.default_rng(0)
    truth, found, mask = rng.standard_normal((5, 6, 7, 3)), rng.standard_normal((5, 6, 7, 3)), rng.random((5, 6, 7)) < 0.5
    error = np.linalg.norm(found - truth, axis=-1)[mask]
    summary = end_point_error(found, truth, mask)
    assert summary.mean_mm == pytest.approx(error.mean()) and summary.median_mm == pytest.approx(np.median(error))
    assert summary.p95_mm == pytest.approx(np.percentile(error, 95)) and summary.coverage == 1.0
    found[:2] = np.nan
    assert end_point_error(found, truth, mask).coverage == pytest.approx(mask[2:].sum() / mask.sum())
    with pytest.raises(InputError, match="do not fit"):
        end_point_error(found[:2], truth, mask)
    with pytest.raises(InputError, match="unknown everywhere"):
        end_point_error(np.full_like(truth, np.nan), truth, mask)


@pytest.mark.parametrize("frame_of", ["deformed", "reference"])
def test_the_true_field_leaves_only_interpolation_and_noise(frame_of: str) -> None:
    frame = grid((20, 30, 34))

    def motion(x: np.ndarray) -> np.ndarray:
        return np.stack([1.5 + 0.05 * x[..., 1], -1.0 + 0.04 * x[..., 0], 0.6 + 0 * x[..., 0]], axis=-1)

    before, after, truth = pair(frame, motion, wave_mm=(12.0, 30.0))
    region = np.zeros(frame.shape, dtype=bool)
    region[inner(frame.shape, 5)] = True
    right = intensity_rms(before, after, truth, region=region, frame=frame_of)
    none = intensity_rms(before, after, np.zeros_like(truth), region=region, frame=frame_of)
    assert right < 0.06 * none
    rng = np.random.default_rng(0)
    a, b = (v.with_values(v.values + 20.0 * rng.standard_normal(v.shape)) for v in (before, after))
    # the warped volume is smoothed by its interpolation: its noise lies between none and all
    assert 20.0 < intensity_rms(a, b, truth, region=region, frame=frame_of) < 20.0 * np.sqrt(2.0)


def test_measures_refuse_what_does_not_fit() -> None:
    frame = grid((6, 7, 8))
    volume = frame.with_values(texture()(positions(frame)))
    other = Volume.from_array(volume.values, spacing_mm=(1, 1, 2))
    with pytest.raises(InputError, match="different grids"):
        intensity_rms(volume, other, np.zeros((*frame.shape, 3)))
    with pytest.raises(InputError, match="moves no voxel"):
        intensity_rms(volume, volume, np.full((*frame.shape, 3), 500.0))
    with pytest.raises(InputError, match="frame must be"):
        intensity_rms(volume, volume, np.zeros((*frame.shape, 3)), frame="other")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="must have shape"):
        small_strain(np.zeros((2, 2, 2, 3)), frame)
    with pytest.raises(InputError, match="known at no voxel"):
        folded_fraction(np.full((*frame.shape, 3), np.nan), frame)
