"""Closed-form solutions at finite strain, and of thick shells and columns at small strain.

They are independent of the kernels of `naibu.mechanics`: stresses are written in principal stretches as in :cite:t:`holzapfel2000`
(chapter 6), shells as in :cite:t:`timoshenko1970` (sections 28 and 136); only the names and the order of a law's parameters are taken from
`naibu.mechanics.finite_elements.hyperelasticity`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.finite_elements.hyperelasticity import (
    LINEAR_ELASTIC,
    MOONEY_RIVLIN,
    NEO_HOOKEAN,
    SAINT_VENANT_KIRCHHOFF,
    YEOH,
    Material,
)


@dataclass(frozen=True, slots=True, eq=False)
class HomogeneousState:
    """A homogeneous deformation without rotation.

    Attributes
    ----------
    stretches : ndarray, shape (3,)
        Along x, y, z.
    nominal_stress : ndarray, shape (3,)
        Force over the area in the reference configuration along x, y, z, kPa; tension is positive.
    """

    stretches: FloatArray
    nominal_stress: FloatArray

    @property
    def volume_ratio(self) -> float:
        """Volume over that of the reference configuration."""
        return float(np.prod(self.stretches))

    @property
    def true_stress(self) -> FloatArray:
        """Force over the deformed area (3,), kPa."""
        return self.nominal_stress * self.stretches / self.volume_ratio


def principal_energy(material: Material, stretches: ArrayLike) -> FloatArray:
    """Return the energy density (...,), kPa = mN mm / mm3, at principal stretches (..., 3)."""
    s = np.asarray(stretches, dtype=float)
    p, code = material.parameters, material.law.code
    j = s.prod(axis=-1)
    i1, fourth = (s**2).sum(axis=-1), (s**4).sum(axis=-1)
    if code == LINEAR_ELASTIC:
        return np.asarray(p[0] * ((s - 1.0) ** 2).sum(axis=-1) + 0.5 * p[1] * (s - 1.0).sum(axis=-1) ** 2)
    if code == SAINT_VENANT_KIRCHHOFF:
        green = 0.5 * (s**2 - 1.0)
        return np.asarray(p[0] * (green**2).sum(axis=-1) + 0.5 * p[1] * green.sum(axis=-1) ** 2)
    if code == NEO_HOOKEAN:
        return np.asarray(0.5 * p[0] * (i1 - 3.0) - p[0] * np.log(j) + 0.5 * p[1] * np.log(j) ** 2)
    first, second = i1 / j ** (2.0 / 3.0) - 3.0, 0.5 * (i1**2 - fourth) / j ** (4.0 / 3.0) - 3.0
    volumetric = 0.25 * p[-1] * (j**2 - 1.0 - 2.0 * np.log(j))
    if code == MOONEY_RIVLIN:
        return np.asarray(p[0] * first + p[1] * second + volumetric)
    if code == YEOH:
        return np.asarray(p[0] * first + p[1] * first**2 + p[2] * first**3 + volumetric)
    return np.asarray(0.5 * p[0] * first + volumetric)


def principal_stress(material: Material, stretches: ArrayLike) -> FloatArray:
    """Return principal nominal stresses (..., 3), kPa, at principal stretches (..., 3): the derivatives of `principal_energy`."""
    s = np.asarray(stretches, dtype=float)
    p, code = material.parameters, material.law.code
    if code == LINEAR_ELASTIC:
        return np.asarray(2.0 * p[0] * (s - 1.0) + p[1] * (s - 1.0).sum(axis=-1, keepdims=True))
    if code == SAINT_VENANT_KIRCHHOFF:
        green = 0.5 * (s**2 - 1.0)
        return np.asarray(s * (2.0 * p[0] * green + p[1] * green.sum(axis=-1, keepdims=True)))
    j = s.prod(axis=-1, keepdims=True)
    if code == NEO_HOOKEAN:
        return np.asarray((p[0] * (s**2 - 1.0) + p[1] * np.log(j)) / s)
    i1 = (s**2).sum(axis=-1, keepdims=True)
    i2 = 0.5 * (i1**2 - (s**4).sum(axis=-1, keepdims=True))
    by_first = j ** (-2.0 / 3.0) * (2.0 * s - 2.0 / 3.0 * i1 / s)
    by_second = j ** (-4.0 / 3.0) * (2.0 * s * (i1 - s**2) - 4.0 / 3.0 * i2 / s)
    volumetric = 0.5 * p[-1] * (j**2 - 1.0) / s
    if code == MOONEY_RIVLIN:
        return np.asarray(p[0] * by_first + p[1] * by_second + volumetric)
    if code == YEOH:
        x = i1 * j ** (-2.0 / 3.0) - 3.0
        return np.asarray((p[0] + 2.0 * p[1] * x + 3.0 * p[2] * x**2) * by_first + volumetric)
    return np.asarray(0.5 * p[0] * by_first + volumetric)


def first_piola(material: Material, deformation_gradient: ArrayLike) -> FloatArray:
    """Return the first Piola-Kirchhoff stress (..., 3, 3), kPa, of deformation gradients (..., 3, 3).

    Isotropy makes P share the principal directions of F: ``F = U diag(s) V^T`` gives ``P = U diag(P(s)) V^T``. The linear law, which is
    not objective, is evaluated from the symmetric part of F - 1.
    """
    f = np.asarray(deformation_gradient, dtype=float)
    if material.law.code == LINEAR_ELASTIC:
        strain = 0.5 * (f + np.swapaxes(f, -1, -2)) - np.eye(3)
        mu, lame_lambda = material.parameters
        trace = np.trace(strain, axis1=-2, axis2=-1)[..., None, None]
        return np.asarray(2.0 * mu * strain + lame_lambda * trace * np.eye(3))
    u, s, vt = np.linalg.svd(f)
    return np.asarray(np.einsum("...ik,...k,...kj->...ij", u, principal_stress(material, s), vt))


def uniaxial(material: Material, stretch: float) -> HomogeneousState:
    """Return the state pulled or pressed along z to `stretch`, the sides free (the lateral stretch is solved for).

    Raises
    ------
    InputError
        No lateral stretch frees the sides: the law has no such state.
    """
    lateral = _free_stretch(material, lambda free: (free, free, stretch), 0)
    return _state(material, (lateral, lateral, stretch))


def equibiaxial(material: Material, stretch: float) -> HomogeneousState:
    """Return the sheet stretched alike along x and y, its faces (z) free.

    Raises
    ------
    InputError
        As for `uniaxial`.
    """
    return _state(material, (stretch, stretch, _free_stretch(material, lambda free: (stretch, stretch, free), 2)))


def confined(material: Material, stretch: float) -> HomogeneousState:
    """Return the state pressed along z to `stretch` between rigid frictionless walls (oedometer)."""
    return _state(material, (1.0, 1.0, stretch))


def simple_shear(material: Material, amount: float) -> FloatArray:
    """Return the nominal stress (3, 3), kPa, of the shear ``x -> x + amount z``; the shear stress on the plane z is ``[0, 2]``."""
    return first_piola(material, np.eye(3) + amount * np.outer([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))


def _state(material: Material, stretches: tuple[float, float, float]) -> HomogeneousState:
    s = np.array(stretches)
    if not (s > 0.0).all():
        raise InputError(f"stretches must be positive, not {stretches}")
    return HomogeneousState(s, principal_stress(material, s))


def _free_stretch(material: Material, stretches: Callable[[float], tuple[float, float, float]], axis: int) -> float:
    """Return the stretch for which the nominal stress along `axis` vanishes."""

    def stress(free: float) -> float:
        return float(principal_stress(material, stretches(free))[axis])

    low, high = 0.05, 20.0
    if not stress(low) < 0.0 < stress(high):
        raise InputError(f"{material.law.name} {material.parameters} has no stress-free stretch between {low} and {high} here")
    return float(brentq(stress, low, high, xtol=1e-15, rtol=8.9e-16))


@dataclass(frozen=True, slots=True)
class ThickShell:
    """A thick sphere, or a long cylinder constrained lengthwise, under inner and outer pressure at small strain (Lamé).

    Attributes
    ----------
    inner_radius, outer_radius : float
        mm.
    inner_pressure, outer_pressure : float
        kPa.
    young_modulus, poisson_ratio : float
        kPa, and dimensionless.
    kind : {"sphere", "cylinder"}
        The cylinder is in plane strain.
    """

    inner_radius: float
    outer_radius: float
    inner_pressure: float
    outer_pressure: float
    young_modulus: float
    poisson_ratio: float
    kind: str = "sphere"

    def __post_init__(self) -> None:
        if not 0.0 < self.inner_radius < self.outer_radius:
            raise InputError(f"a thick shell needs 0 < inner radius < outer radius, not {self.inner_radius:g} and {self.outer_radius:g} mm")
        if self.kind not in ("sphere", "cylinder"):
            raise InputError(f"a thick shell is a 'sphere' or a 'cylinder', not {self.kind!r}")

    @property
    def _power(self) -> int:
        return 3 if self.kind == "sphere" else 2

    def _coefficients(self) -> tuple[float, float]:
        """Return the uniform part of the stress, kPa, and the factor of r^-n in it."""
        a, b = self.inner_radius**self._power, self.outer_radius**self._power
        uniform = (self.inner_pressure * a - self.outer_pressure * b) / (b - a)
        return uniform, (self.inner_pressure - self.outer_pressure) * a * b / (b - a)

    def radial_stress(self, radius: ArrayLike) -> FloatArray:
        """Return the radial stress, kPa, at radii, mm."""
        uniform, decaying = self._coefficients()
        return np.asarray(uniform - decaying / np.asarray(radius, dtype=float) ** self._power)

    def hoop_stress(self, radius: ArrayLike) -> FloatArray:
        """Return the circumferential stress, kPa, at radii, mm."""
        uniform, decaying = self._coefficients()
        return np.asarray(uniform + decaying / (self._power - 1) / np.asarray(radius, dtype=float) ** self._power)

    def displacement(self, radius: ArrayLike) -> FloatArray:
        """Return the radial displacement, mm, at radii, mm."""
        r = np.asarray(radius, dtype=float)
        hoop, radial, nu = self.hoop_stress(r), self.radial_stress(r), self.poisson_ratio
        third = hoop if self.kind == "sphere" else nu * (hoop + radial)
        return np.asarray(r * (hoop - nu * (radial + third)) / self.young_modulus)


def self_weight_settlement(
    height: ArrayLike, *, column_mm: float, density: float, gravity: float, young_modulus: float, poisson_ratio: float
) -> FloatArray:
    """Return the vertical displacement, mm, of a laterally confined column under its own weight at small strain.

    Parameters
    ----------
    height : array_like
        Heights above the base, mm.
    column_mm : float
        Height of the column, mm.
    density, gravity : float
        kg/mm3 and mm/s2 (positive).
    young_modulus, poisson_ratio : float
        kPa, and dimensionless.
    """
    z = np.asarray(height, dtype=float)
    nu = poisson_ratio
    modulus = young_modulus * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu))
    return np.asarray(-density * gravity * z * (column_mm - 0.5 * z) / modulus)


def critical_slope(friction_coefficient: float) -> float:
    """Return the slope, rad, at which a block begins to slide down a plane under its weight (Coulomb)."""
    return float(np.arctan(friction_coefficient))


def critical_pull(normal_force: float, friction_coefficient: float) -> float:
    """Return the sideways force, mN, at which a block pressed on a plane by `normal_force`, mN, begins to slide (Coulomb)."""
    return friction_coefficient * max(normal_force, 0.0)


def plate_penetration(pressure: float, normal_stiffness: float, ramp_mm: float) -> float:
    """Return how deep, mm, a penalty plate sinks in at a nominal `pressure`, kPa: the inverse of the rounded contact law.

    Parameters
    ----------
    pressure : float
        Per unit of area of the reference configuration, kPa, not negative.
    normal_stiffness : float
        kPa/mm.
    ramp_mm : float
        Width of the rounded start of the contact pressure, mm.
    """
    depth = pressure / normal_stiffness + 0.5 * ramp_mm
    return depth if depth >= ramp_mm else float(np.sqrt(2.0 * ramp_mm * pressure / normal_stiffness))
