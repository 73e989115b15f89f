"""Echoes in the frames of an image sequence, linked to tracks by dynamic programming; ghosts rejected.

Bright blobs of the size of a marker are the candidates of a frame :cite:p:`crocker1996`. A track is the path through the candidates that
gains most by their strength and loses least by jumps and gaps: the shortest-path form of multi-frame tracking, solved by dynamic
programming. The best track is removed before the next one is sought.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from naibu.imaging.markers.settings import SequenceSettings
from naibu.imaging.preprocessing.filters import smoothed

# Empirical values, judged by tests/imaging/markers/test_sequence_tracking.py and benchmarks/sense_markers.py.
# standard deviations of the Gaussians: of the marker, in diameters, and of shell and background, as multiples of it
SMOOTHING, WIDER, WIDEST = 0.25, 2.5, 4.0
MOST_IN_FRAME = 60  # candidates that are kept of a frame, which bounds the cost of a step of dynamic programming
# a jump from frame to frame, in diameters, that costs JUMP_COST: quadratic up to it and linear beyond, as Huber's loss; frames beyond which
# a gap gives no more room; cost of a frame without an echo; strengths at which the gain is 0, and beyond which it no longer grows; costs
# and strengths in units of the strength of a usual marker
JUMP, JUMP_COST, FAR_GAP, MISS_COST, BAR, STRONGEST = 0.25, 0.1, 4, 0.02, 0.45, 1.5
WORTHLESS = 0.1  # the search ends at a track whose gain is less than this fraction of the best one's
# a ghost lies within so many diameters of the beam of its marker, and a line through its depth against that of the marker leaves less
SAME_BEAM, MOVES_WITH = 0.75, 0.3
SAME_ECHO = 0.6  # diameters: echoes nearer to a track than this belong to it


class RejectedTrack(NamedTuple):
    """A track that is no marker: its median position (2,), mm, and why it was rejected."""

    point: FloatArray
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Echoes:
    """Candidates of all frames; those of frame t are ``first[t]`` to ``first[t + 1]``.

    Attributes
    ----------
    point : ndarray, shape (m, 2)
        Positions along x and y, mm.
    strength : ndarray, shape (m,)
        Contrast, intensity.
    first : ndarray, shape (t + 1,), int64
        Index of the first candidate of every frame.
    """

    point: FloatArray
    strength: FloatArray
    first: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A path through the candidates.

    Attributes
    ----------
    frames : ndarray, shape (k,), int64
        Frames in which it is seen.
    points : ndarray, shape (k, 2)
        Positions there, mm.
    strengths : ndarray, shape (k,)
        Contrast there, intensity.
    gain : float
        Gain of the path.
    """

    frames: IntArray
    points: FloatArray
    strengths: FloatArray
    gain: float

    @property
    def strength(self) -> float:
        """Median contrast, intensity."""
        return float(np.median(self.strengths))

    def rejected(self, reason: str) -> RejectedTrack:
        """Return the record of its rejection."""
        return RejectedTrack(np.median(self.points, axis=0), reason)


def find_echoes(v: Float32Array, pixel: FloatArray, diameter: FloatArray, allowed: BoolArray, min_contrast: float) -> tuple[Echoes, float]:
    """Return the local maxima of the band-passed frames, to a fraction of a pixel, and the noise SD of their contrast.

    Parameters
    ----------
    v : ndarray, shape (t, ny, nx)
        Intensities, markers bright.
    pixel, diameter : ndarray, shape (2,)
        Of a pixel and of a marker along x and y, mm.
    allowed : ndarray, shape (ny, nx), bool
        Where markers may lie.
    min_contrast : float
        See `naibu.imaging.markers.settings.SequenceSettings`.
    """
    sigma = np.append(SMOOTHING * diameter / pixel, 0.0)
    # only what exceeds the background counts: on a logarithmic scale the holes of speckle are deep, and would make rims seem bright
    v = np.maximum(v - smoothed(v, WIDEST * sigma), 0.0)
    contrast = smoothed(v, sigma) - smoothed(v, WIDER * sigma)
    inside = contrast[:, allowed]
    noise = max(1.4826 * float(np.median(np.abs(inside - np.median(inside)))), 1e-6 * float(np.ptp(v)))
    size = np.maximum(2 * np.round(0.4 * diameter / pixel).astype(int) + 1, 3)
    top = (contrast == maximum_filter(contrast, size=(1, int(size[1]), int(size[0])))) & allowed & (contrast > min_contrast * noise)
    top[:, [0, -1], :], top[:, :, [0, -1]] = False, False
    t, j, i = np.nonzero(top)
    strength = contrast[t, j, i].astype(float)
    order = np.lexsort((-strength, t))
    t, j, i, strength = t[order], j[order], i[order], strength[order]
    rank = np.arange(len(t)) - np.searchsorted(t, t)
    t, j, i, strength = (a[rank < MOST_IN_FRAME] for a in (t, j, i, strength))
    around = np.stack([contrast[t, j + a, i + b] for a in (-1, 0, 1) for b in (-1, 0, 1)], axis=1).astype(float).reshape(-1, 3, 3)
    point = (np.column_stack([i, j]) + _summit(around)) * pixel
    return Echoes(point, np.asarray(strength, dtype=float), np.searchsorted(t, np.arange(len(v) + 1))), noise


def _summit(around: FloatArray) -> FloatArray:
    """Return the vertices (m, 2), along x and y, pixels, of the paraboloids through values (m, 3, 3) around maxima."""
    gx, gy = 0.5 * (around[:, :, 2] - around[:, :, 0]).mean(axis=1), 0.5 * (around[:, 2] - around[:, 0]).mean(axis=1)
    hxx = (around[:, :, 2] - 2.0 * around[:, :, 1] + around[:, :, 0]).mean(axis=1)
    hyy = (around[:, 2] - 2.0 * around[:, 1] + around[:, 0]).mean(axis=1)
    hxy = 0.25 * (around[:, 2, 2] - around[:, 2, 0] - around[:, 0, 2] + around[:, 0, 0])
    determinant = hxx * hyy - hxy**2
    good = (hxx < 0.0) & (determinant > 1e-12 * hxx**2)
    safe = np.where(good, determinant, 1.0)
    off = -np.column_stack([hyy * gx - hxy * gy, hxx * gy - hxy * gx]) / safe[:, None]
    return np.where(good[:, None], np.clip(off, -1.0, 1.0), 0.0)


def find_tracks(echoes: Echoes, diameter: FloatArray, settings: SequenceSettings, most: int) -> list[Track]:
    """Return at most `most` tracks, the one of greatest gain first; each is removed before the next one is sought."""
    n = len(echoes.first) - 1
    frame = np.repeat(np.arange(n), np.diff(echoes.first))
    if not len(frame):
        return []
    usual = float(np.median(np.maximum.reduceat(echoes.strength, np.unique(echoes.first[frame]))))
    gain = np.minimum(echoes.strength / usual, STRONGEST) - BAR
    free = gain > 0.0
    tracks: list[Track] = []
    while len(tracks) < most and free.any():
        path, total = _best_path(echoes, np.where(free, gain, -np.inf), diameter, settings)
        if len(path) < max(min(n, 2), settings.min_seen * n) or (tracks and total < WORTHLESS * tracks[0].gain):
            break
        tracks.append(Track(frame[path], echoes.point[path], echoes.strength[path], total))
        for p in path:
            here = slice(echoes.first[frame[p]], echoes.first[frame[p] + 1])
            free[here] &= (((echoes.point[here] - echoes.point[p]) / diameter) ** 2).sum(axis=1) > SAME_ECHO**2
    return tracks


def _best_path(echoes: Echoes, gain: FloatArray, diameter: FloatArray, settings: SequenceSettings) -> tuple[IntArray, float]:
    """Return the candidates of the path of greatest gain, and that gain, by dynamic programming."""
    first = echoes.first
    total, before = gain.copy(), np.full(len(gain), -1, dtype=np.int64)
    at = echoes.point / diameter
    for t in range(1, len(first) - 1):
        here = np.arange(first[t], first[t + 1])
        here = here[np.isfinite(gain[here])]
        if not len(here):
            continue
        there = np.arange(first[max(t - int(settings.longest_gap) - 1, 0)], first[t])
        there = there[total[there] > 0.0]
        if not len(there):
            continue
        gap = t - np.searchsorted(first, there, side="right") + 1
        square = ((at[here, None] - at[there]) ** 2).sum(axis=2) / np.minimum(gap, FAR_GAP)
        jump = np.sqrt(square) / JUMP
        cost = JUMP_COST * np.where(jump < 1.0, jump**2, 2.0 * jump - 1.0) + MISS_COST * (gap - 1)
        value = np.where(square <= settings.max_jump**2, total[there] - cost, -np.inf)
        best = np.argmax(value, axis=1)
        gained = value[np.arange(len(here)), best]
        better = gained > 0.0
        total[here[better]] += gained[better]
        before[here[better]] = there[best[better]]
    path = [int(np.argmax(total))]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return np.array(path[::-1], dtype=np.int64), float(total.max())


def markers_among(
    tracks: list[Track], diameter: FloatArray, settings: SequenceSettings, count: int | None
) -> tuple[list[Track], list[RejectedTrack]]:
    """Return the tracks of markers, `count` of them where it is given, and the rejected ones: weak tracks and ghosts."""
    if not tracks:
        return [], []
    ranked = sorted(tracks, key=lambda t: -t.gain)
    strongest = ranked[0].gain
    kept: list[Track] = []
    ghosts: list[Track] = []
    rejected: list[RejectedTrack] = []
    for track in ranked:
        if any(_is_ghost(track, other, diameter, settings.ghost_strength) for other in kept):
            ghosts.append(track)
        elif count is None and track.gain < settings.min_gain * strongest:
            rejected.append(track.rejected("weaker than the others"))
        else:
            kept.append(track)
    if count is not None:
        rejected += [t.rejected("weaker than those asked for") for t in kept[count:]]
        kept = kept[:count]
        wanted = count - len(kept)
        kept, ghosts = kept + ghosts[:wanted], ghosts[wanted:]
    return kept, rejected + [t.rejected("ghost of a stronger one") for t in ghosts]


def _is_ghost(track: Track, other: Track, diameter: FloatArray, ghost_strength: float) -> bool:
    """Whether a track is a weaker copy of another on the same beam, at any depth, that moves in proportion to it."""
    if track.strength > ghost_strength * other.strength:
        return False
    _, a, b = np.intersect1d(track.frames, other.frames, return_indices=True)
    if len(a) < 2:
        return False
    off = (track.points[a] - other.points[b]) / diameter
    if abs(float(np.median(off[:, 0]))) > SAME_BEAM:
        return False
    depth, copied = other.points[b, 1], track.points[a, 1]
    design = np.column_stack([np.ones(len(a)), depth])
    left = copied - design @ np.linalg.lstsq(design, copied, rcond=1e-9)[0]
    return float(np.median(np.abs(left))) < MOVES_WITH * float(diameter[1])
