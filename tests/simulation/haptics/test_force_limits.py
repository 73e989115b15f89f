"""Limits of forces on a haptic device: steps whatever is lost, and energy of an environment that drives the hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.simulation import ForceLimits
from naibu.simulation.haptics.force_limits import PassivityController, StepLimiter


@pytest.mark.parametrize("loss", [0.0, 0.01, 0.5])
def test_no_pattern_of_losses_makes_a_step(loss: float) -> None:
    chance = np.random.default_rng(4)
    limiter = StepLimiter(100.0)
    coming: list[tuple[int, int, np.ndarray]] = []
    applied, number, largest, reached = np.zeros(3), 0, 0.0, 0.0
    known = 0
    for k in range(20_000):
        wanted = 3000.0 * np.array([np.sign(np.sin(k / 300.0)), chance.normal(), 0.0])
        limiter.confirmed(known)
        force = limiter.limited(wanted)
        if chance.random() >= loss:
            coming.append((k + int(chance.integers(1, 6)), limiter.number, force))
        for item in [item for item in coming if item[0] <= k]:
            coming.remove(item)
            if item[1] > number:
                number = item[1]
                largest = max(largest, float(np.linalg.norm(item[2] - applied)))
                applied = item[2]
                reached = max(reached, abs(applied[0]))
        if chance.random() >= loss:
            known = number
    assert largest <= 100.0 * (1 + 1e-9)
    assert reached > 2900.0 if loss < 0.1 else reached > 500.0


def test_forces_arrive_at_once_where_they_are_small() -> None:
    limiter = StepLimiter(100.0)
    for wanted in ([30.0, 0.0, 0.0], [60.0, 20.0, 0.0], [90.0, 0.0, 10.0]):
        np.testing.assert_allclose(limiter.limited(np.array(wanted)), wanted)


@pytest.mark.parametrize("gain", [50.0, 400.0])
def test_an_environment_that_drives_the_hand_gives_no_more_than_the_bound(gain: float) -> None:
    """A force along the motion is negative damping; without the controller it gives without end."""
    given = {}
    for limits in (ForceLimits(), replace(ForceLimits(), energy_mn_mm=1e12)):
        controller, limiter = PassivityController(limits, 500.0), StepLimiter(limits.step_mn)
        position, velocity, force, work, most = 0.0, 20.0, 0.0, 0.0, 0.0
        for _ in range(5000):
            velocity += 1e-3 * (force - 100.0 * position) / 0.2
            position += 1e-3 * velocity
            work += force * 1e-3 * velocity
            most = max(most, work)
            controller.observe(-work)
            moving = np.array([velocity, 0.0, 0.0])
            limiter.forget()
            force = limiter.limited(limits.within_magnitude(controller.controlled(gain * moving, moving, 1e-3)))[0]
        given[limits.energy_mn_mm] = most
    assert given[1000.0] <= 1000.0 * (1 + 1e-9)
    assert given[1e12] > 100_000.0


def test_a_device_that_got_all_that_the_bound_permits_feels_again_what_it_presses() -> None:
    """To and fro against a wall: what it puts in from then on comes back, and nothing besides."""
    limits = ForceLimits()
    controller, limiter = PassivityController(limits, 500.0), StepLimiter(limits.step_mn)
    work, force, forces = limits.energy_mn_mm, 0.0, []
    for k in range(3000):
        time = 1e-3 * k
        position, velocity = -np.sin(6.0 * time), -6.0 * np.cos(6.0 * time)
        work = min(work + force * 1e-3 * velocity, limits.energy_mn_mm)  # as the device sees to
        controller.observe(-work)
        limiter.forget()
        moving, wall = np.array([velocity, 0.0, 0.0]), np.array([-200.0 * min(position, 0.0), 0.0, 0.0])
        force = limiter.limited(controller.controlled(wall, moving, 1e-3))[0]
        forces.append(force)
    assert max(forces[-1000:]) > 150.0


def test_an_environment_that_takes_energy_is_left_alone() -> None:
    controller = PassivityController(ForceLimits(), 500.0)
    force, velocity = np.array([-500.0, 20.0, 0.0]), np.array([40.0, 0.0, 0.0])
    assert controller.controlled(force, velocity, 1e-3) is force


def test_limits_that_are_none_are_refused() -> None:
    with pytest.raises(InputError, match="step_mn"):
        ForceLimits(step_mn=0.0)
