"""Outliers and gaps in the tracks of an image sequence: rejected and filled by the motion that the markers share.

A position is an outlier if it agrees neither with robust lines through its neighbouring frames :cite:p:`theil1950,sen1968` nor with what
the other markers do at that time. Gaps are filled by the leading principal components of the motion of all markers, found by iterated
singular value decompositions in which the missing positions are replaced by their reconstruction, less the part of noise in the singular
values (regularised iterative principal component analysis) :cite:p:`josse2012`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.imaging.markers.sequences.sequence_paths import Track
from naibu.imaging.markers.settings import SequenceSettings

# Empirical values, judged by tests/imaging/markers/test_sequence_tracking.py and benchmarks/sense_markers.py.
BESIDE = 4  # frames before, and as many after, through which the line of a position goes
ABOVE_NOISE = 1.5  # a principal motion counts if its singular value exceeds that of noise alone by this factor
FILLINGS = 60  # decompositions at most
REJECTIONS = 3  # rounds of outlier rejection at most


def completed(tracks: Sequence[Track], n: int, diameter: FloatArray, settings: SequenceSettings) -> tuple[FloatArray, BoolArray]:
    """Drop outliers and fill gaps; return positions (n, m, 2), mm, of m tracks in n frames, and which were seen (n, m)."""
    points, seen = np.full((n, len(tracks), 2), np.nan), np.zeros((n, len(tracks)), dtype=bool)
    for k, track in enumerate(tracks):
        points[track.frames, k], seen[track.frames, k] = track.points, True
    for _ in range(REJECTIONS):
        wrong = _outliers(points / diameter, seen, settings)
        seen &= ~wrong
        if not wrong.any():
            break
    return np.where(seen[:, :, None], points, _filled(points, seen, int(settings.shared_motions))), seen


def _outliers(at: FloatArray, seen: BoolArray, settings: SequenceSettings) -> BoolArray:
    """Tell which positions (t, n, 2), diameters, fit neither those around, before or after, nor what the others do then."""
    off, least = np.full_like(at, np.nan), np.full(seen.shape, np.nan)
    for k in range(at.shape[1]):
        when = np.flatnonzero(seen[:, k])
        for i, t in enumerate(when if len(when) >= 2 * BESIDE else ()):
            before, after = when[max(i - BESIDE, 0) : i], when[i + 1 : i + BESIDE + 1]
            off[t, k] = _beside_line(np.concatenate([before, after]) - t, at[np.concatenate([before, after]), k] - at[t, k])
            sides = [_beside_line(side - t, at[side, k] - at[t, k]) for side in (before, after) if len(side)]
            least[t, k] = min(float(np.linalg.norm(v)) for v in (off[t, k], *sides))
    for k in range(at.shape[1] if at.shape[1] > 2 else 0):
        others = np.delete(off, k, axis=1)
        together = np.flatnonzero(np.isfinite(others[:, :, 0]).sum(axis=1) >= 2)
        apart = np.linalg.norm(off[together, k] - np.nanmedian(others[together], axis=1), axis=1)
        least[together, k] = np.fmin(least[together, k], apart)
    known = np.isfinite(least)
    typical = float(np.median(least[known])) if known.any() else 0.0
    return np.asarray(known & (least > max(settings.outlier_sd * 1.4826 * typical, settings.min_outlier)))


def _beside_line(dt: IntArray, off: FloatArray) -> FloatArray:
    """Return the value at time 0 of the Theil-Sen line through offsets (k, 2) at times dt (k,)."""
    if len(dt) == 1:
        return np.asarray(off[0])
    first, second = np.triu_indices(len(dt), 1)
    rate = np.median((off[second] - off[first]) / (dt[second] - dt[first])[:, None], axis=0)
    return np.asarray(np.median(off - rate * dt[:, None], axis=0))


def _filled(points: FloatArray, seen: BoolArray, most: int) -> FloatArray:
    """Fill gaps by at most so many principal motions of all markers, and linearly in time in what these leave."""
    n, m, _ = points.shape
    filled = _bridged(points, seen)
    start = np.linalg.svd((filled - filled.mean(axis=0)).reshape(n, -1), compute_uv=False)
    # the largest singular value of n x 2m noise is about its standard deviation times (sqrt(n) + sqrt(2m))
    sd = float(np.sqrt(np.nanmean(residual_sd(points, seen) ** 2)))
    modes = min(most, (2 * m) // 3, n - 1, int((start > ABOVE_NOISE * sd * (np.sqrt(n) + np.sqrt(2 * m))).sum()))
    for _ in range(FILLINGS if m > 2 and modes > 0 else 0):
        flat = filled.reshape(n, -1)
        mean = flat.mean(axis=0)
        u, s, w = np.linalg.svd(flat - mean, full_matrices=False)
        # without the part of noise, motions that are none would fill gaps with amplified noise
        kept = np.maximum(s[:modes] ** 2 - n * sd**2, 0.0) / np.maximum(s[:modes], 1e-300)
        shared = ((u[:, :modes] * kept) @ w[:modes] + mean).reshape(points.shape)
        new = np.where(seen[:, :, None], points, shared + _bridged(points - shared, seen))
        change = float(np.abs(new - filled).max())
        filled = new
        if change < 1e-6 * float(np.ptp(points[seen])):
            break
    return filled


def _bridged(values: FloatArray, seen: BoolArray) -> FloatArray:
    """Interpolate linearly in time between the frames in which every marker is seen."""
    t, out = np.arange(len(values)), np.empty_like(values)
    for k in range(values.shape[1]):
        for c in range(2):
            out[:, k, c] = np.interp(t, t[seen[:, k]], values[seen[:, k], k, c])
    return out


def residual_sd(points: FloatArray, seen: BoolArray) -> FloatArray:
    """Return the residual SD (n,), mm, of the coordinates of every marker from lines through three neighbouring frames."""
    out = np.full(points.shape[1], np.nan)
    for k in range(points.shape[1]):
        when = np.flatnonzero(seen[:, k])
        if len(when) >= 4:
            bend = points[when[2:], k] - 2.0 * points[when[1:-1], k] + points[when[:-2], k]
            # of white noise of unit variance a second difference has variance 1 + 4 + 1
            out[k] = max(1.4826 * float(np.median(np.abs(bend))) / float(np.sqrt(6.0)), 1e-9)
    return out


def position_sd(points: FloatArray, seen: BoolArray) -> FloatArray:
    """Return standard deviations (t, n), mm: the residual SD, growing as a random walk with the distance from the ends of a gap."""
    t = np.arange(len(points))[:, None]
    away = np.column_stack([np.abs(t - np.flatnonzero(one)).min(axis=1) for one in seen.T])
    return np.asarray(residual_sd(points, seen) * np.sqrt(1.0 + away))
