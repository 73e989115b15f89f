"""A simulated haptic device: a hand that moves a handle along a path, pushed back by the forces that come."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.simulation.haptics.haptic_loop import DeviceForce, DevicePose

SILENCE_S = 0.02  # without an answer for so long, the device lets go


@dataclass(slots=True, eq=False)
class SimulatedDevice:
    """A handle of some mass, led by a hand: a spring and a dashpot to where the hand wants it.

    It does what a program for a real device does: it counts its packets, tells which answer it applies, drops answers that were overtaken,
    and lets go when none comes; from then on it takes only answers to poses that said so. It keeps account of the energy that it gets, and
    applies no more of a force than the energy permits that the answer allows: also where the next answer is late, it gets no more.

    Attributes
    ----------
    path : callable
        Returns where the hand wants the handle (3,), mm, at a time, s.
    mass_kg, stiffness, damping : float
        Of the handle, kg, and of the hand, mN/mm and mN s/mm.
    position, velocity : ndarray, shape (3,)
        Of the handle, mm and mm/s.
    orientation : callable
        Returns how the hand holds the handle, a unit quaternion (4,), scalar first, at a time, s.
    buttons : int
        That are held; see `DevicePose`.
    applied : DeviceForce, optional
        Answer whose force is applied.
    work : float
        Energy that the forces have handed out to the handle so far, mN mm.
    time_s : float
        Its clock, s.
    """

    path: Callable[[float], FloatArray]
    mass_kg: float = 0.2
    stiffness: float = 300.0
    damping: float = 5.0
    orientation: Callable[[float], FloatArray] = lambda _: np.array([1.0, 0.0, 0.0, 0.0])
    position: FloatArray = field(init=False)
    velocity: FloatArray = field(init=False, default_factory=lambda: np.zeros(3))
    buttons: int = 0
    applied: DeviceForce | None = None
    work: float = 0.0
    time_s: float = 0.0
    _sequence: int = 0
    _heard: float = 0.0
    _free: int = 0  # first pose that told that no force is applied

    def __post_init__(self) -> None:
        self.position = np.array(self.path(0.0), dtype=float)

    @property
    def force(self) -> FloatArray:
        """Force that is applied (3,), mN."""
        return np.zeros(3) if self.applied is None else self.applied.force_mn

    def hear(self, answer: DeviceForce) -> bool:
        """Apply an answer from now on, unless it was overtaken, or made before the device let go; False in that case."""
        if answer.sequence < self._free if self.applied is None else answer.number <= self.applied.number:
            return False
        self.applied, self._heard = answer, self.time_s
        return True

    def advance(self, step_s: float) -> DevicePose:
        """Move for a step, and return what the device then sends."""
        if self.applied is not None and self.time_s - self._heard > SILENCE_S:
            self.applied, self._free = None, self._sequence + 1
        self.time_s += step_s
        goal = self.path(self.time_s)
        pull = self.stiffness * (goal - self.position) + self.mass_kg / step_s * self.velocity
        compliance = step_s / (self.mass_kg / step_s + self.damping + self.stiffness * step_s)
        force = self._permitted(compliance * pull, compliance)
        moved = compliance * (pull + force)
        self.velocity = moved / step_s
        self.work += float(force @ moved)
        self.position = self.position + moved
        self._sequence += 1
        number = 0 if self.applied is None else self.applied.number
        return DevicePose(self._sequence, self.time_s, self.position, self.orientation(self.time_s), self.buttons, number, self.work)

    def _permitted(self, moved: FloatArray, compliance: float) -> FloatArray:
        """Return as much of the force (3,), mN, as hands out no more than the answer allows.

        `moved` is the motion of the step without force (3,), mm, `compliance` what a force adds to it, mm/mN.
        """
        if self.applied is None:
            return self.force
        left, linear, square = self.applied.energy_mn_mm - self.work, float(self.force @ moved), compliance * float(self.force @ self.force)
        if linear + square <= max(left, 0.0):
            return self.force
        share = (-linear + np.sqrt(linear**2 + 4.0 * square * max(left, 0.0))) / (2.0 * square)
        return np.asarray(min(max(share, 0.0), 1.0) * self.force)
