"""Virtual coupling: the balance and the motion of a tool between a device and what it touches, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.simulation import VirtualCoupling
from naibu.simulation.haptics.virtual_coupling import LEAST_CHANGE, CoupledTool

STEP = 1e-3


@pytest.mark.parametrize(("stiffness", "damping"), [(50.0, 1.0), (800.0, 20.0), (800.0, 500.0), (5000.0, 2000.0)])
def test_tool_and_wall_are_springs_in_series(stiffness: float, damping: float) -> None:
    """A wall with the damping of a viscous body answers within the step by far more than the tool's own inertia over the step, 20."""
    tool = CoupledTool(VirtualCoupling(), np.array([0.0, 0.0, 1.0]))
    device = np.array([0.0, 0.0, -4.0])
    moves = []
    for _ in range(30_000):
        before = tool.position
        after = tool.next_position(device, np.zeros(3), STEP)
        depth, speed = max(0.0, -after[2]), (after[2] - before[2]) / STEP
        answer = min(0.0, -(stiffness * depth - damping * speed)) if depth > 0.0 else 0.0
        tool.moved(after, np.array([0.0, 0.0, answer]), STEP)
        moves.append(abs(speed))
    expected = -4.0 * tool.coupling.stiffness / (tool.coupling.stiffness + stiffness)
    np.testing.assert_allclose(tool.position[2], expected, rtol=1e-4)
    np.testing.assert_allclose(tool.force(device, np.zeros(3))[2], -stiffness * expected, rtol=1e-4)
    assert max(moves[-1000:]) < 4 * LEAST_CHANGE  # what it takes to learn the impedance anew, a tenth of a micrometre in a step


def test_a_free_tool_is_a_damped_oscillator() -> None:
    own = VirtualCoupling(stiffness=200.0, damping=1.0, mass_kg=0.05)
    tool, step = CoupledTool(own, np.zeros(3)), 1e-5
    path = []
    for _ in range(10_000):
        tool.moved(tool.next_position(np.array([1.0, 0.0, 0.0]), np.zeros(3), step), np.zeros(3), step)
        path.append(tool.position[0])
    times = step * np.arange(1, 10_001)
    decay = own.damping / (2 * own.mass_kg)
    pulse = np.sqrt(own.stiffness / own.mass_kg - decay**2)
    exact = 1.0 - np.exp(-decay * times) * (np.cos(pulse * times) + decay / pulse * np.sin(pulse * times))
    np.testing.assert_allclose(path, exact, atol=3e-3)


def test_couplings_that_are_none_are_refused() -> None:
    for wrong in ({"stiffness": 0.0}, {"damping": -1.0}, {"mass_kg": float("nan")}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            VirtualCoupling(**wrong)
