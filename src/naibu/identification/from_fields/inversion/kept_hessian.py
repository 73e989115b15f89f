"""Steps of few moduli with a Hessian from near by: quasi-Newton (BFGS, :cite:p:`nocedal2006`) that starts from a Gauss-Newton Hessian.

A Hessian takes solutions for every modulus, a gradient those for one. Regions that are tried one after the other have nearly one Hessian.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.from_fields.forward.loaded_components import ROUGH_TOLERANCE
from naibu.identification.from_fields.forward.sensitivities import Concentrated, Linearised
from naibu.identification.from_fields.inversion.gauss_newton import Objective, Step, step_of

REACH = 0.3  # of a logarithm of a modulus: as far as a Hessian serves; sensitivities of a lump change by about as much as its modulus
SLOW = 0.5  # length of a step over that of the one before, both in standard deviations, from which the Hessian is made anew
DAMPED = 0.2  # least curvature along a step over that of the Hessian before, as in Powell's damping


class KeptHessian:
    """A rule of steps for `naibu.identification.from_fields.inversion.gauss_newton.search` that keeps its Hessian while that serves.

    It is made anew where a modulus is further than `REACH` from where it was made, where steps shorten slowly, and where the search asks.

    Parameters
    ----------
    theta : ndarray, shape (2 count,), optional
        Where a first Hessian was made.
    data : Concentrated, optional
        Half the misfit as a quadratic about there, in all moduli.
    """

    def __init__(self, theta: FloatArray | None = None, data: Concentrated | None = None) -> None:
        self._made, self._data = theta, data
        self._before: tuple[FloatArray, FloatArray, float] | None = None  # moduli, gradient and length of the step before

    def __call__(self, at: Linearised, objective: Objective, near: list[FloatArray] | None = None) -> Step:
        """Return the step at a linearisation."""
        theta = at.point.theta
        if self._data is None or self._made is None or np.abs(theta - self._made).max() > REACH:
            return self.renewed(at, objective, near)
        gradient, offset = gradient_of_moduli(at)
        hessian, length = self._data.hessian, np.inf
        if self._before is not None:
            moduli, slope, length = self._before
            hessian = updated(hessian, theta - moduli, gradient - slope)
        self._data = replace(self._data, hessian=hessian, gradient=gradient, offset=offset)
        step = step_of(at, objective, self._data)
        if step.standard_deviations > SLOW * length:
            return self.renewed(at, objective, self._data.response)
        self._before = theta, gradient, step.standard_deviations
        return replace(step, renewed=self.renewed)

    def renewed(self, at: Linearised, objective: Objective, near: list[FloatArray] | None = None) -> Step:
        """Return the step with a Hessian made at this point."""
        response = near if near is not None or self._data is None else self._data.response
        self._made = at.point.theta
        self._data = at.concentrated(np.eye(len(self._made)), ROUGH_TOLERANCE, response)
        step = step_of(at, objective, self._data)
        self._before = self._made, self._data.gradient, step.standard_deviations
        return step


def gradient_of_moduli(at: Linearised) -> tuple[FloatArray, list[FloatArray]]:
    """Return the gradient (2 count,) of half the misfit, minimised over the loaded components, and how far these are from there (n_b,)."""
    of_moduli, of_loaded = at.gradient()
    offset = at.loaded_solved([g[:, None] for g in of_loaded])
    cross, _ = at.product(np.zeros((len(of_moduli), 1)), offset)
    return of_moduli - cross[:, 0], [x[:, 0] for x in offset]


def updated(hessian: FloatArray, step: FloatArray, change: FloatArray) -> FloatArray:
    """Return the Hessian (k, k) by which a gradient changes by `change` (k,) along a `step` (k,), as near to one before as that can be.

    What would leave it indefinite is mixed with what the Hessian before expects.
    """
    expected = hessian @ step
    before, now = float(step @ expected), float(step @ change)
    if not before > 0.0:
        return hessian
    if now < DAMPED * before:
        part = (1.0 - DAMPED) * before / (before - now)
        change = part * change + (1.0 - part) * expected
        now = DAMPED * before
    return hessian - np.outer(expected, expected) / before + np.outer(change, change) / now
