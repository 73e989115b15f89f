"""Moduli found from measured displacement fields, with their uncertainty and how they were found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.status import Status
from naibu.identification.from_fields.assumptions.free_law import FreeLaw
from naibu.identification.from_fields.assumptions.other_assumptions import Assumption
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import moduli_of, young_and_poisson
from naibu.identification.from_fields.inversion.regularization_weight import WeightChoice
from naibu.identification.from_fields.regions.borders import Borders
from naibu.identification.from_fields.regions.segmentation import Segmentation
from naibu.identification.from_fields.uncertainty import ErrorBudget, Uncertainty, intervals
from naibu.identification.from_fields.verdicts.within_cells import DETERMINED, ROUGHLY
from naibu.identification.verdict import Verdict


@dataclass(frozen=True, slots=True, eq=False)
class FieldEstimate:
    """Moduli found from measured fields.

    Attributes
    ----------
    mesh : Mesh
        The model.
    zones : Zones
        Zones of the result: those given, or the regions that were found.
    theta : ndarray, shape (2 count,)
        ln mu, then ln(kappa / mu) of the zones; kPa.
    states : tuple of ndarray, shape (n, d)
        Displacement of every load case in the fit on `mesh`, mm.
    chi_squared, degrees_of_freedom : float
        Misfit in units of the stated noise, and what noise alone would leave on average.
    uncertainty : Uncertainty or None
        Of theta: of the measurement, of the discretisation and of what is known; None where zones are too many to invert.
    weights : WeightChoice or None
        The weights of the penalty that were tried.
    regularized : tuple of ndarray, shape (count of the given zones,), or None
        Young's modulus, kPa, and Poisson's ratio under the penalty, before regions were made of them.
    resolution : ndarray, shape (2 count of the given zones,), or None
        See `naibu.identification.from_fields.uncertainty.resolution`.
    segmentation : Segmentation or None
        The regions, also where they were not taken as the result.
    status : Status
        How the last search ended.
    steps : tuple of str
        What was done, a sentence a step.
    identifiability : tuple of str
        Which moduli the measurements determine, in words.
    verdict : Verdict or None
        Whether the model explains the measurements.
    budget : ErrorBudget or None
        Where the uncertainty stems from.
    mesh_shift : ndarray, shape (2 count,), or None
        What extrapolation to vanishing element size added to the best theta on `mesh`; None where that error was not estimated.
    assumptions : tuple of Assumption
        What other moduli of the known regions, or another law, would do.
    borders : Borders or None
        Borders of regions that were found, which run through cells; None where regions are made of whole cells.
    parts : ndarray, shape (m, count), or None
        With such borders: part of every cell in each region, by which logarithms of moduli are mixed.
    surface_bias : ndarray, shape (2 count,), or None
        What the motion of the surface, its weak prior and the noise had added to theta, and was taken off (see `surface.bias`).
    free_law : FreeLaw or None
        What moduli are with the shape of the law sought as well; None where strains are small, or no equilibrium was found.
    """

    mesh: Mesh
    zones: Zones
    theta: FloatArray
    states: tuple[FloatArray, ...]
    chi_squared: float
    degrees_of_freedom: float
    uncertainty: Uncertainty | None
    weights: WeightChoice | None
    regularized: tuple[FloatArray, FloatArray] | None
    resolution: FloatArray | None
    segmentation: Segmentation | None
    status: Status
    steps: tuple[str, ...]
    identifiability: tuple[str, ...]
    verdict: Verdict | None = None
    budget: ErrorBudget | None = None
    mesh_shift: FloatArray | None = None
    assumptions: tuple[Assumption, ...] = ()
    borders: Borders | None = None
    parts: FloatArray | None = None
    surface_bias: FloatArray | None = None
    free_law: FreeLaw | None = None

    @property
    def young_modulus(self) -> FloatArray:
        """Young's modulus of every zone (count,), kPa."""
        return young_and_poisson(self.theta)[0]

    @property
    def poisson_ratio(self) -> FloatArray:
        """Poisson's ratio of every zone (count,)."""
        return young_and_poisson(self.theta)[1]

    def lame_of_cells(self) -> tuple[FloatArray, FloatArray]:
        """Return lambda and mu of every cell (m,), kPa, known ones included."""
        return moduli_of(self.zones, self.theta)

    def intervals(self, level: float = 0.95, *, law_exact: bool = False) -> tuple[FloatArray, FloatArray]:
        """Return the bounds of Young's modulus (count, 2), kPa, and of Poisson's ratio (count, 2) at a level of confidence.

        They hold other forms of the law; with `law_exact` those that hold if the material obeys the law that was assumed.

        Raises
        ------
        InputError
            The estimate has no covariance.
        """
        if self.uncertainty is None:
            raise InputError("a field of many moduli under a penalty has no intervals; see its `resolution`, or use regions")
        return intervals(self.theta, self.uncertainty.if_law_exact if law_exact else self.uncertainty, level)

    @property
    def limited_by_mesh(self) -> bool:
        """Whether the size of elements leaves more in doubt of a shear modulus that the measurement determines than that does."""
        if self.budget is None or self.uncertainty is None:
            return False
        k = self.zones.count
        noise, mesh = self.budget.noise[:k], self.budget.mesh[:k]
        return bool(((mesh > np.maximum(noise, ROUGHLY)) & (noise < DETERMINED)).any())

    @property
    def noise_factor(self) -> float:
        """Root mean square misfit in units of the stated noise: above 1 the model or the noise is not as stated."""
        return float(np.sqrt(self.chi_squared / max(self.degrees_of_freedom, 1.0)))
