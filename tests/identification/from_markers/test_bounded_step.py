"""Steps of the search within bounds."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.identification.from_markers.bounded_step import SHORTEST_REACH, bounded_step, next_reach


def test_steps_stay_within_their_limits() -> None:
    hessian, gradient = np.array([[4.0, 1.0, 0.0], [1.0, 3.0, 1.0], [0.0, 1.0, 2.0]]), np.array([8.0, 1.0, 2.0])
    free = bounded_step(hessian, gradient, np.array([np.inf]))
    np.testing.assert_allclose(hessian @ free, gradient)
    step = bounded_step(hessian, gradient, np.array([0.5, 10.0]))
    assert step[0] == 0.5
    np.testing.assert_allclose((hessian @ step)[1:], gradient[1:])  # the others are the best for it


@pytest.mark.parametrize(("kept", "factor"), [(-1.0, 0.5), (0.1, 0.5), (0.5, 1.0), (1.0, 2.0)])
def test_bounds_follow_how_well_the_last_step_was_foretold(kept: float, factor: float) -> None:
    assert next_reach(0.4, kept) == pytest.approx(0.4 * factor)
    assert next_reach(SHORTEST_REACH, 0.0) == SHORTEST_REACH and next_reach(1.0, 1.0) == 1.0


def test_a_step_that_overshoots_ends_at_the_minimum() -> None:
    """Of |x|, whose quadratic model about every point is taken to be the same: full steps alternate for ever."""
    x, reach = 0.8, 1.0
    for _ in range(12):
        step = bounded_step(np.eye(1), np.array([-10.0 * np.sign(x)]), np.array([reach]))[0]
        expected = abs(step)
        gained = abs(x) - abs(x + step)
        reach = next_reach(reach, gained / expected)
        x = x + step if gained > 0.0 else x
    assert abs(x) <= SHORTEST_REACH
