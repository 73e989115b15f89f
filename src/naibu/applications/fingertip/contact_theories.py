"""Force, depth and contact radius of soft fingertips in the literature: Hertz, power laws, and parallel springs.

Hertz's theory is that of :cite:t:`johnson1985` for a sphere that a rigid plane presses on a half space: small strains, no friction. Soft
fingers of a power-law material have a contact radius ``a = c F^gamma`` with gamma up to 1/3, the value of linear elasticity
:cite:p:`xydas1999`. A hemisphere of independent springs, perpendicular to the base, has the force ``pi E d^2`` at the depth d
:cite:p:`inoue2006`.
"""

from __future__ import annotations

import numpy as np

from naibu.applications.fingertip.fingertip import Fingertip
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError


def hertz_force(fingertip: Fingertip, depth_mm: FloatArray) -> FloatArray:
    """Return Hertz's force, mN, at depths (n,), mm."""
    plane = fingertip.young_modulus_kpa / (1.0 - fingertip.poisson_ratio**2)
    return np.asarray(4.0 / 3.0 * plane * np.sqrt(fingertip.radius_mm) * depth_mm**1.5)


def hertz_radius(fingertip: Fingertip, force_mn: FloatArray) -> FloatArray:
    """Return Hertz's contact radius, mm, at forces (n,), mN."""
    plane = fingertip.young_modulus_kpa / (1.0 - fingertip.poisson_ratio**2)
    return np.asarray(np.cbrt(0.75 * force_mn * fingertip.radius_mm / plane))


def parallel_springs_force(fingertip: Fingertip, depth_mm: FloatArray) -> FloatArray:
    """Return the force, mN, of independent springs in the hemisphere at depths (n,), mm, pressed along its axis."""
    return np.asarray(np.pi * fingertip.young_modulus_kpa * depth_mm**2)


def power_law(force_mn: FloatArray, radius_mm: FloatArray) -> tuple[float, float]:
    """Return c and gamma of ``a = c F^gamma`` that fit contact radii (n,), mm, at forces (n,), mN, best in logarithms.

    Raises
    ------
    InputError
        Fewer than two forces, or values that are not positive.
    """
    if len(force_mn) < 2 or not (np.min(force_mn) > 0.0 and np.min(radius_mm) > 0.0):
        raise InputError("a power law needs at least two positive forces with positive radii")
    gamma, log_c = np.polyfit(np.log(force_mn), np.log(radius_mm), 1)
    return float(np.exp(log_c)), float(gamma)
