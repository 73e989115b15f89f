"""Moduli at vanishing element size, from those on a mesh and what cells of half the size change, without what noise adds to that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.field_laws import FieldElements, LawName
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import Concentrated, Linearised, moduli_of, young_and_poisson
from naibu.identification.from_fields.forward.zones_within_cells import RegionAt, moduli_within_cells
from naibu.identification.from_fields.inversion.gauss_newton import Bounds, Objective
from naibu.identification.from_fields.mesh_error import (
    EXTRAPOLATED,
    changes_of_motions,
    changes_on_finer_mesh,
    extrapolated,
    refitted,
)
from naibu.identification.from_fields.surface.noise import SurfaceNoise


@dataclass(frozen=True, slots=True, eq=False)
class SizeCorrection:
    """The best fit at vanishing element size.

    Attributes
    ----------
    theta : ndarray, shape (2 count,)
        ln mu, then ln(kappa / mu) of the zones.
    residuals : tuple of ndarray, shape (q,)
        Whitened, on the finer mesh.
    shift : ndarray, shape (2 count,), or None
        Change of theta; None where it was not estimated.
    alike : bool
        Whether that is one under the law of the identification.
    of_noise : ndarray, shape (2 count, 2 count)
        Covariance that noise in the sought motion of the surface gives to the change; 0 where only that of a part of it is sought, which is
        nearly known.
    told : tuple of str
        What was done, in words.
    """

    theta: FloatArray
    residuals: tuple[FloatArray, ...]
    shift: FloatArray | None
    alike: bool
    of_noise: FloatArray
    told: tuple[str, ...]


def without_size_of_elements(
    at: Linearised,
    quadratic: Concentrated,
    noise: SurfaceNoise,
    law: LawName,
    elements: FieldElements,
    bounds: Bounds,
    region_at: RegionAt | None,
) -> SizeCorrection:
    """Extrapolate the moduli of the best fit `at` to vanishing element size (see `identify_field`)."""
    fitted, model = at.point.theta, at.model

    def moduli_on(mesh: Mesh, zones: Zones) -> tuple[FloatArray, FloatArray]:
        return moduli_of(zones, fitted) if region_at is None else moduli_within_cells(mesh, model.zones, fitted, region_at)

    changes = changes_on_finer_mesh(at, law, moduli_on) if elements == "accurate" else None
    if changes is None:
        as_fitted = tuple(o.residual(u) for o, u in zip(model.observed, at.point.states, strict=True))
        return SizeCorrection(fitted, as_fitted, None, True, np.zeros_like(quadratic.hessian), ())
    told = ["elements of half the size find no equilibrium at finite strain: what they change is taken from small strain"]
    told *= changes[1] != law
    finer, covariance = refitted(at, quadratic, changes[0]), np.zeros_like(quadratic.hessian)
    step = finer.theta + np.linalg.lstsq(quadratic.hessian, quadratic.gradient, rcond=1e-12)[0]  # `at` may not be the best fit
    if model.surface_sought:
        of_noise, covariance = noise.of_change(at, quadratic, changes[0], lambda moved: changes_of_motions(at, moduli_on, moved))
        step = -noise.information.step(-quadratic.hessian @ step) - of_noise
        covariance = EXTRAPOLATED**2 * covariance
    theta = Objective(bounds=bounds).clipped(extrapolated(fitted, step))
    young, before = young_and_poisson(theta)[0], young_and_poisson(fitted)[0]
    most = 100.0 * float(np.abs(young / before - 1.0).max())
    told.append(f"half the element size: Young's modulus changes by up to {most:.2g} % when extrapolated to vanishing size")
    return SizeCorrection(theta, finer.residuals, theta - fitted, changes[1] == law, covariance, tuple(told))
