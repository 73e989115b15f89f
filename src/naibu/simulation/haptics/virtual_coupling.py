"""Virtual coupling: a spring and a dashpot between a haptic device and the tool that it leads :cite:p:`colgate1995`.

The tool has a small mass. The body answers to a velocity of the tool within the same step, stiffly where it is viscous; an estimate of how
the reaction grows with the velocity is therefore taken into the tool's implicit Euler step. An error of the estimate changes how the tool
gets to the balance of spring and reaction, never where the balance is.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray, require_positive

MARGIN = 2.0  # on the estimated impedance: too much makes the tool slow, too little makes it chatter
MEMORY_S = 1.0  # in which the estimate is forgotten
LEAST_CHANGE = 0.1  # mm/s; smaller changes of velocity tell nothing


@dataclass(frozen=True, slots=True)
class VirtualCoupling:
    """Spring, dashpot and mass between a device and its tool.

    Attributes
    ----------
    stiffness : float
        mN/mm; how stiff the hardest contact feels.
    damping : float
        mN s/mm.
    mass_kg : float
        Of the tool.

    Raises
    ------
    InputError
        A value that is not positive.
    """

    stiffness: float = 500.0
    damping: float = 4.0
    mass_kg: float = 0.02

    def __post_init__(self) -> None:
        require_positive("stiffness", self.stiffness, "mN/mm")
        require_positive("damping", self.damping, "mN s/mm")
        require_positive("mass_kg", self.mass_kg, "kg")


@dataclass(slots=True, eq=False)
class CoupledTool:
    """A tool on the virtual coupling, stepped together with the body that it touches.

    Attributes
    ----------
    coupling : VirtualCoupling
        Between the device and the tool.
    position, velocity : ndarray, shape (3,)
        Of the tool, mm and mm/s.
    reaction : ndarray, shape (3,)
        Of the tool on the body in the last step, mN.
    impedance : float
        Estimate of how the reaction grows with the velocity within a step, mN s/mm.
    """

    coupling: VirtualCoupling
    position: FloatArray
    velocity: FloatArray = field(default_factory=lambda: np.zeros(3))
    reaction: FloatArray = field(default_factory=lambda: np.zeros(3))
    impedance: float = 0.0

    def next_position(self, device: FloatArray, device_velocity: FloatArray, step_s: float) -> FloatArray:
        """Return where the tool is to be after a step (3,), mm, with the device at a position (3,), mm, and a velocity (3,), mm/s."""
        own = self.coupling
        inertia = own.mass_kg / step_s
        drive = own.stiffness * (device - self.position) + own.damping * device_velocity - self.reaction
        resistance = inertia + own.stiffness * step_s + own.damping + self.impedance
        velocity = (drive + (inertia + self.impedance) * self.velocity) / resistance
        return np.asarray(self.position + step_s * velocity)

    def moved(self, position: FloatArray, reaction: FloatArray, step_s: float) -> None:
        """Take note of where the tool went in a step (3,), mm, and of its force on the body there (3,), mN."""
        velocity = (position - self.position) / step_s
        self.impedance *= max(0.0, 1.0 - step_s / MEMORY_S)
        if self.reaction.any():
            change, answer = velocity - self.velocity, reaction - self.reaction
        else:  # the body was at rest: all of the reaction answers to the velocity
            change, answer = velocity, reaction
        squared = float(change @ change)
        if squared > LEAST_CHANGE**2:
            self.impedance = max(self.impedance, MARGIN * float(answer @ change) / squared)
        self.position, self.velocity, self.reaction = position, velocity, reaction

    def force(self, device: FloatArray, device_velocity: FloatArray) -> FloatArray:
        """Return the force of the coupling on the device (3,), mN."""
        own = self.coupling
        return np.asarray(own.stiffness * (self.position - device) + own.damping * (self.velocity - device_velocity))
