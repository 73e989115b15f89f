"""Piezoresistance of silicon: tensor :cite:p:`smith1954`, its directions :cite:p:`kanda1982`, and doping :cite:p:`harley2000`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, require_within
from naibu.mechanics.small_strain.cubic_elasticity import crystal_frame, cubic_tensor

_PER_TPA = 1e-9  # 1/TPa in 1/kPa
_EXPONENT, _REFERENCE = 0.2014, 1.53e22  # of the measured coefficients over the concentration, cm^-3
LEAST_DOPING, MOST_DOPING = 1e14, 1e21  # per cm^3


@dataclass(frozen=True, slots=True)
class Piezoresistance:
    """Coefficients of a cubic crystal in its own axes: relative change of resistivity per stress.

    Attributes
    ----------
    pi11, pi12, pi44 : float
        1/kPa, in the notation of Smith: the shear component of the resistivity is pi44 times the shear stress.
    """

    pi11: float
    pi12: float
    pi44: float

    def tensor(self, axes: ArrayLike | None = None) -> FloatArray:
        """Return pi_ijkl (3, 3, 3, 3), 1/kPa, in a frame whose unit vectors in the crystal's axes are the rows of `axes` (3, 3)."""
        return cubic_tensor(self.pi11, self.pi12, 0.5 * self.pi44, axes)

    def longitudinal(self, direction: ArrayLike) -> float:
        """Return the coefficient of stress along the current, 1/kPa; `direction` (3,) holds Miller indices."""
        n = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
        return float(np.einsum("ijkl,i,j,k,l", self.tensor(), n, n, n, n))

    def transverse(self, direction: ArrayLike, normal: ArrayLike) -> float:
        """Return the coefficient of stress across the current in the surface, 1/kPa.

        Parameters
        ----------
        direction, normal : array_like, shape (3,)
            Miller indices of the current and of the surface's normal, perpendicular to each other.

        Raises
        ------
        InputError
            They are not perpendicular.
        """
        n, m, _ = crystal_frame(direction, normal)
        return float(np.einsum("ijkl,i,j,k,l", self.tensor(), n, n, m, m))

    def relative_change(self, stress: FloatArray, current: ArrayLike, axes: ArrayLike) -> FloatArray:
        """Return the relative change of resistance of thin straight resistors.

        Parameters
        ----------
        stress : ndarray, shape (..., 3, 3)
            In the frame `axes`, kPa.
        current : array_like, shape (..., 3)
            Unit vectors of the current, in the same frame.
        axes : array_like, shape (3, 3)
            Unit vectors of the frame in the crystal's axes.
        """
        e = np.asarray(current, dtype=float)
        return np.asarray(np.einsum("ijkl,...i,...j,...kl->...", self.tensor(axes), e, e, stress))

    def scaled(self, factor: float) -> Piezoresistance:
        """Return all coefficients times a factor."""
        return Piezoresistance(factor * self.pi11, factor * self.pi12, factor * self.pi44)


def p_type_silicon(factor: float = 1.0) -> Piezoresistance:
    """Return p-type silicon at room temperature, lightly doped :cite:p:`smith1954`, times a factor such as `doping_factor`."""
    return Piezoresistance(66.0 * _PER_TPA, -11.0 * _PER_TPA, 1381.0 * _PER_TPA).scaled(factor)


def n_type_silicon(factor: float = 1.0) -> Piezoresistance:
    """Return n-type silicon at room temperature, lightly doped :cite:p:`smith1954`, times a factor."""
    return Piezoresistance(-1022.0 * _PER_TPA, 534.0 * _PER_TPA, -136.0 * _PER_TPA).scaled(factor)


def doping_factor(concentration_per_cm3: float) -> float:
    """Return the piezoresistance of doped silicon over that of lightly doped silicon: a fit to measurements :cite:p:`harley2000`.

    It is ``log10((1.53e22 / N)^0.2014)``, at most 1. Theory without scattering by ions :cite:p:`kanda1982` overestimates those of
    strongly doped silicon :cite:p:`barlian2009`.

    Raises
    ------
    InputError
        A concentration beyond 1e14 to 1e21 per cm^3.
    """
    n = require_within("doping_per_cm3", concentration_per_cm3, LEAST_DOPING, MOST_DOPING)
    return float(min(1.0, _EXPONENT * np.log10(_REFERENCE / n)))
