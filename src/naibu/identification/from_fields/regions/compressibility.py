"""Poisson's ratio while regions are sought."""

from __future__ import annotations

from dataclasses import replace

from naibu.core.arrays import FloatArray
from naibu.identification.from_fields.forward.sensitivities import FieldModel, young_and_poisson
from naibu.identification.from_fields.inversion.gauss_newton import Bounds

NARROWEST = 1e-3  # width of the bounds of Poisson's ratio


def no_less_compressible(model: FieldModel, theta: FloatArray, bounds: Bounds) -> Bounds:
    """Return bounds for a search of regions: where the surface is sought, Poisson's ratio no greater than where the search begins.

    Noise that the motion of the surface follows draws Poisson's ratio of the whole body towards 0.5, in ever smaller steps, and by more of
    the misfit than a region costs: how far it had come when a search ended would tell which regions there are.

    Parameters
    ----------
    model : FieldModel
        Load cases.
    theta : ndarray, shape (2 count,)
        Logarithms of moduli where the search begins, of any zones.
    bounds : Bounds
        Of the moduli.
    """
    if not model.surface_sought:
        return bounds
    least, most = bounds.poisson_ratio
    greatest = float(young_and_poisson(theta)[1].max())
    return replace(bounds, poisson_ratio=(least, min(most, max(greatest, least + NARROWEST))))
