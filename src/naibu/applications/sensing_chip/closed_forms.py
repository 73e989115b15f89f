"""Closed forms of the cross-beam chip: equations (1) to (22) of the paper in chapter 6 of :cite:t:`hirai2008`, misprints corrected.

The printed equation (8) lacks a factor 1/2, (11) divides by I where L belongs, and (22) has a wrong sign, so that

``delta_x = c theta^2 / 2``, ``F_RX = (w t E / L) c theta^2 / 2``, ``x0 = L / (2 c + L) ((L + 3 c) / 3 - L c theta / (6 t))``

and the terms in theta^2 of (18), (20), (21) are half of what is printed. The beams' bending shortens them by a further amount of the same
order, which (8) neglects: see `CrossBeam.axial_strain`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class CrossBeam:
    """Euler-Bernoulli and Saint-Venant theory of four clamped beams around a rigid block; all entries may be arrays of designs.

    Attributes
    ----------
    length, width, thickness : ndarray
        L, w and t of a beam, mm.
    half_width : ndarray
        c of the block, mm.
    young_modulus, shear_modulus : ndarray
        E along the beams and G in the plane of the wafer, kPa.
    """

    length: FloatArray
    width: FloatArray
    thickness: FloatArray
    half_width: FloatArray
    young_modulus: FloatArray
    shear_modulus: FloatArray

    @classmethod
    def of(
        cls, length: ArrayLike, width: ArrayLike, thickness: ArrayLike, half_width: ArrayLike, young: ArrayLike, shear: ArrayLike
    ) -> CrossBeam:
        """Return the beams of dimensions, mm, and moduli, kPa, as arrays."""
        return cls(*(np.asarray(value, dtype=float) for value in (length, width, thickness, half_width, young, shear)))

    @property
    def second_moment(self) -> FloatArray:
        """I, mm^4."""
        return self.width * self.thickness**3 / 12.0

    @property
    def section_modulus(self) -> FloatArray:
        """Z, equation (2), mm^3."""
        return self.width * self.thickness**2 / 6.0

    @property
    def torsion_constant(self) -> FloatArray:
        """K, equation (13), mm^4: Roark's formula :cite:p:`roark1965`, whose larger side must be the width."""
        a, b = np.maximum(self.width, self.thickness), np.minimum(self.width, self.thickness)
        ratio = b / a
        return np.asarray(a * b**3 / 16.0 * (16.0 / 3.0 - 3.36 * ratio * (1.0 - ratio**4 / 12.0)))

    def force_stress(self, x: ArrayLike) -> FloatArray:
        """Return the surface stress at x, mm, per force on the block, kPa/mN: equation (1)."""
        return np.asarray((0.5 * self.length - np.asarray(x)) / (4.0 * self.section_modulus))

    def force_deflection(self, x: ArrayLike) -> FloatArray:
        """Return the deflection at x, mm, per force on the block, mm/mN: equation (3)."""
        at = np.asarray(x)
        return np.asarray(at**2 * (3.0 * self.length - 2.0 * at) / (48.0 * self.young_modulus * self.second_moment))

    @property
    def force_stiffness(self) -> FloatArray:
        """Force over displacement of the block, mN/mm: equation (4)."""
        return 48.0 * self.young_modulus * self.second_moment / self.length**3

    @property
    def end_force(self) -> FloatArray:
        """F_RZ over the block's rotation, mN: equation (9)."""
        return 12.0 * self.young_modulus * self.second_moment / self.length**3 * (self.half_width + 0.5 * self.length)

    @property
    def end_moment(self) -> FloatArray:
        """M_RY over the block's rotation, mN mm: equation (10)."""
        return 12.0 * self.young_modulus * self.second_moment / self.length**2 * (0.5 * self.half_width + self.length / 3.0)

    @property
    def end_torque(self) -> FloatArray:
        """T_RY over the block's rotation, mN mm: equation (12)."""
        return self.torsion_constant * self.shear_modulus / self.length

    @property
    def moment_stiffness(self) -> FloatArray:
        """Moment on the block over its rotation, mN mm: equations (14) and (15)."""
        return 2.0 * (self.end_moment + self.end_torque + self.end_force * self.half_width)

    def bending_stress(self, x: ArrayLike) -> FloatArray:
        """Return the surface stress at x, mm, of the beams bent by a rotation of the block, over the rotation, kPa: (16) and (17)."""
        at, c, length = np.asarray(x), self.half_width, self.length
        of_moment = 0.5 * c + length / 3.0
        of_force = (c + 0.5 * length) * (length - at) / length
        return np.asarray(6.0 * self.young_modulus * self.thickness / length**2 * (of_moment - of_force))

    def axial_strain(self, rotation: ArrayLike, *, bending: bool = False) -> FloatArray:
        """Return the mean strain along the bent beams of a rotation of the block, to its second order.

        Parameters
        ----------
        rotation : array_like
            theta, rad.
        bending : bool
            Whether the shortening of the bent beams counts, half of the integral of the squared slope; the report's (8), (11) and (18)
            have the displacement of the block's edge only, c theta^2 / 2.
        """
        c, length = self.half_width, self.length
        arc = 0.6 * c**2 / length + 0.1 * c + length / 15.0 if bending else 0.0
        return np.asarray((0.5 * c + arc) * np.asarray(rotation) ** 2 / length)

    def stress(self, x: ArrayLike, rotation: ArrayLike, *, bending: bool = False) -> FloatArray:
        """Return the surface stress at x, mm, of beam A after a rotation of the block, rad, kPa: equation (19), at the ends (20), (21).

        `bending` as for `axial_strain`.
        """
        return np.asarray(self.bending_stress(x) * np.asarray(rotation) + self.young_modulus * self.axial_strain(rotation, bending=bending))

    def stress_free_point(self, rotation: ArrayLike = 0.0) -> FloatArray:
        """Return where equation (19) vanishes, mm from the clamp: equation (22)."""
        c, length = self.half_width, self.length
        return np.asarray(
            length / (2.0 * c + length) * ((length + 3.0 * c) / 3.0 - length * c * np.asarray(rotation) / (6.0 * self.thickness))
        )

    @property
    def torsion_stress(self) -> FloatArray:
        """Largest shear stress of a twisted beam over the torque in it, 1/mm^3: at the middle of the wide face :cite:p:`roark1965`."""
        a, b = np.maximum(self.width, self.thickness), np.minimum(self.width, self.thickness)
        return np.asarray((3.0 * a + 1.8 * b) / (a**2 * b**2))


def orthotropic_torsion_stiffness(width: float, thickness: float, in_plane: float, out_of_plane: float) -> float:
    """Return the torque over the twist per length of a rectangular bar with two shear moduli, mN mm^2 :cite:p:`lekhnitskii1963`.

    Parameters
    ----------
    width, thickness : float
        mm.
    in_plane, out_of_plane : float
        Shear moduli between the axis and the width, and between the axis and the thickness, kPa; equal ones are Saint-Venant's torsion.
    """
    stretch = np.sqrt(in_plane / out_of_plane)
    side = width / stretch
    n = np.arange(1, 60, 2)
    series = np.sum(np.tanh(0.5 * n * np.pi * side / thickness) / n**5)
    return float(stretch * in_plane * side * thickness**3 * (1.0 / 3.0 - 64.0 / np.pi**5 * thickness / side * series))
