"""Joint estimates against one least squares fit of all data at once, which they are for linear models."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.identification.joint_estimate import NormalEstimate, joint_estimate


def fitted(names: tuple[str, ...], design: np.ndarray, data: np.ndarray) -> NormalEstimate:
    return NormalEstimate(names, np.linalg.lstsq(design, data, rcond=None)[0], np.linalg.inv(design.T @ design))


def test_joint_estimate_is_the_fit_of_all_data_at_once() -> None:
    rng = np.random.default_rng(0)
    truth = np.array([1.0, -2.0, 0.5, 3.0])  # a and b are shared, c and d known to one kind of data each
    one, two = rng.standard_normal((30, 4)) * [1, 1, 1, 0], rng.standard_normal((12, 4)) * [1, 1, 0, 1]
    data = [d @ truth + rng.standard_normal(len(d)) for d in (one, two)]
    found = joint_estimate([fitted(("a", "b", "c"), one[:, [0, 1, 2]], data[0]), fitted(("b", "a", "d"), two[:, [1, 0, 3]], data[1])])
    whole, measured = np.concatenate([one, two]), np.concatenate(data)
    order = [("a", "b", "c", "d").index(n) for n in found.together.names]
    expected, *_ = np.linalg.lstsq(whole, measured, rcond=None)
    np.testing.assert_allclose(found.together.values, expected[order], rtol=1e-9)
    np.testing.assert_allclose(found.together.covariance, np.linalg.inv(whole.T @ whole)[np.ix_(order, order)], rtol=1e-8, atol=1e-12)
    apart = sum(float(np.sum((d - m @ np.linalg.lstsq(m, d, rcond=None)[0]) ** 2)) for m, d in zip((one, two), data, strict=True))
    assert found.chi_squared == pytest.approx(float(np.sum((measured - whole @ expected) ** 2)) - apart, rel=1e-6)
    assert (found.shared, found.degrees_of_freedom, found.contradicted) == (("a", "b"), 2, False)


def test_contradiction_widens_until_both_are_possible() -> None:
    found = joint_estimate([NormalEstimate(("a",), np.array([v]), np.array([[0.01]])) for v in (0.0, 1.0)])
    assert found.contradicted
    # two values of one standard deviation scatter by 0.5 about their mean, whose standard error is then that over sqrt(2 - 1)
    assert found.together.values[0] == pytest.approx(0.5)
    assert found.together.standard_deviation("a") == pytest.approx(0.5)


def test_what_is_not_determined_joins_nothing() -> None:
    blind = NormalEstimate(("a", "b"), np.zeros(2), np.diag([np.inf, 1.0]))
    with pytest.raises(InputError, match="no parameter is told by more than one kind"):
        joint_estimate([blind, NormalEstimate(("a",), np.ones(1), np.eye(1))])
