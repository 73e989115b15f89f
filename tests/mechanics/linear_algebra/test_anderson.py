"""Anderson's acceleration solves linear problems in as many steps as they have dimensions, also where the iteration diverges."""

from __future__ import annotations

import numpy as np

from naibu.mechanics.linear_algebra.anderson import AndersonMixing


def test_a_linear_iteration_that_diverges_is_solved_in_a_few_steps() -> None:
    slopes = np.array([0.5, -1.4, 2.0])
    solution = np.array([1.0, -2.0, 3.0])
    x, mixing = np.zeros(3), AndersonMixing(4)
    for _ in range(4):
        x = x + mixing.step(x, slopes * (solution - x))
    np.testing.assert_allclose(x, solution, atol=1e-6)
