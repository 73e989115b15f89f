"""Simulated forces over all steps, and their means over windows as a sensor sees them: at its samples, late if its clock is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ForceHistory:
    """Forces of a simulation, a step at a time.

    Attributes
    ----------
    borders : ndarray, shape (n + 1,)
        Where steps begin and the last one ends, s.
    force : ndarray, shape (n, bodies, 3)
        Mean forces over the steps, mN.
    change : ndarray, shape (p, n, bodies, 3)
        Derivatives along p directions of the parameters.
    """

    borders: FloatArray
    force: FloatArray
    change: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class SampledMeans:
    """Means over windows of what a sensor samples of the force of one body, for any delay of its clock.

    The impulse is interpolated by cubic Hermite polynomials through its values between steps, with the mean of the forces on both sides as
    slopes: means over undivided steps are kept, and means change smoothly with the delay. Before its beginning and after its end the force
    stays as it is there. Samples are taken at instants, mostly not in the middle of a step: to the mean force of a step is added what it
    changes by until then, by the lesser one of its differences from the steps beside it, and nothing where these have opposite signs (the
    minmod limiter; :cite:t:`leveque2002`): a force that jumps does so between samples.

    Attributes
    ----------
    borders : ndarray, shape (n + 1,)
        Of the steps, s.
    impulse, slope : ndarray, shape (n + 1, q, 3)
        mN s and mN, between the steps; of the force, and of its derivatives along q - 1 directions.
    times : ndarray, shape (m + 1,)
        Borders of the fine steps in the windows, s.
    shares, phase : ndarray, shape (m,)
        Of fine steps in the means of their windows, and how much later than in the middle of a step its samples are taken, as a share of
        its length.
    window_steps : int
        Fine steps in a window.
    """

    borders: FloatArray
    impulse: FloatArray
    slope: FloatArray
    times: FloatArray
    shares: FloatArray
    phase: FloatArray
    window_steps: int

    @classmethod
    def of(
        cls, borders: FloatArray, force: FloatArray, shares: FloatArray, phase_s: FloatArray, window_steps: int, step_s: float
    ) -> SampledMeans:
        """Prepare the means of a force and its derivatives (n, q, 3) of steps with these borders (n + 1,); phases (m,) in s."""
        each = np.diff(borders)[:, None, None]
        impulse = np.concatenate([np.zeros((1, *force.shape[1:])), np.cumsum(force * each, axis=0)])
        inner = (force[:-1] * each[1:] + force[1:] * each[:-1]) / (each[1:] + each[:-1])
        slope = np.concatenate([force[:1], inner, force[-1:]])
        times = np.asarray(step_s * np.arange(len(shares) + 1), dtype=np.float64)
        return cls(borders, impulse, slope, times, shares, phase_s / step_s, window_steps)

    def __call__(self, delay: float) -> tuple[FloatArray, FloatArray]:
        """Return means (windows, q, 3) of a force that is seen later by a delay, s, and their derivatives by it."""
        means, rates = self._of_steps(delay)
        before, after = self._limited(means[:, :1])
        of_means, of_rates = (self._windows(of + before * _before(of) + after * _after(of)) for of in (means, rates))
        return of_means, of_rates

    def doubtful(self, delay: float) -> FloatArray:
        """Return what means (windows, q, 3) would change by, could forces not jump: if they change evenly from step to step."""
        means = self._of_steps(delay)[0]
        before, after = self._limited(means[:, :1])
        evenly = 0.5 * self.phase[:, None, None]
        return self._windows((evenly - before) * _before(means) + (evenly - after) * _after(means))

    def _of_steps(self, delay: float) -> tuple[FloatArray, FloatArray]:
        """Return means (m, q, 3) over fine steps, and their derivatives by the delay."""
        asked = self.times - delay
        inside = np.clip(asked, self.borders[0], self.borders[-1])
        k = np.clip(np.searchsorted(self.borders, inside, side="right") - 1, 0, len(self.borders) - 2)
        each = (self.borders[k + 1] - self.borders[k])[:, None, None]
        u = (inside - self.borders[k])[:, None, None] / each
        first, last, left, right = self.impulse[k], self.impulse[k + 1], each * self.slope[k], each * self.slope[k + 1]
        rise = last - first
        impulse = first + u * left + u**2 * (3.0 * rise - 2.0 * left - right) + u**3 * (left + right - 2.0 * rise)
        force = (left + 2.0 * u * (3.0 * rise - 2.0 * left - right) + 3.0 * u**2 * (left + right - 2.0 * rise)) / each
        impulse = impulse + (asked - inside)[:, None, None] * force
        step = self.times[1] - self.times[0]
        return np.diff(impulse, axis=0) / step, -np.diff(force, axis=0) / step

    def _limited(self, force: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what differences of a force (m, 1, 3) from the steps before and after count by until the samples are taken."""
        before, after = _before(force), _after(force)
        same = before * after > 0.0
        first = np.abs(before) < np.abs(after)
        phase = self.phase[:, None, None]
        return phase * (same & first), phase * (same & ~first)

    def _windows(self, of_steps: FloatArray) -> FloatArray:
        weighed = of_steps * self.shares[:, None, None]
        return np.asarray(weighed.reshape(-1, self.window_steps, *weighed.shape[1:]).sum(axis=1))


def _before(force: FloatArray) -> FloatArray:
    return np.diff(force, axis=0, prepend=force[:1])


def _after(force: FloatArray) -> FloatArray:
    return np.diff(force, axis=0, append=force[-1:])
