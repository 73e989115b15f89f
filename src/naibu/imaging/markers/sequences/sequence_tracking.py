"""Marker tracking in image sequences such as B-mode ultrasound :cite:p:`hirai2008` (chapter 2.2): through gaps, with ghosts rejected.

Detect-and-link tracking as of particles :cite:p:`crocker1996`, with the links found over all frames at once by dynamic programming
(`naibu.imaging.markers.sequences.sequence_paths`): a marker may be unseen for many frames. Tracks that are weak, short, or a weaker copy
of another on the same beam (reverberation) are rejected. Outliers are dropped, and gaps are filled by the motion that all markers share
(`naibu.imaging.markers.sequences.sequence_gaps`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, as_mask
from naibu.core.errors import InputError
from naibu.core.markers import Markers
from naibu.core.progress import Progress, report_progress
from naibu.imaging.markers.sequences.sequence_gaps import completed, position_sd
from naibu.imaging.markers.sequences.sequence_paths import RejectedTrack, find_echoes, find_tracks, markers_among
from naibu.imaging.markers.settings import SequenceSettings

EchoPolarity = Literal["bright", "dark"]
SPARE_TRACKS, MOST_TRACKS = 6, 40  # tracks that are sought beyond twice `count`, for ghosts; and in all where it is not given
LEAST_PIXELS = 1.2  # diameter of a marker, pixels, below which it is no larger than a single noisy pixel


@dataclass(frozen=True, slots=True, eq=False)
class TrackedSequence:
    """Positions of markers in every frame; markers are numbered from left to right.

    Attributes
    ----------
    points : ndarray, shape (t, n, 2)
        Positions in the image, x to the right and y down, mm; the centre of the first pixel is the origin. Complete: see `seen`.
    seen : ndarray, shape (t, n), bool
        Whether a position was measured; else it is filled in from the motion of the others.
    sd_mm : ndarray, shape (t, n)
        Standard deviation of each coordinate, mm: the residual SD from the motion through neighbouring frames, growing with the distance
        from the ends of a gap. Errors that stay the same from frame to frame, as by speckle that moves with the marker, do not show in it.
    strength : ndarray, shape (n,)
        Median contrast of the echoes, intensity.
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
            Label of the marker whose first position becomes the origin; the report takes `middle`.
        y_up : bool
            Whether y points up the image.

        Raises
        ------
        InputError
            No such frame, or no such marker.
        """
        if not -len(self.points) <= frame < len(self.points):
            raise InputError(f"frame {frame} is not among the {len(self.points)} frames of the sequence")
        if origin is not None and not 1 <= origin <= len(self):
            raise InputError(f"origin is {origin}; it must be the label of a marker, 1 to {len(self)}")
        start = np.zeros(2) if origin is None else self.points[0, origin - 1]
        plane = (self.points[frame] - start) * (1.0, -1.0 if y_up else 1.0)
        return Markers.from_arrays(np.arange(1, len(self) + 1), np.column_stack([plane, np.full(len(self), np.nan)]))


def track_sequence(
    frames: ArrayLike,
    *,
    pixel_mm: float | Sequence[float],
    diameter_mm: float | Sequence[float],
    region_mm: Sequence[float] | None = None,
    mask: ArrayLike | None = None,
    count: int | None = None,
    polarity: EchoPolarity = "bright",
    settings: SequenceSettings | None = None,
    progress: Progress | None = None,
) -> TrackedSequence:
    """Track markers through a sequence of images.

    Parameters
    ----------
    frames : array_like, shape (t, ny, nx)
        Intensities.
    pixel_mm : float or sequence of two
        Size of a pixel along x and y, mm.
    diameter_mm : float or sequence of two
        Diameter of a marker in the image along x and y, mm.
    region_mm : sequence of four, optional
        Least x, greatest x, least y, greatest y, mm, of the part of the image in which markers may lie: leaves out ghosts and walls.
    mask : array_like of bool, shape (ny, nx), optional
        The same, pixel by pixel.
    count : int, optional
        Number of markers: so many tracks are kept, ghosts last.
    polarity : {"bright", "dark"}
        Whether markers are brighter or darker than their surroundings.
    settings : SequenceSettings, optional
        How echoes are found and followed.
    progress : callable, optional
        Called with a `naibu.core.progress.ProgressReport` at every stage.

    Returns
    -------
    TrackedSequence
        Positions in every frame.

    Raises
    ------
    InputError
        Frames of a wrong shape, not finite or without contrast; sizes that are not positive, below a pixel or beyond the image; an empty
        region or mask; an unknown polarity; no marker, or fewer than `count`.
    """
    how = settings if settings is not None else SequenceSettings()
    v = _checked(frames)
    if polarity not in get_args(EchoPolarity):
        raise InputError(f"polarity must be 'bright' or 'dark', not {polarity!r}")
    pixel, diameter = lengths_mm("pixel_mm", pixel_mm), lengths_mm("diameter_mm", diameter_mm)
    _require_diameter(diameter, pixel, v.shape)
    if count is not None and count < 1:
        raise InputError(f"count is {count}; leave it out where the number of markers is not known")
    allowed = _allowed(v.shape[1:], pixel, region_mm, mask)
    report_progress(progress, "finding echoes", done=0, total=3)
    echoes, noise = find_echoes(v if polarity == "bright" else -v, pixel, diameter, allowed, how.min_contrast)
    report_progress(progress, "linking echoes", done=1, total=3)
    tracks = find_tracks(echoes, diameter, how, 2 * count + SPARE_TRACKS if count is not None else MOST_TRACKS)
    kept, rejected = markers_among(tracks, diameter, how, count)
    if not kept or (count is not None and len(kept) < count):
        strongest = max((t.strength for t in tracks), default=float(echoes.strength.max()) if len(echoes.strength) else 0.0)
        raise InputError(
            f"{len(kept)} markers were followed{f', {count} asked for' if count else ''}: the strongest echoes of that size have a "
            f"contrast of {strongest:.3g}, {strongest / noise:.1f} times the noise, and {len(tracks)} tracks were tried. "
            "Check diameter_mm, polarity and region_mm"
        )
    report_progress(progress, "filling gaps", done=2, total=3)
    kept.sort(key=lambda track: float(np.median(track.points[:, 0])))
    points, seen = completed(kept, len(v), diameter, how)
    report_progress(progress, "filling gaps", done=3, total=3)
    return TrackedSequence(points, seen, position_sd(points, seen), np.array([t.strength for t in kept]), tuple(rejected))


def lengths_mm(name: str, value: float | Sequence[float]) -> FloatArray:
    """Return one positive length for both axes, or two, as lengths (2,) along x and y, mm.

    Raises
    ------
    InputError
        Another number of values, or one that is not finite and positive.
    """
    pair = np.ravel(np.asarray(value, dtype=float))
    if pair.size not in (1, 2) or not (np.isfinite(pair).all() and (pair > 0.0).all()):
        raise InputError(f"{name} must be a positive number, mm, or two (x, y), not {value}")
    return np.asarray(np.broadcast_to(pair, 2), dtype=float)


def _checked(frames: ArrayLike) -> Float32Array:
    v = np.asarray(frames)
    if v.ndim != 3 or 0 in v.shape:
        raise InputError(f"frames must have shape (t, ny, nx), not {v.shape}; choose one colour, and give one frame as (1, ny, nx)")
    if v.dtype.kind not in "biuf":
        raise InputError(f"frames must hold real numbers, not {v.dtype}")
    if v.dtype.kind == "f" and not np.isfinite(v).all():
        bad = tuple(int(i) for i in np.argwhere(~np.isfinite(v))[0])
        raise InputError(f"frames: pixel {bad} (frame, y, x) is {v[bad]}; mask or repair it")
    if v.max() == v.min():
        raise InputError(f"frames: all pixels are {v.flat[0]}, so there is nothing to follow")
    return np.ascontiguousarray(v, dtype=np.float32)


def _require_diameter(diameter: FloatArray, pixel: FloatArray, shape: tuple[int, ...]) -> None:
    extent = pixel * np.array(shape[:0:-1])
    if (diameter < LEAST_PIXELS * pixel).any():
        raise InputError(f"diameter_mm is {diameter.tolist()}; it must exceed {LEAST_PIXELS:g} pixels of {pixel.tolist()} mm")
    if (diameter >= extent).any():
        raise InputError(
            f"diameter_mm is {diameter.tolist()}; it must be smaller than the image, {extent.round(2).tolist()} mm along x and y"
        )


def _allowed(shape: tuple[int, ...], pixel: FloatArray, region: Sequence[float] | None, mask: ArrayLike | None) -> BoolArray:
    """Return the pixels (ny, nx) in which markers may lie."""
    allowed: BoolArray = np.ones(shape, dtype=bool) if mask is None else as_mask("mask", mask, shape)
    if region is None:
        return allowed
    if len(region) != 4 or not (np.isfinite(region).all() and region[0] < region[1] and region[2] < region[3]):
        raise InputError(f"region_mm must be least x, greatest x, least y, greatest y, mm, not {list(region)}")
    y, x = (np.arange(n) * p for n, p in zip(shape, pixel[::-1], strict=True))
    allowed &= ((y >= region[2]) & (y <= region[3]))[:, None] & ((x >= region[0]) & (x <= region[1]))
    if not allowed.any():
        size = [round(float(n * p), 2) for n, p in zip(shape[::-1], pixel, strict=True)]
        raise InputError(f"no pixel lies in region_mm{' and mask' if mask is not None else ''}; the image measures {size} mm along x and y")
    return allowed
