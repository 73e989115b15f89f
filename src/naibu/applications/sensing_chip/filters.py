"""Filters of the readings: the report's first-order filter, a Kalman filter that follows ramps without lag, and both offline."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from naibu.core.arrays import FloatArray, require_positive, require_within
from naibu.core.errors import InputError

_MOVE = np.array([[1.0, 1.0], [0.0, 1.0]])  # of level and slope from a sample to the next
_UNKNOWN = 1e4  # variance of a level that jumped, over the square of the jump


def first_order_filter(readings: FloatArray, share: float) -> FloatArray:
    """Return ``V(t) = r U(t) + (1 - r) V(t - 1)``, equation (6.1) of :cite:t:`hirai2008`, from V(0) = U(0).

    Parameters
    ----------
    readings : ndarray, shape (n,) or (n, k)
        U, one row a sample.
    share : float
        r, above 0 and at most 1.

    Raises
    ------
    InputError
        Another share.
    """
    from scipy.signal import lfilter  # slow to load, with all of scipy.stats

    r = _share(share)
    u = np.asarray(readings, dtype=float)
    return np.asarray(lfilter([r], [1.0, r - 1.0], u, axis=0, zi=(1.0 - r) * u[:1])[0])


def forward_backward_filter(readings: FloatArray, share: float) -> FloatArray:
    """Return the first-order filter run forward, then backward: no lag, but it needs the whole recording."""
    return first_order_filter(first_order_filter(readings, share)[::-1], share)[::-1]


def noise_gain(share: float) -> float:
    """Return the standard deviation of filtered over that of unfiltered white noise: ``sqrt(r / (2 - r))``."""
    r = _share(share)
    return float(np.sqrt(r / (2.0 - r)))


def time_constant(share: float) -> float:
    """Return the number of samples in which the first-order filter's response to a step comes within 1/e: ``-1 / ln(1 - r)``."""
    r = _share(share)
    return 0.0 if r == 1.0 else float(-1.0 / np.log1p(-r))


def ramp_lag(share: float) -> float:
    """Return the number of samples by which the first-order filter lags behind a ramp: ``(1 - r) / r``."""
    r = _share(share)
    return (1.0 - r) / r


@dataclass(frozen=True, slots=True)
class RampKalman:
    """Kalman filter :cite:p:`kalman1960` of a level that drifts with a slowly changing slope, sampled at unit intervals.

    Attributes
    ----------
    noise_sd : float
        Standard deviation of a reading.
    slope_sd : float
        Standard deviation of the change of the slope from a sample to the next.
    jump : float
        Difference of a reading from its prediction, in standard deviations, beyond which the level has jumped and is found anew.
    """

    noise_sd: float
    slope_sd: float
    jump: float = np.inf

    def __post_init__(self) -> None:
        require_positive("noise_sd", self.noise_sd)
        require_positive("slope_sd", self.slope_sd)
        if not self.jump > 0.0:
            raise InputError(f"jump must be positive, or infinite for none, not {self.jump:g}")

    @classmethod
    def with_noise_gain(cls, noise_sd: float, gain: float, *, jump: float = np.inf) -> RampKalman:
        """Return the filter that lets through a given share of white noise, such as `noise_gain` of another filter.

        Raises
        ------
        InputError
            A gain beyond 0.01 to 0.95.
        """
        require_within("gain", gain, 0.01, 0.95)

        def excess(log_ratio: float) -> float:
            return cls(noise_sd, noise_sd * np.exp(log_ratio)).steady_noise_gain - gain

        return cls(noise_sd, noise_sd * float(np.exp(brentq(excess, -25.0, 8.0))), jump)

    @property
    def steady_gains(self) -> tuple[float, float]:
        """Shares of the innovation by which level and slope are corrected after many samples: an alpha-beta filter :cite:p:`kalata1984`."""
        index = self.slope_sd / self.noise_sd
        r = 0.25 * (4.0 + index - np.sqrt(8.0 * index + index**2))
        alpha = 1.0 - r**2
        return float(alpha), float(2.0 * (2.0 - alpha) - 4.0 * np.sqrt(1.0 - alpha))

    @property
    def steady_noise_gain(self) -> float:
        """Standard deviation of the filtered level over that of white noise, after many samples."""
        a, b = self.steady_gains
        return float(np.sqrt((2.0 * a**2 + b * (2.0 - 3.0 * a)) / (a * (4.0 - 2.0 * a - b))))

    def filtered(self, readings: FloatArray) -> FloatArray:
        """Return the level (n,) or (n, k) after every reading, from the readings until then only; each column by itself."""
        return self._by_column(readings, lambda u: self._forward(u)[0][:, 0])

    def smoothed(self, readings: FloatArray) -> FloatArray:
        """Return the level (n,) or (n, k) from all readings: the fixed-interval smoother :cite:p:`rauch1965`; each column by itself."""
        return self._by_column(readings, self._smoothed)

    def _by_column(self, readings: FloatArray, apply: Callable[[FloatArray], FloatArray]) -> FloatArray:
        u = np.asarray(readings, dtype=float)
        return apply(u) if u.ndim == 1 else np.stack([apply(column) for column in u.T], axis=1)

    def _smoothed(self, readings: FloatArray) -> FloatArray:
        states, covariances, predicted = self._forward(readings)
        result = states.copy()
        for k in range(len(states) - 2, -1, -1):
            gain = covariances[k] @ _MOVE.T @ np.linalg.inv(predicted[k + 1])
            result[k] = states[k] + gain @ (result[k + 1] - _MOVE @ states[k])
        return np.asarray(result[:, 0])

    def _forward(self, readings: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return states (n, 2), their covariances and those of their predictions (n, 2, 2)."""
        variance, start = self.noise_sd**2, (10.0 * self.noise_sd) ** 2
        # the slope changes at once by a random amount, of which the level takes half within the sample
        drift = self.slope_sd**2 * np.array([[0.25, 0.5], [0.5, 1.0]])
        state, covariance = np.array([readings[0], 0.0]), np.diag([variance, start])
        states, covariances, predicted = [state], [covariance], [covariance]
        for reading in readings[1:]:
            ahead, before = _MOVE @ state, _MOVE @ covariance @ _MOVE.T + drift
            if abs(reading - ahead[0]) > self.jump * np.sqrt(before[0, 0] + variance):
                before = before + np.diag([(reading - ahead[0]) ** 2 * _UNKNOWN, start])
            gain = before[:, 0] / (before[0, 0] + variance)
            state = ahead + gain * (reading - ahead[0])
            covariance = before - np.outer(gain, before[0])
            states.append(state)
            covariances.append(covariance)
            predicted.append(before)
        return np.stack(states), np.stack(covariances), np.stack(predicted)


def _share(share: float) -> float:
    if not 0.0 < share <= 1.0:
        raise InputError(f"share is {share:g}; the first-order filter needs a number above 0 and at most 1")
    return float(share)
