"""Tools and grips that follow a hand seen now and then: their velocity, and the force that a viscous body exerts, do not leap."""

from __future__ import annotations

import numpy as np
import pytest
from touched_lattice import TOP, touched_lattice

from naibu.core.arrays import FloatArray
from naibu.mechanics import spherical_indenter
from naibu.simulation import InteractiveSimulation
from naibu.simulation.tool_places import FollowedHand

FRAME_S, SPEED, DELAY_S = 1.0 / 60.0, 18.0, 0.06  # mm/s


def followed(every: int, delay_s: float, frames: int = 120) -> FloatArray:
    """Places along the way of a hand that moves at `SPEED`, and is seen in every so many frames."""
    hand, at, out = FollowedHand(), np.zeros(3), []
    for k in range(frames):
        seen = np.array([SPEED * FRAME_S * (k // every) * every, 0.0, 0.0])
        at = hand.next_place(at, seen, FRAME_S, delay_s)
        out.append(at[0])
    return np.array(out)


def test_the_velocity_does_not_leap_and_is_that_of_the_hand() -> None:
    for every in (1, 2, 4):
        velocity = np.diff(followed(every, DELAY_S))[60:] / FRAME_S
        assert velocity.mean() == pytest.approx(SPEED, rel=0.05)
        assert np.abs(velocity - SPEED).max() < (0.01 if every == 1 else 0.35) * SPEED
        leaps = np.diff(followed(every, 0.0))[60:] / FRAME_S
        assert leaps.max() == pytest.approx(every * SPEED)


def test_the_delay_is_what_was_asked_for_and_the_place_is_reached() -> None:
    """A ramp is followed with the sum of the time constants, less what each filter gains by knowing the place at the end of a frame."""
    lag = SPEED * FRAME_S * np.arange(120) - followed(1, DELAY_S)
    rest = np.exp(-2.0 * FRAME_S / DELAY_S)
    assert lag[-1] == pytest.approx(2.0 * SPEED * FRAME_S * rest / (1.0 - rest))
    assert lag[-1] / SPEED == pytest.approx(DELAY_S, abs=FRAME_S)
    hand, at = FollowedHand(), np.zeros(3)
    for _ in range(60):
        at = hand.next_place(at, np.array([20.0, 0.0, 0.0]), FRAME_S, DELAY_S)
    np.testing.assert_array_equal(at, [20.0, 0.0, 0.0])
    np.testing.assert_array_equal(hand.next_place(at, np.zeros(3), FRAME_S, 0.0), 0.0)


def test_it_does_not_go_beyond_where_the_hand_stops() -> None:
    hand, at, seen = FollowedHand(), np.zeros(3), np.zeros(3)
    for k in range(60):
        seen = np.array([0.0, 0.0, -2.0 * min(k, 10)])
        at = hand.next_place(at, seen, FRAME_S, DELAY_S)
        assert -20.0 <= at[2] <= 0.0


def pressed(every: int, delay_s: float) -> FloatArray:
    """Force (k,), mN, on a sphere that a hand leads into a viscous lattice, seen in every so many frames."""
    touched = InteractiveSimulation(touched_lattice(), {"sphere": spherical_indenter((20.0, 20.0, 60.0), 8.0)}, delay_s=delay_s)
    touched.take("sphere")
    forces = []
    for k in range(54):
        touched.move((20.0, 20.0, 50.0 - SPEED * FRAME_S * (k // every) * every))
        forces.append(-touched.advance().force[2])
    assert touched.last.tool_centre[2] < TOP
    touched.close()
    return np.array(forces)


def test_the_force_of_a_viscous_body_does_not_leap_with_the_places_where_the_hand_is_seen() -> None:
    exact, leaping, found = pressed(1, 0.0), pressed(4, 0.0), pressed(4, DELAY_S)
    assert leaping.max() > 1.3 * exact.max()
    assert found.max() < 1.15 * exact.max()
    assert np.abs(np.diff(found)).max() < 0.4 * np.abs(np.diff(leaping)).max()


def test_a_tool_that_is_taken_anew_begins_at_rest() -> None:
    touched = InteractiveSimulation(touched_lattice(), {"sphere": spherical_indenter((20.0, 20.0, 60.0), 8.0)}, delay_s=DELAY_S)
    touched.take("sphere")
    touched.move((20.0, 20.0, 90.0))
    for _ in range(3):
        touched.advance()
    touched.take("sphere")
    waiting = touched.advance().tool_centre
    np.testing.assert_array_equal(touched.advance().tool_centre, waiting)
    touched.close()
