"""Scales of parameters, and rotations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from naibu.core.parameters import Parameter
from naibu.core.rotation import left_jacobian, rotation_matrix


@pytest.mark.parametrize(("scale", "value"), [("linear", 3.0), ("log", 70.0), ("incompressibility", 0.48)])
def test_slope_and_bend_are_derivatives_of_the_physical_value(scale, value) -> None:
    p = Parameter("p", value, scale=scale)
    x, h = p.inner(value), 1e-4
    assert p.physical(x) == pytest.approx(value)
    low, high = p.physical(x - h), p.physical(x + h)
    assert (high - low) / (2 * h) == pytest.approx(p.slope(value), rel=1e-6)
    second = (high - 2 * value + low) / h**2
    assert second / p.slope(value) == pytest.approx(p.bend, abs=1e-4)


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (1e-8, 0.0, 2e-8), (0.3, -0.2, 0.9), (2.0, 1.0, -1.0)])
def test_left_jacobian_is_that_of_the_rotation(vector) -> None:
    v, d, h = np.array(vector), np.array([0.4, 1.0, -0.7]), 1e-6
    np.testing.assert_allclose(rotation_matrix(v), Rotation.from_rotvec(v).as_matrix(), atol=1e-12)
    further = rotation_matrix(v + h * d) @ rotation_matrix(v - h * d).T
    np.testing.assert_allclose(Rotation.from_matrix(further).as_rotvec() / (2 * h), left_jacobian(v) @ d, atol=1e-8)
