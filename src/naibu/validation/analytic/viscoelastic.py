"""Closed solutions of the three-element solid in one dimension, and its motion by matrix exponentials.

With a spring E, a dashpot C1 in parallel and a dashpot C2 in series: ``r = C2 / (C1 + C2)``, ``tau = (C1 + C2) / E`` and
``Cbar = C1 C2 / (C1 + C2)``. Any E >= 0, C1 >= 0 and C2 in (0, inf] may be given, so these hold for elastic, Voigt and Maxwell solids too.
Nothing here uses the kernels or the time steps of `naibu.mechanics`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm

from naibu.core.arrays import FloatArray

Elements = tuple[float, float, float]


def creep_strain(elements: Elements, stress_kpa: float, loaded_s: float, times_s: ArrayLike) -> FloatArray:
    """Return the strain (k,) under a stress from 0 s to `loaded_s` and none afterwards.

    ``e = s / E (1 - exp(-E t / C1)) + s t / C2`` while loaded; then the first part fades and the second stays (any textbook, Burgers' solid
    without its series spring).

    Parameters
    ----------
    elements : tuple of float
        E, kPa; C1 and C2, kPa s.
    stress_kpa : float
        The stress.
    loaded_s : float
        How long it acts.
    times_s : array_like, shape (k,)
        When, from 0 s on.
    """
    modulus, first, second = elements
    t = np.asarray(times_s, dtype=float)
    on = np.minimum(t, loaded_s)
    if modulus == 0.0:
        recoverable = stress_kpa / first * on
    elif first == 0.0:
        recoverable = np.where(t <= loaded_s, stress_kpa / modulus, 0.0)
    else:
        recoverable = stress_kpa / modulus * -np.expm1(-modulus / first * on) * np.exp(-modulus / first * np.maximum(t - loaded_s, 0.0))
    return np.asarray(recoverable + stress_kpa * on / second)


def ramp_stress(elements: Elements, strain: float, ramp_s: float, times_s: ArrayLike) -> FloatArray:
    """Return the stress (k,), kPa, of a strain that grows evenly until `ramp_s` and is then kept.

    ``s = Cbar e' + r^2 E tau (1 - exp(-t / tau)) e'`` on the ramp, where ``r^2 E tau = r C2``; afterwards the second term, as it then is,
    fades with tau. At `ramp_s` itself the value just before is returned.
    """
    fraction, dashpot, rate = _derived(elements)
    t = np.asarray(times_s, dtype=float)
    speed, on = strain / ramp_s, np.minimum(t, ramp_s)
    grown = fraction**2 * elements[0] * speed * (on if rate == 0.0 else -np.expm1(-rate * on) / rate)
    return np.asarray(np.where(t <= ramp_s, dashpot * speed, 0.0) + grown * np.exp(-rate * np.maximum(t - ramp_s, 0.0)))


def residual_strain(elements: Elements, strain: float, ramp_s: float, held_s: float) -> float:
    """Return what stays for good of a strain that was made in `ramp_s`, held for `held_s`, and then released.

    It is the stress integrated over both and divided by C2: the series dashpot's part.
    """
    fraction, dashpot, rate = _derived(elements)
    if np.isinf(elements[2]):
        return 0.0
    speed, stiff = strain / ramp_s, fraction**2 * elements[0]
    if rate == 0.0:
        return float(dashpot * strain / elements[2])
    tau, peak = 1.0 / rate, stiff * speed / rate * -np.expm1(-rate * ramp_s)
    on_ramp = dashpot * strain + stiff * speed * tau * (ramp_s + tau * np.expm1(-rate * ramp_s))
    return float((on_ramp + peak * tau * -np.expm1(-rate * held_s)) / elements[2])


def released_strain(elements: Elements, strain: float, ramp_s: float, held_s: float, times_s: ArrayLike) -> FloatArray:
    """Return the strain (k,) that is made evenly in `ramp_s`, held for `held_s` and then released: what is not residual fades with C1 / E.

    A body of one material whose three Poisson ratios agree does the same at every point, if its inertia does not matter: its
    displacement is this history times the elastic one.
    """
    t = np.asarray(times_s, dtype=float)
    stays = residual_strain(elements, strain, ramp_s, held_s)
    since = np.maximum(t - ramp_s - held_s, 0.0)
    fading = np.exp(-elements[0] / elements[1] * since) if elements[1] > 0.0 else np.zeros_like(t)
    after = stays + (strain - stays) * fading
    return np.asarray(np.where(t <= ramp_s + held_s, strain * np.minimum(t / ramp_s, 1.0), after))


def complex_modulus(elements: Elements, angular_frequency: ArrayLike) -> NDArray[np.complex128]:
    """Return stress over strain of a steady vibration, kPa: the Voigt part ``E + i w C1`` in series with ``i w C2``; w in 1/s."""
    modulus, first, second = elements
    w = np.asarray(angular_frequency, dtype=float)
    inner = modulus + 1j * w * first
    return np.asarray(inner if np.isinf(second) else 1.0 / (1.0 / inner + 1.0 / (1j * w * second)))


def free_motion(
    mass: FloatArray, parts: list[tuple[FloatArray, Elements]], start: tuple[FloatArray, FloatArray], times_s: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Return displacement and velocity (k, N) of ``M u'' + sum_p J_p s_p = 0`` by the exponential of the whole system.

    Each part's nodal strain history obeys equations (13) to (15) of :cite:t:`hirai2008` in their corrected form: ``s = Cbar u' + w``,
    ``w' = -w / tau + r^2 E u'``.

    Parameters
    ----------
    mass : ndarray, shape (N, N)
        M, kg.
    parts : list of (ndarray, shape (N, N), tuple)
        Connection matrices, mm, with the elements E (kPa), C1, C2 (kPa s) of each.
    start : tuple of ndarray, shape (N,)
        u, mm, and u', mm/s; the body was free of stress at u = 0, and the strain u is given to its springs at once.
    times_s : array_like, shape (k,)
        When.
    """
    n, p = len(mass), len(parts)
    system = np.zeros(((2 + p) * n, (2 + p) * n))
    inverse = np.linalg.inv(mass)
    system[:n, n : 2 * n] = np.eye(n)
    y = np.concatenate([*start, *[np.zeros(n)] * p])
    for i, (connection, elements) in enumerate(parts):
        fraction, dashpot, rate = _derived(elements)
        here = slice((2 + i) * n, (3 + i) * n)
        system[n : 2 * n, n : 2 * n] -= inverse @ connection * dashpot
        system[n : 2 * n, here] -= inverse @ connection
        system[here, here] = -rate * np.eye(n)
        system[here, n : 2 * n] = fraction**2 * elements[0] * np.eye(n)
        y[here] = fraction**2 * elements[0] * start[0]
    states = np.array([expm(system * t) @ y for t in np.asarray(times_s, dtype=float)])
    return states[:, :n], states[:, n : 2 * n]


def _derived(elements: Elements) -> tuple[float, float, float]:
    """Return r, Cbar and 1 / tau."""
    modulus, first, second = elements
    fraction = 1.0 if np.isinf(second) else second / (first + second)
    return fraction, first * fraction, 0.0 if np.isinf(second) else modulus / (first + second)
