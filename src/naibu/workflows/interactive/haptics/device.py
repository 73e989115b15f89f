"""A simulated haptic device that talks to a live simulation by UDP, and a channel that loses packets on purpose."""

from __future__ import annotations

import socket
import struct
import sys
import time
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray, require_positive, require_within
from naibu.core.errors import InputError
from naibu.simulation.haptics.haptic_loop import STALE
from naibu.simulation.haptics.simulated_device import SimulatedDevice
from naibu.simulation.haptics.thread_priority import scheduled_first
from naibu.workflows.interactive.haptics.endpoint import LOOPBACK
from naibu.workflows.interactive.haptics.packets import FORCE, pose_bytes, read_force

STEP_S = 1e-3
STAMP, STAMPED = struct.Struct("@ll"), 35  # seconds and nanoseconds when a datagram came, and SO_TIMESTAMPNS of Linux
BEHIND_S = 0.01  # a delay that the device does not catch up with, shorter than after which it lets go


@dataclass(frozen=True, slots=True, eq=False)
class DeviceRecord:
    """What a device saw.

    Attributes
    ----------
    heard_s : ndarray, shape (a,)
        When an answer was applied, s.
    forces : ndarray, shape (a, 3)
        Force of each of them, mN.
    steps_mn : ndarray, shape (a,)
        Magnitude of the change of the force that was applied by each of them, mN; a device that has let go applied none.
    delays_s : ndarray, shape (a,)
        From the pose that an answer is to until it was applied, s.
    flags : ndarray, shape (a,), int64
        Of each answer.
    work : float
        Energy that the device got, mN mm; negative where it put energy in.
    most_work : float
        Most of it at any time, mN mm.
    sent, overtaken : int
        Poses sent, and answers that were dropped: a later one had come, or the device had let go.
    arrived_s : ndarray, shape (b,)
        When answers reached this machine's side of the line, lost ones among them, s: as the system tells it (Linux), whenever the device
        reads them; elsewhere when they were read.
    late_s : ndarray, shape (sent,)
        By how much the device itself was late to send each pose, s.
    """

    heard_s: FloatArray
    forces: FloatArray
    steps_mn: FloatArray
    delays_s: FloatArray
    flags: IntArray
    work: float
    most_work: float
    sent: int
    overtaken: int
    arrived_s: FloatArray
    late_s: FloatArray

    @property
    def gaps_s(self) -> FloatArray:
        """Times between answers (a - 1,), s."""
        return np.diff(self.heard_s)

    @property
    def arrival_gaps_s(self) -> FloatArray:
        """Times between arrivals (b - 1,), s: pauses of the simulation, not of the device."""
        return np.diff(np.sort(self.arrived_s))

    @property
    def stale(self) -> BoolArray:
        """Answers (a,) that came although no pose had come for a while."""
        return np.asarray((self.flags & STALE) > 0)


@dataclass(slots=True, eq=False)
class _Line:
    """Packets in one direction, some lost, some overtaken by the next one."""

    chance: np.random.Generator
    loss: float
    reordering: float
    _held: bytes | None = field(default=None)

    def passed(self, packet: bytes) -> list[bytes]:
        """Return what arrives of a packet, and of one that was held back."""
        lost, late = self.chance.random(2) < (self.loss, self.reordering)
        held, self._held = self._held, None
        if late and not lost:
            self._held = packet
            packet = b""
        return [each for each in (b"" if lost else packet, held) if each]


def drive_live_simulation(
    device: SimulatedDevice, port: int, duration_s: float, *, loss: float = 0.0, reordering: float = 0.0, seed: int = 0
) -> DeviceRecord:
    """Lead the tool of a live simulation of this machine by a simulated device, 1000 packets a second.

    Parameters
    ----------
    device : SimulatedDevice
        Hand and handle.
    port : int
        That of ``naibu live --haptics-port``.
    duration_s : float
        How long, s.
    loss, reordering : float
        Shares of the packets that are lost, and that are overtaken by the next one, in both directions.
    seed : int
        Of the choice of these packets.

    Raises
    ------
    InputError
        A duration or share out of range, or no answer within the duration.
    """
    require_positive("duration_s", duration_s, "s")
    require_within("loss", loss, 0.0, 1.0)
    require_within("reordering", reordering, 0.0, 1.0)
    up, down = (_Line(np.random.default_rng([seed, k]), loss, reordering) for k in range(2))
    heard: list[tuple[float, float, int, FloatArray, float]] = []
    arrived, late, overtaken, most = [], [], 0, 0.0
    with scheduled_first(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.connect((LOOPBACK, port))
        if sys.platform == "linux":
            line.setsockopt(socket.SOL_SOCKET, STAMPED, 1)
        began = due = time.perf_counter()
        left: dict[int, float] = {}
        while due - began < duration_s:
            pose = device.advance(STEP_S)
            most = max(most, device.work)
            left[pose.sequence] = now = time.perf_counter()
            left.pop(pose.sequence - 2000, None)
            late.append(max(now - due, 0.0))
            for out in up.passed(pose_bytes(pose)):
                _sent(line, out)
            due = max(due + STEP_S, time.perf_counter() - BEHIND_S)
            while (found := _received(line, due)) is not None:
                packet, came = found
                arrived.append(came - began)
                for each in down.passed(packet):
                    answer = read_force(each)
                    now, before = time.perf_counter(), device.force
                    if device.hear(answer):
                        step = float(np.linalg.norm(answer.force_mn - before))
                        heard.append((now - began, now - left.get(answer.sequence, now), answer.flags, answer.force_mn, step))
                    else:
                        overtaken += 1
    if not heard:
        raise InputError(f"no answer came from port {port}; start naibu live with that port for haptic devices first")
    times, delays, flags, forces, steps = (np.array(values) for values in zip(*heard, strict=True))
    return DeviceRecord(times, forces, steps, delays, flags, device.work, most, len(late), overtaken, np.array(arrived), np.array(late))


def _sent(line: socket.socket, packet: bytes) -> None:
    try:
        line.send(packet)
    except OSError:  # nobody listens yet
        return


def _received(line: socket.socket, due: float) -> tuple[bytes, float] | None:
    """Return the next datagram that has come or comes before a time, s, and when it came; None when there is none."""
    while True:
        wait = max(due - time.perf_counter(), 0.0)
        line.settimeout(wait)
        try:
            return _read(line)
        except (TimeoutError, BlockingIOError):
            return None
        except OSError:  # nobody listens yet
            if wait == 0.0:
                return None
            time.sleep(min(STEP_S, wait))


def _read(line: socket.socket) -> tuple[bytes, float]:
    """Return a datagram, and when it came on the clock of `time.perf_counter`, s."""
    if sys.platform != "linux":
        return line.recv(FORCE.size + 1), time.perf_counter()
    packet, told, _, _ = line.recvmsg(FORCE.size + 1, socket.CMSG_SPACE(STAMP.size))
    now, age = time.perf_counter(), 0.0
    for level, kind, data in told:
        if (level, kind) == (socket.SOL_SOCKET, STAMPED):
            seconds, nanoseconds = STAMP.unpack(data)
            age = max(time.time() - seconds - 1e-9 * nanoseconds, 0.0)
    return packet, now - age
