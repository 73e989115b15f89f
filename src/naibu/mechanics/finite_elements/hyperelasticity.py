"""Hyperelastic laws: neo-Hookean, Mooney-Rivlin, Yeoh and Saint Venant-Kirchhoff, each linear in its parameters.

Every law is written as ``W(F) = sum_k p_k W_k(I1, I2, J)`` with the invariants ``I1 = tr C``, ``I2 = (I1^2 - tr C^2) / 2`` of
``C = F^T F`` and ``J = det F``. A law supplies only the first and second derivatives of W with respect to the three invariants;
stress and tangent follow from them once, for all laws. Because W is linear in the parameters, so are the internal forces, whose derivative
with respect to a parameter is the internal force of a unit parameter.

The compressible neo-Hookean law with ln J is that of :cite:t:`bonet2008`. The laws of :cite:t:`mooney1940` and :cite:t:`rivlin1948`, and of
:cite:t:`yeoh1993`, are in the isochoric invariants, with the volumetric energy ``kappa (J^2 - 1 - 2 ln J) / 4``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError

NEO_HOOKEAN, MOONEY_RIVLIN, YEOH, SAINT_VENANT_KIRCHHOFF, NEO_HOOKEAN_ISOCHORIC, LINEAR_ELASTIC = range(6)
OF_FIRST_INVARIANT = (NEO_HOOKEAN, YEOH, NEO_HOOKEAN_ISOCHORIC)  # and of J, alone
MAX_PARAMETERS = 4


@dataclass(frozen=True, slots=True)
class Law:
    """A hyperelastic law: its code in the kernels, and the names of its parameters.

    Attributes
    ----------
    name : str
        Name of the law in files and options.
    code : int
        Number of the law in compiled kernels.
    parameter_names : tuple of str
        Names in the order of the parameter vector; all in kPa.
    volumetric : str
        The parameter that resists a change of volume.
    """

    name: str
    code: int
    parameter_names: tuple[str, ...]
    volumetric: str


LAWS: dict[str, Law] = {
    law.name: law
    for law in (
        Law("neo_hookean", NEO_HOOKEAN, ("shear_modulus", "lame_lambda"), "lame_lambda"),
        Law("neo_hookean_isochoric", NEO_HOOKEAN_ISOCHORIC, ("shear_modulus", "bulk_modulus"), "bulk_modulus"),
        Law("mooney_rivlin", MOONEY_RIVLIN, ("c10", "c01", "bulk_modulus"), "bulk_modulus"),
        Law("yeoh", YEOH, ("c10", "c20", "c30", "bulk_modulus"), "bulk_modulus"),
        Law("saint_venant_kirchhoff", SAINT_VENANT_KIRCHHOFF, ("shear_modulus", "lame_lambda"), "lame_lambda"),
        Law("linear_elastic", LINEAR_ELASTIC, ("shear_modulus", "lame_lambda"), "lame_lambda"),
    )
}


@dataclass(frozen=True, slots=True)
class Material:
    """A law with values for its parameters, kPa.

    Attributes
    ----------
    law : Law
        The hyperelastic law.
    parameters : tuple of float
        One value for each of ``law.parameter_names``, kPa.
    """

    law: Law
    parameters: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.parameters) != len(self.law.parameter_names):
            raise InputError(f"{self.law.name} needs {', '.join(self.law.parameter_names)}; got {len(self.parameters)} values")
        if not np.isfinite(self.parameters).all():
            raise InputError(f"parameters of {self.law.name} must be finite, not {self.parameters}")
        if self.small_strain_shear_modulus <= 0.0:
            raise InputError(
                f"the shear modulus of {self.law.name} at small strain is {self.small_strain_shear_modulus:g} kPa; it must be positive"
            )
        if self.small_strain_bulk_modulus <= 0.0:
            raise InputError(
                f"the bulk modulus of {self.law.name} at small strain is {self.small_strain_bulk_modulus:g} kPa; it must be positive"
            )

    @property
    def small_strain_shear_modulus(self) -> float:
        """Shear modulus of the linearised law, kPa."""
        return float(small_strain_shear_moduli(np.array([self.law.code]), np.array([self.parameters]))[0])

    @property
    def small_strain_bulk_modulus(self) -> float:
        """Bulk modulus of the linearised law, kPa."""
        last = self.parameters[-1]
        return last if self.law.volumetric == "bulk_modulus" else last + 2.0 / 3.0 * self.parameters[0]

    @property
    def young_modulus(self) -> float:
        """Young's modulus of the linearised law, kPa."""
        mu, kappa = self.small_strain_shear_modulus, self.small_strain_bulk_modulus
        return 9.0 * kappa * mu / (3.0 * kappa + mu)

    @property
    def poisson_ratio(self) -> float:
        """Poisson's ratio of the linearised law."""
        mu, kappa = self.small_strain_shear_modulus, self.small_strain_bulk_modulus
        return (3.0 * kappa - 2.0 * mu) / (6.0 * kappa + 2.0 * mu)


def small_strain_shear_moduli(law_codes: IntArray, parameters: FloatArray) -> FloatArray:
    """Return the shear moduli (m,), kPa, of linearised laws (m,) with parameters (m, k), kPa."""
    second = np.where(law_codes == MOONEY_RIVLIN, parameters[:, 1], 0.0)
    return np.asarray(np.where((law_codes == MOONEY_RIVLIN) | (law_codes == YEOH), 2.0, 1.0) * (parameters[:, 0] + second))


def small_strain_bulk_moduli(law_codes: IntArray, parameters: FloatArray) -> FloatArray:
    """Return the bulk moduli (m,), kPa, of linearised laws (m,) with parameters (m, k), kPa."""
    shear, out = small_strain_shear_moduli(law_codes, parameters), np.zeros(len(law_codes))
    for law in LAWS.values():
        last = parameters[:, law.parameter_names.index(law.volumetric)]
        out = np.where(law_codes == law.code, last + (0.0 if law.volumetric == "bulk_modulus" else 2.0 / 3.0) * shear, out)
    return np.asarray(out)


def largest_poisson_ratio(law_codes: IntArray, parameters: FloatArray) -> float:
    """Return the largest Poisson's ratio of linearised laws (m,) with parameters (m, k), kPa."""
    mu, kappa = small_strain_shear_moduli(law_codes, parameters), small_strain_bulk_moduli(law_codes, parameters)
    return float(np.max((3.0 * kappa - 2.0 * mu) / (6.0 * kappa + 2.0 * mu)))


def law_named(name: str) -> Law:
    """Return the hyperelastic law called `name`.

    Raises
    ------
    InputError
        There is no such law; the message lists the names.
    """
    if name not in LAWS:
        raise InputError(f"law {name!r} is not known; use one of {', '.join(LAWS)}")
    return LAWS[name]


def lame_parameters(young_modulus: float, poisson_ratio: float) -> tuple[float, float]:
    """Return (lame_lambda, shear_modulus), kPa, of an isotropic linear elastic solid.

    Parameters
    ----------
    young_modulus : float
        kPa, positive.
    poisson_ratio : float
        In (-1, 0.5).

    Raises
    ------
    InputError
        A value outside its range.
    """
    if not young_modulus > 0.0:
        raise InputError(f"Young's modulus must be positive, not {young_modulus:g} kPa")
    if not -1.0 < poisson_ratio < 0.5:
        raise InputError(f"Poisson's ratio must lie in (-1, 0.5), not {poisson_ratio:g}; use 0.499 for a nearly incompressible solid")
    lame_lambda = poisson_ratio * young_modulus / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))
    return lame_lambda, young_modulus / (2.0 * (1.0 + poisson_ratio))


def material(law: str = "neo_hookean", *, young_modulus: float, poisson_ratio: float, shape: tuple[float, ...] = ()) -> Material:
    """Return a hyperelastic material with given Young's modulus and Poisson's ratio at small strain.

    Parameters
    ----------
    law : str
        Name of the law, see `LAWS`.
    young_modulus : float
        kPa.
    poisson_ratio : float
        In (-1, 0.5).
    shape : tuple of float
        What the two moduli leave open: for ``mooney_rivlin`` the fraction c01 / (c10 + c01), for ``yeoh`` the ratios c20 / c10 and
        c30 / c10; empty means zeros, which is neo-Hookean.

    Raises
    ------
    InputError
        Unknown law, or a value outside its range.
    """
    chosen = law_named(law)
    lame_lambda, mu = lame_parameters(young_modulus, poisson_ratio)
    return from_moduli(chosen, mu, lame_lambda + 2.0 / 3.0 * mu, shape)


def from_moduli(law: Law, shear_modulus: float, bulk_modulus: float, shape: tuple[float, ...] = ()) -> Material:
    """Return a hyperelastic material with given small-strain shear and bulk moduli, kPa; `shape` as in `material`."""
    return Material(law, parameter_vector(law, shear_modulus, bulk_modulus, shape))


def parameter_vector(law: Law, shear_modulus: float, bulk_modulus: float, shape: tuple[float, ...] = ()) -> tuple[float, ...]:
    """Return the law's parameters, kPa, as a linear function of its small-strain moduli, kPa (also of their changes)."""
    if law.code == MOONEY_RIVLIN:
        fraction = shape[0] if shape else 0.0
        half = 0.5 * shear_modulus
        return (1.0 - fraction) * half, fraction * half, bulk_modulus
    if law.code == YEOH:
        c10 = 0.5 * shear_modulus
        second, third = (*shape, 0.0, 0.0)[:2]
        return c10, second * c10, third * c10, bulk_modulus
    if law.volumetric == "bulk_modulus":
        return shear_modulus, bulk_modulus
    return shear_modulus, bulk_modulus - 2.0 / 3.0 * shear_modulus


def parameter_table(materials: list[Material], regions: IntArray) -> tuple[IntArray, FloatArray]:
    """Return, for every cell, the code of its law (m,) and its parameters (m, 4), kPa, padded with zeros."""
    if len(materials) <= int(regions.max()):
        raise InputError(f"the mesh has regions 0 to {regions.max()}, but {len(materials)} materials are given; give one for each region")
    codes = np.array([m.law.code for m in materials], dtype=np.int64)
    values = np.zeros((len(materials), MAX_PARAMETERS))
    for row, m in zip(values, materials, strict=True):
        row[: len(m.parameters)] = m.parameters
    return codes[regions], values[regions]


@njit(cache=True, fastmath=False)
def invariant_derivatives(code, p, i1, i2, j, d):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Energy of a law, and in `d` its derivatives W_1, W_2, W_J, W_11, W_12, W_22, W_1J, W_2J, W_JJ (kPa)."""
    d[:] = 0.0
    log_j = np.log(j)
    if code == NEO_HOOKEAN:
        # W = mu (I1 - 3) / 2 - mu ln J + lambda (ln J)^2 / 2
        d[0] = 0.5 * p[0]
        d[2] = (p[1] * log_j - p[0]) / j
        d[8] = (p[0] + p[1] * (1.0 - log_j)) / (j * j)
        return 0.5 * p[0] * (i1 - 3.0) - p[0] * log_j + 0.5 * p[1] * log_j * log_j
    if code == SAINT_VENANT_KIRCHHOFF:
        # W = lambda (I1 - 3)^2 / 8 + mu (I1^2 - 2 I2 - 2 I1 + 3) / 4
        d[0] = 0.25 * p[1] * (i1 - 3.0) + 0.5 * p[0] * (i1 - 1.0)
        d[1] = -0.5 * p[0]
        d[3] = 0.25 * p[1] + 0.5 * p[0]
        return 0.125 * p[1] * (i1 - 3.0) ** 2 + 0.25 * p[0] * (i1 * i1 - 2.0 * i2 - 2.0 * i1 + 3.0)
    # laws split into isochoric and volumetric parts: I1bar = J^-2/3 I1, I2bar = J^-4/3 I2, U = kappa (J^2 - 1 - 2 ln J) / 4
    a = j ** (-2.0 / 3.0)
    bar1, bar2 = a * i1, a * a * i2
    x = bar1 - 3.0
    if code == MOONEY_RIVLIN:
        w1, w11, w2, kappa = p[0], 0.0, p[1], p[2]
        energy = p[0] * x + p[1] * (bar2 - 3.0)
    elif code == YEOH:
        w1 = p[0] + 2.0 * p[1] * x + 3.0 * p[2] * x * x
        w11 = 2.0 * p[1] + 6.0 * p[2] * x
        w2, kappa = 0.0, p[3]
        energy = p[0] * x + p[1] * x * x + p[2] * x * x * x
    else:
        w1, w11, w2, kappa = 0.5 * p[0], 0.0, 0.0, p[1]
        energy = 0.5 * p[0] * x
    b1j = -2.0 / 3.0 * bar1 / j
    b2j = -4.0 / 3.0 * bar2 / j
    d[0] = w1 * a
    d[1] = w2 * a * a
    d[2] = w1 * b1j + w2 * b2j + 0.5 * kappa * (j - 1.0 / j)
    d[3] = w11 * a * a
    d[6] = w11 * b1j * a - 2.0 / 3.0 * w1 * a / j
    d[7] = -4.0 / 3.0 * w2 * a * a / j
    d[8] = w11 * b1j * b1j + w1 * 10.0 / 9.0 * bar1 / (j * j) + w2 * 28.0 / 9.0 * bar2 / (j * j) + 0.5 * kappa * (1.0 + 1.0 / (j * j))
    return energy + 0.25 * kappa * (j * j - 1.0 - 2.0 * log_j)


@njit(cache=True, fastmath=False, error_model="numpy")  # a flat element gives infinities; callers check det F
def inverse_transpose(f, g):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Put F^-T into `g` and return det F."""
    g[0, 0] = f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1]
    g[0, 1] = f[1, 2] * f[2, 0] - f[1, 0] * f[2, 2]
    g[0, 2] = f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0]
    g[1, 0] = f[0, 2] * f[2, 1] - f[0, 1] * f[2, 2]
    g[1, 1] = f[0, 0] * f[2, 2] - f[0, 2] * f[2, 0]
    g[1, 2] = f[0, 1] * f[2, 0] - f[0, 0] * f[2, 1]
    g[2, 0] = f[0, 1] * f[1, 2] - f[0, 2] * f[1, 1]
    g[2, 1] = f[0, 2] * f[1, 0] - f[0, 0] * f[1, 2]
    g[2, 2] = f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0]
    j = f[0, 0] * g[0, 0] + f[0, 1] * g[0, 1] + f[0, 2] * g[0, 2]
    for i in range(3):
        for k in range(3):
            g[i, k] /= j
    return j


@njit(cache=True, fastmath=False)
def linear_stress(p, f, stress, tangent, with_tangent):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Small-strain law W = lambda (tr e)^2 / 2 + mu e : e with e = sym(F - 1); returns the energy."""
    trace = f[0, 0] + f[1, 1] + f[2, 2] - 3.0
    energy = 0.5 * p[1] * trace * trace
    for i in range(3):
        for k in range(3):
            e = 0.5 * (f[i, k] + f[k, i]) - (1.0 if i == k else 0.0)
            stress[i, k] = 2.0 * p[0] * e + (p[1] * trace if i == k else 0.0)
            energy += p[0] * e * e
    if with_tangent:
        tangent[:] = 0.0
        for i in range(3):
            for k in range(3):
                tangent[3 * i + k, 3 * i + k] += p[0]
                tangent[3 * i + k, 3 * k + i] += p[0]
                tangent[4 * i, 4 * k] += p[1]
    return energy


@njit(cache=True, fastmath=False)
def stress_and_tangent(code, p, f, ft_inv, j, d, c, stress, tangent, with_tangent):  # type: ignore[no-untyped-def]  # pragma: no cover
    """First Piola-Kirchhoff stress P (3, 3) and tangent dP/dF (9, 9), kPa, row-major in F; returns the energy density.

    `ft_inv` is F^-T and `j` is det F > 0; `d` (9,) and `c` (3, 3) are scratch.
    """
    if code == LINEAR_ELASTIC:
        return linear_stress(p, f, stress, tangent, with_tangent)
    i1 = 0.0
    cc = 0.0
    for i in range(3):
        for k in range(3):
            c[i, k] = f[0, i] * f[0, k] + f[1, i] * f[1, k] + f[2, i] * f[2, k]
            cc += c[i, k] * c[i, k]
        i1 += c[i, i]
    energy = invariant_derivatives(code, p, i1, 0.5 * (i1 * i1 - cc), j, d)
    second = d[1] != 0.0 or d[5] != 0.0
    for i in range(3):
        for k in range(3):
            stress[i, k] = 2.0 * d[0] * f[i, k] + d[2] * j * ft_inv[i, k]
            if second:
                fc = f[i, 0] * c[0, k] + f[i, 1] * c[1, k] + f[i, 2] * c[2, k]
                stress[i, k] += 2.0 * d[1] * (i1 * f[i, k] - fc)
    if not with_tangent:
        return energy
    ww = d[8] * j * j + d[2] * j
    for i in range(3):
        for k in range(3):
            row = 3 * i + k
            fr, gr = f[i, k], ft_inv[i, k]
            for m in range(3):
                for n in range(3):
                    col = 3 * m + n
                    fs, gs = f[m, n], ft_inv[m, n]
                    v = 4.0 * d[3] * fr * fs + 2.0 * d[6] * j * (fr * gs + gr * fs) + ww * gr * gs
                    tangent[row, col] = v - d[2] * j * ft_inv[i, n] * ft_inv[m, k]
            tangent[row, row] += 2.0 * d[0]
    if second:
        add_second_invariant(i1, f, ft_inv, j, d, c, tangent)
    return energy


@njit(cache=True, fastmath=False)
def add_second_invariant(i1, f, ft_inv, j, d, c, tangent):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add to `tangent` what depends on I2: W_2 d2I2 + W_2J (dI2 x dJ + dJ x dI2); no law has W_12 or W_22."""
    for i in range(3):
        for k in range(3):
            row = 3 * i + k
            a_row = 2.0 * (i1 * f[i, k] - f[i, 0] * c[0, k] - f[i, 1] * c[1, k] - f[i, 2] * c[2, k])
            for m in range(3):
                b_im = f[i, 0] * f[m, 0] + f[i, 1] * f[m, 1] + f[i, 2] * f[m, 2]
                for n in range(3):
                    a_col = 2.0 * (i1 * f[m, n] - f[m, 0] * c[0, n] - f[m, 1] * c[1, n] - f[m, 2] * c[2, n])
                    v = 2.0 * f[i, k] * f[m, n] - f[i, n] * f[m, k]
                    if i == m:
                        v -= c[k, n]
                    if k == n:
                        v -= b_im
                    if i == m and k == n:
                        v += i1
                    w = d[7] * j * (a_row * ft_inv[m, n] + ft_inv[i, k] * a_col)
                    tangent[row, 3 * m + n] += 2.0 * d[1] * v + w
