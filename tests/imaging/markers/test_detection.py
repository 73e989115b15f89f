"""Markers in volumes: at the centroids of the spheres and washers that were drawn, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from marker_scenes import lattice, render_spheres
from scipy.spatial import cKDTree

from naibu.core.errors import InputError
from naibu.core.progress import ProgressReport
from naibu.core.rigid_transform import rotation_matrix
from naibu.core.volume import Volume
from naibu.imaging.markers.detection import DetectedMarkers, detect_markers
from naibu.imaging.markers.settings import DetectionSettings
from naibu.imaging.markers.washers import slice_profile

GRID = lattice((4, 4, 3), 5.0, 0.8)
ORIGIN = np.array([7.0, -3.0, 11.0])


def misses(found: DetectedMarkers, centres: np.ndarray, reach: float = 0.5) -> np.ndarray:
    """Return the distances of all true centres from what was found, each found once and nothing more."""
    distance, which = cKDTree(found.points).query(centres)
    assert len(found) == len(centres) == len(set(which))
    assert distance.max() < reach
    return np.asarray(distance)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_bright_and_dark_beads_are_placed_within_a_tenth_of_a_voxel(sign: float) -> None:
    found = detect_markers(render_spheres(GRID, contrast=400.0 * sign), diameter_mm=2.0)
    assert found.polarity == ("bright" if sign > 0 else "dark")
    assert np.median(misses(found, GRID + ORIGIN)) < 0.1 * 0.5
    assert np.abs(np.median(found.size_mm) / 2.0 - 1.0) < 0.5


def test_stated_deviations_are_those_of_the_errors() -> None:
    ratio = []
    for seed in range(4):
        found = detect_markers(render_spheres(GRID, noise=60.0, seed=seed), diameter_mm=2.0)
        centres = GRID + ORIGIN
        _, which = cKDTree(found.points).query(centres)
        ratio.append((found.points[which] - centres) / found.sd_mm[which])
    assert 0.7 < np.sqrt(np.mean(np.square(ratio))) < 1.5


def test_the_frame_of_the_scan_is_that_of_the_centres() -> None:
    turn = rotation_matrix(np.array([0.2, -0.4, 0.7]))
    spacing = (0.4, 0.5, 0.6)
    volume = render_spheres(GRID, spacing=spacing, shape=(36, 48, 64), direction=turn)
    misses(detect_markers(volume, diameter_mm=2.0), GRID @ turn.T + ORIGIN, reach=0.15)


def test_touching_beads_are_told_apart() -> None:
    first = lattice((3, 3, 2), 7.0, 0.3, start=5.0)
    pairs = np.concatenate([first, first + np.array([2.0, 0.0, 0.0])])  # one diameter apart
    misses(detect_markers(render_spheres(pairs), diameter_mm=2.0), pairs + ORIGIN, reach=0.15)


def test_bubbles_specks_streaks_and_the_edge_of_the_object_are_rejected() -> None:
    volume = render_spheres(GRID, noise=15.0)
    values = volume.values.copy()
    values[:, :, :3] = 0.0  # air beside the object
    other = np.array([[6.5, 21.9, 17.3], [21.7, 11.5, 17.0]])
    large = render_spheres(other, radii=np.array([1.9, 1.9]), noise=0.0).values - 1000.0
    values += large
    values[13, 13, 13] += 600.0  # one voxel
    values[34, 44, :] += 300.0  # a line through the whole volume
    found = detect_markers(volume.with_values(values), diameter_mm=2.0)
    misses(found, GRID + ORIGIN)
    assert len(found.rejected) > 0


def test_a_mask_and_a_count_choose() -> None:
    volume = render_spheres(GRID)
    mask = np.zeros(volume.shape, dtype=bool)
    mask[:, :, :26] = True
    left = GRID[np.round(GRID[:, 0] / 0.5).astype(int) < 26]
    misses(detect_markers(volume, diameter_mm=2.0, mask=mask), left + ORIGIN)
    assert len(detect_markers(volume, diameter_mm=2.0, count=10)) == 10


def test_thin_washers_in_thick_slices_have_honest_heights() -> None:
    rng = np.random.default_rng(5)
    spacing, diameter, thick = np.array([0.4, 0.4, 1.0]), 2.8, 0.3
    centres = lattice((5, 5, 3), 6.0, 0.5, seed=5)
    values = np.zeros((20, 85, 85))
    y, x = np.arange(85) * 0.4, np.arange(85) * 0.4
    z = np.arange(20.0)
    for c in centres:
        fraction = np.clip(np.minimum(z + 0.5, c[2] + 0.5 * thick) - np.maximum(z - 0.5, c[2] - 0.5 * thick), 0.0, None)
        r = np.hypot(y[:, None] - c[1], x - c[0])
        disc = 1.0 / (1.0 + np.exp((r - 0.5 * diameter) / 0.1))
        values += 2500.0 * fraction[:, None, None] * disc
    volume = Volume.from_array(values + 20.0 * rng.standard_normal(values.shape), spacing_mm=spacing)
    found = detect_markers(volume, diameter_mm=diameter, thickness_mm=thick)
    misses(found, centres, reach=0.6)
    error = found.points[cKDTree(found.points).query(centres)[1]] - centres
    assert np.abs(error[:, :2]).max() < 0.1
    hidden = np.abs(centres[:, 2] - np.round(centres[:, 2])) < 0.5 - 0.5 * thick - 0.05
    which = cKDTree(found.points).query(centres)[1]
    # wholly inside a slice any height is as good: uniform, of deviation (1 - 0.3) / sqrt(12) at most; across two slices their shares tell
    assert 0.1 < np.median(found.sd_mm[which][hidden, 2]) < 0.25
    assert np.median(np.abs(error[~hidden, 2])) < 0.06


@given(st.floats(0.05, 0.9), st.floats(0.0, 0.6))
@settings(max_examples=30, deadline=None)
def test_what_the_slices_see_of_a_plate_adds_up_to_the_whole(thickness: float, blur: float) -> None:
    profile = slice_profile(thickness, blur)
    at = np.arange(len(profile)) * 0.01
    for offset in (0.0, 0.2, 0.5):
        seen = sum(np.interp(abs(k - offset), at, profile, right=0.0) for k in range(-6, 7))
        assert seen == pytest.approx(1.0, abs=2e-3)


def test_what_cannot_be_searched_is_refused() -> None:
    volume = render_spheres(GRID)
    for arguments, words in (
        ({"diameter_mm": 0.3}, "diameter_mm is 0.3"),
        ({"diameter_mm": -1.0}, "diameter_mm is -1"),
        ({"diameter_mm": 2.0, "thickness_mm": 3.0}, "thickness_mm is 3"),
        ({"diameter_mm": 2.0, "polarity": "grey"}, "polarity must be"),
        ({"diameter_mm": 2.0, "count": 0}, "count is 0"),
        ({"diameter_mm": 2.0, "count": 500}, "500 asked for"),
        ({"diameter_mm": 2.0, "mask": np.zeros(volume.shape)}, "mask is empty"),
        ({"diameter_mm": 2.0, "mask": np.ones((2, 2, 2))}, "mask must have shape"),
    ):
        with pytest.raises(InputError, match=words):
            detect_markers(volume, **arguments)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="all voxels of volume are 1000"):
        detect_markers(volume.with_values(np.full(volume.shape, 1000)), diameter_mm=2.0)
    broken = volume.values.copy()
    broken[3, 4, 5] = np.nan
    with pytest.raises(InputError, match="not finite"):
        detect_markers(volume.with_values(broken), diameter_mm=2.0)


def test_an_empty_volume_says_what_contrast_there_was() -> None:
    nothing = render_spheres(np.zeros((0, 3)), noise=20.0)
    with pytest.raises(InputError, match=r"contrast of [\d.]+, [\d.]+ times the noise"):
        detect_markers(nothing, diameter_mm=2.0)


def test_settings_decide_what_is_a_marker() -> None:
    volume = render_spheres(GRID)
    found = detect_markers(volume, diameter_mm=2.0)
    with pytest.raises(InputError, match=r"\(100000 times are needed\)"):
        detect_markers(volume, diameter_mm=2.0, settings=DetectionSettings(min_contrast=1e5))
    with pytest.raises(InputError, match="too small"):
        detect_markers(volume, diameter_mm=2.0, settings=DetectionSettings(size_range=(3.0, 4.0)))
    with pytest.raises(InputError, match="no stronger than noise"):
        detect_markers(volume, diameter_mm=2.0, settings=DetectionSettings(above_chance=1e4))
    close = detect_markers(volume, diameter_mm=2.0, settings=DetectionSettings(min_distance=3.0))
    assert len(close) < len(found)


def test_detection_settings_out_of_range_are_refused() -> None:
    for arguments, words in (
        ({"min_contrast": 0.0}, "min_contrast must be positive"),
        ({"outlier_sd": -1.0}, "outlier_sd must be positive"),
        ({"size_ratio": 0.9}, "size_ratio must lie between 1 and infinity"),
        ({"content_ratio": np.nan}, "content_ratio must lie"),
        ({"elongation_ratio": 0.0}, "elongation_ratio must lie"),
        ({"spread_sd": -1.0}, "spread_sd must lie"),
        ({"min_distance": -0.1}, "min_distance must lie"),
        ({"above_chance": np.inf}, "above_chance must lie"),
        ({"size_range": (2.2, 0.4)}, "size_range must be two increasing positive numbers"),
    ):
        with pytest.raises(InputError, match=words):
            DetectionSettings(**arguments)  # type: ignore[arg-type]


def test_progress_of_a_detection_is_reported() -> None:
    reports: list[ProgressReport] = []
    detect_markers(render_spheres(GRID), diameter_mm=2.0, progress=reports.append)
    assert [r.stage for r in reports] == ["finding peaks", "fitting blobs", "locating markers", "locating markers"]
    assert [r.done for r in reports] == [0, 1, 2, 3] and reports[-1].fraction == 1.0
