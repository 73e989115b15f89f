"""Rigid motion from points against an independent solution, and from intensities against known truth."""

from __future__ import annotations

import sys
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import grid, texture
from scipy.spatial.transform import Rotation

from naibu.core.errors import InputError, MissingDependencyError
from naibu.core.rigid_transform import RigidTransform
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.bone_mask import bone_mask, otsu_thresholds
from naibu.imaging.preprocessing.resampling import positions
from naibu.imaging.preprocessing.rigid_registration import (
    NotRigidWarning,
    register_rigid,
    remaining_motion,
    rigid_displacement,
    rigid_from_points,
    total_displacement,
)


@given(st.integers(0, 10**6), st.integers(3, 12), st.floats(0.0, 2.0))
def test_points_give_the_rotation_of_kabsch(seed: int, n: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    x = 20.0 * rng.standard_normal((n, 3))
    y = Rotation.random(rng=rng).apply(x) + 50.0 * rng.standard_normal(3) + noise * rng.standard_normal((n, 3))
    found = rigid_from_points(x, y)
    rotation = found.transform.rotation
    best, rssd = Rotation.align_vectors(y - y.mean(axis=0), x - x.mean(axis=0))
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    # three points may leave two rotations all but equally good: the residual decides
    assert np.sqrt((found.residuals_mm**2).sum()) == pytest.approx(rssd, rel=1e-6, abs=1e-5)
    if n > 3:
        np.testing.assert_allclose(rotation, best.as_matrix(), atol=1e-5)
        np.testing.assert_allclose(found.transform.applied(x.mean(axis=0)), y.mean(axis=0), atol=1e-9)


@given(st.floats(-3.1, 3.1), st.integers(0, 10**6))
def test_a_plane_motion_is_found_from_three_points(angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = rng.uniform(-50, 50, (3, 2))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shift = rng.uniform(-50, 50, 2)
    found = rigid_from_points(x, x @ turn.T + shift).transform
    np.testing.assert_allclose(found.rotation, turn, atol=1e-9)
    np.testing.assert_allclose(found.translation, shift, atol=1e-6)
    np.testing.assert_allclose(found.inverse().applied(found.applied(x)), x, atol=1e-9)
    assert found.angle_deg == pytest.approx(abs(np.degrees(angle)), abs=1e-6)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.eye(3)[:2], "three points or more"),
        (np.outer(np.arange(4.0), [1.0, 2.0, 3.0]), "on one line"),
        (np.ones((4, 3)), "coincide"),
        (np.ones((4, 2)), "coincide"),
        (np.full((4, 3), np.nan), "finite"),
        (np.ones((4, 4)), "shape"),
    ],
)
def test_points_that_leave_the_motion_open_are_refused(points: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        rigid_from_points(points, points)


def test_points_that_do_not_move_rigidly_cause_a_warning() -> None:
    x = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10.0]])
    y = x * [1.0, 1.0, 1.2]
    with pytest.warns(NotRigidWarning, match="point 3"):
        rigid_from_points(x, y, rigid_within_mm=0.3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rigid_from_points(x, y + 1.0, rigid_within_mm=2.0)


def test_a_displacement_before_a_rigid_motion_adds_up() -> None:
    frame = grid((5, 6, 7), (1.0, 1.5, 2.0))
    motion = RigidTransform.of(Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), [4.0, 5.0, -6.0])
    v = np.random.default_rng(0).standard_normal((*frame.shape, 3))
    whole = total_displacement(v, motion, frame)
    np.testing.assert_allclose(positions(frame) + whole, motion.applied(positions(frame) + v))
    np.testing.assert_allclose(rigid_displacement(motion, frame), total_displacement(np.zeros_like(v), motion, frame))


def limb(move: RigidTransform, seed: int = 0, squeeze: float = 0.0) -> tuple[Volume, Volume, np.ndarray]:
    """Return two scans of muscle about a dark bone with bright marrow, and where the bone is; the bone squeezed where asked for."""
    frame = Volume.from_array(np.zeros((24, 64, 64)), spacing_mm=(1.5, 1.5, 2.0))
    pattern = texture(seed, (6.0, 18.0))

    def scan(x: np.ndarray) -> np.ndarray:
        centre = np.array([48.0, 44.0, 24.0])
        axis = np.array([0.15, -0.1, 1.0]) / np.linalg.norm([0.15, -0.1, 1.0])
        d = x - centre
        d = d - (d @ axis)[..., None] * axis
        r = np.hypot(d[..., 0], 1.3 * d[..., 1]) * (1 + 0.08 * np.cos(3 * np.arctan2(d[..., 1], d[..., 0])))
        body = np.hypot(x[..., 0] - 48, x[..., 1] - 48)
        marrow, bone, inside = (1 / (1 + np.exp((r - a) / 0.6)) for a in (8.0, 12.0, 1e9))
        v = 300 + 0.5 * (pattern(x) - 100)
        v = v * (1 - bone) + bone * (40 + marrow * (700 + 0.8 * (pattern(x) - 100)))
        return v * inside / (1 + np.exp((body - 40) / 0.8))

    x = positions(frame)
    back = move.inverse().applied(x)
    if squeeze:
        back[..., 2] += squeeze * (back[..., 2] - 24.0)
    rng = np.random.default_rng(seed)
    noise = [np.abs(8 * rng.standard_normal(frame.shape)) for _ in range(2)]
    volumes = [frame.with_values((v + n).astype("u2")) for v, n in zip((scan(x), scan(back)), noise, strict=True)]
    d = x - np.array([48.0, 44.0, 24.0])
    axis = np.array([0.15, -0.1, 1.0]) / np.linalg.norm([0.15, -0.1, 1.0])
    d = d - (d @ axis)[..., None] * axis
    r = np.hypot(d[..., 0], 1.3 * d[..., 1]) * (1 + 0.08 * np.cos(3 * np.arctan2(d[..., 1], d[..., 0])))
    return volumes[0], volumes[1], r < 12.0


MOVE = RigidTransform.of(Rotation.from_rotvec(np.radians([1.0, -2.0, 6.0])).as_matrix(), [-3.0, 4.0, 1.0])


def test_bone_is_found_by_its_dark_rim_and_by_its_brightness() -> None:
    volume, _, truth = limb(RigidTransform.identity())
    found = bone_mask(volume, appearance="dark")
    assert 2 * (found & truth).sum() / (found.sum() + truth.sum()) > 0.95
    bright = volume.with_values(np.where(truth, 2000, volume.values))
    found = bone_mask(bright, appearance="bright")
    assert 2 * (found & truth).sum() / (found.sum() + truth.sum()) > 0.98
    wide = bone_mask(bright, appearance="bright", margin_mm=3.0)
    assert wide[found].all() and wide.sum() > 1.3 * found.sum()
    with pytest.raises(InputError, match="appearance"):
        bone_mask(volume, appearance="grey")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="count = 40"):
        bone_mask(bright, appearance="bright", count=40)


def test_otsu_parts_classes_where_brute_force_does() -> None:
    rng = np.random.default_rng(2)
    values = np.concatenate([rng.normal(m, 8.0, n) for m, n in ((20, 400), (100, 900), (180, 200))])
    low, high = otsu_thresholds(values, 3)
    assert 40 < low < 80 and 120 < high < 160
    cuts = np.linspace(values.min(), values.max(), 60)
    within = [
        min(np.var(values[values < a]) * (values < a).mean() + np.var(values[values >= a]) * (values >= a).mean() for a in cuts[1:-1])
    ]
    a = otsu_thresholds(values, 2)[0]
    assert np.var(values[values < a]) * (values < a).mean() + np.var(values[values >= a]) * (values >= a).mean() <= 1.01 * within[0]
    with pytest.raises(InputError, match="constant"):
        otsu_thresholds(np.ones(5))


def test_intensities_in_a_bone_mask_give_its_motion() -> None:
    pytest.importorskip("SimpleITK")
    before, after, bone = limb(MOVE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = register_rigid(before, after, bone_mask(before, appearance="dark", margin_mm=1.0))
    there = positions(before)[bone]
    assert np.linalg.norm(found.transform.applied(there) - MOVE.applied(there), axis=1).mean() < 0.15
    assert found.rms_mm < 0.5


def test_a_bone_that_is_not_rigid_causes_a_warning() -> None:
    before, after, bone = limb(RigidTransform.identity(), squeeze=0.12)
    left = remaining_motion(before, after, bone, RigidTransform.identity())
    # the ends of the bone are 24 mm from its middle
    assert left.max() > 1.0
    rigid = remaining_motion(*limb(RigidTransform.identity())[:2], bone, RigidTransform.identity())
    assert rigid.max() < 0.3
    pytest.importorskip("SimpleITK")
    with pytest.warns(NotRigidWarning, match="not"):
        register_rigid(before, after, bone)


def test_registration_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = grid((4, 5, 6))
    monkeypatch.setitem(sys.modules, "SimpleITK", None)
    with pytest.raises(MissingDependencyError, match=r"naibu\[imaging\]"):
        register_rigid(frame, frame, np.ones(frame.shape))


def test_an_empty_mask_is_refused() -> None:
    pytest.importorskip("SimpleITK")
    frame = grid((4, 5, 6))
    with pytest.raises(InputError, match="empty"):
        register_rigid(frame, frame, np.zeros(frame.shape))
