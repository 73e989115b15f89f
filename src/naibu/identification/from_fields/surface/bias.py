"""Bias that the sought motion of loaded nodes gives to moduli, and the moduli without it.

It has two parts. The weak prior expects no strain along the surface: what it takes off the strain there, where measurements are few, the
moduli make up for, and Poisson's ratio comes out too large. As with other penalised estimates, this part is what the estimator does to data
that the model at the estimate explains exactly.

The second is that of noise. The motion of the surface follows the noise, the more so the softer and the less compressible the body is, so
that these moduli leave less of the noise unexplained. For noise n of unit variance the expectation of the least objective is half the trace
of ``I - A (A' A + L)^-1 A'`` above that of exact data, where A leads from the motion of the surface to the measurements and L is the prior.
That trace is the number of measurements less the number of components that they, rather than the prior, determine. With half of that
number added the score has no bias, as corrected scores of measurement error models (:cite:p:`nakamura1990`).

The moduli without bias are where that corrected score vanishes. A step from the best fit finds them only where it is short: with few points
the best fit is far on the side of soft, incompressible bodies, where measurements tell less, and the step is several times too long.

Combinations of moduli without bounds, as all moduli next to a known zone so stiff that it is rigid, keep the best fit's values. Where a
step leads to moduli of which fewer combinations have bounds, it is not made, and what the bias is there remains part of the intervals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import ConvergenceError
from naibu.identification.from_fields.forward.sensitivities import Concentrated, FieldModel, Linearised, Point
from naibu.identification.from_fields.inversion.gauss_newton import LONGEST_STEP, Objective
from naibu.identification.from_fields.inversion.told_combinations import told
from naibu.identification.from_fields.mesh_error import change_of_fit
from naibu.identification.from_fields.surface.noise import CorrectedInformation, works_of_moduli

# part of the bias that is reckoned with as a standard deviation after it was taken off: to first order, and from a biased motion
LEFT = 0.5
PROBES = 32  # vectors of random signs that estimate the trace: to a few per cent of the slope
SHORT = 0.25  # standard deviations of a logarithm: of a step after which derivatives are as before it
MOST_STEPS = 5
SHORTEST = 0.2  # part of a step below which a body of finite strain that cannot follow it is left where it is


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedScore:
    """Moduli, the quadratic there, and the score without bias.

    Attributes
    ----------
    at : Linearised
        Moduli and motion.
    quadratic : Concentrated
        Of all logarithms there.
    value : ndarray, shape (2 count,)
        Gradient of the objective, the motion of the surface eliminated, without what its prior and the noise add to it in the mean.
    free : ndarray, shape (2 count,), bool
        Logarithms inside of their bounds, or that it leads back from there. Others are held.
    """

    at: Linearised
    quadratic: Concentrated
    value: FloatArray
    free: BoolArray

    @classmethod
    def of(cls, at: Linearised, quadratic: Concentrated, variance: float, objective: Objective | None = None) -> CorrectedScore:
        """Find it; `variance` is that of the residuals over that stated: beyond 1 it may be that of errors of the model, not of noise."""
        explained = [-o.residual(u) for o, u in zip(at.model.observed, at.point.states, strict=True)]
        of_prior = quadratic.hessian @ change_of_fit(at, quadratic, explained)
        value = of_prior + 0.5 * min(variance, 1.0) * slope_of_informed(at)
        return cls(at, quadratic, value, (objective or Objective()).free(at.point.theta, value))

    @property
    def step(self) -> FloatArray:
        """Change (2 count,) of the logarithms that would make it vanish, by no more than a standard deviation of each or `LONGEST_STEP`."""
        values, vectors = self._told
        sd = self._standard_deviations
        step = np.clip(-vectors @ ((vectors.T @ self.value[self.free]) / values), -sd, sd)
        return self._all(step * min(1.0, LONGEST_STEP / max(float(np.abs(step).max(initial=0.0)), 1e-300)))

    @property
    def is_short(self) -> bool:
        """Whether derivatives after that step are about those before it."""
        return bool((np.abs(self.step[self.free]) <= SHORT * self._standard_deviations).all())

    @property
    def determined(self) -> int:
        """Number of combinations of free logarithms that have bounds."""
        return len(self._told[0])

    @property
    def _told(self) -> tuple[FloatArray, FloatArray]:
        return told(self._hessian)

    @property
    def _standard_deviations(self) -> FloatArray:
        values, vectors = self._told
        return np.asarray(np.sqrt((vectors**2 / values).sum(axis=1)))

    @property
    def _hessian(self) -> FloatArray:
        return self.quadratic.hessian[np.ix_(self.free, self.free)]

    def left(self, information: CorrectedInformation) -> FloatArray:
        """Return the bias (2 count,) that moduli still have, by the information without that of noise; one standard deviation at most."""
        sd = np.sqrt(np.abs(np.diag(np.linalg.pinv(information.matrix))))
        return np.where(self.free, np.clip(information.step(np.where(self.free, self.value, 0.0)), -sd, sd), 0.0)

    def _all(self, of_free: FloatArray) -> FloatArray:
        out = np.zeros(len(self.free))
        out[self.free] = of_free
        return out


def without_bias(model: FieldModel, best: Point, objective: Objective, variance: float) -> CorrectedScore:
    """Return where the score without bias vanishes but for a short step, from the best fit, which must be the model's last evaluation.

    Parameters
    ----------
    model : FieldModel
        Load cases and zones.
    best : Point
        The best fit.
    objective : Objective
        For its bounds.
    variance : float
        Of the residuals over that stated.
    """
    at = model.linearised(best)
    quadratic = at.concentrated(np.eye(2 * model.zones.count))
    low, high = objective.bounds.box(model.zones.count)
    bounded = (best.theta <= low) | (best.theta >= high)
    quadratic = replace(quadratic, gradient=np.where(bounded, quadratic.gradient, 0.0))  # elsewhere there is none but for rounding
    score = CorrectedScore.of(at, quadratic, variance, objective)
    for _ in range(MOST_STEPS):
        if score.is_short:
            break
        here = score.at.point
        step = objective.clipped(here.theta + score.step) - here.theta
        motion = score.at.forward(step[:, None], [b[:, None] for b in score.quadratic.loaded(step)])
        further, new = moved(model, here, step, [u[:, 0] for u in motion]), None
        if further is not None:
            at = model.linearised(further)
            new = CorrectedScore.of(at, at.concentrated(np.eye(2 * model.zones.count)), variance, objective)
        if new is None or new.determined < score.determined:
            return replace(score, at=model.linearised(model.evaluate(here.theta, here.states)))
        score = new
    return score


def motions_along(at: Linearised, quadratic: Concentrated, steps: FloatArray) -> list[FloatArray]:
    """Return the displacement (n d, r), mm, of every load case that goes with steps (2 count, r), the motion of loaded nodes following."""
    return at.forward(steps, [-(x @ steps) for x in quadratic.response])


def moved(model: FieldModel, start: Point, step: FloatArray, motion: list[FloatArray]) -> Point | None:
    """Return the point a step (2 count,) and its motion (n d,) further, less far where a body cannot follow; None if it cannot at all."""
    part = 1.0
    while part >= SHORTEST:
        guesses = [u + part * du.reshape(u.shape) for u, du in zip(start.states, motion, strict=True)]
        try:
            return model.evaluate(start.theta + part * step, guesses)
        except ConvergenceError:
            part *= 0.5
    return None


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
        out -= works_of_moduli(at, t, moved[t], np.roll(answers[t], PROBES, axis=1))
    return out / PROBES
