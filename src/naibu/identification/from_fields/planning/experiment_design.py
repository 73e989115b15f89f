"""Optimal experiment design: expected covariance (Cramer-Rao bound) and systematic error of a planned experiment (:cite:p:`kay1993`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.field_laws import FieldElements, LawName
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel, logarithms, young_and_poisson
from naibu.identification.from_fields.inversion.gauss_newton import Objective, SearchSettings, first_point, search
from naibu.identification.from_fields.uncertainty import Uncertainty, information_at
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters

_TO_THE_END = SearchSettings(max_iterations=40, tolerance=1e-10)


@dataclass(frozen=True, slots=True, eq=False)
class Accuracy:
    """Expected accuracy of the moduli of all zones in a planned experiment.

    Attributes
    ----------
    names : tuple of str
        The zones.
    young_modulus_sd : ndarray, shape (k,)
        Relative standard deviation of Young's modulus.
    poisson_ratio_sd : ndarray, shape (k,)
        Standard deviation of Poisson's ratio.
    young_modulus_bias, poisson_ratio_bias : ndarray, shape (k,)
        Systematic error without noise: relative error of Young's modulus, and error of Poisson's ratio.
    """

    names: tuple[str, ...]
    young_modulus_sd: FloatArray
    poisson_ratio_sd: FloatArray
    young_modulus_bias: FloatArray
    poisson_ratio_bias: FloatArray

    @property
    def young_modulus_error(self) -> FloatArray:
        """Expected root mean square relative error (k,) of Young's modulus: noise and systematic error together."""
        return np.hypot(self.young_modulus_sd, self.young_modulus_bias)

    @property
    def poisson_ratio_error(self) -> FloatArray:
        """Expected root mean square error (k,) of Poisson's ratio."""
        return np.hypot(self.poisson_ratio_sd, self.poisson_ratio_bias)


def expected_accuracy(
    mesh: Mesh,
    load_cases: Sequence[FieldLoadCase],
    zones: Zones,
    *,
    young_modulus: ArrayLike,
    poisson_ratio: ArrayLike,
    law: LawName = "linear",
    elements: FieldElements = "accurate",
) -> Accuracy:
    """Return the accuracy with which FEMU will identify the moduli of the zones.

    The covariance is the inverse of the Fisher information (the Cramer-Rao bound) at the true moduli, the unknown displacement of the
    loaded nodes estimated along with them. The systematic error is what matching finds in the load cases' fields as they are, which should
    be simulated without noise, best on a finer mesh than `mesh`; fields simulated on `mesh` itself have none.

    Parameters
    ----------
    mesh : Mesh
        On which the moduli will be sought.
    load_cases : sequence of FieldLoadCase
        Planned pushes with simulated fields without noise, whose covariance is that of the measurement to come.
    zones : Zones
        What is known and what is sought.
    young_modulus, poisson_ratio : array_like, shape (k,)
        True moduli of the zones, kPa.
    law : {"linear", "neo_hookean"}
        Law of the material.
    elements : {"accurate", "as_given"}
        As for `identify_field`.

    Raises
    ------
    InputError
        Fields without noise, another number of moduli than of zones, or an experiment that leaves a modulus undetermined.
    """
    young, poisson = np.asarray(young_modulus, dtype=float), np.asarray(poisson_ratio, dtype=float)
    if young.shape != (zones.count,) or poisson.shape != (zones.count,):
        raise InputError(f"give Young's modulus and Poisson's ratio of the {zones.count} zones, not {young.shape} and {poisson.shape}")
    for load_case in load_cases:
        sd = load_case.field.standard_deviation
        if sd is None or not (sd[load_case.field.valid] > 0.0).all():
            raise InputError(f"load case {load_case.name!r}: a planned measurement needs the standard deviation it will have, sd_mm > 0")
    lame, shear = np.array([lame_parameters(e, nu) for e, nu in zip(young, poisson, strict=True)]).T
    model = FieldModel(mesh, load_cases, zones, law, elements)
    truth = logarithms(lame, shear)
    start = first_point(model, truth)
    found = Uncertainty.of(information_at(model, start))
    for zone, sd in zip(zones.names, found.standard_deviations().reshape(2, -1).T, strict=True):
        if not np.isfinite(sd).all():
            raise InputError(f"the experiment does not determine the moduli of {zone!r}: measure or push more")
    of_young, of_poisson = found.of_young_and_poisson(truth)
    e, nu = young_and_poisson(search(model, start, Objective(), _TO_THE_END).point.theta)
    return Accuracy(zones.names, of_young, of_poisson, e / young - 1.0, nu - poisson)
