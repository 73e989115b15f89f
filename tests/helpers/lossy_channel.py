"""A channel between a haptic hand and a simulated device that loses packets and lets others overtake them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.simulation import Frame, HapticHand, InteractiveSimulation, SimulatedDevice
from naibu.simulation.haptics.haptic_loop import DeviceForce
from naibu.workflows.interactive.haptics.endpoint import LOOPBACK, DeviceDatagrams
from naibu.workflows.interactive.haptics.packets import force_bytes, pose_bytes, read_force


@dataclass(eq=False)
class LossyLine:
    """One direction: a packet arrives a step after it was sent, late, twice or never."""

    seed: int
    loss: float = 0.01
    late: float = 0.01
    twice: float = 0.005
    _now: int = 0
    _coming: list[tuple[int, bytes]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._chance = np.random.default_rng(self.seed)

    def send(self, packet: bytes) -> None:
        chance = self._chance.random(3)
        if chance[0] < self.loss:
            return
        delay = 1 + (int(self._chance.integers(1, 5)) if chance[1] < self.late else 0)
        self._coming.append((self._now + delay, packet))
        if chance[2] < self.twice:
            self._coming.append((self._now + delay + 2, packet))

    def arrived(self) -> list[bytes]:
        self._now += 1
        due = [packet for when, packet in self._coming if when <= self._now]
        self._coming = [(when, packet) for when, packet in self._coming if when > self._now]
        return due


@dataclass(eq=False)
class LossyChannel:
    """Both directions, through the packets and the checks of the endpoint."""

    seed: int = 0
    loss: float = 0.01
    late: float = 0.01
    silent: bool = False  # nothing of the device arrives
    datagrams: DeviceDatagrams = field(default_factory=DeviceDatagrams)

    def __post_init__(self) -> None:
        self.up = LossyLine(2 * self.seed, self.loss, self.late)
        self.down = LossyLine(2 * self.seed + 1, self.loss, self.late)

    def receive(self) -> list:
        packets = self.up.arrived()
        found = [self.datagrams.accepted(packet, (LOOPBACK, 9999)) for packet in packets if not self.silent]
        return [pose for pose in found if pose is not None]

    def send(self, answer: DeviceForce) -> None:
        self.down.send(force_bytes(answer))

    def leave(self) -> None:
        self.datagrams.device = None


@dataclass(eq=False)
class Felt:
    """What happened: forces applied by the device, its energy, positions and frames, by step."""

    forces: FloatArray
    work: FloatArray
    positions: FloatArray
    flags: list[int]
    frames: list[Frame]


def felt(
    simulation: InteractiveSimulation, hand: HapticHand, device: SimulatedDevice, channel: LossyChannel, seconds: float,
    meanwhile: Callable[[float], None] = lambda _: None,
) -> Felt:  # fmt: skip
    """Run device and hand together, one step each."""
    forces, work, positions, flags, frames = [], [], [], [], []
    step = simulation.frame_s
    for k in range(round(seconds / step)):
        meanwhile(k * step)
        channel.up.send(pose_bytes(device.advance(step)))
        hand.before(simulation)
        frames.append(simulation.advance())
        hand.after(frames[-1], step)
        for packet in channel.down.arrived():
            device.hear(read_force(packet))
        forces.append(device.force)
        work.append(device.work)
        positions.append(device.position)
        flags.append(0 if device.applied is None else device.applied.flags)
    return Felt(np.array(forces), np.array(work), np.array(positions), flags, frames)
