"""What a haptic device feels of a body that takes 1/60 s a step: against the body itself, and within the limits of the force."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from lossy_channel import LossyChannel, felt
from scipy.spatial.transform import Rotation

from naibu.core.arrays import FloatArray
from naibu.mechanics import Assembler, elements, material, spherical_indenter
from naibu.meshing import box
from naibu.simulation import FiniteElementBody, ForceLimits, Frame, HapticHand, InteractiveSimulation, LocalContact, SimulatedDevice
from naibu.simulation.haptics.local_contact import LocalFrame, LocalReaction
from naibu.simulation.interactive_simulation import FRAME_S
from naibu.simulation.tool_places import LEAST_TURN

STEP_S = 1e-3
RADIUS, EDGE = 8.0, 40.0


@dataclass(eq=False)
class BesideBody:
    """The local model and the body in turns, as by two threads: a frame of the body reaches the model when its time is over."""

    body: InteractiveSimulation
    contact: LocalContact
    frames: list[Frame]
    hand: HapticHand
    _due: float = 0.0
    frame_s: float = STEP_S

    def __getattr__(self, name: str) -> object:  # as HapticHand sees it
        return getattr(self.contact, name)

    def advance(self) -> LocalFrame:
        self._due -= STEP_S
        if self._due <= 0.0:
            self._due += self.body.frame_s
            for order in self.contact.observe(self.body.last, led=self.hand.leading):
                order(self.body)
            self.frames.append(self.body.advance())
        return self.contact.advance()


def gel(step_s: float = FRAME_S) -> FiniteElementBody:
    mesh = box((EDGE, EDGE, EDGE), (4, 4, 4))
    assembler = Assembler.from_materials(
        elements(mesh, "mean_dilatation"), mesh.regions, [material(young_modulus=10.0, poisson_ratio=0.45)]
    )
    body = FiniteElementBody.of(mesh, assembler, supported=np.flatnonzero(mesh.points[:, 2] < 1e-9).astype(np.int64), step_s=step_s)
    return replace(body, engine=replace(body.engine, background=False))  # repeatable


def beside(channel: LossyChannel, body: InteractiveSimulation | None = None, **limits: float) -> tuple[BesideBody, HapticHand]:
    if body is None:
        tool = spherical_indenter((0.0, 0.0, EDGE + RADIUS + 3.0), RADIUS, static_friction=0.3, kinetic_friction=0.3)
        body = InteractiveSimulation(gel(), {"sphere": tool})
    hand = HapticHand(channel, limits=ForceLimits(**limits))
    return BesideBody(body, LocalContact(body.tools, body.fastest_mm_s, body_step_s=body.frame_s), [], hand), hand


def test_the_reaction_grows_with_the_push_and_ends_where_the_tool_leaves() -> None:
    here = np.array([1.0, 2.0, 3.0])
    pushing = LocalReaction(here, np.array([0.0, 0.0, -1.0]), 90.0, 30.0, 0.5)
    for way, force in (
        ((0.0, 0.0, 0.0), (0.0, 0.0, -90.0)),
        ((0.0, 0.0, -2.0), (0.0, 0.0, -150.0)),
        ((0.0, 0.0, 3.5), (0.0, 0.0, 0.0)),
        ((0.5, 0.0, 0.0), (15.0, 0.0, -90.0)),  # sticks
        ((0.0, -9.0, 0.0), (0.0, -45.0, -90.0)),  # slips
    ):
        np.testing.assert_allclose(pushing.at(here + np.array(way)), force)
    above = replace(pushing, push=-60.0)  # 2 mm
    assert not above.at(here + np.array([0.0, 0.0, -1.9])).any()
    np.testing.assert_allclose(above.at(here + np.array([9.0, 0.0, -3.0])), [0.0, 0.0, -30.0])


def test_device_model_and_body_are_in_balance_at_rest() -> None:
    channel = LossyChannel(loss=0.0, late=0.0)
    led, hand = beside(channel)
    device = SimulatedDevice(lambda t: np.array([5.0, 6.0, 7.0 - 16.0 * min(t / 0.8, 1.0)]))
    run = felt(led, hand, device, channel, 2.5)
    frame, force = led.body.last, run.forces[-1]
    assert force[2] > 100.0
    np.testing.assert_allclose(force, -frame.force, atol=0.02 * force[2])
    np.testing.assert_allclose(device.stiffness * (device.position - device.path(9.0)), force, atol=0.02 * force[2])
    lead = (device.position - np.array([5.0, 6.0, 7.0])) - (frame.tool_centre - np.array([0.0, 0.0, EDGE + RADIUS + 3.0]))
    np.testing.assert_allclose(-hand.coupling.stiffness * lead, force, atol=0.02 * force[2])
    assert led.contact._new.stiffness > 0.0
    assert not any(f.failed for f in led.frames)


def test_the_force_is_that_of_a_body_that_takes_steps_of_a_millisecond() -> None:
    """Pressed in, and then to and fro."""

    def path(t: float) -> FloatArray:
        return np.array([0.0, 0.0, -14.0 * min(t / 0.6, 1.0) + 2.0 * np.sin(9.0 * t) * (t > 0.6)])

    runs = []
    for step_s in (STEP_S, FRAME_S):
        channel = LossyChannel(loss=0.0, late=0.0)
        tool = spherical_indenter((0.0, 0.0, EDGE + RADIUS + 3.0), RADIUS, static_friction=0.3, kinetic_friction=0.3)
        body = InteractiveSimulation(gel(step_s), {"sphere": tool}, frame_s=step_s)
        led, hand = (body, HapticHand(channel)) if step_s == STEP_S else beside(channel, body)
        runs.append(felt(led, hand, SimulatedDevice(path), channel, 0.9).forces[:, 2])
    expected, found = runs
    assert expected.max() > 200.0
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.03 * expected.max()
    assert np.abs(found - expected).max() < 0.1 * expected.max()


def test_a_tool_that_turns_back_does_not_feel_a_stiffer_body() -> None:
    """A spring whose force is known to 1 %: the way of the step in which the tool turns back is small, and tells no stiffness."""
    led, _ = beside(LossyChannel(loss=0.0, late=0.0))
    spring, depth = 200.0, np.concatenate([np.arange(1.0, 5.0, 0.25), [4.71], np.arange(4.5, 4.0, -0.25)])
    for k, d in enumerate(depth):
        force = spring * d * (1.0 - 0.01 * (d == 4.71))
        frame = replace(led.body.last, number=k, tool="sphere", tool_centre=np.array([0.0, 0.0, -d]), force=np.array([0.0, 0.0, -force]))
        led.contact.observe(frame, led=True)
        assert k < 2 or led.contact._new.stiffness < 1.05 * spring
    assert led.contact._new.stiffness > 0.9 * spring


@pytest.mark.parametrize("seed", [1, 2])
def test_lost_and_late_packets_and_frames_make_no_step_and_no_energy(seed: int) -> None:
    def stirring(t: float) -> FloatArray:
        return np.array([4.0 * np.sin(9.0 * t), 3.0 * np.sin(7.0 * t), -14.0 * min(t / 0.5, 1.0) + 4.0 * np.sin(19.0 * t) * (t > 0.6)])

    channel = LossyChannel(seed, loss=0.01, late=0.02)
    led, hand = beside(channel, step_mn=60.0)
    run = felt(led, hand, SimulatedDevice(stirring), channel, 1.5)
    assert np.linalg.norm(np.diff(run.forces, axis=0), axis=1).max() <= 60.0 * (1 + 1e-9)
    assert np.linalg.norm(run.forces, axis=1).max() > 200.0
    assert run.work.max() <= hand.limits.energy_mn_mm
    np.testing.assert_allclose(hand.passivity.absorbed, -run.work[-1], rtol=0.02)


def test_a_tool_that_the_page_moves_is_taken_where_it_is() -> None:
    channel = LossyChannel(loss=0.0, late=0.0)
    led, hand = beside(channel)
    device = SimulatedDevice(lambda _: np.zeros(3))
    felt(led, hand, device, channel, 0.2)
    led.body.undo()
    led.body.take("sphere")
    led.body.move((0.0, 0.0, EDGE + 3.0 * RADIUS))
    for _ in range(30):
        led.body.advance()
    led.contact.observe(led.body.last, led=False)
    np.testing.assert_array_equal(led.contact.last.tool_centre, led.body.last.tool_centre)


def test_the_tool_turns_with_the_steps_of_the_body() -> None:
    channel = LossyChannel()
    both, hand = beside(channel)

    def orientation(t: float) -> FloatArray:
        return np.asarray(np.roll(Rotation.from_rotvec([0.0, 0.4 * min(max(t - 0.1, 0.0) / 0.3, 1.0), 0.0]).as_quat(), 1))

    felt(both, hand, SimulatedDevice(lambda _: np.zeros(3), orientation=orientation), channel, 0.6)
    np.testing.assert_allclose(Rotation.from_matrix(both.body.last.tool_rotation).as_rotvec(), [0.0, 0.4, 0.0], atol=1.1 * LEAST_TURN)
