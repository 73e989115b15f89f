"""Bias that the weak prior on the motion of loaded nodes gives to moduli, found to first order and taken off.

The prior expects no strain along the surface. What it takes off the strain there, where measurements are few, the moduli make up for:
Poisson's ratio comes out too large. As with other penalised estimates, the bias is what the estimator does to data that the model at the
estimate explains exactly.
"""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.from_fields.forward.sensitivities import Concentrated, Linearised
from naibu.identification.from_fields.mesh_error import refitted

# part of the bias that is reckoned with as a standard deviation after it was taken off: to first order, and from a biased motion
LEFT = 0.5


def bias_of_prior(at: Linearised, quadratic: Concentrated) -> tuple[FloatArray, FloatArray]:
    """Return the bias (2 count,) of the logarithms of the moduli that fit best, and the covariance (2 count, 2 count) of what is left.

    No more is taken off than one standard deviation of the measurement: a larger bias is not one of first order.

    Parameters
    ----------
    at : Linearised
        The best fit.
    quadratic : Concentrated
        Of all logarithms there.
    """
    explained = [-o.residual(u) for o, u in zip(at.model.observed, at.point.states, strict=True)]
    sd = np.sqrt(np.abs(np.diag(np.linalg.pinv(quadratic.hessian))))
    bias = np.clip(refitted(at, quadratic, explained).theta, -sd, sd)
    return bias, np.outer(LEFT * bias, LEFT * bias)
