"""Polynomials of a fingertip's decoder, and the kernel that evaluates them for a reading."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray

LOG_POWERS, RATIO_POWERS = 3, 3  # powers of log(N) and of the squared ratio, from 0
TERMS = LOG_POWERS * RATIO_POWERS
FORCE, TILT, POSITION = range(3)  # rows of the coefficients
OUTPUTS = 8  # force, its sd over it, tilt, its sd, azimuth, sd of the direction across the tilt, angle of the contact, its sd
FORCE_OUT, FORCE_SD, TILT_OUT, TILT_SD, AZIMUTH_OUT, ACROSS_SD, POSITION_OUT, POSITION_SD = range(OUTPUTS)


def terms(log_load: FloatArray, ratio: FloatArray) -> FloatArray:
    """Return the terms (n, TERMS) of the polynomials: powers of log loads (n,) times powers of squared ratios (n,)."""
    powers = [log_load**i * ratio ** (2 * j) for i in range(LOG_POWERS) for j in range(RATIO_POWERS)]
    return np.stack(powers, axis=1)


@njit(cache=True)
def decode_readings(loads, coefficients, unit, spread, noise, error, limits, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Decode F_z, M_x, M_y (n, 3) into `out` (n, OUTPUTS); NaN where F_z or the ratio lies beyond `limits` (3,).

    NaN also where direction or contact lie a right angle or more from the base's normal, as polynomials beyond their training may say.

    `coefficients` (3, TERMS) are of log force, of tilt over ratio, and of the contact's angle over ratio; `unit` are the F_z and the length
    that scale them; `spread` (3,), `noise` (2,) and `error` are standard deviations: of the fits, of F_z and the moments, relative of both.
    """
    value, along, across = np.empty(3), np.empty(3), np.empty(3)
    for row in range(len(loads)):
        normal, mx, my = loads[row, 0], loads[row, 1], loads[row, 2]
        moment = np.sqrt(mx * mx + my * my)
        out[row] = np.nan
        if not (limits[0] <= normal <= limits[1]):
            continue
        ratio = moment / (normal * unit[1])
        if not ratio <= limits[2]:
            continue
        u, w = np.log(normal / unit[0]), ratio * ratio
        for k in range(3):
            v, du, dw, power = 0.0, 0.0, 0.0, 1.0
            for i in range(LOG_POWERS):
                a, b, c = coefficients[k, 3 * i], coefficients[k, 3 * i + 1], coefficients[k, 3 * i + 2]
                inner = a + w * (b + w * c)
                v += power * inner
                dw += power * (b + 2.0 * w * c)
                if i + 1 < LOG_POWERS:
                    du += (i + 1) * power * (coefficients[k, 3 * i + 3] + w * (coefficients[k, 3 * i + 4] + w * coefficients[k, 3 * i + 5]))
                power *= u
            value[k], along[k], across[k] = v, du, dw
        if not (ratio * value[TILT] < 0.5 * np.pi and ratio * value[POSITION] < 0.5 * np.pi):
            continue
        of_load = np.sqrt((noise[0] / normal) ** 2 + error * error)
        of_moment = np.sqrt((noise[1] / (normal * unit[1])) ** 2 + (ratio * error) ** 2)
        slope = 2.0 * ratio * across[FORCE]
        out[row, FORCE_OUT] = np.exp(value[FORCE])
        out[row, FORCE_SD] = np.sqrt(((along[FORCE] - slope * ratio) * of_load) ** 2 + (slope * of_moment) ** 2 + spread[FORCE] ** 2)
        for k in (TILT, POSITION):
            slope = value[k] + 2.0 * w * across[k]
            sd = np.sqrt((slope * of_moment) ** 2 + ((along[k] - slope) * ratio * of_load) ** 2 + spread[k] ** 2)
            out[row, TILT_OUT if k == TILT else POSITION_OUT] = ratio * value[k]
            out[row, TILT_SD if k == TILT else POSITION_SD] = sd
        out[row, AZIMUTH_OUT] = np.arctan2(mx, -my)
        out[row, ACROSS_SD] = noise[1] / (normal * unit[1]) * value[TILT]
