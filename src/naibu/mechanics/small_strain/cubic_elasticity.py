"""Linear elasticity of cubic crystals, such as silicon, in any orientation :cite:p:`nye1985,hopcroft2010`."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, as_vector, require_finite, require_shape
from naibu.core.errors import InputError

_INDICES = re.compile(r"[<\[(]?\s*(-?\d)[\s,]*(-?\d)[\s,]*(-?\d)\s*[>\])]?")
_PERPENDICULAR = 1e-9  # largest cosine between perpendicular directions


@dataclass(frozen=True, slots=True)
class CubicCrystal:
    """The three elastic stiffnesses of a cubic crystal in its own axes.

    Attributes
    ----------
    c11, c12, c44 : float
        Stiffnesses in Voigt's notation, kPa.

    Raises
    ------
    InputError
        Stiffnesses for which some strain would have no positive energy.
    """

    c11: float
    c12: float
    c44: float

    def __post_init__(self) -> None:
        require_finite("the stiffnesses c11, c12, c44", np.array([self.c11, self.c12, self.c44]))
        if not (self.c44 > 0.0 and self.c11 > abs(self.c12) and self.c11 + 2.0 * self.c12 > 0.0):
            raise InputError(
                f"c11 = {self.c11:g}, c12 = {self.c12:g}, c44 = {self.c44:g} kPa are not those of a stable crystal; "
                "c44 > 0, c11 > |c12| and c11 + 2 c12 > 0 must hold"
            )

    @classmethod
    def isotropic(cls, young_modulus: float, poisson_ratio: float) -> CubicCrystal:
        """Return the stiffnesses of an isotropic solid of a Young's modulus, kPa, and a Poisson's ratio."""
        shear = young_modulus / (2.0 * (1.0 + poisson_ratio))
        lame = young_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))
        return cls(lame + 2.0 * shear, lame, shear)

    @property
    def anisotropy(self) -> float:
        """Zener's ratio 2 c44 / (c11 - c12): 1 for an isotropic solid."""
        return 2.0 * self.c44 / (self.c11 - self.c12)

    def stiffness_tensor(self, axes: ArrayLike | None = None) -> FloatArray:
        """Return the stiffness tensor C_ijkl (3, 3, 3, 3), kPa.

        Parameters
        ----------
        axes : array_like, shape (3, 3), optional
            Rows are the unit vectors x, y, z of the frame in the crystal's axes, as from `crystal_frame`; the crystal's own by default.

        Raises
        ------
        InputError
            `axes` is not a rotation.
        """
        return cubic_tensor(self.c11, self.c12, self.c44, axes)

    def compliance_tensor(self, axes: ArrayLike | None = None) -> FloatArray:
        """Return the compliance tensor S_ijkl (3, 3, 3, 3), 1/kPa; `axes` as for `stiffness_tensor`."""
        s11, s12, s44 = self._compliances
        return cubic_tensor(s11, s12, 0.25 * s44, axes)

    @property
    def _compliances(self) -> tuple[float, float, float]:
        """s11, s12 and s44 in Voigt's notation, 1/kPa."""
        common = (self.c11 - self.c12) * (self.c11 + 2.0 * self.c12)
        return (self.c11 + self.c12) / common, -self.c12 / common, 1.0 / self.c44

    def young_modulus(self, direction: ArrayLike) -> float:
        """Return Young's modulus along a direction of the crystal, kPa.

        Parameters
        ----------
        direction : array_like, shape (3,)
            Miller indices, such as (1, 1, 0).
        """
        n = unit_vector("direction", direction)
        return float(1.0 / np.einsum("ijkl,i,j,k,l", self.compliance_tensor(), n, n, n, n))

    def poisson_ratio(self, direction: ArrayLike, transverse: ArrayLike) -> float:
        """Return the contraction along `transverse` over the extension along `direction` of uniaxial stress.

        Parameters
        ----------
        direction, transverse : array_like, shape (3,)
            Perpendicular Miller indices.

        Raises
        ------
        InputError
            They are not perpendicular.
        """
        n, m = _perpendicular(direction, transverse)
        s = self.compliance_tensor()
        return float(-np.einsum("ijkl,i,j,k,l", s, m, m, n, n) / np.einsum("ijkl,i,j,k,l", s, n, n, n, n))

    def shear_modulus(self, direction: ArrayLike, normal: ArrayLike) -> float:
        """Return the modulus of shear along `direction` in the plane with `normal`, kPa; both (3,) and perpendicular, else `InputError`."""
        n, m = _perpendicular(direction, normal)
        return float(0.25 / np.einsum("ijkl,i,j,k,l", self.compliance_tensor(), n, m, n, m))


def silicon() -> CubicCrystal:
    """Return silicon at room temperature: c11 165.7, c12 63.9, c44 79.6 GPa :cite:p:`wortman1965,hopcroft2010`."""
    return CubicCrystal(165.7e6, 63.9e6, 79.6e6)


def cubic_tensor(c11: float, c12: float, c44: float, axes: ArrayLike | None = None) -> FloatArray:
    """Return the tensor (3, 3, 3, 3) of a cubic crystal from its components 1111, 1122 and 1212, in the frame `axes`.

    It is ``c12 d_ij d_kl + c44 (d_ik d_jl + d_il d_jk) + (c11 - c12 - 2 c44) sum_n a_in a_jn a_kn a_ln`` with the axes a.

    Raises
    ------
    InputError
        `axes` is not a rotation.
    """
    d = np.eye(3)
    a = d if axes is None else np.asarray(axes, dtype=float)
    require_shape("axes", a, (3, 3))
    if not (np.abs(a @ a.T - d).max() < 1e-6 and np.linalg.det(a) > 0.0):
        raise InputError("axes must be the three unit vectors of a right-handed frame, one a row; make them by crystal_frame")
    isotropic = c12 * np.einsum("ij,kl->ijkl", d, d) + c44 * (np.einsum("ik,jl->ijkl", d, d) + np.einsum("il,jk->ijkl", d, d))
    return np.asarray(isotropic + (c11 - c12 - 2.0 * c44) * np.einsum("in,jn,kn,ln->ijkl", a, a, a, a))


def miller_indices(text: str) -> tuple[int, int, int]:
    """Return the indices of a crystal direction written as ``"110"``, ``"<110>"``, ``"[1 -1 0]"`` or ``"(0, 0, 1)"``.

    Raises
    ------
    InputError
        Another text, or 000.
    """
    found = _INDICES.fullmatch(text.strip())
    indices = tuple(int(i) for i in found.groups()) if found else (0, 0, 0)
    if indices == (0, 0, 0):
        raise InputError(f"{text!r} is no crystal direction; write three Miller indices of one digit, such as '110' or '[1 -1 0]'")
    return indices[0], indices[1], indices[2]


def crystal_frame(x: ArrayLike, z: ArrayLike) -> FloatArray:
    """Return the frame (3, 3) whose rows x, y, z are unit vectors in the axes of the crystal.

    Parameters
    ----------
    x, z : array_like, shape (3,)
        Miller indices of the first and the third axis, perpendicular to each other: (1, 1, 0) and (0, 0, 1) for a beam along [110] on a
        (001) wafer.

    Raises
    ------
    InputError
        A direction without length, or two that are not perpendicular.
    """
    first, third = _perpendicular(x, z)
    return np.stack([first, np.cross(third, first), third])


def unit_vector(name: str, direction: ArrayLike) -> FloatArray:
    """Return a direction (3,) at length 1, or refuse one without length."""
    vector = as_vector(name, direction)
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        raise InputError(f"{name} is (0, 0, 0), which is no crystal direction; give Miller indices such as (1, 1, 0)")
    return vector / length


def _perpendicular(direction: ArrayLike, other: ArrayLike) -> tuple[FloatArray, FloatArray]:
    n, m = unit_vector("direction", direction), unit_vector("direction", other)
    if abs(n @ m) > _PERPENDICULAR:
        raise InputError(f"the crystal directions {_written(direction)} and {_written(other)} are not perpendicular; give two that are")
    return n, m


def _written(direction: ArrayLike) -> str:
    return f"[{' '.join(f'{i:g}' for i in np.asarray(direction, dtype=float))}]"
