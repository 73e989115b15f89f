"""Rigid transforms: group laws, what they conserve, and registration against known truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform, left_jacobian, registration, rotation_matrix

seeds = st.integers(0, 10**6)


def random_transform(rng: np.random.Generator) -> RigidTransform:
    return RigidTransform(Rotation.random(rng=rng).as_matrix(), 30.0 * rng.standard_normal(3), 30.0 * rng.standard_normal(3))


@given(seeds)
def test_distances_and_handedness_are_conserved(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, p = random_transform(rng), 20.0 * rng.standard_normal((5, 3))
    q = t.applied(p)
    assert_allclose(np.linalg.norm(q[:, None] - q, axis=2), np.linalg.norm(p[:, None] - p, axis=2), atol=1e-9)
    assert np.linalg.det(q[1:4] - q[0]) == pytest.approx(np.linalg.det(p[1:4] - p[0]))
    assert_allclose(t.displacement(p), q - p, atol=1e-12)


@given(seeds)
def test_transforms_form_a_group(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, c = (random_transform(rng) for _ in range(3))
    p = 20.0 * rng.standard_normal((2, 4, 3))  # any leading axes
    assert_allclose(a.composed(b).applied(p), a.applied(b.applied(p)), atol=1e-9)
    assert_allclose(a.composed(b).composed(c).applied(p), a.composed(b.composed(c)).applied(p), atol=1e-9)
    for same in (a.inverse().applied(a.applied(p)), a.applied(a.inverse().applied(p)), RigidTransform.identity().applied(p)):
        assert_allclose(same, p, atol=1e-9)
    assert_allclose(a.composed(b).inverse().applied(p), b.inverse().composed(a.inverse()).applied(p), atol=1e-9)


@given(seeds)
def test_matrices_and_translations_describe_the_same_transform(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, p = random_transform(rng), 20.0 * rng.standard_normal((4, 3))
    assert_allclose(np.column_stack([p, np.ones(4)]) @ t.matrix[:3].T, t.applied(p), atol=1e-9)
    for same in (RigidTransform.from_matrix(t.matrix), RigidTransform.of(t.rotation, t.translation)):
        assert_allclose(same.applied(p), t.applied(p), atol=1e-9)


@given(seeds)
def test_a_further_motion_turns_about_the_image_of_the_centre(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, p, change = random_transform(rng), 20.0 * rng.standard_normal((4, 3)), rng.standard_normal(6)
    expected = Rotation.from_rotvec(change[3:]).apply(t.applied(p) - t.position) + t.position + change[:3]
    assert_allclose(t.moved(change).applied(p), expected, atol=1e-9)


@given(st.floats(0.0, np.pi), seeds)
def test_the_angle_is_that_of_the_rotation(angle: float, seed: int) -> None:
    axis = np.random.default_rng(seed).standard_normal(3)
    turn = rotation_matrix(angle * axis / np.linalg.norm(axis))
    assert RigidTransform.of(turn, np.zeros(3)).angle_deg == pytest.approx(np.degrees(angle), abs=1e-6)
    plane = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    assert RigidTransform.of(plane, np.zeros(2)).angle_deg == pytest.approx(np.degrees(angle), abs=1e-6)


@pytest.mark.parametrize(
    ("matrix", "told"),
    [
        (np.diag([1.0, 1.0, -1.0, 1.0]), "determinant 1"),
        (np.diag([1.0, 1.1, 1.0, 1.0]), "orthogonal"),
        (np.eye(2), r"\(4, 4\)"),
        (np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0.1, 1]]), "last row"),
        (np.full((4, 4), np.nan), "last row"),
    ],
)
def test_a_matrix_that_is_not_rigid_is_refused(matrix: np.ndarray, told: str) -> None:
    with pytest.raises(InputError, match=told):
        RigidTransform.from_matrix(matrix)


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match="shapes"):
        RigidTransform.of(np.eye(3), np.zeros(2))


@given(seeds, st.floats(0.0, 0.3))
def test_registration_finds_the_transform_although_coordinates_are_missing(seed: int, missing: float) -> None:
    rng = np.random.default_rng(seed)
    truth, p = random_transform(rng), 20.0 * rng.standard_normal((40, 3))
    exact = truth.applied(p)
    seen = exact.copy()
    seen[10:][rng.uniform(size=(30, 3)) < missing] = np.nan
    assert_allclose(registration(p, seen).applied(p), exact, atol=1e-4)


def test_registration_is_the_least_squares_solution() -> None:
    rng = np.random.default_rng(3)
    p = 20.0 * rng.standard_normal((12, 3))
    q = random_transform(rng).applied(p) + rng.standard_normal((12, 3))
    _, rssd = Rotation.align_vectors(q - q.mean(axis=0), p - p.mean(axis=0))
    assert np.linalg.norm(registration(p, q).applied(p) - q) == pytest.approx(rssd)


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (1e-8, 0.0, 2e-8), (0.3, -0.2, 0.9), (2.0, 1.0, -1.0)])
def test_left_jacobian_is_that_of_the_rotation(vector) -> None:
    v, d, h = np.array(vector), np.array([0.4, 1.0, -0.7]), 1e-6
    assert_allclose(rotation_matrix(v), Rotation.from_rotvec(v).as_matrix(), atol=1e-12)
    further = rotation_matrix(v + h * d) @ rotation_matrix(v - h * d).T
    assert_allclose(Rotation.from_matrix(further).as_rotvec() / (2 * h), left_jacobian(v) @ d, atol=1e-8)
