"""Joint localisation of markers in several states, by a Gaussian process model of the motion between them :cite:p:`rasmussen2006`.

A washer thinner than the slices may lie anywhere in the one that shows it, but seldom so in all states, and its neighbours constrain its
motion. The motion from the first state is affine plus a Gaussian process, whose amplitude is estimated by restricted maximum likelihood
:cite:p:`patterson1971`, so that sharp changes of the motion are kept. Every marker is predicted from the others alone, and its positions in
all states are updated with that prediction by a Kalman update :cite:p:`kalman1960`; markers that are well located already hardly move.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from naibu.core.arrays import BoolArray, FloatArray, IntArray

# Empirical values, judged by tests/imaging/markers/test_tracking.py and benchmarks/sense_markers.py, unless said otherwise.
# fewer markers do not determine a motion; more would need too large a dense matrix
FEWEST, MOST = 12, 600
# amplitudes of the kernel that are tried, in units of the median variance, for points scaled to a unit box
AMPLITUDES = np.logspace(-3.0, 7.0, 16)
# range of the estimated factor of the stated variances; the fit to a blob that is no Gaussian overstates its error, up to three times in
# standard deviation, but errors common to neighbours do not show
CALIBRATION = (0.2, 9.0)
# a position further than so many standard deviations from its prediction is an outlier, and not updated
APART = 4.0
LOCAL = 14  # neighbours from which the deformation gradient at a marker is fitted


@dataclass(frozen=True, slots=True, eq=False)
class JointPositions:
    """Positions of markers after the update.

    Attributes
    ----------
    points : ndarray, shape (s, n, d)
        Positions, mm.
    covariance : ndarray, shape (s, n, d, d)
        Of the positions, mm^2.
    outliers : ndarray, shape (s, n), bool
        Positions that disagree with their prediction, and were not updated.
    """

    points: FloatArray
    covariance: FloatArray
    outliers: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """Of one state: predictions from the others (k, d) with variances, factors of the stated variances (d,), gradients (k, d, d)."""

    seen: IntArray
    predicted: FloatArray
    variance: FloatArray
    calibration: FloatArray
    gradient: FloatArray


def joint_positions(points: FloatArray, covariance: FloatArray) -> JointPositions:
    """Update the positions of markers in all states with their predictions from the smooth motion between the states.

    Parameters
    ----------
    points : ndarray, shape (s, n, d)
        Markers in the reference and other states, mm; NaN where one is not seen. States with too few are not changed.
    covariance : ndarray, shape (s, n, d, d)
        Of the positions, mm^2.
    """
    motions = [_motion(points[0], p, covariance[0], c) for p, c in zip(points[1:], covariance[1:], strict=True)]
    states = [s for s, motion in enumerate(motions, start=1) if motion is not None]
    outliers = np.zeros(points.shape[:2], dtype=bool)
    if not states:
        return JointPositions(points, covariance, outliers)
    scale = np.ones((len(points), points.shape[2]))
    for s in states:
        scale[s] = np.sqrt(_there(motions[s - 1]).calibration)
    scale[0] = np.sqrt(np.mean(scale[states] ** 2, axis=0))
    updated, stated = points.copy(), covariance * scale[:, None, :, None] * scale[:, None, None, :]
    after = stated.copy()
    for i in range(points.shape[1]):
        _update(i, [(s, _there(motions[s - 1])) for s in states], points, stated, updated, after, outliers)
    return JointPositions(updated, after, outliers)


def _there(motion: _Motion | None) -> _Motion:
    assert motion is not None
    return motion


def _motion(free: FloatArray, moved: FloatArray, free_covariance: FloatArray, moved_covariance: FloatArray) -> _Motion | None:
    """Predict every marker of a state from the others; None where there are too few or too many."""
    seen = np.flatnonzero(np.isfinite(free).all(axis=1) & np.isfinite(moved).all(axis=1))
    if not FEWEST <= len(seen) <= MOST:
        return None
    x, y = free[seen], moved[seen]
    gradient = _gradients(x, y)
    noise = moved_covariance[seen] + gradient @ free_covariance[seen] @ np.swapaxes(gradient, 1, 2)
    d = x.shape[1]
    predicted, variance, calibration = np.empty_like(y), np.empty_like(y), np.empty(d)
    at = (x - x.mean(axis=0)) / max(float(np.ptp(x, axis=0).max()), 1e-300)
    for axis in range(d):
        predicted[:, axis], variance[:, axis], calibration[axis] = _predicted(at, y[:, axis], np.maximum(noise[:, axis, axis], 1e-12))
    return _Motion(seen, predicted, variance, calibration, gradient)


def _gradients(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return deformation gradients (k, d, d) by least squares over the nearest markers."""
    k = min(LOCAL, len(x))
    near = np.asarray(cKDTree(x).query(x, k=k)[1])
    a, b = x[near] - x[near].mean(axis=1, keepdims=True), y[near] - y[near].mean(axis=1, keepdims=True)
    spread = np.swapaxes(a, 1, 2) @ a
    spread += 1e-6 * np.trace(spread, axis1=1, axis2=2)[:, None, None] * np.eye(x.shape[1])
    return np.asarray(np.swapaxes(np.linalg.solve(spread, np.swapaxes(a, 1, 2) @ b), 1, 2))


def _predicted(x: FloatArray, y: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Predict one coordinate of every marker from the others; return that, its variances, and the factor of the noise variance."""
    r = cdist(x, x)
    kernel, linear = r**3, np.column_stack([np.ones(len(x)), x])
    typical = float(np.median(noise))
    best: tuple[float, FloatArray, float] | None = None
    for amplitude in AMPLITUDES * typical:
        matrix = amplitude * kernel + np.diag(noise)
        # positive definite on the complement of affine motions, and made so elsewhere
        matrix += linear @ linear.T * (10.0 * np.abs(matrix).max())
        try:
            factor = cho_factor(matrix)
        except np.linalg.LinAlgError:
            continue
        inverse = np.asarray(cho_solve(factor, np.eye(len(x))))
        across = inverse @ linear
        inverse -= across @ np.linalg.solve(linear.T @ across, across.T)
        misfit = float(y @ inverse @ y)
        free = len(x) - linear.shape[1]
        determinant = 2.0 * float(np.log(np.diag(factor[0])).sum()) + float(np.linalg.slogdet(linear.T @ across)[1])
        scale = float(np.clip(misfit / free, *CALIBRATION))
        likelihood = -0.5 * (free * np.log(scale) + misfit / scale + determinant)
        if best is None or likelihood > best[0]:
            best = likelihood, inverse, scale
    if best is None:
        return y, np.full(len(y), np.inf), 1.0
    _, inverse, scale = best
    alone = np.diag(inverse)
    # the variance of a leave-one-out residual is that of the motion there and that of the marker
    variance = np.maximum(scale / alone - scale * noise, 0.02 * scale * noise)
    return y - (inverse @ y) / alone, variance, scale


def _update(
    i: int,
    motions: list[tuple[int, _Motion]],
    points: FloatArray,
    stated: FloatArray,
    updated: FloatArray,
    after: FloatArray,
    outliers: BoolArray,
) -> None:
    """Update one marker in all states that see it; arrays are filled in place."""
    d = points.shape[2]
    rows: list[tuple[int, FloatArray, FloatArray, FloatArray]] = []
    for s, motion in motions:
        k = int(np.searchsorted(motion.seen, i))
        if k < len(motion.seen) and motion.seen[k] == i and np.isfinite(motion.variance[k]).all():
            rows.append((s, points[s, i] - motion.predicted[k], np.diag(motion.variance[k]), motion.gradient[k]))
    kept = []
    for s, innovation, variance, gradient in rows:
        total = stated[s, i] + gradient @ stated[0, i] @ gradient.T + variance
        if float(innovation @ np.linalg.solve(total, innovation)) > APART**2 * d:
            outliers[s, i] = True
        else:
            kept.append((s, innovation, variance, gradient))
    if not kept:
        return
    m = len(kept)
    # unknowns: errors of the reference and the m other positions; innovations are the latter less the gradient times the former
    prior = np.zeros(((m + 1) * d, (m + 1) * d))
    prior[:d, :d] = stated[0, i]
    observe, noise, seen = np.zeros((m * d, (m + 1) * d)), np.zeros((m * d, m * d)), np.zeros(m * d)
    for j, (s, innovation, variance, gradient) in enumerate(kept):
        here, there = slice(j * d, (j + 1) * d), slice((j + 1) * d, (j + 2) * d)
        prior[there, there] = stated[s, i]
        observe[here, :d], observe[here, there], noise[here, here], seen[here] = -gradient, np.eye(d), variance, innovation
    gain = prior @ observe.T @ np.linalg.inv(observe @ prior @ observe.T + noise)
    off, left = gain @ seen, prior - gain @ observe @ prior
    for j, s in enumerate((0, *(s for s, *_ in kept))):
        part = slice(j * d, (j + 1) * d)
        updated[s, i] = points[s, i] - off[part]
        after[s, i] = 0.5 * (left[part, part] + left[part, part].T)
