"""A haptic device on a lattice, through a channel that loses, delays and repeats packets; time is counted in steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lossy_channel import LossyChannel, felt
from scipy.spatial.transform import Rotation
from touched_lattice import TOP, touched_lattice

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics import Assembler, elements, material, spherical_indenter
from naibu.meshing import box
from naibu.simulation import FiniteElementBody, ForceLimits, HapticHand, InteractiveSimulation, RealTimeLoop, SimulatedDevice
from naibu.simulation.haptics.haptic_loop import CONTACT, HOLDS, LEAVES_S, STALE, DeviceForce, DevicePose
from naibu.simulation.tool_places import LEAST_TURN
from naibu.workflows.interactive.haptics.packets import pose_bytes, read_force

START = 54.0
RADIUS = 8.0


def simulation(start: float = START) -> InteractiveSimulation:
    body = touched_lattice()
    tool = spherical_indenter((20.0, 20.0, start), RADIUS)
    return InteractiveSimulation(body, {"sphere": tool}, frame_s=body.step_s)


def pressing(depth: float, within: float = 0.4) -> SimulatedDevice:
    return SimulatedDevice(lambda t: np.array([5.0, 6.0, 7.0 - depth * min(t / within, 1.0)]))


def stirring(t: float) -> FloatArray:
    """Down into the body, then to and fro and in and out of contact."""
    return np.array([4.0 * np.sin(9.0 * t), 3.0 * np.sin(7.0 * t), -14.0 * min(t / 0.5, 1.0) + 4.0 * np.sin(19.0 * t) * (t > 0.6)])


def test_device_body_and_coupling_are_in_balance_at_rest() -> None:
    touched, channel = simulation(), LossyChannel(loss=0.0, late=0.0)
    device, hand = pressing(10.0), HapticHand(channel)
    run = felt(touched, hand, device, channel, 4.0)
    frame, force = run.frames[-1], run.forces[-1]
    assert force[2] > 50.0
    assert run.flags[-1] == CONTACT
    np.testing.assert_allclose(force, -frame.force, atol=0.02 * force[2])
    lead = (device.position - np.array([5.0, 6.0, 7.0])) - (frame.tool_centre - np.array([20.0, 20.0, START]))
    np.testing.assert_allclose(-hand.coupling.stiffness * lead, force, atol=0.02 * force[2])
    np.testing.assert_allclose(device.stiffness * (device.position - device.path(9.0)), force, atol=0.02 * force[2])


def test_the_tool_turns_as_the_device_does_but_not_while_the_button_is_held() -> None:
    """It leads from where it came; then half a radian about x, whatever is lost; about y with the button; then back by 0.2 about x."""
    held = Rotation.from_rotvec([0.0, 0.7, 0.0])

    def orientation(t: float) -> FloatArray:
        about_x = Rotation.from_rotvec([0.5 * min(max(t - 0.1, 0.0) / 0.3, 1.0), 0.0, 0.0])
        back = Rotation.from_rotvec([-0.2 * min(max(t - 1.0, 0.0) / 0.2, 1.0), 0.0, 0.0])
        return np.asarray(np.roll((back * (held if t > 0.8 else Rotation.identity()) * about_x).as_quat(), 1))

    touched, channel = simulation(), LossyChannel(3, loss=0.05, late=0.05)
    device, hand = SimulatedDevice(lambda _: np.zeros(3), orientation=orientation), HapticHand(channel)
    felt(touched, hand, device, channel, 0.7)
    np.testing.assert_allclose(Rotation.from_matrix(touched.last.tool_rotation).as_rotvec(), [0.5, 0.0, 0.0], atol=1.1 * LEAST_TURN)
    device.buttons = HOLDS
    felt(touched, hand, device, channel, 0.25)
    device.buttons = 0
    felt(touched, hand, device, channel, 0.6)
    np.testing.assert_allclose(Rotation.from_matrix(touched.last.tool_rotation).as_rotvec(), [0.3, 0.0, 0.0], atol=1.1 * LEAST_TURN)


@pytest.mark.parametrize("seed", [1, 2])
def test_lost_late_and_repeated_packets_make_no_step_and_no_energy(seed: int) -> None:
    touched, channel = simulation(), LossyChannel(seed, loss=0.01, late=0.02)
    limits = replace(ForceLimits(), step_mn=60.0)
    device, hand = SimulatedDevice(stirring), HapticHand(channel, limits=limits)
    run = felt(touched, hand, device, channel, 2.5)
    assert np.linalg.norm(np.diff(run.forces, axis=0), axis=1).max() <= 60.0 * (1 + 1e-9)
    assert np.linalg.norm(run.forces, axis=1).max() > 300.0
    assert run.work.max() <= limits.energy_mn_mm
    lost = run.work[-1]
    assert lost < -1000.0
    np.testing.assert_allclose(hand.passivity.absorbed, -lost, rtol=0.02)
    assert channel.datagrams.dropped["old"] > 0
    assert not any(frame.failed for frame in run.frames)


def test_a_body_under_tension_pushes_the_hand_no_further_than_the_bound() -> None:
    """The page presses the tool in, then a device with a weak hand takes it over: the stored energy is the body's, not the device's."""
    work = {}
    for bound in (4.0, 8.0, 16.0, 1e12):
        touched, channel = simulation(), LossyChannel()
        touched.take("sphere")
        touched.move((20.0, 20.0, TOP - 4.0))
        for _ in range(200):
            touched.advance()
        assert touched.last.force[2] < -500.0
        device = SimulatedDevice(lambda _: np.zeros(3), stiffness=1.0, damping=0.5)
        run = felt(touched, HapticHand(channel, limits=ForceLimits(energy_mn_mm=bound)), device, channel, 0.6)
        work[bound] = run.work.max()
    assert work[1e12] > 30.0
    assert all(work[bound] <= bound for bound in (4.0, 8.0, 16.0))


def test_the_bound_holds_while_a_busy_computer_answers_rarely() -> None:
    """The same device, with an answer every 15 ms: the force that goes on between them hands out more than it may, but for the device."""
    most = {}
    for guarded in (True, False):
        touched, channel = simulation(), LossyChannel(loss=0.0, late=0.0)
        touched.take("sphere")
        touched.move((20.0, 20.0, TOP - 4.0))
        for _ in range(200):
            touched.advance()
        device, step = SimulatedDevice(lambda _: np.zeros(3), stiffness=1.0, damping=0.05, mass_kg=0.02), touched.frame_s
        hand = HapticHand(channel, limits=replace(ForceLimits(), energy_mn_mm=4.0))
        work = []
        for k in range(round(0.3 / step)):
            channel.up.send(pose_bytes(device.advance(step)))
            work.append(device.work)
            if k % round(0.015 / step) == 0:
                hand.before(touched)
                hand.after(touched.advance(), step)
            for packet in channel.down.arrived():
                answer = read_force(packet)
                device.hear(answer if guarded else replace(answer, energy_mn_mm=1e12))
        most[guarded] = max(work)
        touched.close()
    assert most[True] <= 4.0 * (1 + 1e-9)
    assert most[False] > 8.0


def test_the_force_fades_when_the_device_falls_silent_and_it_may_come_back() -> None:
    touched, channel = simulation(), LossyChannel(loss=0.0, late=0.0)
    device, hand = pressing(10.0, 0.3), HapticHand(channel)

    def listen(t: float) -> None:
        channel.silent = 0.6 <= t < 1.0

    run = felt(touched, hand, device, channel, 1.1, listen)
    size, step = np.linalg.norm(run.forces, axis=1), touched.frame_s
    assert size[round(0.69 / step)] > 50.0
    fading = size[round(0.71 / step) : round(0.80 / step)]
    assert (np.diff(fading) <= 0.0).all()
    assert fading[-1] < 0.15 * fading[0]
    assert size[round(0.83 / step)] == 0.0
    assert run.flags[round(0.83 / step)] & STALE
    assert np.diff(run.forces, axis=0).max() <= hand.limits.step_mn
    assert not run.flags[-1] & STALE
    channel.silent = True
    felt(touched, hand, device, channel, LEAVES_S + 0.1)
    assert not hand.leading
    assert channel.datagrams.device is None


def test_a_device_that_gets_no_answers_lets_go_and_is_led_again_from_no_force() -> None:
    """The computer is busy for 60 ms, and answers from before arrive after it: letting go is final until naibu knows of it."""
    touched, channel = simulation(), LossyChannel(loss=0.0, late=0.0)
    limits = replace(ForceLimits(), step_mn=20.0)
    device, hand = pressing(10.0), HapticHand(channel, limits=limits)
    step = touched.frame_s
    held = felt(touched, hand, device, channel, 1.0).forces[-1]
    late = device.applied
    assert late is not None and held[2] > 3.0 * limits.step_mn
    began, forces, work = device.time_s, [], device.work
    while device.time_s < began + 0.06:
        channel.up.send(pose_bytes(device.advance(step)))
        forces.append(device.force)
        if device.time_s > began + 0.04:
            assert not device.hear(replace(late, number=late.number + 1))
    acted = np.linalg.norm(forces, axis=1) > 0.0
    assert acted[: round(0.018 / step)].all() and not acted[round(0.024 / step) :].any()
    assert hand.passivity.absorbed < -work + limits.energy_mn_mm
    run = felt(touched, hand, device, channel, 1.0)
    steps = np.linalg.norm(np.diff(np.vstack([np.zeros(3), run.forces]), axis=0), axis=1)
    assert steps.max() <= limits.step_mn * (1 + 1e-9)
    force = run.forces[-1]
    assert force[2] > 3.0 * limits.step_mn
    np.testing.assert_allclose(device.stiffness * (device.position - device.path(9.0)), force, atol=0.02 * force[2])
    np.testing.assert_allclose(hand.passivity.absorbed, -device.work, rtol=0.02)


def test_the_button_moves_the_device_without_its_tool() -> None:
    touched, channel = simulation(), LossyChannel(loss=0.0, late=0.0)
    device, hand = pressing(10.0, 0.3), HapticHand(channel)
    felt(touched, hand, device, channel, 0.1)
    place = touched.last.tool_centre
    device.buttons = HOLDS
    run = felt(touched, hand, device, channel, 0.4)
    np.testing.assert_allclose(run.frames[-1].tool_centre, place, atol=0.3)
    np.testing.assert_allclose(run.frames[-1].tool_centre, run.frames[10].tool_centre, atol=1e-12)
    np.testing.assert_allclose(run.forces[-1], 0.0, atol=1e-9)
    device.buttons = 0
    assert np.linalg.norm(felt(touched, hand, device, channel, 0.1).forces, axis=1).max() < 30.0


def test_a_loop_that_is_late_rests_a_share_of_its_time() -> None:
    """Linux stops a thread that is scheduled first for 50 ms where it takes 95 % of a core; also where its steps take several ms."""
    now, slept = [0.0], []

    class Slow:
        def receive(self) -> list[DevicePose]:
            now[0] += 0.003
            return []

        def send(self, answer: DeviceForce) -> None: ...

        def leave(self) -> None: ...

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        now[0] += seconds

    loop, due = RealTimeLoop(simulation(), clock=lambda: now[0], sleep=sleep, hand=HapticHand(Slow())), 0.0
    for _ in range(20):
        due = loop._once(due)
    assert 0.05 < sum(slept[1:]) / now[0] < 0.1


def test_the_page_watches_sixty_times_a_second_and_can_pause() -> None:
    touched, channel = simulation(), LossyChannel(loss=0.0, late=0.0)
    device, hand, now = pressing(10.0, 0.3), HapticHand(channel), [0.0]
    loop = RealTimeLoop(touched, clock=lambda: now[0], hand=hand)
    shown, forces = set(), []

    def once(count: int) -> None:
        for _ in range(count):
            channel.up.send(pose_bytes(device.advance(touched.frame_s)))
            loop._once(now[0])
            now[0] += touched.frame_s
            for packet in channel.down.arrived():
                device.hear(read_force(packet))
            shown.add(loop.latest()[0].number)
            forces.append(np.linalg.norm(device.force))

    once(500)  # one second
    assert touched.last.number == 500
    assert 50 <= len(shown) <= 64
    assert forces[-1] > 50.0
    loop.pause(True)
    once(30)
    assert touched.last.number == 500
    assert forces[-1] == 0.0
    assert hand.leading
    touched.close()


def test_bodies_that_are_not_stepped_finely_enough_are_refused() -> None:
    mesh = box((30.0, 30.0, 30.0), (2, 2, 2), cell_type="tetra")
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [material(young_modulus=10.0, poisson_ratio=0.4)])
    with pytest.raises(InputError, match="steps of at most 2 ms"):
        RealTimeLoop(InteractiveSimulation(FiniteElementBody.of(mesh, assembler), {}), hand=HapticHand(LossyChannel()))
    with pytest.raises(InputError, match="frame_s"):
        RealTimeLoop(InteractiveSimulation(touched_lattice(), {}), hand=HapticHand(LossyChannel()))
