"""Generalized-alpha method :cite:p:`chung1993`: second order, with adjustable numerical dissipation of high frequencies.

The internal strain takes its exact step for the mean strain rate.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.small_strain._rheology_kernels import advanced, rates, stage_forces
from naibu.mechanics.small_strain.implicit_integrators import Integrator, MotionState, Phase
from naibu.mechanics.small_strain.rheology import CellRheology, StepCoefficients


class GeneralizedAlpha(Integrator):
    """Generalized-alpha method: forces at ``t + (1 - alpha_f) h``, inertia at ``t + (1 - alpha_m) h``.

    Parameters
    ----------
    spectral_radius : float
        Spectral radius at infinite frequency, in [0, 1]: 1 is without dissipation, 0 annihilates these modes in one step.
    """

    name = "generalized_alpha"

    needs_inertia = True

    def __init__(self, spectral_radius: float = 0.8) -> None:
        super().__init__()
        if not 0.0 <= spectral_radius <= 1.0:
            raise InputError(f"spectral_radius must lie in [0, 1], not {spectral_radius:g}")
        r = spectral_radius
        self.alpha_m, self.alpha_f = (2.0 * r - 1.0) / (r + 1.0), r / (r + 1.0)
        self.gamma = 0.5 - self.alpha_m + self.alpha_f
        self.beta = 0.25 * (1.0 - self.alpha_m + self.alpha_f) ** 2
        self._acceleration = np.zeros(0)
        self._power = 0.0

    def begin(self, phase: Phase, state: MotionState, step_s: float, changed: bool) -> MotionState:
        """Return the state after an impulse, and store its acceleration."""
        state = super().begin(phase, state, step_s, changed)
        a, reaction = _accelerated(phase, state, 1)
        self._acceleration, self._power = a, _power(phase, state.time, state.velocity, reaction)
        return state

    def step(self, phase: Phase, state: MotionState, until: float) -> MotionState:
        """Return the state at `until`."""
        h, constrained, law, body = until - state.time, phase.supports.constrained, phase.law, phase.body.simplices
        at, b, g, a_old = 1.0 - self.alpha_f, self.beta * h**2, self.gamma * h, self._acceleration
        predicted = (
            state.displacement + h * state.velocity + (0.5 * h**2 - b) * a_old,
            state.velocity + (h - g) * a_old,
        )
        a = np.where(constrained, self._constrained_acceleration(phase, state, predicted, h), a_old)
        u, v = predicted[0] + b * a, predicted[1] + g * a
        if phase.stabilization is None:
            u, v = (
                np.where(constrained, phase.supports.displacement(until), u),
                np.where(constrained, phase.supports.velocity(until, -1), v),
            )
        full, part = self.factorizations.over(law, h), self.factorizations.over(law, at * h)
        now = _without_springs(law)
        inner = replace(part, dashpot=np.zeros_like(part.dashpot))
        mean = (u - state.displacement) / h
        force = stage_forces(body, now, at * v + (1.0 - at) * state.velocity, state.trace, state.strain)
        force += stage_forces(body, inner, mean, state.trace, state.strain)
        residual = phase.momentum((1.0 - self.alpha_m) * a + self.alpha_m * a_old) + force - phase.load(state.time + at * h)
        residual[constrained] = 0.0
        moduli = at * g * part.dashpot + b / h * part.spring * part.gain
        factor = self.factorizations.of(phase, f"alpha {h:.8g}", moduli, 1.0 - self.alpha_m)
        change = -factor.solve(residual.ravel()).reshape(u.shape)
        a, u, v = a + change, u + b * change, v + g * change
        _, trace, strain = advanced(body, full, (u - state.displacement) / h, state.trace, state.strain)
        end = MotionState(until, u, v, trace, strain, state.reaction, state.work)
        reaction = _accelerated(phase, end, -1)[1]
        power = _power(phase, until, v, reaction)
        end = replace(end, reaction=reaction, work=state.work + 0.5 * h * (power + self._power))
        self._acceleration, self._power = a, power
        self.steps += 1
        return end

    def _constrained_acceleration(self, phase: Phase, state: MotionState, predicted: tuple[FloatArray, FloatArray], h: float) -> FloatArray:
        """Return the accelerations (n, d) at the end of the step for which the weighted mean is the prescribed one."""
        at, middle = 1.0 - self.alpha_f, state.time + (1.0 - self.alpha_f) * h
        u = at * predicted[0] + self.alpha_f * state.displacement
        v = at * predicted[1] + self.alpha_f * state.velocity
        mean = phase.constrained_acceleration(middle, 1, u, v) - self.alpha_m * self._acceleration
        w = 0.0 if phase.stabilization is None else phase.stabilization.frequency
        return mean / (1.0 - self.alpha_m + at * (2.0 * w * self.gamma * h + w**2 * self.beta * h**2))


def _without_springs(law: CellRheology) -> StepCoefficients:
    zero = np.zeros_like(law.spring)
    return StepCoefficients(zero, zero, zero, law.dashpot)


def _accelerated(phase: Phase, state: MotionState, side: int) -> tuple[FloatArray, FloatArray]:
    """Return accelerations (n, d) and reactions (n, d) of a state with inertia."""
    if phase.mass is None:
        raise InputError("density=None needs method 'sdirk2' or 'backward_euler'")
    constrained = phase.supports.constrained
    force = phase.load(state.time) - rates(phase.body.simplices, phase.flow, state.velocity, state.trace, state.strain)[0]
    known = phase.constrained_acceleration(state.time, side, state.displacement, state.velocity)
    a = phase.mass.accelerations(force, constrained, known)
    return a, np.where(constrained, phase.mass.apply(a) - force, 0.0)


def _power(phase: Phase, time: float, velocity: FloatArray, reaction: FloatArray) -> float:
    return float((velocity * (reaction + phase.load(time))).sum())
