"""Endpoint of haptic devices: datagrams on the loopback interface, checked before anything acts on them."""

from __future__ import annotations

import socket
from collections import Counter
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from naibu.core.errors import InputError
from naibu.simulation.haptics.haptic_loop import DeviceForce, DevicePose
from naibu.workflows.interactive.haptics.packets import POSE, force_bytes, read_pose

LOOPBACK = "127.0.0.1"
MOST_A_STEP = 64  # datagrams that are read at once
HALF = 2**31  # sequence numbers wrap at 2**32

Address = tuple[str, int]


@dataclass(slots=True, eq=False)
class DeviceDatagrams:
    """What datagrams may pass: those of one device, each newer than the one before.

    Attributes
    ----------
    dropped : Counter of str
        Packets that were not used, by the reason: ``malformed``, ``foreign`` (another sender than the device that leads, or another
        machine), ``old`` (repeated or overtaken).
    device : tuple, optional
        Address of the device.
    """

    dropped: Counter[str] = field(default_factory=Counter)
    device: Address | None = None
    _sequence: int = 0

    def accepted(self, packet: bytes, sender: Address) -> DevicePose | None:
        """Return the pose of a packet, None where it is dropped; the first device that sends a valid one leads."""
        if sender[0] != LOOPBACK or (self.device is not None and sender != self.device):
            self.dropped["foreign"] += 1
            return None
        try:
            pose = read_pose(packet)
        except InputError:
            self.dropped["malformed"] += 1
            return None
        if self.device is not None and not 0 < (pose.sequence - self._sequence) % (2 * HALF) < HALF:
            self.dropped["old"] += 1
            return None
        self.device, self._sequence = sender, pose.sequence
        return pose


@dataclass(slots=True, eq=False)
class HapticEndpoint:
    """A UDP socket on the loopback interface, as a channel of `naibu.simulation.HapticHand`.

    Attributes
    ----------
    port : int
        Port; 0 takes a free one, which is then stated.
    datagrams : DeviceDatagrams
        What passes, and counts of what does not.

    Raises
    ------
    InputError
        The port is taken.
    """

    port: int
    datagrams: DeviceDatagrams = field(default_factory=DeviceDatagrams)
    _socket: socket.socket = field(init=False)

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise InputError(f"port of haptic devices must lie between 0 and 65535, not {self.port}")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind((LOOPBACK, self.port))
        except OSError as error:
            self._socket.close()
            raise InputError(f"port {self.port} is taken or not allowed; choose another for haptic devices, or 0 for a free one") from error
        self.port = self._socket.getsockname()[1]

    def receive(self) -> list[DevicePose]:
        """Return the poses that have come since the last call."""
        poses = []
        for _ in range(MOST_A_STEP):
            try:
                packet, sender = self._socket.recvfrom(POSE.size + 1)
            except BlockingIOError:
                break
            except OSError:  # Windows: a datagram was longer, or an answer found no one
                continue
            if (pose := self.datagrams.accepted(packet, sender)) is not None:
                poses.append(pose)
        return poses

    def send(self, answer: DeviceForce) -> None:
        """Send a force to the device that leads; one that cannot be sent is lost, as on the way."""
        if self.datagrams.device is not None:
            try:
                self._socket.sendto(force_bytes(answer), self.datagrams.device)
            except OSError:
                self.datagrams.dropped["not sent"] += 1

    def leave(self) -> None:
        """Let another device come."""
        self.datagrams.device = None

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def __enter__(self) -> Self:
        """Return the endpoint."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close the socket."""
        self.close()
