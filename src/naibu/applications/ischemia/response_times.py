"""Rise and fall times of an indentation or of a pale area, and what remains: the measures of active ischemia :cite:p:`kaneko2007`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError


@dataclass(frozen=True, slots=True)
class ResponseTimes:
    """Times of a response to a load that is applied at time zero, and removed.

    Attributes
    ----------
    rise_s, fall_s : float
        Time from 10 % to 90 % of the change under the load, and after it, s; NaN where nothing changes, 0 where it changes at once: between
        two instants.
    rise_constant_s, fall_constant_s : float
        Time constant of the exponential with an offset that fits best (and, under the load, with a linear flow), s; NaN where none fits,
        0 where the change is at once.
    peak : float
        Value when the load is removed.
    residual : float
        Value at the last time.
    """

    rise_s: float
    fall_s: float
    rise_constant_s: float
    fall_constant_s: float
    peak: float
    residual: float


def response_times(times: ArrayLike, values: ArrayLike, release_s: float) -> ResponseTimes:
    """Measure a response.

    Parameters
    ----------
    times : array_like, shape (t,)
        Increasing, s, from the start of the load to long after its end.
    values : array_like, shape (t,)
        Indentation, mm, or area, mm^2.
    release_s : float
        When the load is removed, s.

    Raises
    ------
    InputError
        Fewer than four times under the load or after it, or values that are not finite.
    """
    t, v = np.asarray(times, dtype=float), np.asarray(values, dtype=float)
    if t.ndim != 1 or t.shape != v.shape or not (np.isfinite(t).all() and np.isfinite(v).all()) or not (np.diff(t) > 0.0).all():
        raise InputError(
            f"times and values must be finite numbers of one shape, times increasing; they have shapes {t.shape} and {v.shape}"
        )
    under, after = t <= release_s, t >= release_s
    if under.sum() < 4 or after.sum() < 4:
        raise InputError(
            f"times must have four or more instants up to the release at {release_s:g} s, and from there on; they have "
            f"{under.sum()} and {after.sum()}"
        )
    peak = float(np.interp(release_s, t, v))
    return ResponseTimes(
        _tenth_to_nine_tenths(t[under], v[under]),
        _tenth_to_nine_tenths(t[after], v[after]),
        _time_constant(t[under], v[under], flow=True),
        _time_constant(t[after], v[after], flow=False),
        peak,
        float(v[-1]),
    )


def _tenth_to_nine_tenths(t: FloatArray, v: FloatArray) -> float:
    change = v[-1] - v[0]
    if abs(change) <= 1e-12 * max(np.abs(v).max(), 1e-300):
        return float("nan")
    share = (v - v[0]) / change
    low, high = (int(np.argmax(share >= level)) for level in (0.1, 0.9))
    if low == high:  # between two instants: how fast, they do not tell
        return 0.0
    return _crossing(t, share, high, 0.9) - _crossing(t, share, low, 0.1)


def _crossing(t: FloatArray, share: FloatArray, i: int, level: float) -> float:
    """Return when `share` reaches the level, between the instants i - 1 and i."""
    if i == 0:
        return float(t[0])
    return float(t[i - 1] + (t[i] - t[i - 1]) * (level - share[i - 1]) / (share[i] - share[i - 1]))


def _time_constant(t: FloatArray, v: FloatArray, *, flow: bool) -> float:
    span, change = t[-1] - t[0], v[-1] - v[0]
    if change == 0.0:
        return float("nan")
    x, y = (t - t[0]) / span, (v - v[0]) / change
    rise = _tenth_to_nine_tenths(x, y)
    if rise == 0.0:
        return 0.0
    root = np.sqrt(np.gradient(x))  # instants may be denser where more happens

    def residuals(p: FloatArray) -> FloatArray:
        size, log_rate = p[0], p[1]
        flowing = p[2] * x if flow else 0.0
        return np.asarray(root * (size * -np.expm1(-x * np.exp(log_rate)) + flowing - y))

    start = [1.0, np.log(1.0 / max(rise / 2.2, 1e-6)), *([0.0] if flow else [])]
    found = least_squares(residuals, start, xtol=1e-12, ftol=1e-12, gtol=1e-12, max_nfev=500)
    constant = float(span * np.exp(-found.x[1]))
    # slower than the record: the exponential and the flow are not told apart
    return constant if found.success and constant < span else float("nan")
