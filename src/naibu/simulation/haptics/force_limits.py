"""Limits of the force that a haptic device gets: energy :cite:p:`hannaford2002`, magnitude, and step, whatever answers are lost."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray, length_of, require_positive

MOST_OPEN = 256  # answers whose forces are remembered
TAKEN_BACK = 0.01  # of the bound, which damping gets back where nothing is left: at nothing no force could begin that takes energy in
RESERVED = 0.5  # of the energy that is left is used: the device may get faster before the force is taken back
CONFIRMED_AFTER = 3  # steps in which an answer usually gets to the device and is confirmed


@dataclass(frozen=True, slots=True)
class ForceLimits:
    """What a force on the device must keep to.

    Attributes
    ----------
    force_mn : float
        Magnitude, mN.
    step_mn : float
        Change between two answers that the device applies one after the other, mN.
    energy_mn_mm : float
        Energy that may be handed out beyond what was put in, mN mm (1 mN mm is 1 uJ).
    damping : float
        Largest damping by which energy is taken back, mN s/mm.
    silence_s : float
        Without a packet for so long, the force fades.
    fade_s : float
        Time in which it fades to zero.

    Raises
    ------
    InputError
        A value that is not positive.
    """

    force_mn: float = 3000.0
    step_mn: float = 100.0
    energy_mn_mm: float = 1000.0
    damping: float = 5.0
    silence_s: float = 0.1
    fade_s: float = 0.1

    def __post_init__(self) -> None:
        for name, unit in (
            ("force_mn", "mN"), ("step_mn", "mN"), ("energy_mn_mm", "mN mm"), ("damping", "mN s/mm"), ("silence_s", "s"), ("fade_s", "s"),
        ):  # fmt: skip
            require_positive(name, getattr(self, name), unit)

    def within_magnitude(self, force: FloatArray) -> FloatArray:
        """Return a force (3,), mN, shortened to the largest magnitude."""
        size = length_of(force)
        return force if size <= self.force_mn else np.asarray(force * (self.force_mn / size))


@dataclass(slots=True, eq=False)
class PassivityController:
    """Observe the energy that passes to the device, and damp what would hand out more than was put in :cite:p:`hannaford2002`.

    Attributes
    ----------
    limits : ForceLimits
        Energy that may be handed out in advance, and the largest damping.
    stiffness : float
        Of the coupling between device and tool, mN/mm.
    absorbed : float
        Energy that the device has put in so far less what it got, mN mm.
    """

    limits: ForceLimits
    stiffness: float
    absorbed: float = 0.0

    def observe(self, absorbed: float) -> None:
        """Take note of the energy that the device has put in so far less what it got, mN mm."""
        self.absorbed = absorbed

    def controlled(self, force: FloatArray, velocity: FloatArray, step_s: float) -> FloatArray:
        """Return a force (3,), mN, reduced where a device at a velocity (3,), mm/s, would get more energy than there is.

        No force exceeds that of the coupling when it has stored what is left, and the energy that passes while the force is taken back at
        its limited rate is counted, too. Where nothing is left, a damping takes back what was handed out, and a little more.
        """
        speed = length_of(velocity)
        left = self.absorbed + self.limits.energy_mn_mm
        if left <= 0.0:
            lack = TAKEN_BACK * self.limits.energy_mn_mm - left
            return np.asarray(-min(lack / (speed * step_s), self.limits.damping * speed) * velocity / speed) if speed > 0.0 else np.zeros(3)
        size = length_of(force)
        kept = min(1.0, np.sqrt(2.0 * self.stiffness * left) / size) if size > 0.0 else 1.0
        along = kept * float(force @ velocity) / speed if speed > 0.0 else 0.0
        if along > 0.0:
            # largest a with speed * (a delay + a^2 / (2 rate)) = left: a delay until an answer acts, then the force is taken back
            rate = self.limits.step_mn / (CONFIRMED_AFTER * step_s)
            delay = CONFIRMED_AFTER * step_s * rate
            allowed = float(np.sqrt(delay**2 + 2.0 * rate * RESERVED * left / speed) - delay)
            # the whole force: one that loses only its component along the motion turns as the device turns, and swings it
            kept *= min(1.0, allowed / along)
        return force if kept == 1.0 else np.asarray(kept * force)


@dataclass(slots=True, eq=False)
class StepLimiter:
    """Keep each force within a step of every force that the device may apply at present.

    Answers get lost. Which force the device applies is known from the answers that it confirms; it lies among the confirmed one and those
    that were sent since.

    Attributes
    ----------
    step_mn : float
        Largest change, mN.
    number : int
        Of the last answer.
    """

    step_mn: float
    number: int = 0
    _open: deque[tuple[int, FloatArray]] = field(default_factory=lambda: deque([(0, np.zeros(3))], maxlen=MOST_OPEN))

    @property
    def last(self) -> FloatArray:
        """Force of the last answer (3,), mN."""
        return self._open[-1][1]

    def confirmed(self, number: int) -> FloatArray:
        """Take note that the device applies an answer, and return its force (3,), mN; of a number that is not open, the oldest open.

        The number 0 is that of no force: a device that has let go takes no answer that was made before that is known here.
        """
        if number == 0 and self._open[0][0] != 0:
            self._open = deque([(0, np.zeros(3))], maxlen=MOST_OPEN)
        if any(number == known for known, _ in self._open):
            while self._open[0][0] != number:
                self._open.popleft()
        return self._open[0][1]

    def forget(self) -> None:
        """Take it that the last answer has arrived."""
        self._open = deque([self._open[-1]], maxlen=MOST_OPEN)

    def limited(self, wanted: FloatArray) -> FloatArray:
        """Return the force of the next answer (3,), mN: as far on the way to the one wanted as every open answer permits."""
        start = self.last
        way = wanted - start
        squared = float(way @ way)
        if squared > 0.0:
            offsets = start - np.array([force for _, force in self._open])  # each no longer than the step
            half = offsets @ way
            room = np.maximum(self.step_mn**2 - (offsets**2).sum(axis=1), 0.0)
            share = float(((-half + np.sqrt(half**2 + squared * room)) / squared).min())
            start = start + min(max(share, 0.0), 1.0) * way
        self.number += 1
        self._open.append((self.number, start))
        return start
