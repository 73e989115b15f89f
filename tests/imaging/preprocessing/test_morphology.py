"""Dilation and closing by steps are those of SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from naibu.imaging.preprocessing.morphology import closed_by_steps, dilated


def regions(seed: int) -> np.ndarray:
    """Blobs and specks, some of them at the faces of a box."""
    rng = np.random.default_rng(seed)
    smooth = ndimage.gaussian_filter(rng.standard_normal((17, 23, 19)), 1.2)
    return np.asarray((smooth > 0.15) | (rng.random(smooth.shape) > 0.99))


@pytest.mark.parametrize("steps", [1, 2, 3])
@pytest.mark.parametrize("seed", [0, 1])
def test_dilation_by_steps(seed: int, steps: int) -> None:
    found = regions(seed)
    before = found.copy()
    np.testing.assert_array_equal(dilated(found, steps), ndimage.binary_dilation(found, iterations=steps))
    np.testing.assert_array_equal(found, before)


@pytest.mark.parametrize("steps", [1, 2, 3])
@pytest.mark.parametrize("seed", [0, 1])
def test_closing_by_steps_in_an_empty_surrounding(seed: int, steps: int) -> None:
    found, pad = regions(seed), steps + 1
    expected = ndimage.binary_closing(np.pad(found, pad), iterations=steps)[(slice(pad, -pad),) * 3]
    np.testing.assert_array_equal(closed_by_steps(found, steps), expected)


def test_no_steps_change_nothing() -> None:
    found = regions(0)
    np.testing.assert_array_equal(dilated(found, 0), found)
    np.testing.assert_array_equal(closed_by_steps(found, 0), found)
