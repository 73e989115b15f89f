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
from naibu.identification.from_fields.forward.sensitivities import Concentrated, Linearised, moduli_of, modulus_columns
from naibu.identification.from_fields.mesh_error import refitted

# part of the bias that is reckoned with as a standard deviation after it was taken off: to first order, and from a biased motion
LEFT = 0.5
PROBES = 32  # vectors of random signs that estimate the trace: to a few per cent of the slope
SMALL_STRAIN = 1e-4  # of the derivative of the tangent


def bias_of_surface(at: Linearised, quadratic: Concentrated, variance: float) -> tuple[FloatArray, FloatArray]:
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
    """
    explained = [-o.residual(u) for o, u in zip(at.model.observed, at.point.states, strict=True)]
    sd = np.sqrt(np.abs(np.diag(np.linalg.pinv(quadratic.hessian))))
    of_prior = refitted(at, quadratic, explained).theta
    of_noise = np.linalg.lstsq(quadratic.hessian, 0.5 * min(variance, 1.0) * slope_of_informed(at), rcond=1e-12)[0]
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
            out -= _tangent_columns(at, t, moved[t][:, k]).T @ answers[t][:, (k + PROBES) % (2 * PROBES)]
    return out / PROBES


def _tangent_columns(at: Linearised, t: int, direction: FloatArray) -> FloatArray:
    """Return what a relative change of every modulus adds to the forces (n d, 2 count) of a small displacement (n d,) about the state."""
    model, state = at.model, at.point.states[t]
    lame, shear = moduli_of(model.zones, at.point.theta)
    extent = float(np.ptp(model.points, axis=0).max())
    step = SMALL_STRAIN * extent / max(float(np.abs(direction).max()), 1e-300) * direction.reshape(state.shape)
    ahead, behind = (modulus_columns(model.law, model.zones, lame, shear, state + side * step) for side in (1.0, -1.0))
    scale = float(np.abs(step).max()) / max(float(np.abs(direction).max()), 1e-300)
    return np.asarray((ahead - behind).toarray() / (2.0 * scale))
