"""Explicit integrators: classical Runge-Kutta, and Runge-Kutta-Fehlberg 4(5) with step size control :cite:p:`fehlberg1969`."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray, require_positive
from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.small_strain._rheology_kernels import rates
from naibu.mechanics.small_strain.implicit_integrators import Integrator, MotionState, Phase

_FEHLBERG_TIMES = (0.0, 1 / 4, 3 / 8, 12 / 13, 1.0, 1 / 2)
_FEHLBERG = (
    (),
    (1 / 4,),
    (3 / 32, 9 / 32),
    (1932 / 2197, -7200 / 2197, 7296 / 2197),
    (439 / 216, -8.0, 3680 / 513, -845 / 4104),
    (-8 / 27, 2.0, -3544 / 2565, 1859 / 4104, -11 / 40),
)
_FOURTH = np.array([25 / 216, 0.0, 1408 / 2565, 2197 / 4104, -1 / 5, 0.0])
_FIFTH = np.array([16 / 135, 0.0, 6656 / 12825, 28561 / 56430, -9 / 50, 2 / 55])


class Explicit(Integrator):
    """Base of the Runge-Kutta methods: the state as one vector (u, v, internal strain, work) and its rate."""

    needs_inertia = True

    def __init__(self) -> None:
        super().__init__()
        self._reaction = np.zeros(0)
        self._last: tuple[MotionState, FloatArray] | None = None

    def begin(self, phase: Phase, state: MotionState, step_s: float, changed: bool) -> MotionState:
        """Return the state just after an event, where rates are discontinuous."""
        self._last = None
        return super().begin(phase, state, step_s, changed)

    def _first(self, phase: Phase, state: MotionState, y: FloatArray) -> FloatArray:
        """Return the rate at the start of a step, from the end of the last one if there was no event."""
        if self._last is not None and self._last[0] is state:
            return self._last[1]
        return self._rate(phase, state.time, 1, y)

    def _rate(self, phase: Phase, time: float, side: int, y: FloatArray) -> FloatArray:
        """Return dy/dt and store the reaction."""
        if phase.mass is None:
            raise InputError("density=None needs method 'sdirk2' or 'backward_euler'")
        constrained, body = phase.supports.constrained, phase.body.simplices
        u, v, trace, strain = _unpacked(y, constrained.shape, body.n_cells)
        if phase.stabilization is None:
            v = np.where(constrained, phase.supports.velocity(time, side), v)
        internal, trace_rate, strain_rate = rates(body, phase.flow, v, trace, strain)
        load = phase.load(time)
        a = phase.mass.accelerations(load - internal, constrained, phase.constrained_acceleration(time, side, u, v))
        self._reaction = np.where(constrained, phase.mass.apply(a) + internal - load, 0.0)
        power = float((v * (self._reaction + load)).sum())
        return np.concatenate([v.ravel(), a.ravel(), trace_rate, strain_rate.ravel(), [power]])

    def _state(self, phase: Phase, time: float, y: FloatArray) -> MotionState:
        """Return the state with its reaction, its constrained components set to their prescribed values, and store its rate."""
        rate = self._rate(phase, time, -1, y)
        constrained, supports = phase.supports.constrained, phase.supports
        u, v, trace, strain = _unpacked(y, constrained.shape, phase.body.simplices.n_cells)
        if not (np.isfinite(y).all() and np.abs(u).max() < 1e6 * np.ptp(phase.body.points, axis=0).max()):
            raise ConvergenceError(
                f"the explicit integration is unstable at {time:g} s: take shorter steps (see explicit_step_limit), or method='sdirk2'"
            )
        if phase.stabilization is None:
            u, v = np.where(constrained, supports.displacement(time), u), np.where(constrained, supports.velocity(time, -1), v)
        state = MotionState(time, u, v, trace, strain, self._reaction, float(y[-1]))
        self._last = state, rate
        return state


class RungeKutta4(Explicit):
    """Classical Runge-Kutta method: four stages a step, fourth order."""

    name = "rk4"

    def step(self, phase: Phase, state: MotionState, until: float) -> MotionState:
        """Return the state at `until`."""
        t, h, y = state.time, until - state.time, _packed(state)
        with np.errstate(over="ignore", invalid="ignore"):
            k1 = self._first(phase, state, y)
            k2 = self._rate(phase, t + 0.5 * h, 1, y + 0.5 * h * k1)
            k3 = self._rate(phase, t + 0.5 * h, 1, y + 0.5 * h * k2)
            k4 = self._rate(phase, until, -1, y + h * k3)
            end = y + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
            self.steps += 1
            return self._state(phase, until, end)


class RungeKuttaFehlberg(Explicit):
    """Runge-Kutta-Fehlberg 4(5): the fourth-order solution is kept, the difference from the fifth order controls the step.

    Parameters
    ----------
    tolerance : float
        Local error of displacement, velocity and internal strain, each relative to its largest magnitude so far.
    """

    name = "rkf45"

    def __init__(self, tolerance: float = 1e-6) -> None:
        super().__init__()
        self.tolerance = require_positive("tolerance", tolerance)
        self.rejected = 0
        self._length = np.inf
        self._largest = np.zeros(0)

    def step(self, phase: Phase, state: MotionState, until: float) -> MotionState:
        """Return the state at `until`, in as many steps as the tolerance needs."""
        t, y, span = state.time, _packed(state), until - state.time
        while t < until:
            h = min(self._length, until - t)
            last = t + h >= until - 1e-12 * span
            with np.errstate(over="ignore", invalid="ignore"):
                end, error, largest = self._attempt(phase, state, t, h, y, last)
            if not error > 1.0:  # also where nothing moves; an overflow makes it infinite
                t, y = (until if last else t + h), end
                self._largest = (
                    largest  # of accepted steps only: a rejected one may be far too large, and would loosen the tolerance for good
                )
                self.steps += 1
            else:
                self.rejected += 1
            grown = h * min(4.0, max(0.1, 0.9 * max(error, 1e-10) ** -0.2))
            if not (last and error <= 1.0 and grown < self._length < np.inf):
                self._length = grown
            if self._length < 1e-13 * max(span, 1e-300):
                raise ConvergenceError(f"Runge-Kutta-Fehlberg needs steps below {self._length:.2g} s at {t:g} s; use 'sdirk2'")
        return self._state(phase, until, y)

    def _attempt(
        self, phase: Phase, state: MotionState, t: float, h: float, y: FloatArray, last: bool
    ) -> tuple[FloatArray, float, FloatArray]:
        """Return the state after a step of length `h`, its error in units of the tolerance, and the largest magnitudes up to there."""
        stages: list[FloatArray] = []
        for c, row in zip(_FEHLBERG_TIMES, _FEHLBERG, strict=True):
            at = y + h * sum((w * k for w, k in zip(row, stages, strict=True)), np.zeros_like(y))
            stages.append(self._rate(phase, t + c * h, -1 if last and c == 1.0 else 1, at))
        k = np.array(stages)
        end, error = y + h * (_FOURTH @ k), np.abs(h * ((_FIFTH - _FOURTH) @ k))
        if not np.isfinite(end).all():
            return y, np.inf, self._largest
        n, m = state.displacement.size, len(state.trace)
        blocks = [slice(0, n), slice(n, 2 * n), slice(2 * n, 2 * n + m), slice(2 * n + m, -1)]
        size = np.array([max(np.abs(y[b]).max(), np.abs(end[b]).max()) for b in blocks])
        if len(self._largest):
            size = np.maximum(size, self._largest)
        worst = [error[b].max() / largest for b, largest in zip(blocks, size, strict=True) if largest > 0.0]
        return end, max(worst, default=0.0) / self.tolerance, size


def _packed(state: MotionState) -> FloatArray:
    return np.concatenate([state.displacement.ravel(), state.velocity.ravel(), state.trace, state.strain.ravel(), [state.work]])


def _unpacked(y: FloatArray, shape: tuple[int, ...], n_cells: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    n, d = shape[0] * shape[1], shape[1]
    u, v, trace, strain = np.split(y[:-1], [n, 2 * n, 2 * n + n_cells])
    return u.reshape(shape), v.reshape(shape), trace, strain.reshape(n_cells, d, d)
