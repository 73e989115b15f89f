"""Simulated forces over all steps, and their means over windows as a sensor whose clock is late sees them."""

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
class DelayedMeans:
    """Means over windows of the forces of one body, for any delay.

    The impulse is interpolated by cubic Hermite polynomials through its values between steps, with the mean of the forces on both sides as
    slopes: means over undivided steps are kept, and means change smoothly with the delay. Before its beginning and after its end the force
    stays as it is there.

    Attributes
    ----------
    borders : ndarray, shape (n + 1,)
        Of the steps, s.
    impulse, slope : ndarray, shape (n + 1, k)
        mN s and mN, between the steps.
    times : ndarray, shape (m + 1,)
        Borders of the fine steps in the windows, s.
    shares : ndarray, shape (m,)
        Of fine steps in the means of their windows.
    window_steps : int
        Fine steps in a window.
    """

    borders: FloatArray
    impulse: FloatArray
    slope: FloatArray
    times: FloatArray
    shares: FloatArray
    window_steps: int

    @classmethod
    def of(cls, borders: FloatArray, force: FloatArray, shares: FloatArray, window_steps: int, step_s: float) -> DelayedMeans:
        """Prepare the means of forces (n, k) of steps with these borders (n + 1,)."""
        each = np.diff(borders)[:, None]
        impulse = np.concatenate([np.zeros((1, force.shape[1])), np.cumsum(force * each, axis=0)])
        inner = (force[:-1] * each[1:] + force[1:] * each[:-1]) / (each[1:] + each[:-1])
        slope = np.concatenate([force[:1], inner, force[-1:]])
        return cls(borders, impulse, slope, np.asarray(step_s * np.arange(len(shares) + 1), dtype=np.float64), shares, window_steps)

    def __call__(self, delay: float) -> tuple[FloatArray, FloatArray]:
        """Return means (windows, k) of forces that are seen later by a delay, s, and their derivatives by it."""
        asked = self.times - delay
        inside = np.clip(asked, self.borders[0], self.borders[-1])
        k = np.clip(np.searchsorted(self.borders, inside, side="right") - 1, 0, len(self.borders) - 2)
        each = (self.borders[k + 1] - self.borders[k])[:, None]
        u = (inside - self.borders[k])[:, None] / each
        first, last, left, right = self.impulse[k], self.impulse[k + 1], each * self.slope[k], each * self.slope[k + 1]
        rise = last - first
        impulse = first + u * left + u**2 * (3.0 * rise - 2.0 * left - right) + u**3 * (left + right - 2.0 * rise)
        force = (left + 2.0 * u * (3.0 * rise - 2.0 * left - right) + 3.0 * u**2 * (left + right - 2.0 * rise)) / each
        impulse = impulse + (asked - inside)[:, None] * force
        step = self.times[1] - self.times[0]
        return self._windows(np.diff(impulse, axis=0) / step), -self._windows(np.diff(force, axis=0) / step)

    def _windows(self, of_steps: FloatArray) -> FloatArray:
        weighed = of_steps * self.shares[:, None]
        return np.asarray(weighed.reshape(-1, self.window_steps, weighed.shape[1]).sum(axis=1))
