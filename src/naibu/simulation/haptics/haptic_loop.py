"""A haptic device leads the tool of an interactive simulation: poses in, forces out, one step at a time.

Time is counted in steps of the simulation, and packets come through a channel; neither a clock nor a socket is needed here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.simulation.haptics.force_limits import ForceLimits, PassivityController, StepLimiter
from naibu.simulation.haptics.virtual_coupling import CoupledTool, VirtualCoupling
from naibu.simulation.interactive_simulation import InteractiveSimulation

LONGEST_STEP_S = 2e-3
HOLDS = 1  # button that lets the device move without its tool
VELOCITY_S = 3e-3  # over which the velocity of the device is averaged
ROUNDING_MN = 1e-6
LEAVES_S = 1.0  # without a packet for so long, a device is gone
CONTACT, LIMITED, STALE, DAMPED, WAITS = 1, 2, 4, 8, 16


@dataclass(frozen=True, slots=True, eq=False)
class DevicePose:
    """What a device sends.

    Attributes
    ----------
    sequence : int
        Counts the packets of the device.
    time_s : float
        Its clock, s.
    position : ndarray, shape (3,)
        mm.
    quaternion : ndarray, shape (4,)
        Orientation, scalar first; its changes turn the tool.
    buttons : int
        Bits; the lowest one lets the device move without its tool.
    applied : int
        Number of the answer whose force it applied since its last packet, 0 for none.
    energy_mn_mm : float
        Energy that the forces have handed out to it so far, less what it put in, mN mm: by its own account, which lost packets leave right.
    """

    sequence: int
    time_s: float
    position: FloatArray
    quaternion: FloatArray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    buttons: int = 0
    applied: int = 0
    energy_mn_mm: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class DeviceForce:
    """What a device gets.

    Attributes
    ----------
    number : int
        Counts the answers, from 1.
    sequence : int
        Of the last pose that has come.
    time_s : float
        That of the pose, s.
    force_mn : ndarray, shape (3,)
        Force on the device, mN.
    flags : int
        Sum of `CONTACT`, `LIMITED` (magnitude or step), `STALE` (no pose has come for a while), `DAMPED` (passivity) and `WAITS` (the
        simulation is being prepared, paused or shown again: no force).
    energy_mn_mm : float
        What the account of the device may come to at most, mN mm; it applies no more of any force than that permits.
    """

    number: int
    sequence: int
    time_s: float
    force_mn: FloatArray
    flags: int
    energy_mn_mm: float = 0.0


class DeviceChannel(Protocol):
    """Where poses come from and forces go to."""

    def receive(self) -> Sequence[DevicePose]:
        """Return the poses that have come since the last call, the oldest first, none of them older than one returned before."""

    def send(self, answer: DeviceForce) -> None:
        """Send a force to the device that the last pose came from."""

    def leave(self) -> None:
        """Let another device come."""


class LedFrame(Protocol):
    """A tool, and its force on the body, at the end of a step."""

    @property
    def tool(self) -> str:
        """Its name, or an empty string."""

    @property
    def tool_centre(self) -> FloatArray:
        """Where it is (3,), mm."""

    @property
    def force(self) -> FloatArray:
        """Its force on the body (3,), mN."""


class LedSimulation(Protocol):
    """A simulation whose tool is led step by step: one of the body, or of the contact alone."""

    @property
    def frame_s(self) -> float:
        """Length of a step, s."""

    @property
    def tools(self) -> Mapping[str, RigidIndenter]:
        """Tools by name."""

    @property
    def last(self) -> LedFrame:
        """The end of the last step."""

    def take(self, tool: str) -> None:
        """Bring a tool into play."""

    def move(self, centre: ArrayLike) -> None:
        """Lead it to a position (3,), mm."""

    def turn(self, rotation: ArrayLike) -> None:
        """Turn it further by a rotation vector (3,), rad."""


@dataclass(slots=True, eq=False)
class HapticHand:
    """A device that leads the tool through a virtual coupling.

    When a device comes, comes back after a silence, or lets go of its button, its pose then is taken for the pose of the tool: no force
    acts at first, whatever the device's frame. It leads the tool that is in play, or the first one, which turns as the device does, at the
    speed that the simulation permits; no torque is handed back.

    Attributes
    ----------
    channel : DeviceChannel
        To the device.
    coupling : VirtualCoupling
        Between the device and the tool.
    limits : ForceLimits
        Of the force.
    passivity : PassivityController
        Energy of the device that leads at present.
    """

    channel: DeviceChannel
    coupling: VirtualCoupling = field(default_factory=VirtualCoupling)
    limits: ForceLimits = field(default_factory=ForceLimits)
    passivity: PassivityController = field(init=False)
    _limiter: StepLimiter = field(init=False)
    _tool: CoupledTool | None = field(init=False, default=None)
    _name: str = field(init=False, default="")
    _pose: DevicePose | None = field(init=False, default=None)
    _velocity: FloatArray = field(init=False, default_factory=lambda: np.zeros(3))
    _offset: FloatArray = field(init=False, default_factory=lambda: np.zeros(3))
    _orientation: FloatArray = field(init=False, default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))  # to which the tool was turned
    _silence: float = field(init=False, default=0.0)
    _energy: float = field(init=False, default=0.0)  # on the account of the device when it came

    def __post_init__(self) -> None:
        self.passivity = PassivityController(self.limits, self.coupling.stiffness)
        self._limiter = StepLimiter(self.limits.step_mn)

    @property
    def leading(self) -> bool:
        """Whether a device is there."""
        return self._pose is not None

    def before(self, simulation: LedSimulation) -> None:
        """Read the poses that have come, and lead the tool, before a step of the simulation."""
        if not self._listen(simulation.frame_s) or self._pose is None:
            return
        if not simulation.last.tool and simulation.tools:
            simulation.take(next(iter(simulation.tools)))
        frame = simulation.last
        if self._tool is None or frame.tool != self._name or not np.array_equal(frame.tool_centre, self._tool.position):
            self._anchor(simulation)
        if self._tool is not None and self._silence <= self.limits.silence_s and not self._pose.buttons & HOLDS:
            simulation.move(self._tool.next_position(self._place(), self._velocity, simulation.frame_s))
            if not np.array_equal(self._pose.quaternion, self._orientation):
                simulation.turn(_rotation_between(self._orientation, self._pose.quaternion))
        self._orientation = self._pose.quaternion

    def after(self, frame: LedFrame, step_s: float) -> None:
        """Answer with the force on the device, after a step."""
        if self._pose is None or self._tool is None:
            return
        self._tool.moved(frame.tool_centre, frame.force, step_s)
        if self._pose.buttons & HOLDS:
            self._offset = self._tool.position - self._pose.position
            self._answer(np.zeros(3), step_s, CONTACT * bool(frame.force.any()))
        else:
            self._answer(self._tool.force(self._place(), self._velocity), step_s, CONTACT * bool(frame.force.any()))

    def idle(self, step_s: float) -> None:
        """Keep in touch with the device for the time of a step, without force, while the simulation waits."""
        if self._listen(step_s):
            self._tool = None
            self._answer(np.zeros(3), step_s, WAITS)

    def _listen(self, step_s: float) -> bool:
        """Read the poses that have come; False where no device is there."""
        self._silence += step_s
        for pose in self.channel.receive():
            self._observe(pose)
        if self._silence > LEAVES_S and self._pose is not None:
            self._leave()
        return self._pose is not None

    def _answer(self, wanted: FloatArray, step_s: float, flags: int) -> None:
        """Send a force as near to the one wanted as the limits permit."""
        assert self._pose is not None
        if self._silence > self.limits.silence_s:
            flags |= STALE
            self._limiter.forget()
            left = self.limits.silence_s + self.limits.fade_s - self._silence
            wanted = self._limiter.last * max(0.0, left / (left + step_s)) if left > 0.0 else np.zeros(3)
        else:
            damped = self.passivity.controlled(wanted, self._velocity, step_s)
            flags |= DAMPED * (damped is not wanted)
            wanted = damped
        force = self._limiter.limited(self.limits.within_magnitude(wanted))
        flags |= LIMITED * (bool(np.abs(force - wanted).max() > ROUNDING_MN))
        most = self._energy + self.limits.energy_mn_mm
        self.channel.send(DeviceForce(self._limiter.number, self._pose.sequence, self._pose.time_s, force, flags, most))

    def _observe(self, pose: DevicePose) -> None:
        """Take a pose in: energy since the one before, and velocity."""
        self._limiter.confirmed(pose.applied)
        before, self._pose = self._pose, pose
        if before is None:
            self._energy = pose.energy_mn_mm
        self.passivity.observe(self._energy - pose.energy_mn_mm)
        if before is None or self._silence > self.limits.silence_s:
            self._tool, self._velocity = None, np.zeros(3)
        else:
            moved, took = pose.position - before.position, pose.time_s - before.time_s
            if took > 0.0:
                share = 1.0 - np.exp(-took / VELOCITY_S)
                self._velocity = self._velocity + share * (moved / took - self._velocity)
        self._silence = 0.0

    def _anchor(self, simulation: LedSimulation) -> None:
        """Begin to lead the tool in play from where it is."""
        frame = simulation.last
        self._tool, self._name = None, frame.tool
        if frame.tool and self._pose is not None:
            self._tool = CoupledTool(self.coupling, frame.tool_centre)
            self._offset = frame.tool_centre - self._pose.position
            self._orientation = self._pose.quaternion

    def _place(self) -> FloatArray:
        """Position of the device in the frame of the body (3,), mm."""
        assert self._pose is not None
        return np.asarray(self._pose.position + self._offset)

    def _leave(self) -> None:
        self._pose, self._tool = None, None
        self.passivity = PassivityController(self.limits, self.coupling.stiffness)
        self._limiter.forget()
        self.channel.leave()


def _rotation_between(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the rotation vector (3,), rad, in the frame of the body, that leads from one unit quaternion, scalar first, to another."""
    first, second = (Rotation.from_quat(np.roll(quaternion, -1)) for quaternion in (before, after))
    return np.asarray((second * first.inv()).as_rotvec())


def require_haptic_steps(simulation: InteractiveSimulation) -> None:
    """Check that a simulation is advanced step by step, and finely enough to be felt.

    Raises
    ------
    InputError
        Steps longer than 2 ms, or frames of several steps.
    """
    if simulation.body.step_s > LONGEST_STEP_S:
        raise InputError(
            f"a haptic device needs steps of at most {1e3 * LONGEST_STEP_S:g} ms, and those of this body take "
            f"{1e3 * simulation.body.step_s:.3g} ms; let a `HapticThread` serve it beside the loop"
        )
    if simulation.steps != 1:
        raise InputError(f"frame_s is {simulation.frame_s:g} s, {simulation.steps} steps; make it {simulation.body.step_s:g} s, one step")
