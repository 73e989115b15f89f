"""Dense fields from sparse ones are exact for affine motions, and the same as SciPy's interpolation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import grid
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial.transform import Rotation

from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform, rotation_matrix
from naibu.imaging.feature_matching.relaxation_labelling import PotentialMatches
from naibu.imaging.feature_matching.scattered_interpolation import dense_from_sparse, elevation_angle, sparse_displacement, triangulated
from naibu.imaging.preprocessing.resampling import positions

MATRIX, SHIFT = np.array([[0.1, 0.02, 0], [-0.05, 0.2, 0.01], [0.0, 0.03, -0.1]]), np.array([1.0, -2.0, 0.5])


def affine(x: np.ndarray) -> np.ndarray:
    return x @ MATRIX.T + SHIFT


@given(st.integers(0, 10**6))
@settings(max_examples=15, deadline=None)
def test_an_affine_motion_is_met_exactly_at_every_voxel_of_the_hull(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame = grid((9, 12, 14), (1.0, 0.7, 1.8), rotation_matrix(rng.standard_normal(3)))
    points = frame.to_physical(rng.uniform(-2, [15, 13, 10], (60, 3)))
    found = dense_from_sparse(DisplacementField.from_arrays(points, affine(points)), frame)
    np.testing.assert_allclose(found.vectors[found.valid], affine(positions(frame))[found.valid], atol=1e-9)
    assert np.isnan(found.vectors[~found.valid]).all()
    whole = dense_from_sparse(DisplacementField.from_arrays(points, affine(points)), frame, outside="affine")
    np.testing.assert_allclose(whole.vectors, affine(positions(frame)), atol=1e-8)


@pytest.mark.parametrize("shape", [(10, 12, 14), (1, 24, 30)])
def test_the_field_is_that_of_scipy(shape: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(3)
    frame = grid(shape)
    d = 3 if shape[0] > 1 else 2
    index = np.zeros((80, 3))
    index[:, :d] = rng.uniform(0, np.array(shape[::-1])[:d], (80, d))
    points, vectors = frame.to_physical(index), rng.standard_normal((80, 3))
    found = dense_from_sparse(DisplacementField.from_arrays(points, vectors), frame, outside="nearest")
    reference = LinearNDInterpolator(points[:, :d], vectors)(positions(frame)[..., :d])
    inside = np.isfinite(reference).all(axis=-1)
    assert (inside == found.valid).mean() > 0.999
    both = inside & found.valid
    np.testing.assert_allclose(found.vectors[both], reference[both], atol=1e-9)
    away = np.argwhere(~found.valid)[0]
    nearest = np.argmin(np.linalg.norm(points - positions(frame)[tuple(away)], axis=1))
    np.testing.assert_allclose(found.vectors[tuple(away)], vectors[nearest])
    assert triangulated(points, frame).simplices.shape[1] == d + 1


def matched(seed: int = 0) -> tuple[PotentialMatches, RigidTransform, np.ndarray]:
    rng = np.random.default_rng(seed)
    rigid = RigidTransform.of(Rotation.from_euler("z", 20, degrees=True).as_matrix(), [5.0, 1.0, -2.0])
    x1, local = rng.uniform(0, 30, (20, 3)), 0.5 * rng.standard_normal((20, 3))
    x2 = rigid.applied(x1) + local
    nothing = np.zeros(20)
    pairs = np.column_stack([np.arange(20)] * 2)
    return PotentialMatches(pairs, x1, x2, rigid.applied(x1), nothing, nothing, nothing, nothing, "nothing changed"), rigid, local


def test_the_displacement_is_told_in_the_registered_frame_or_as_a_whole() -> None:
    matches, rigid, local = matched()
    registered = sparse_displacement(matches, rigid)
    np.testing.assert_allclose(registered.vectors, local, atol=1e-12)
    np.testing.assert_allclose(registered.points, rigid.applied(matches.reference_mm))
    turned = sparse_displacement(matches, rigid, rotation_only=True)
    np.testing.assert_allclose(turned.vectors, local + rigid.translation, atol=1e-12)
    whole = sparse_displacement(matches)
    np.testing.assert_allclose(whole.points + whole.vectors, matches.deformed_mm)
    with pytest.raises(InputError, match="give the rigid motion"):
        sparse_displacement(matches, rotation_only=True)


def test_the_elevation_is_measured_from_the_plane_of_x_and_z() -> None:
    angle = elevation_angle([[1, 0, 0], [0, 2, 0], [0, -1, 0], [1, 1, 0], [0, 0, 0], [0, 1, np.sqrt(3)]])
    np.testing.assert_allclose(np.degrees(angle), [0, 90, -90, 45, 0, 30], atol=1e-9)


def test_points_that_span_nothing_are_refused() -> None:
    frame = grid((6, 7, 8))
    flat = frame.to_physical(np.random.default_rng(0).uniform(0, 6, (10, 3)) * [1, 1, 0])
    with pytest.raises(InputError, match="one plane"):
        dense_from_sparse(DisplacementField.from_arrays(flat, flat), frame)
    with pytest.raises(InputError, match="4 matches or more"):
        dense_from_sparse(DisplacementField.from_arrays(flat[:3], flat[:3]), frame)
    away = np.random.default_rng(0).uniform(500, 510, (10, 3))
    with pytest.raises(InputError, match="in one frame"):
        dense_from_sparse(DisplacementField.from_arrays(away, away), frame)
    with pytest.raises(InputError, match="outside must be"):
        dense_from_sparse(DisplacementField.from_arrays(away, away), frame, outside="zero")  # type: ignore[arg-type]


def test_doubled_points_and_points_without_data_do_no_harm() -> None:
    frame = grid((9, 9, 9))
    points = frame.to_physical(np.random.default_rng(1).uniform(-1, 10, (40, 3)))
    points = np.vstack([points, points[:5]])
    vectors = affine(points)
    vectors[7] = np.nan
    found = dense_from_sparse(DisplacementField.from_arrays(points, vectors), frame)
    np.testing.assert_allclose(found.vectors[found.valid], affine(positions(frame))[found.valid], atol=1e-9)
    some = found.at_points(step=3)
    assert len(some.points) == found.valid[::3, ::3, ::3].sum()
    np.testing.assert_allclose(some.vectors, affine(some.points), atol=1e-9)
