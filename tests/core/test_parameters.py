"""Scales of parameters."""

from __future__ import annotations

import pytest

from naibu.core.parameters import Parameter


@pytest.mark.parametrize(("scale", "value"), [("linear", 3.0), ("log", 70.0), ("incompressibility", 0.48)])
def test_slope_and_bend_are_derivatives_of_the_physical_value(scale, value) -> None:
    p = Parameter("p", value, scale=scale)
    x, h = p.inner(value), 1e-4
    assert p.physical(x) == pytest.approx(value)
    low, high = p.physical(x - h), p.physical(x + h)
    assert (high - low) / (2 * h) == pytest.approx(p.slope(value), rel=1e-6)
    second = (high - 2 * value + low) / h**2
    assert second / p.slope(value) == pytest.approx(p.bend, abs=1e-4)
