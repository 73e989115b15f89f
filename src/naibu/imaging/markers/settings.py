"""Settings of marker detection, of marker linking and of marker tracking in image sequences; the defaults suit the scans of the gels.

The defaults are empirical: `benchmarks/sense_markers.py` and the tests of this package judge them on scenes whose truth is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.errors import InputError


def require_between(name: str, value: float, low: float, high: float, *, unit: str = "") -> None:
    """Refuse a number outside a closed range.

    Raises
    ------
    InputError
        It is not finite, or outside; the message names it, its value and the range.
    """
    if not (np.isfinite(value) and low <= value <= high):
        upper = f"{high:g}" if np.isfinite(high) else "infinity"
        raise InputError(f"{name} must lie between {low:g} and {upper}{f' {unit}' if unit else ''}, not {value:g}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SequenceSettings:
    """How `naibu.imaging.markers.sequence_tracking.track_sequence` finds and follows echoes.

    Attributes
    ----------
    min_contrast : float
        Least contrast of an echo, in standard deviations of the noise of the band-passed image; 0 or more. Lower values find fainter
        markers and more speckle.
    max_jump : float
        Largest displacement of a marker from frame to frame, in its diameters; above 0.
    longest_gap : int
        Frames through which a marker may be unseen; 0 or more.
    min_seen : float
        Least fraction of the frames in which a marker must be seen, 0 to 1.
    min_gain : float
        Least gain of a track as a fraction of the best one, 0 to 1, where the number of markers is not given.
    ghost_strength : float
        Strength, as a fraction of that of another track on the same beam, 0 to 1, below which a track may be its ghost; 0 keeps all ghosts.
    outlier_sd : float
        A position is an outlier beyond so many robust standard deviations of the residual from its neighbouring frames; above 0.
    min_outlier : float
        Residual below which no position is an outlier, in diameters; 0 or more.
    shared_motions : int
        Largest number of principal motions, shared by all markers, that fill gaps; 0 or more. 0 interpolates linearly in time; 1 suits a
        motion that one load drives.
    """

    min_contrast: float = 2.5
    max_jump: float = 1.5
    longest_gap: int = 60
    min_seen: float = 0.3
    min_gain: float = 0.3
    ghost_strength: float = 0.8
    outlier_sd: float = 5.0
    min_outlier: float = 0.2
    shared_motions: int = 3

    def __post_init__(self) -> None:
        for name in ("min_seen", "min_gain", "ghost_strength"):
            require_between(name, getattr(self, name), 0.0, 1.0)
        for name in ("min_contrast", "min_outlier", "longest_gap", "shared_motions"):
            require_between(name, getattr(self, name), 0.0, np.inf)
        for name in ("max_jump", "outlier_sd"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"{name} must be positive, not {getattr(self, name):g}")
        for name in ("longest_gap", "shared_motions"):
            if getattr(self, name) != int(getattr(self, name)):
                raise InputError(f"{name} must be a whole number, not {getattr(self, name):g}")
