"""Checks of arrays that callers hand in: what is right passes unchanged, what is wrong is named."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from naibu.core.arrays import as_mask, as_points, as_vector, require_finite, require_positive, require_shape
from naibu.core.errors import InputError

FINITE = st.floats(-1e6, 1e6)


@given(hnp.arrays(np.float64, st.tuples(st.integers(0, 5), st.integers(2, 3)), elements=FINITE))
def test_points_are_copied_unchanged(points: np.ndarray) -> None:
    taken = as_points("points", points)
    np.testing.assert_array_equal(taken, points)
    assert taken is not points and not np.shares_memory(taken, points)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([1.0, 2.0, 3.0], r"markers must have shape \(n, 3\), not \(3,\)"),
        (np.zeros((4, 2)), r"not \(4, 2\)"),
        ([[0.0, 0.0, 0.0], [1.0, np.nan, 0.0]], r"markers\[1, 1\] is nan"),
        (np.zeros((1, 3)), "1 rows; at least 2"),
    ],
)
def test_wrong_points_are_named(values: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        as_points("markers", values, 3, least=2)  # type: ignore[arg-type]


def test_vectors_have_their_length() -> None:
    np.testing.assert_array_equal(as_vector("normal", (0, 0, 1)), [0.0, 0.0, 1.0])
    with pytest.raises(InputError, match="normal must be 3 numbers"):
        as_vector("normal", (0, 1))


def test_single_numbers_and_shapes() -> None:
    assert require_positive("radius_mm", 2) == 2.0
    for wrong in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(InputError, match="radius_mm must be positive, mm"):
            require_positive("radius_mm", wrong, "mm")
    with pytest.raises(InputError, match="load is inf"):
        require_finite("load", np.array(np.inf))
    with pytest.raises(InputError, match=r"load must have shape \(2,\), not \(3,\)"):
        require_shape("load", np.zeros(3), (2,))


def test_masks_are_boolean_or_0_and_1() -> None:
    assert as_mask("mask", [[0, 1]], (1, 2)).tolist() == [[False, True]]
    for wrong, message in (([[0, 2]], "0 and 1"), ([[0, 0]], "empty"), ([0, 1], "shape")):
        with pytest.raises(InputError, match=message):
            as_mask("mask", wrong, (1, 2))
