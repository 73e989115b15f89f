"""Outlines of a breast: which are taken, what is measured, which are refused."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.applications.mammography.breast_outline import breast_outline, inside_polygon, mask_outline
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError

TURN = np.linspace(-np.pi / 2, np.pi / 2, 181)
HALF_ELLIPSE: FloatArray = np.column_stack([100.0 * np.cos(TURN), 70.0 * np.sin(TURN)])


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("closed", [False, True])
def test_the_extent_of_a_half_ellipse_is_that_of_its_equation(side: float, closed: bool) -> None:
    points = HALF_ELLIPSE * [side, 1.0] + [30.0, 12.0]
    if closed:
        wall = np.column_stack([np.full(9, 30.0), np.linspace(82.0, -58.0, 11)[1:-1]])
        points = np.roll(np.vstack([points, wall]), 57, axis=0)
        points = np.vstack([points, points[:1]])
    outline = breast_outline(points)
    expected = 70.0 * np.sqrt(1.0 - (outline.depths / 100.0) ** 2)
    np.testing.assert_allclose(outline.high[:-3], expected[:-3], atol=0.3)
    np.testing.assert_allclose(outline.low[:-3], -expected[:-3], atol=0.3)
    assert (outline.wall_mm, outline.nipple_mm, outline.reversed) == (pytest.approx(30.0, abs=0.1), pytest.approx(12.0, abs=0.1), side < 0)
    place = np.array([30.0 + side * 40.0, 22.0])
    np.testing.assert_allclose(outline.from_image(place), [40.0, 10.0], atol=0.1)
    np.testing.assert_allclose(outline.to_image(outline.from_image(place)), place)


def test_the_outline_of_a_mask_is_that_of_its_equation() -> None:
    rows, columns = np.mgrid[:400, :300]
    mask = ((columns + 0.5) / 250.0) ** 2 + ((rows + 0.5 - 200.0) / 180.0) ** 2 < 1.0
    for image, right in ((mask, False), (mask[:, ::-1], True)):
        outline = mask_outline(image, 0.4)
        np.testing.assert_allclose(outline.high[:-8], 72.0 * np.sqrt(1.0 - (outline.depths[:-8] / 100.0) ** 2), atol=0.6)
        assert outline.reversed is right
        assert outline.depth_mm == pytest.approx(100.0, abs=0.4)
        assert outline.wall_mm == pytest.approx(120.0 if right else 0.0, abs=1e-9)


def test_points_in_a_polygon() -> None:
    square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
    assert inside_polygon(square, [[1.0, 1.0], [3.0, 1.0], [1.0, -0.1]]).tolist() == [True, False, False]


def test_a_straight_part_does_not_cross_itself_by_rounding() -> None:
    """Four points along one edge of a mesh: rounding, of 1e-16 mm², puts the ends of the outer two parts on either side of each other."""
    edge = [
        [76.17732338378659, -3.6772473371173264],
        [76.42188092287677, 0.8547918854473675],
        [76.61227233291916, 4.383046794952934],
        [76.74836266871793, 6.905016642811887],
    ]
    outline = breast_outline([[0.0, -100.0], [60.0, -60.0], *edge, [60.0, 60.0], [0.0, 100.0]])
    assert outline.depth_mm == pytest.approx(edge[-1][0])


@pytest.mark.parametrize(
    ("points", "told"),
    [
        (HALF_ELLIPSE[:120], "ends lie at"),
        (HALF_ELLIPSE[:, ::-1], "ends lie at|chest wall"),
        (HALF_ELLIPSE / 10.0, "in mm"),
        (HALF_ELLIPSE * 1000.0, "in mm"),
        (HALF_ELLIPSE[np.r_[:60, 120, 61:120, 60, 121:181]], "crosses itself"),
        (HALF_ELLIPSE[:3], "at least 5"),
        (np.full((9, 2), np.nan), "finite"),
        (np.zeros((9, 3)), "two coordinates"),
        (np.column_stack([60.0 * np.cos(4 * TURN), 60.0 * np.sin(4 * TURN)])[:91], "no straight side"),
        (np.column_stack([60.0 * np.cos(4 * TURN), 60.0 * np.sin(4 * TURN)])[:90], "between its ends"),
    ],
)
def test_what_is_no_outline_is_refused(points: FloatArray, told: str) -> None:
    with pytest.raises(InputError, match=told):
        breast_outline(points, what="CC.csv")


@pytest.mark.parametrize(
    ("mask", "pixel", "told"),
    [
        (np.zeros((50, 50)), 1.0, "0 pixels"),
        (np.ones((50, 50)), 1.0, "both sides"),
        (np.pad(np.ones((40, 40)), 5), 1.0, "neither side"),
        (np.ones((3, 50, 50)), 1.0, "one plane"),
        (np.ones((50, 50)), 0.0, "pixel_mm"),
    ],
)
def test_what_is_no_mask_is_refused(mask: FloatArray, pixel: float, told: str) -> None:
    with pytest.raises(InputError, match=told):
        mask_outline(mask, pixel)
