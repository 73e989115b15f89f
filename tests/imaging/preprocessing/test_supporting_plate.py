"""Plates under objects are told by their shape, and nothing else is taken for one."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import BoolArray, FloatArray
from naibu.imaging.preprocessing.supporting_plate import supporting_plate

Z, Y, X = np.meshgrid(np.arange(20.0), np.arange(50.0), np.arange(80.0), indexing="ij")
ALONG = 1.0 + 0.2 * np.cos(Z / 4.0)  # an object is not the same in all slices


def oval(size: FloatArray | float = 1.0) -> BoolArray:
    return np.asarray(np.hypot((X - 40.0) / 25.0, (Y - 22.0) / 15.0) < size)


def plate(bent: float) -> BoolArray:
    return np.asarray((np.abs(Y - 39.0 + bent * (X - 40.0) ** 2) < 2.6) & (np.abs(X - 40.0) < 37.0))


@pytest.mark.parametrize("bent", [0.0, 0.005])
@pytest.mark.parametrize("turns", range(4))
def test_a_plate_is_found_on_each_side_flat_or_bent(bent: float, turns: int) -> None:
    both = np.rot90(oval(ALONG) | plate(bent), turns, axes=(1, 2))
    found = supporting_plate(both)
    assert found is not None
    found = np.rot90(found, -turns, axes=(1, 2))
    assert found[plate(bent)].mean() > 0.95
    assert (found & oval(ALONG) & ~plate(bent)).sum() < 0.04 * oval(ALONG).sum()


@pytest.mark.parametrize(
    "mask",
    [
        oval(),
        oval(ALONG),
        (np.abs(X - 40.0) < 20.0) & (np.abs(Y - 25.0) < 15.0),
        plate(0.0),
        oval() | (plate(0.0) & (X < 45.0)),  # on one side only
        oval() | (plate(0.0) & (Z < 12.0)),  # in some slices only
        oval() | ((np.abs(Y - 39.0) < 1.0 + 0.3 * np.abs(X - 40.0)) & (np.abs(X - 40.0) < 37.0)),  # a wedge on either side
        np.zeros_like(oval()),
    ],
)
def test_what_is_no_plate_under_an_object_is_none(mask: BoolArray) -> None:
    assert supporting_plate(mask) is None
