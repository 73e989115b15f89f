"""Combinations of moduli that data tell, apart from those of which they tell nothing."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray

UNBOUNDED = 1e3  # a factor between estimate and bound beyond which the data give no bound
LEAST_INFORMATION = (1.96 / np.log(UNBOUNDED)) ** 2  # on a combination of logarithms, below which its 95 % interval has no bounds


def told(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return eigenvalues (r,) and eigenvectors (k, r) of information (k, k) on logarithms, but for combinations that have no bounds.

    Along those, gradients are divided by next to nothing: such a step leads to moduli of no meaning, beyond all that can be computed with.
    """
    values, vectors = np.linalg.eigh(information)
    kept = values > LEAST_INFORMATION
    return values[kept], vectors[:, kept]


def bounded_covariance(information: FloatArray) -> FloatArray:
    """Return the inverse of information (k, k) on logarithms, which rounding may leave below 0, as if it gave bounds at least."""
    values, vectors = np.linalg.eigh(information)
    return np.asarray(vectors / np.maximum(values, LEAST_INFORMATION) @ vectors.T)
