"""Prescribed motions: piecewise linear and smooth, their derivatives, and what they refuse."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.mechanics.prescribed_motion import PrescribedMotion


def test_piecewise_linear_motion_rests_before_and_after() -> None:
    motion = PrescribedMotion.through([1.0, 2.0, 4.0], [(0.0, 0.0), (0.0, -3.0), (1.0, -3.0)])
    expected = [(0.0, 0.0), (0.0, 0.0), (0.0, -1.5), (0.0, -3.0), (0.5, -3.0), (1.0, -3.0), (1.0, -3.0)]
    np.testing.assert_allclose(motion.sampled([0.0, 1.0, 1.5, 2.0, 3.0, 4.0, 9.0]), expected, atol=1e-14)
    assert motion.kinks == (1.0, 2.0, 4.0)


@pytest.mark.parametrize(
    ("time", "side", "velocity"),
    [(1.0, -1, (0.0, 0.0)), (1.0, 1, (0.0, -3.0)), (2.0, -1, (0.0, -3.0)), (2.0, 1, (0.5, 0.0)), (4.0, 1, (0.0, 0.0))],
)
def test_velocity_has_two_sides_at_a_kink(time: float, side: int, velocity: tuple[float, float]) -> None:
    motion = PrescribedMotion.through([1.0, 2.0, 4.0], [(0.0, 0.0), (0.0, -3.0), (1.0, -3.0)])
    assert motion.velocity(time, side).tolist() == list(velocity)
    assert motion.acceleration(time).tolist() == [0.0, 0.0]


def test_derivatives_that_are_not_given_are_central_differences() -> None:
    motion = PrescribedMotion.of(lambda t: (np.sin(2.0 * t), t**2))
    given = PrescribedMotion.of(
        lambda t: (np.sin(2.0 * t), t**2),
        velocity=lambda t: (2.0 * np.cos(2.0 * t), 2.0 * t),
        acceleration=lambda t: (-4.0 * np.sin(2.0 * t), 2.0),
    )
    np.testing.assert_allclose(motion.velocity(0.7, 1), given.velocity(0.7, 1), atol=1e-8)
    np.testing.assert_allclose(motion.acceleration(0.7), given.acceleration(0.7), atol=1e-5)


@pytest.mark.parametrize(
    ("times", "displacements", "message"),
    [
        ([0.0, 0.0], [[0.0], [1.0]], "times_s must increase"),
        ([0.0, np.nan], [[0.0], [1.0]], "finite"),
        ([0.0, 1.0], [0.0, 1.0], r"displacements_mm \(k, d\)"),
        ([], np.zeros((0, 3)), "k at least 1"),
    ],
)
def test_bad_motions_are_named(times: list[float], displacements: list[list[float]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        PrescribedMotion.through(times, displacements)


def test_a_path_goes_to_other_processes() -> None:
    path = PrescribedMotion.through([0.0, 0.1, 0.3], [[0.0, 0.0], [1.0, -2.0], [1.0, 0.0]])
    sent = pickle.loads(pickle.dumps(path))
    for time in (-0.1, 0.0, 0.05, 0.1, 0.2, 0.3, 0.4):
        np.testing.assert_array_equal(sent.displacement(time), path.displacement(time))
        for side in (-1, 1):
            np.testing.assert_array_equal(sent.velocity(time, side), path.velocity(time, side))
    np.testing.assert_allclose(sent.velocity(0.1, -1), [10.0, -20.0])
    np.testing.assert_allclose(sent.velocity(0.1, 1), [0.0, 10.0])
    np.testing.assert_array_equal(sent.velocity(0.3, 1), [0.0, 0.0])
