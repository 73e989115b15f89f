"""Slip from readings: how far the moment over F_z moves away from where a contact began tells the sideways share of the force.

While a rod presses towards the centre, the moment over F_z stays nearly constant. A sideways force T changes it in proportion to T / F,
whether the surface sticks or slips; `tangential_sensitivity` is that proportion, from a press of the model that slides. When T / F reaches
the friction coefficient, the contact slips.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.applications.fingertip.pressing import Pressing
from naibu.applications.fingertip.readings import ReadingChain
from naibu.core.arrays import BoolArray, FloatArray, as_points, as_vector, require_positive, require_within
from naibu.core.errors import InputError

LEAST_SLIDING_STATES = 3


@dataclass(frozen=True, slots=True)
class SlipDetector:
    """Sideways share of the force, and slip, from F_z, M_x and M_y.

    Attributes
    ----------
    sensitivity_mm : float
        Change of the moment over F_z per change of T / F, mm.
    friction : float
        Coefficient of static friction.
    share : float
        Slip is told when T / F exceeds this share of the coefficient.

    Raises
    ------
    InputError
        A sensitivity or coefficient that is not positive, or a share beyond 0 to 1.
    """

    sensitivity_mm: float
    friction: float
    share: float = 0.9

    def __post_init__(self) -> None:
        require_positive("sensitivity_mm", self.sensitivity_mm, "mm")
        require_positive("friction", self.friction)
        require_within("share", self.share, 0.01, 1.0)

    def tangential_share(self, loads: ArrayLike, at_touch: ArrayLike) -> FloatArray:
        """Return T / F along x and y (n, 2), against when the contact began.

        Parameters
        ----------
        loads : array_like, shape (n, 3)
            F_z, M_x and M_y as measured, mN and mN mm; F_z must be positive.
        at_touch : array_like, shape (3,)
            The same after the contact was made, before it was dragged.

        Raises
        ------
        InputError
            F_z that is not positive.
        """
        now, before = as_points("loads", loads, 3), as_vector("at_touch", at_touch)
        if not (now[:, 0] > 0.0).all() or not before[0] > 0.0:
            raise InputError(f"F_z is {min(float(now[:, 0].min(initial=0.0)), float(before[0])):g} mN; without a press there is no slip")
        change = now[:, 1:] / now[:, :1] - before[1:] / before[0]
        return np.stack([change[:, 1], -change[:, 0]], axis=1) / self.sensitivity_mm

    def slips(self, loads: ArrayLike, at_touch: ArrayLike) -> BoolArray:
        """Return whether the contact slips (n,), bool; arguments as of `tangential_share`."""
        return np.asarray(np.linalg.norm(self.tangential_share(loads, at_touch), axis=1) >= self.share * self.friction)


def tangential_sensitivity(sliding: Pressing, chain: ReadingChain) -> float:
    """Return the change of M_y over F_z per change of T / F, mm, of a press that slides in the plane of its tilt.

    Parameters
    ----------
    sliding : Pressing
        With ``press.slide_mm`` other than 0.
    chain : ReadingChain
        The chip.

    Raises
    ------
    InputError
        A press that does not slide.
    """
    share = true_tangential_share(sliding)
    moved = sliding.slide_mm != 0.0
    if moved.sum() < LEAST_SLIDING_STATES:
        raise InputError("the press does not slide; give it a slide_mm other than 0")
    loads = chain.measured_loads(chain.volts(sliding.chip_loads))
    first = int(np.flatnonzero(moved)[0]) - 1
    change, ratio = share[moved] - share[first], loads[moved, 2] / loads[moved, 0] - loads[first, 2] / loads[first, 0]
    return float(change @ ratio / (change @ change))


def true_tangential_share(pressing: Pressing) -> FloatArray:
    """Return the force across the rod over that along it (n,), positive away from the base's normal, 0 without contact."""
    axis = pressing.press.axis
    across = pressing.force_mn @ np.array([axis[2], 0.0, -axis[0]])
    along = pressing.along_rod_mn
    return np.asarray(np.divide(across, along, out=np.zeros_like(across), where=along > 0.0))
