"""Markers in a sequence of images, such as B-mode ultrasound: found in every frame, followed through gaps, ghosts told apart (spec S9 c).

Echoes of the size of a marker are candidates in every frame. A track is the path through the candidates, over gaps where a marker is not
seen, that gains most by their strength and loses least by jumps (dynamic programming); the strongest is taken away before the next is
sought. Tracks that are weak, short, or a weaker copy of another on the same beam (reverberation) are rejected. Single positions that do not
fit what all markers do together are dropped, and gaps are filled by what the others do meanwhile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import maximum_filter

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.markers import Markers
from naibu.imaging.preprocessing.filters import smoothed

# smoothing in diameters, and how much wider those of the shell and of the background are
SMOOTHING, WIDER, WIDEST = 0.25, 2.5, 4.0
STANDING_OUT = 2.5  # times the noise: little, as a marker shows in most frames at places that agree
MOST_IN_FRAME = 60
# a jump from frame to frame, in diameters, that costs JUMP_COST (larger ones in proportion), and the largest one; frames beyond which a gap
# gives no more room; what a frame without an echo costs; strength below which an echo is as good as none, and beyond which more does not
# count; all in units of the strength of a usual marker
JUMP, JUMP_COST, LARGEST_JUMP, FAR_GAP, MISS_COST, BAR, STRONGEST = 0.25, 0.1, 1.5, 4, 0.02, 0.45, 1.5
# tracks seen in fewer frames, or that gain less than this share of the best, are none; below the last share the search ends
LEAST_SEEN, WEAK, WORTHLESS = 0.3, 0.3, 0.1
# a ghost is weaker than this share of another track, as far along the beam as this, in diameters, across it, and moves with it
GHOST_WEAKER, SAME_BEAM, MOVES_WITH = 0.8, 0.75, 0.3
SAME_ECHO = 0.6  # diameters
# a position departs from what those before and after tell by so many deviations, and by so many diameters at least; frames that tell it
DEPARTING, LEAST_DEPARTURE, BESIDE = 5.0, 0.2, 4
MODES, ABOVE_NOISE = 3, 1.5  # motions that markers share at most, and how far they stand out
FILLINGS = 60


class RejectedTrack(NamedTuple):
    """A track that is no marker: where it was on average (2,), mm, and why."""

    point: FloatArray
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class TrackedSequence:
    """Markers in every frame, numbered from left to right.

    Attributes
    ----------
    points : ndarray, shape (t, n, 2)
        Positions in the image, x to the right and y down, mm; the centre of the first pixel is the origin. Complete: see `seen`.
    seen : ndarray, shape (t, n)
        Whether a position was measured; else it is filled in by the motion of the others.
    sd_mm : ndarray, shape (t, n)
        Standard deviation of each coordinate, mm: scatter about the motion that the markers share, growing with the length of a gap.
    strength : ndarray, shape (n,)
        Median contrast of the echoes, grey values.
    rejected : tuple of RejectedTrack
        Ghosts and other tracks.
    """

    points: FloatArray
    seen: BoolArray
    sd_mm: FloatArray
    strength: FloatArray
    rejected: tuple[RejectedTrack, ...]

    def __len__(self) -> int:
        return int(self.points.shape[1])

    @property
    def middle(self) -> int:
        """Label of the middle one of the markers."""
        return 1 + len(self) // 2

    def markers(self, frame: int, *, origin: int | None = None, y_up: bool = True) -> Markers:
        """Return the markers of one frame as those of a plane (z is NaN).

        Parameters
        ----------
        frame : int
            Number of the frame; negative ones count from the end.
        origin : int, optional
            Label of the marker whose first position becomes the origin; `middle` is what the report does.
        y_up : bool
            Whether y shall point up the image.
        """
        if not -len(self.points) <= frame < len(self.points):
            raise InputError(f"frame {frame} is not among the {len(self.points)} frames of the sequence")
        start = np.zeros(2) if origin is None else self.points[0, origin - 1]
        plane = (self.points[frame] - start) * (1.0, -1.0 if y_up else 1.0)
        return Markers.from_arrays(np.arange(1, len(self) + 1), np.column_stack([plane, np.full(len(self), np.nan)]))


@dataclass(frozen=True, slots=True, eq=False)
class _Echoes:
    """Candidates of all frames: frame (m,), position (m, 2), mm, contrast (m,); those of frame t are ``first[t]`` to ``first[t + 1]``."""

    point: FloatArray
    strength: FloatArray
    first: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class _Track:
    """Frames (k,) in which it is seen, positions (k, 2), mm, strengths (k,), and what the path gains."""

    frames: IntArray
    points: FloatArray
    strengths: FloatArray
    worth: float

    @property
    def strength(self) -> float:
        return float(np.median(self.strengths))


def track_sequence(
    frames: ArrayLike,
    *,
    pixel_mm: float | Sequence[float],
    diameter_mm: float | Sequence[float],
    region_mm: Sequence[float] | None = None,
    mask: ArrayLike | None = None,
    count: int | None = None,
    polarity: Literal["bright", "dark"] = "bright",
    longest_gap: int = 60,
) -> TrackedSequence:
    """Follow markers through a sequence of images.

    Parameters
    ----------
    frames : array_like, shape (t, ny, nx)
        Grey values.
    pixel_mm : float or sequence of two
        Size of a pixel along x and y, mm.
    diameter_mm : float or sequence of two
        How large a marker looks along x and y, mm.
    region_mm : sequence of four, optional
        Least x, greatest x, least y, greatest y, mm, of the part of the image in which markers may lie: leaves out ghosts and walls.
    mask : array_like of bool, shape (ny, nx), optional
        The same, pixel by pixel.
    count : int, optional
        How many markers there are: so many tracks are kept, ghosts last.
    polarity : {"bright", "dark"}
        Whether markers are brighter or darker than what lies around.
    longest_gap : int
        Frames through which a marker may be unseen.

    Returns
    -------
    TrackedSequence
        Positions in every frame.

    Raises
    ------
    InputError
        Frames of a wrong shape, not finite or without contrast; sizes that are not positive or below a pixel; an empty region; no marker,
        or fewer than `count`.
    """
    v = _checked(frames)
    pixel, diameter = _two(pixel_mm, "pixel_mm"), _two(diameter_mm, "diameter_mm")
    if (diameter < 1.2 * pixel).any():
        raise InputError(f"diameter_mm is {diameter.tolist()}; it must exceed 1.2 pixels of {pixel.tolist()} mm")
    if count is not None and count < 1:
        raise InputError(f"count is {count}; leave it out where the number of markers is not known")
    allowed = _allowed(v.shape[1:], pixel, region_mm, mask)
    echoes, noise = _echoes(v if polarity == "bright" else -v, pixel, diameter, allowed)
    tracks = _tracks(echoes, diameter, longest_gap, 2 * count + 6 if count is not None else 40)
    kept, rejected = _markers_among(tracks, diameter, len(v), count)
    if not kept or (count is not None and len(kept) < count):
        strongest = max((t.strength for t in tracks), default=float(echoes.strength.max()) if len(echoes.strength) else 0.0)
        raise InputError(
            f"{len(kept)} markers were followed{f', {count} asked for' if count else ''}: the strongest echoes of that size have a "
            f"contrast of {strongest:.3g}, {strongest / noise:.1f} times the noise, and {len(tracks)} tracks were tried. "
            "Check diameter_mm, polarity and region"
        )
    kept.sort(key=lambda track: float(np.median(track.points[:, 0])))
    points, seen = _completed(kept, len(v), diameter)
    return TrackedSequence(points, seen, _deviations(points, seen), np.array([t.strength for t in kept]), tuple(rejected))


def _checked(frames: ArrayLike) -> Float32Array:
    v = np.asarray(frames)
    if v.ndim != 3 or 0 in v.shape:
        raise InputError(f"frames must have shape (t, ny, nx), not {v.shape}; choose one colour, and give one frame as (1, ny, nx)")
    if v.dtype.kind not in "biuf":
        raise InputError(f"grey values must be real numbers, not {v.dtype}")
    if v.dtype.kind == "f" and not np.isfinite(v).all():
        bad = tuple(int(i) for i in np.argwhere(~np.isfinite(v))[0])
        raise InputError(f"pixel {bad} (frame, y, x) is {v[bad]}; mask or repair it")
    if v.max() == v.min():
        raise InputError(f"all pixels are {v.flat[0]}: there is nothing to follow")
    return np.ascontiguousarray(v, dtype=np.float32)


def _two(value: float | Sequence[float], name: str) -> FloatArray:
    pair = np.ravel(np.asarray(value, dtype=float))
    if pair.size not in (1, 2) or not (np.isfinite(pair).all() and (pair > 0.0).all()):
        raise InputError(f"{name} must be a positive number, mm, or two (x, y), not {value}")
    return np.asarray(np.broadcast_to(pair, 2), dtype=float)


def _allowed(shape: tuple[int, ...], pixel: FloatArray, region: Sequence[float] | None, mask: ArrayLike | None) -> BoolArray:
    allowed = np.ones(shape, dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
    if allowed.shape != shape:
        raise InputError(f"the mask must have shape {shape} (y, x), not {allowed.shape}")
    if region is not None:
        if len(region) != 4 or not (region[0] < region[1] and region[2] < region[3]):
            raise InputError(f"region_mm must be least x, greatest x, least y, greatest y, mm, not {list(region)}")
        y, x = (np.arange(n) * p for n, p in zip(shape, pixel[::-1], strict=True))
        allowed = allowed & ((y >= region[2]) & (y <= region[3]))[:, None] & ((x >= region[0]) & (x <= region[1]))
    if not allowed.any():
        size = [round(float(n * p), 2) for n, p in zip(shape[::-1], pixel, strict=True)]
        raise InputError(f"no pixel lies in the region; the image measures {size} mm along x and y")
    return allowed


def _echoes(v: Float32Array, pixel: FloatArray, diameter: FloatArray, allowed: BoolArray) -> tuple[_Echoes, float]:
    """Find what stands out in every frame, to a fraction of a pixel; return also the noise of the contrast."""
    sigma = np.append(SMOOTHING * diameter / pixel, 0.0)
    # what is darker than its surroundings tells nothing of a bright marker: the holes of speckle are deep on a logarithmic scale
    v = np.maximum(v - smoothed(v, WIDEST * sigma), 0.0)
    contrast = smoothed(v, sigma) - smoothed(v, WIDER * sigma)
    inside = contrast[:, allowed]
    noise = max(1.4826 * float(np.median(np.abs(inside - np.median(inside)))), 1e-6 * float(np.ptp(v)))
    size = np.maximum(2 * np.round(0.4 * diameter / pixel).astype(int) + 1, 3)
    top = (contrast == maximum_filter(contrast, size=(1, int(size[1]), int(size[0])))) & allowed & (contrast > STANDING_OUT * noise)
    top[:, [0, -1], :], top[:, :, [0, -1]] = False, False
    t, j, i = np.nonzero(top)
    strength = contrast[t, j, i].astype(float)
    order = np.lexsort((-strength, t))
    t, j, i, strength = t[order], j[order], i[order], strength[order]
    rank = np.arange(len(t)) - np.searchsorted(t, t)
    t, j, i, strength = (a[rank < MOST_IN_FRAME] for a in (t, j, i, strength))
    around = np.stack([contrast[t, j + a, i + b] for a in (-1, 0, 1) for b in (-1, 0, 1)], axis=1).astype(float).reshape(-1, 3, 3)
    point = (np.column_stack([i, j]) + _summit(around)) * pixel
    return _Echoes(point, np.asarray(strength, dtype=float), np.searchsorted(t, np.arange(len(v) + 1))), noise


def _summit(around: FloatArray) -> FloatArray:
    """Return where the paraboloids through values (m, 3, 3) around peaks have their summits (m, 2), along x and y, pixels."""
    gx, gy = 0.5 * (around[:, :, 2] - around[:, :, 0]).mean(axis=1), 0.5 * (around[:, 2] - around[:, 0]).mean(axis=1)
    hxx = (around[:, :, 2] - 2.0 * around[:, :, 1] + around[:, :, 0]).mean(axis=1)
    hyy = (around[:, 2] - 2.0 * around[:, 1] + around[:, 0]).mean(axis=1)
    hxy = 0.25 * (around[:, 2, 2] - around[:, 2, 0] - around[:, 0, 2] + around[:, 0, 0])
    determinant = hxx * hyy - hxy**2
    good = (hxx < 0.0) & (determinant > 1e-12 * hxx**2)
    safe = np.where(good, determinant, 1.0)
    off = -np.column_stack([hyy * gx - hxy * gy, hxx * gy - hxy * gx]) / safe[:, None]
    return np.where(good[:, None], np.clip(off, -1.0, 1.0), 0.0)


def _tracks(echoes: _Echoes, diameter: FloatArray, longest_gap: int, most: int) -> list[_Track]:
    """Take away one path after another, the most gainful first."""
    n = len(echoes.first) - 1
    frame = np.repeat(np.arange(n), np.diff(echoes.first))
    if not len(frame):
        return []
    usual = float(np.median(np.maximum.reduceat(echoes.strength, np.unique(echoes.first[frame]))))
    gain = np.minimum(echoes.strength / usual, STRONGEST) - BAR
    free = gain > 0.0
    tracks: list[_Track] = []
    while len(tracks) < most and free.any():
        path, worth = _best_path(echoes, np.where(free, gain, -np.inf), diameter, longest_gap)
        if len(path) < max(min(n, 2), LEAST_SEEN * n) or (tracks and worth < WORTHLESS * tracks[0].worth):
            break
        tracks.append(_Track(frame[path], echoes.point[path], echoes.strength[path], worth))
        for p in path:
            here = slice(echoes.first[frame[p]], echoes.first[frame[p] + 1])
            free[here] &= (((echoes.point[here] - echoes.point[p]) / diameter) ** 2).sum(axis=1) > SAME_ECHO**2
    return tracks


def _best_path(echoes: _Echoes, gain: FloatArray, diameter: FloatArray, longest_gap: int) -> tuple[IntArray, float]:
    """Return the candidates of the path of greatest gain, and that, by dynamic programming."""
    first = echoes.first
    total, before = gain.copy(), np.full(len(gain), -1, dtype=np.int64)
    at = echoes.point / diameter
    for t in range(1, len(first) - 1):
        here = np.arange(first[t], first[t + 1])
        here = here[np.isfinite(gain[here])]
        if not len(here):
            continue
        there = np.arange(first[max(t - longest_gap - 1, 0)], first[t])
        there = there[total[there] > 0.0]
        if not len(there):
            continue
        gap = t - np.searchsorted(first, there, side="right") + 1
        square = ((at[here, None] - at[there]) ** 2).sum(axis=2) / np.minimum(gap, FAR_GAP)
        jump = np.sqrt(square) / JUMP
        cost = JUMP_COST * np.where(jump < 1.0, jump**2, 2.0 * jump - 1.0) + MISS_COST * (gap - 1)
        value = np.where(square <= LARGEST_JUMP**2, total[there] - cost, -np.inf)
        best = np.argmax(value, axis=1)
        gained = value[np.arange(len(here)), best]
        better = gained > 0.0
        total[here[better]] += gained[better]
        before[here[better]] = there[best[better]]
    path = [int(np.argmax(total))]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return np.array(path[::-1], dtype=np.int64), float(total.max())


def _markers_among(tracks: list[_Track], diameter: FloatArray, n: int, count: int | None) -> tuple[list[_Track], list[RejectedTrack]]:
    """Tell markers from weak tracks and from ghosts."""
    if not tracks:
        return [], []
    ranked = sorted(tracks, key=lambda t: -t.worth)
    strongest = ranked[0].worth
    kept: list[_Track] = []
    ghosts: list[_Track] = []
    rejected: list[RejectedTrack] = []
    for track in ranked:
        if any(_is_ghost(track, other, diameter) for other in kept):
            ghosts.append(track)
        elif count is None and track.worth < WEAK * strongest:
            rejected.append(RejectedTrack(np.median(track.points, axis=0), "weaker than the others"))
        else:
            kept.append(track)
    if count is not None:
        spare = kept[count:]
        rejected += [RejectedTrack(np.median(t.points, axis=0), "weaker than those asked for") for t in spare]
        kept = kept[:count]
        wanted = count - len(kept)
        kept, ghosts = kept + ghosts[:wanted], ghosts[wanted:]
    rejected += [RejectedTrack(np.median(t.points, axis=0), "the ghost of a stronger one") for t in ghosts]
    return kept, rejected


def _is_ghost(track: _Track, other: _Track, diameter: FloatArray) -> bool:
    """Whether a track is a weaker copy of another on the same beam, at whatever depth, that moves as the other does."""
    if track.strength > GHOST_WEAKER * other.strength:
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


def _completed(tracks: list[_Track], n: int, diameter: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Drop positions that depart from what all markers do, and fill gaps; return positions (t, n, 2) and which of them were seen."""
    points, seen = np.full((n, len(tracks), 2), np.nan), np.zeros((n, len(tracks)), dtype=bool)
    for k, track in enumerate(tracks):
        points[track.frames, k], seen[track.frames, k] = track.points, True
    for _ in range(3):
        wild = _departing(points / diameter, seen)
        seen &= ~wild
        if not wild.any():
            break
    return np.where(seen[:, :, None], points, _filled(points, seen)), seen


def _departing(at: FloatArray, seen: BoolArray) -> BoolArray:
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
    return np.asarray(known & (least > max(DEPARTING * 1.4826 * typical, LEAST_DEPARTURE)))


def _beside_line(dt: IntArray, off: FloatArray) -> FloatArray:
    """Return where the line of Theil and Sen through offsets (k, 2) at times dt (k,) passes at time 0."""
    if len(dt) == 1:
        return np.asarray(off[0])
    first, second = np.triu_indices(len(dt), 1)
    slope = np.median((off[second] - off[first]) / (dt[second] - dt[first])[:, None], axis=0)
    return np.asarray(np.median(off - slope * dt[:, None], axis=0))


def _filled(points: FloatArray, seen: BoolArray) -> FloatArray:
    """Fill gaps by the few motions that all markers share, and go straight from end to end in what is left."""
    n, m, _ = points.shape
    t = np.arange(n)

    def bridged(values: FloatArray) -> FloatArray:
        out = np.empty_like(values)
        for k in range(m):
            for c in range(2):
                out[:, k, c] = np.interp(t, t[seen[:, k]], values[seen[:, k], k, c])
        return out

    filled = bridged(points)
    start = np.linalg.svd((filled - filled.mean(axis=0)).reshape(n, -1), compute_uv=False)
    # of noise alone, singular values are about as large as the lengths of rows and columns together
    noise = float(np.sqrt(np.nanmean(_scatter(points, seen) ** 2))) * (np.sqrt(n) + np.sqrt(2 * m))
    modes = min(MODES, (2 * m) // 3, n - 1, int((start > ABOVE_NOISE * noise).sum()))
    for _ in range(FILLINGS if m > 2 and modes > 0 else 0):
        flat = filled.reshape(n, -1)
        mean = flat.mean(axis=0)
        u, s, w = np.linalg.svd(flat - mean, full_matrices=False)
        shared = ((u[:, :modes] * s[:modes]) @ w[:modes] + mean).reshape(points.shape)
        new = np.where(seen[:, :, None], points, shared + bridged(points - shared))
        change = float(np.abs(new - filled).max())
        filled = new
        if change < 1e-6 * float(np.ptp(points[seen])):
            break
    return filled


def _scatter(points: FloatArray, seen: BoolArray) -> FloatArray:
    """Return the standard deviation of the coordinates of every marker (n,) about straight lines through neighbouring frames."""
    out = np.full(points.shape[1], np.nan)
    for k in range(points.shape[1]):
        when = np.flatnonzero(seen[:, k])
        if len(when) >= 4:
            bend = points[when[2:], k] - 2.0 * points[when[1:-1], k] + points[when[:-2], k]
            out[k] = max(1.4826 * float(np.median(np.abs(bend))) / float(np.sqrt(6.0)), 1e-9)
    return out


def _deviations(points: FloatArray, seen: BoolArray) -> FloatArray:
    """Return standard deviations (t, n) from the scatter of neighbouring frames; in gaps as if the scatter added up from their ends."""
    t = np.arange(len(points))[:, None]
    away = np.column_stack([np.abs(t - np.flatnonzero(one)).min(axis=1) for one in seen.T])
    return np.asarray(_scatter(points, seen) * np.sqrt(1.0 + away))
