"""Compression of a breast's shape: inverse maps, volume, symmetry, and the measured half ellipsoid."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.applications.mammography.breast_shape import BreastShape, half_ellipsoid_shape, shape_from_widths
from naibu.applications.mammography.geometric_model import Compression, CompressionParameters, compressed
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError


def tilted() -> BreastShape:
    """Return a shape whose centres wander and whose ellipses are tilted."""
    d = 90.0 * np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, 60))
    rest = 1.0 - (d / 90.0) ** 2
    centres = np.column_stack([6.0 * rest, -9.0 * rest])
    return BreastShape(d, centres, rest[:, None] * np.array([4225.0, 4900.0, 800.0]))


def interior(shape: BreastShape, count: int = 400) -> FloatArray:
    random = np.random.default_rng(5)
    depth = random.uniform(0.5, 0.95 * shape.depth_mm, count)
    centres, squares = shape.in_view(0.0, depth)
    turn, size = random.uniform(0.0, 2.0 * np.pi, count), np.sqrt(random.uniform(0.0, 0.95, count))
    found = []
    for m, (xx, yy, xy), t, r, z in zip(centres, squares, turn, size, depth, strict=True):
        found.append([*(m + np.linalg.cholesky([[xx, xy], [xy, yy]]) @ (r * np.array([np.cos(t), np.sin(t)]))), z])
    return np.array(found)


@pytest.mark.parametrize("angle", [0.0, 45.0, 90.0])
@pytest.mark.parametrize("bending", [-0.5, 0.0, 0.3, 1.0])
def test_uncompression_is_the_inverse_and_the_volume_is_kept(angle: float, bending: float) -> None:
    shape = tilted()
    state = compressed(shape, angle, 55.0, CompressionParameters(1.03, 0.6, bending))
    points = interior(shape)
    pressed = state.compress(points)
    np.testing.assert_allclose(state.uncompress(pressed), points, atol=1e-9)
    assert np.abs(pressed[:, 1]).max() <= 27.5 + 1e-9
    # volume by the divergence of the map itself: mean of its Jacobian determinants over uniform points, with central differences
    step = 1e-4
    columns = [(state.compress(points + step * e) - state.compress(points - step * e)) / (2 * step) for e in np.eye(3)]
    assert (np.linalg.det(np.stack(columns, axis=-1)) > 0.0).all()
    assert state.volume_mm3() / shape.volume_mm3 == pytest.approx(1.03, rel=1e-5)


def test_the_volume_of_an_ellipsoid_is_that_of_its_closed_form() -> None:
    shape = half_ellipsoid_shape((110.0, 130.0, 50.0))
    closed = 2.0 / 3.0 * np.pi * 55.0 * 65.0 * 50.0
    assert shape.volume_mm3 == pytest.approx(closed, rel=1e-3)
    assert Compression(shape, 0.0, 129.999, 1.0, 1.0, 0.0).volume_mm3() == pytest.approx(closed, rel=2e-3)
    assert Compression(shape, 0.0, 129.999, 1.1, 1.2, 0.0).volume_mm3() == pytest.approx(1.32 * closed, rel=2e-3)


def test_a_symmetric_breast_is_pressed_symmetrically_and_its_mid_plane_stays_flat() -> None:
    shape = half_ellipsoid_shape((120.0, 120.0, 80.0))
    state = compressed(shape, 0.0, 60.0)
    points = interior(shape)
    pressed = state.compress(points)
    np.testing.assert_allclose(state.compress(points * [-1, 1, 1]), pressed * [-1, 1, 1], atol=1e-9)
    np.testing.assert_allclose(state.compress(points * [1, -1, 1]), pressed * [1, -1, 1], atol=1e-9)
    np.testing.assert_allclose(state.compress(points * [1, 0, 1])[:, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(state.compress(points * [1, 1, 0])[:, 2], 0.0, atol=1e-12)


def test_without_stretch_and_bending_sections_deform_in_their_plane_and_the_mid_plane_is_fixed() -> None:
    shape = half_ellipsoid_shape((120.0, 120.0, 80.0))
    state = Compression(shape, 0.0, 60.0, 1.0, 1.0, 0.0)
    points = interior(shape)
    np.testing.assert_allclose(state.compress(points)[:, [0, 2]], points[:, [0, 2]], atol=1e-12)
    np.testing.assert_allclose(state.compress(points * [1, 0, 1]), points * [1, 0, 1], atol=1e-12)
    top = np.array([0.0, 60.0 * np.sqrt(1 - 0.25), 40.0])
    np.testing.assert_allclose(state.compress(top), [0.0, 30.0, 40.0], atol=0.01)


def test_bending_moves_the_middle_farther_than_the_plates() -> None:
    state = compressed(half_ellipsoid_shape((120.0, 120.0, 80.0)), 0.0, 60.0, CompressionParameters(bending=0.6))
    middle, plate = state.compress([[30.0, 0.0, 20.0], [30.0, 45.0, 20.0]])
    assert middle[0] > plate[0] > 30.0
    assert middle[2] > plate[2] > 20.0


@pytest.mark.parametrize("angle", [30.0, 45.0, 60.0, 90.0])
def test_ellipses_have_the_widths_that_were_seen(angle: float) -> None:
    depths = np.array([0.0, 20.0, 40.0])
    first, second = (np.array([[-60.0, 50.0], [-40.0, 38.0], [-5.0, 5.0]]), np.array([[-70.0, 52.0], [-45.0, 40.0], [-5.5, 5.0]]))
    shape = shape_from_widths(depths, first, second, angle)
    for direction, widths in ((0.0, first), (angle, second)):
        centres, squares = shape.in_view(direction, depths)
        reach = np.sqrt(squares[:, 0])
        np.testing.assert_allclose(np.column_stack([centres[:, 0] - reach, centres[:, 0] + reach]), widths, atol=1e-9)


def test_widths_that_no_ellipse_has_are_refused() -> None:
    with pytest.raises(InputError, match="do not fit together"):
        shape_from_widths(
            np.array([0.0, 30.0, 40.0]), np.array([[-60.0, 60], [-40, 40], [0, 0]]), np.array([[-20.0, 20], [-9, 9], [0, 0]]), 45.0
        )


@pytest.mark.parametrize("thickness", [0.0, 5.0, 120.0, 200.0, float("nan")])
def test_plates_that_do_not_press_are_refused(thickness: float) -> None:
    with pytest.raises(InputError, match="thickness_mm is"):
        compressed(half_ellipsoid_shape((120.0, 120.0, 80.0)), 0.0, thickness)
