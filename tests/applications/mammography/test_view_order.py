"""Views that may be swapped: what outlines tell, and that the fit of two outlines does not."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.applications.mammography.breast_outline import BreastOutline, breast_outline
from naibu.applications.mammography.pair_construction import mammographic_pair
from naibu.applications.mammography.view_order import excess_above_nipple, may_be_swapped
from naibu.validation.specimens.virtual_breasts import press_breast, random_breast


def lopsided(depth: float, upper: float, lower: float) -> BreastOutline:
    """Return an outline of two quarters of ellipses that meet at the nipple."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, 201)
    along = np.where(turn > 0.0, upper, lower) * np.sin(turn)
    return breast_outline(np.column_stack([depth * np.cos(turn), along]))


def test_the_excess_is_that_of_the_quarters() -> None:
    assert excess_above_nipple(lopsided(100.0, 90.0, 60.0)) == pytest.approx((90.0 - 60.0) / 150.0, abs=2e-3)
    assert not may_be_swapped(lopsided(100.0, 80.0, 80.0), lopsided(105.0, 82.0, 82.0))
    assert may_be_swapped(lopsided(100.0, 90.0, 70.0), lopsided(100.0, 80.0, 80.0))


def test_both_orders_of_two_outlines_fit_alike() -> None:
    """The breast of one order is the mirror image of that of the other: distances to curves and volumes tell nothing of the order."""
    first, second = lopsided(100.0, 82.0, 76.0), lopsided(104.0, 90.0, 68.0)
    there = mammographic_pair(first, second, (55.0, 60.0), 50.0, draws=20)
    swapped = mammographic_pair(second, first, (60.0, 55.0), 50.0, draws=20)
    assert swapped.nominal.shape.volume_mm3 == pytest.approx(there.nominal.shape.volume_mm3, rel=1e-4)
    for place, other in (((50.0, 20.0), (48.0, 30.0)), ((30.0, -35.0), (40.0, -10.0))):
        one = there.epipolar_curve(np.array(place)).distance(np.array(other))
        assert swapped.epipolar_curve(np.array(place), from_view="MLO").distance(np.array(other)) == pytest.approx(one, abs=0.01)


def test_swapped_views_of_virtual_breasts_are_told_and_ordered_ones_are_not() -> None:
    """By other finite elements, with gravity, on coarse meshes; the benchmark of the population has the rates."""
    for seed in (3, 4, 5, 6):
        cc, mlo = (breast_outline(o) for o in press_breast(random_breast(seed), count=1, cell=0.35).outlines)
        assert may_be_swapped(mlo, cc) and not may_be_swapped(cc, mlo), seed
