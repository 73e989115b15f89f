"""Bias that the sought motion of loaded nodes gives to moduli, found to first order and taken off.

It has two parts. The weak prior expects no strain along the surface: what it takes off the strain there, where measurements are few, the
moduli make up for, and Poisson's ratio comes out too large. As with other penalised estimates, this part is what the estimator does to data
that the model at the estimate explains exactly.

The second is that of noise. The motion of the surface follows the noise, the more so the softer and the less compressible the body is, so
that these moduli leave less of the noise unexplained. For noise n of unit variance the expectation of the least objective is half the trace
of ``I - A (A' A + L)^-1 A'`` above that of exact data, where A leads from the motion of the surface to the measurements and L is the prior.
That trace is the number of measurements less the number of components that they, rather than the prior, determine. With half of that
number added the score has no bias, as corrected scores of measurement error models (:cite:p:`nakamura1990`).
"""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.from_fields.forward.sensitivities import Concentrated, Linearised
from naibu.identification.from_fields.mesh_error import refitted
from naibu.identification.from_fields.surface_noise import CorrectedInformation, tangent_columns

# part of the bias that is reckoned with as a standard deviation after it was taken off: to first order, and from a biased motion
LEFT = 0.5
PROBES = 32  # vectors of random signs that estimate the trace: to a few per cent of the slope


def bias_of_surface(
    at: Linearised, quadratic: Concentrated, variance: float, information: CorrectedInformation
) -> tuple[FloatArray, FloatArray]:
    """Return the bias (2 count,) of the logarithms of the moduli that fit best, and the covariance (2 count, 2 count) of what is left.

    No more is taken off than one standard deviation of the measurement: a larger bias is not one of first order.

    Parameters
    ----------
    at : Linearised
        The best fit.
    quadratic : Concentrated
        Of all logarithms there.
    variance : float
        Of the residuals over that stated; beyond 1 it may be that of errors of the model, which are not taken for noise here.
    information : CorrectedInformation
        On all logarithms, without that of noise.
    """
    explained = [-o.residual(u) for o, u in zip(at.model.observed, at.point.states, strict=True)]
    sd = np.sqrt(np.abs(np.diag(np.linalg.pinv(information.matrix))))
    of_prior = refitted(at, quadratic, explained).theta
    of_noise = information.step(0.5 * min(variance, 1.0) * slope_of_informed(at))
    bias = np.clip(of_prior + of_noise, -sd, sd)
    return bias, np.outer(LEFT * bias, LEFT * bias)


def slope_of_informed(at: Linearised) -> FloatArray:
    """Return the derivative (2 count,) of the number of loaded components that the measurements determine, by random signs.

    That number is ``n_b - tr((A' A + L)^-1 L)``; its derivative, ``tr(G^-1 d(A' A) G^-1 L)`` with G = A' A + L, is estimated as
    the mean of ``y' d(A' A) w`` with ``y = G^-1 z`` and ``w = G^-1 L z`` (:cite:p:`bekas2007`). What moduli change of the state
    about which the body is linearised is left out.
    """
    observed, rng = at.model.observed, np.random.default_rng(0)
    signs = [rng.choice([-1.0, 1.0], size=(len(o.unknown), PROBES)) for o in observed]
    right = [np.hstack([z, o.prior @ z]) for o, z in zip(observed, signs, strict=True)]
    moved = at.forward(None, at.loaded_solved(right))
    pulled = [o.operator.T @ (o.operator @ v) for o, v in zip(observed, moved, strict=True)]
    for o, pull in zip(observed, pulled, strict=True):
        pull[o.loaded] = 0.0
    answers = at.solved(pulled)
    out = np.zeros(2 * at.model.zones.count)
    for t, o in enumerate(observed):
        answers[t][o.loaded] = 0.0
        for k in range(2 * PROBES):
            out -= tangent_columns(at, t, moved[t][:, k]).T @ answers[t][:, (k + PROBES) % (2 * PROBES)]
    return out / PROBES
