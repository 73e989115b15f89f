"""Linear viscoelasticity at small strain: elastic, Kelvin-Voigt, Maxwell and three-element (Jeffreys) materials.

A spring E and a dashpot C1 in parallel (Voigt part) are in series with a dashpot C2 :cite:p:`hirai2008` (chapter 2). For each of the lambda
and mu parts, with the strain e and the strain e1 of the Voigt part, ``sigma = E e1 + C1 e1' = C2 (e' - e1')``. Eliminating e2 = e - e1
gives::

    e1'   = r e' - e1 / tau        r = C2 / (C1 + C2),  tau = (C1 + C2) / E
    sigma = Cbar e' + r E e1       Cbar = C1 C2 / (C1 + C2)

and the internal variable of :cite:t:`hirai2008` is ``w = r E e1``. C2 -> inf gives Voigt, C1 = 0 Maxwell, both elasticity, E = 0 two
dashpots in series.
The internal strain stored here is e1: its trace for the lambda part, the whole tensor for the mu part, because their times tau differ where
the Poisson ratios of the three elements do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.linear_simplices import per_cell


@dataclass(frozen=True, slots=True)
class Rheology:
    """A three-element (Jeffreys) solid; `elastic`, `voigt`, `maxwell` and `three_element` return the common ones.

    Attributes
    ----------
    young_modulus : float
        E of the spring, kPa; zero leaves two dashpots in series.
    voigt_viscosity : float
        C1, of the dashpot parallel to the spring, kPa s.
    series_viscosity : float
        C2, of the dashpot in series, kPa s; infinite for a solid without permanent flow.
    poisson_ratio, voigt_poisson_ratio, series_poisson_ratio : float
        Of the spring and of the two dashpots, in (-1, 0.5).
    """

    young_modulus: float
    voigt_viscosity: float
    series_viscosity: float
    poisson_ratio: float
    voigt_poisson_ratio: float
    series_poisson_ratio: float

    def __post_init__(self) -> None:
        CellRheology.of(1, self)

    @property
    def relaxation_time(self) -> float:
        """Relaxation time (C1 + C2) / E, s, of the stress at constant strain where the three Poisson ratios agree."""
        return np.inf if self.young_modulus == 0.0 else (self.voigt_viscosity + self.series_viscosity) / self.young_modulus

    @property
    def retardation_time(self) -> float:
        """Retardation time C1 / E, s, of the strain recovery without stress."""
        return np.inf if self.young_modulus == 0.0 else self.voigt_viscosity / self.young_modulus


def three_element(
    young_modulus: float,
    voigt_viscosity: float,
    series_viscosity: float,
    poisson_ratio: float,
    *,
    voigt_poisson_ratio: float | None = None,
    series_poisson_ratio: float | None = None,
) -> Rheology:
    """Return a three-element (Jeffreys) solid, a Voigt solid in series with a dashpot: it creeps, and recovers in part.

    Parameters
    ----------
    young_modulus : float
        E, kPa.
    voigt_viscosity, series_viscosity : float
        C1 and C2, kPa s.
    poisson_ratio : float
        Of the spring, and of the dashpots unless they have their own, in (-1, 0.5).
    voigt_poisson_ratio, series_poisson_ratio : float, optional
        Of the dashpots.

    Raises
    ------
    InputError
        A negative or missing modulus or viscosity, or a Poisson ratio outside (-1, 0.5).
    """
    first = poisson_ratio if voigt_poisson_ratio is None else voigt_poisson_ratio
    second = poisson_ratio if series_poisson_ratio is None else series_poisson_ratio
    return Rheology(young_modulus, voigt_viscosity, series_viscosity, poisson_ratio, first, second)


def elastic(young_modulus: float, poisson_ratio: float) -> Rheology:
    """Return a linear elastic solid.

    Parameters
    ----------
    young_modulus : float
        E, kPa.
    poisson_ratio : float
        In (-1, 0.5).
    """
    return three_element(young_modulus, 0.0, np.inf, poisson_ratio)


def voigt(young_modulus: float, viscosity: float, poisson_ratio: float, *, voigt_poisson_ratio: float | None = None) -> Rheology:
    """Return a Kelvin-Voigt solid, which recovers completely.

    Parameters
    ----------
    young_modulus : float
        E, kPa.
    viscosity : float
        C1, kPa s.
    poisson_ratio : float
        Of the spring, and of the dashpot unless it has its own, in (-1, 0.5).
    voigt_poisson_ratio : float, optional
        Of the dashpot.
    """
    return three_element(young_modulus, viscosity, np.inf, poisson_ratio, voigt_poisson_ratio=voigt_poisson_ratio)


def maxwell(young_modulus: float, viscosity: float, poisson_ratio: float, *, series_poisson_ratio: float | None = None) -> Rheology:
    """Return a Maxwell solid, which flows under any load.

    Parameters
    ----------
    young_modulus : float
        E, kPa.
    viscosity : float
        C2, kPa s.
    poisson_ratio : float
        Of the spring, and of the dashpot unless it has its own, in (-1, 0.5).
    series_poisson_ratio : float, optional
        Of the dashpot.
    """
    return three_element(young_modulus, 0.0, viscosity, poisson_ratio, series_poisson_ratio=series_poisson_ratio)


@dataclass(frozen=True, slots=True, eq=False)
class CellRheology:
    """The three elements of every cell, split into their lambda (column 0) and mu (column 1) parts.

    Attributes
    ----------
    elastic : ndarray, shape (m, 2)
        lambda and mu of the spring, kPa.
    voigt, series : ndarray, shape (m, 2)
        lambda and mu parts of C1 and C2, kPa s; `series` is infinite where there is no permanent flow.
    """

    elastic: FloatArray
    voigt: FloatArray
    series: FloatArray

    @classmethod
    def of(cls, n_cells: int, materials: Rheology | CellRheology) -> CellRheology:
        """Return the table of one material for all cells, or a given table of the right length.

        Raises
        ------
        InputError
            A table for another number of cells.
        """
        if isinstance(materials, CellRheology):
            if len(materials.elastic) != n_cells:
                raise InputError(f"materials are for {len(materials.elastic)} cells, the body has {n_cells}")
            return materials
        m = materials
        return cls.from_arrays(
            n_cells, m.young_modulus, m.voigt_viscosity, m.series_viscosity, m.poisson_ratio, m.voigt_poisson_ratio, m.series_poisson_ratio
        )

    @classmethod
    def from_arrays(
        cls,
        n_cells: int,
        young_modulus: ArrayLike,
        voigt_viscosity: ArrayLike,
        series_viscosity: ArrayLike,
        poisson_ratio: ArrayLike,
        voigt_poisson_ratio: ArrayLike | None = None,
        series_poisson_ratio: ArrayLike | None = None,
    ) -> CellRheology:
        """Return the table of one number or one a cell each, in the units of `Rheology`; by default all Poisson ratios are the spring's.

        Raises
        ------
        InputError
            A value outside its range; the message names the first cell.
        """
        e, first = per_cell(young_modulus, n_cells, "young_modulus"), per_cell(voigt_viscosity, n_cells, "voigt_viscosity")
        second = np.asarray(series_viscosity, dtype=float)
        flows = ~np.isposinf(np.broadcast_to(second, (n_cells,))) if second.shape in ((), (n_cells,)) else np.ones(n_cells, dtype=bool)
        finite = per_cell(np.where(np.isposinf(second), 1.0, second), n_cells, "series_viscosity")
        nu = per_cell(poisson_ratio, n_cells, "poisson_ratio")
        nu_1 = nu if voigt_poisson_ratio is None else per_cell(voigt_poisson_ratio, n_cells, "voigt_poisson_ratio")
        nu_2 = nu if series_poisson_ratio is None else per_cell(series_poisson_ratio, n_cells, "series_poisson_ratio")
        _require(e >= 0.0, "Young's modulus must not be negative", e, "kPa")
        _require(first >= 0.0, "the Voigt viscosity C1 must not be negative", first, "kPa s")
        _require(finite > 0.0, "the series viscosity C2 must be positive, or infinite without permanent flow", finite, "kPa s")
        _require((e > 0.0) | (first > 0.0), "a solid needs a Young's modulus or a Voigt viscosity; both are zero", e, "kPa")
        for values in (nu, nu_1, nu_2):
            _require((values > -1.0) & (values < 0.5), "Poisson's ratio must lie in (-1, 0.5), 0.499 if nearly incompressible", values, "")
        same = (nu == nu_1) & ((nu == nu_2) | ~flows)
        lowest = np.minimum(np.minimum(nu, nu_1), np.where(flows, nu_2, 0.0))
        _require((lowest >= 0.0) | same, "a negative Poisson ratio is stable only if all three are equal", lowest, "")
        series = np.where(flows[:, None], _lame(finite, nu_2), np.inf)
        return cls(_lame(e, nu), _lame(first, nu_1), series)

    @property
    def viscosity_ratio(self) -> FloatArray:
        """Fraction ``r = C2 / (C1 + C2)`` (m, 2) of an instantaneous strain taken by the Voigt part; 0 where both viscosities are zero."""
        with np.errstate(invalid="ignore"):
            ratio = self.series / (self.voigt + self.series)
        return np.where(np.isposinf(self.series), 1.0, np.where(self.voigt + self.series == 0.0, 0.0, ratio))

    @property
    def dashpot(self) -> FloatArray:
        """``Cbar = C1 C2 / (C1 + C2)`` (m, 2), kPa s: instantaneous viscosity."""
        return np.asarray(self.voigt * self.viscosity_ratio)

    @property
    def spring(self) -> FloatArray:
        """``r E`` (m, 2), kPa: stress per unit strain of the Voigt part."""
        return np.asarray(self.viscosity_ratio * self.elastic)

    @property
    def relaxation_rate(self) -> FloatArray:
        """``1 / tau = E / (C1 + C2)`` (m, 2), 1/s."""
        total = self.voigt + self.series
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(total == 0.0, 0.0, self.elastic / total)

    def over(self, step_s: float) -> StepCoefficients:
        """Return the coefficients of a step of this length, s."""
        x = self.relaxation_rate * step_s
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = np.where(x == 0.0, 1.0, -np.expm1(-x) / x)
        return StepCoefficients(np.exp(-x), self.viscosity_ratio * step_s * mean, self.spring, self.dashpot)

    def flow(self) -> FlowCoefficients:
        """Return the coefficients of the rate equations."""
        one, zero = np.ones_like(self.elastic), np.zeros_like(self.elastic)
        return FlowCoefficients(one, zero, self.spring, self.dashpot, -self.relaxation_rate, self.viscosity_ratio)


@dataclass(frozen=True, slots=True, eq=False)
class FlowCoefficients:
    """Rate equations of the internal strain: ``e1' = viscosity_ratio e' + decay_rate e1``, ``sigma = dashpot e' + spring e1``.

    Attributes
    ----------
    one, zero : ndarray, shape (m, 2)
        Coefficients of a step of zero length.
    spring, dashpot : ndarray, shape (m, 2)
        ``r E``, kPa, and ``Cbar``, kPa s.
    decay_rate : ndarray, shape (m, 2)
        ``-1 / tau``, 1/s.
    viscosity_ratio : ndarray, shape (m, 2)
        ``r``.
    """

    one: FloatArray
    zero: FloatArray
    spring: FloatArray
    dashpot: FloatArray
    decay_rate: FloatArray
    viscosity_ratio: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class StepCoefficients:
    """The exact solution of the internal strain over a step of constant strain rate: ``e1(h) = decay e1(0) + gain e'``.

    Attributes
    ----------
    decay : ndarray, shape (m, 2)
        ``exp(-h / tau)``.
    gain : ndarray, shape (m, 2)
        ``r tau (1 - exp(-h / tau))``, s.
    spring, dashpot : ndarray, shape (m, 2)
        ``r E``, kPa, and ``Cbar``, kPa s: ``sigma = dashpot e' + spring e1``.
    """

    decay: FloatArray
    gain: FloatArray
    spring: FloatArray
    dashpot: FloatArray

    @property
    def effective(self) -> FloatArray:
        """Stress at the end of the step for each unit of strain rate (m, 2), kPa s."""
        return self.dashpot + self.spring * self.gain


def per_region(mesh: Mesh, materials: Mapping[str, Rheology]) -> CellRheology:
    """Return the table of materials of a mesh with one material for each region.

    Parameters
    ----------
    mesh : Mesh
        Mesh with named regions.
    materials : mapping of str to Rheology
        Material of every region, by its name.

    Raises
    ------
    InputError
        A region without a material, or a material whose region does not exist.
    """
    missing = [name for name in mesh.region_names if name not in materials]
    unknown = [name for name in materials if name not in mesh.region_names]
    if missing or unknown:
        raise InputError(f"the mesh has regions {', '.join(mesh.region_names)}; materials are given for {', '.join(materials) or 'none'}")
    tables = [CellRheology.of(1, materials[name]) for name in mesh.region_names]
    stacked = [np.concatenate([getattr(t, part) for t in tables])[mesh.regions] for part in ("elastic", "voigt", "series")]
    return CellRheology(*stacked)


def _lame(modulus: FloatArray, poisson_ratio: FloatArray) -> FloatArray:
    shear = modulus / (2.0 * (1.0 + poisson_ratio))
    return np.stack([2.0 * shear * poisson_ratio / (1.0 - 2.0 * poisson_ratio), shear], axis=1)


def _require(fine: BoolArray, rule: str, values: FloatArray, unit: str) -> None:
    if not fine.all():
        bad = int(np.flatnonzero(~fine)[0])
        raise InputError(f"{rule}: cell {bad} has {values[bad]:g} {unit}".rstrip())
