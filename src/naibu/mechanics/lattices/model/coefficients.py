"""Coefficients of three-element (Jeffreys) elements for explicit and implicit steps :cite:p:`hirai2008` (chapter 4.3)."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.mechanics.lattices.model.lattice import LatticeParameters


def explicit_coefficients(parameters: LatticeParameters) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, D, G of every element: tension ``A l' + B y`` and ``y' = D l' - G y`` of the extension y = Z - a L."""
    k, c1, c2 = parameters.stiffness, parameters.voigt_damping, parameters.series_damping
    fraction = series_fraction(parameters)
    return c1 * fraction, k * fraction, fraction, k / (c1 + c2)


def series_fraction(parameters: LatticeParameters) -> FloatArray:
    """Return C2 / (C1 + C2) of every element, also where C2 is infinite."""
    return 1.0 / (1.0 + parameters.voigt_damping / parameters.series_damping)


def implicit_coefficients(parameters: LatticeParameters, step: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return a, b, E, g of every element for a step in s.

    While the length changes evenly by dl, ``y1 = E y0 + g dl`` is exact and the mean tension is ``a dl + b y0``; all are finite and not
    negative for every K, C1 >= 0 and C2 > 0.
    """
    k, c1, c2 = parameters.stiffness, parameters.voigt_damping, parameters.series_damping
    fraction = series_fraction(parameters)
    x = k * step / (c1 + c2)
    decay = np.exp(-x)
    first, second = _exponential_means(x)
    return (c1 * fraction + fraction**2 * k * step * second) / step, k * fraction * first, decay, fraction * first


def _exponential_means(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (1 - exp(-x)) / x and (1 - that) / x without cancellation, 1 and 1/2 at 0."""
    small = x < 0.1  # the series of eight terms is exact to the last place below
    safe = np.where(small, 1.0, x)
    first = -np.expm1(-safe) / safe
    second = (1.0 - first) / safe
    series_first, series_second, term = np.zeros_like(x), np.zeros_like(x), np.ones_like(x)
    for n in range(1, 11):  # term = (-x)^(n-1) / n!
        term = term / n
        series_first += term
        series_second += term / (n + 1)
        term = -term * np.where(small, x, 0.0)
    return np.where(small, series_first, first), np.where(small, series_second, second)
