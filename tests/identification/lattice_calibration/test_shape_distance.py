"""Distances from a deformed surface against brute force, closed forms and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import minimize

from naibu.core.errors import InputError
from naibu.identification.lattice_calibration.captured.shape_distance import closest_points, force_difference, shape_difference
from naibu.mechanics.contact.triangle_tree import TriangleTree
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice
from naibu.mechanics.lattices.model.octrees.octree import octree_lattice
from naibu.mechanics.lattices.model.surface import surface_of

Array = NDArray[np.float64]


def block() -> tuple[TriangleTree, Array]:
    lattice = classic_lattice(box_mask((4, 3, 2)), 10.0, density=1e-6)
    return surface_of(lattice), lattice.points


def deformed(points: Array, seed: int, size: float = 1.5) -> Array:
    return points + size * np.random.default_rng(seed).standard_normal(points.shape)


def box_distance(p: Array, low: Array, high: Array) -> Array:
    """Signed distance from a box, positive outside."""
    q = np.maximum(low - p, p - high)
    return np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)


def test_the_hull_of_a_box_is_closed_and_has_its_volume() -> None:
    hull, points = block()
    assert len(hull.triangles) == 2 * 2 * (4 * 3 + 4 * 2 + 3 * 2)
    a, b, c = points[hull.triangles].transpose(1, 0, 2)
    np.testing.assert_allclose((np.cross(a, b) * c).sum() / 6.0, 40.0 * 30.0 * 20.0)
    edges = np.concatenate([hull.triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    assert {tuple(e) for e in edges.tolist()} == {tuple(e) for e in edges[:, ::-1].tolist()}


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_octree_lattices_have_the_hull_of_their_cube(kind: int) -> None:
    lattice = octree_lattice(box_mask((8, 8, 8)), 10.0, kind, density=1e-6)
    hull = surface_of(lattice)
    a, b, c = lattice.points[hull.triangles].transpose(1, 0, 2)
    np.testing.assert_allclose((np.cross(a, b) * c).sum() / 6.0, 80.0**3)


@given(st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_distances_from_an_undeformed_box_are_the_closed_form(seed: int) -> None:
    hull, points = block()
    asked = np.random.default_rng(seed).uniform(-15.0, 55.0, (40, 3))
    found = closest_points(asked, hull, points)
    np.testing.assert_allclose(found.signed, box_distance(asked, points.min(axis=0), points.max(axis=0)), atol=1e-10)
    on_surface = (points[hull.triangles[found.triangle]] * found.weights[:, :, None]).sum(axis=1)
    np.testing.assert_allclose(on_surface + found.signed[:, None] * found.direction, asked, atol=1e-9)


def test_distances_from_a_deformed_surface_are_those_of_an_optimiser_over_every_triangle() -> None:
    hull, points = block()
    moved = deformed(points, 3)
    asked = np.random.default_rng(4).uniform(-5.0, 45.0, (6, 3))
    found = closest_points(asked, hull, moved)
    for p, distance in zip(asked, np.abs(found.signed), strict=True):
        least = np.inf
        for a, b, c in moved[hull.triangles]:
            if np.linalg.norm(np.mean([a, b, c], axis=0) - p) > distance + 25.0:
                continue  # no point of a triangle is farther than this from its middle

            def square(w: Array, a: Array = a, b: Array = b, c: Array = c, p: Array = p) -> float:
                return float(((a + w[0] * (b - a) + w[1] * (1.0 - w[0]) * (c - a) - p) ** 2).sum())

            least = min(least, min(float(minimize(square, w, bounds=[(0, 1), (0, 1)]).fun) for w in ([0.3, 0.3], [0.0, 0.9])))
        assert np.sqrt(least) == pytest.approx(distance, rel=1e-4)


def test_gradient_of_the_shape_difference_is_its_finite_difference() -> None:
    hull, points = block()
    moved = deformed(points, 5)
    asked = np.random.default_rng(6).uniform(-5.0, 45.0, (60, 3))
    found = shape_difference(asked, hull, moved, threshold_mm=0.8)
    assert 0 < found.counted.sum() < 60
    way = np.random.default_rng(7).standard_normal(points.shape)
    step = 1e-6
    ahead, behind = (shape_difference(asked, hull, moved + s * step * way, threshold_mm=0.8).total for s in (1.0, -1.0))
    assert (found.gradient * way).sum() == pytest.approx((ahead - behind) / (2.0 * step), rel=1e-6)


def test_distances_below_the_sensor_error_are_not_counted() -> None:
    hull, points = block()
    asked = np.array([[20.0, 15.0, 20.3], [20.0, 15.0, 21.0], [-2.0, 15.0, 10.0]])
    found = shape_difference(asked, hull, points, threshold_mm=0.5)
    assert found.counted.tolist() == [False, True, True]
    assert found.total == pytest.approx(3.0)


def test_force_difference_and_its_derivative() -> None:
    rng = np.random.default_rng(0)
    seen, ours = rng.standard_normal((2, 7, 2, 3))
    total, slope = force_difference(seen, ours)
    assert total == pytest.approx(sum(np.sqrt(((seen[i, j] - ours[i, j]) ** 2).sum()) for i in range(7) for j in range(2)))
    way = rng.standard_normal(ours.shape)
    ahead, behind = (force_difference(seen, ours + s * 1e-6 * way)[0] for s in (1.0, -1.0))
    assert (slope * way).sum() == pytest.approx((ahead - behind) / 2e-6, rel=1e-6)


def test_wrong_input_is_told() -> None:
    hull, points = block()
    with pytest.raises(InputError, match="1 of 2 points hold NaN, the first is number 1; leave them out"):
        closest_points([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]], hull, points)
    with pytest.raises(InputError, match=r"must have the shape \(k, 3\)"):
        closest_points([[0.0, 0.0]], hull, points)
    with pytest.raises(InputError, match="unequal time bases"):
        force_difference(np.zeros((5, 3)), np.zeros((4, 3)))
    with pytest.raises(InputError, match="measured forces hold 1 NaN"):
        force_difference(np.array([[np.nan, 0.0, 0.0]]), np.zeros((1, 3)))
