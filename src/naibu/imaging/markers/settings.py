"""Settings of marker detection in volumes, of links between states, and of marker tracking in image sequences.

The defaults are empirical: `benchmarks/sense_markers.py` and the tests of this package judge them on scenes whose truth is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import require_positive
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
class DetectionSettings:
    """How `naibu.imaging.markers.detection.detect_markers` separates markers from noise, bubbles and streaks.

    Attributes
    ----------
    min_contrast : float
        Least contrast of a peak to the shell around it, in standard deviations of the noise of the smoothed volume; above 0. Lower values
        find fainter markers and more false peaks, and take longer.
    size_range : tuple of float
        Smallest and largest fitted diameter, as multiples of `diameter_mm`; above 0, increasing.
    size_ratio, content_ratio, elongation_ratio : float
        Largest ratio of diameter, of content (contrast times volume), and of the ratio of the two wider axes, to the median of all markers;
        1 or more. The tolerances widen to `spread_sd` where the population itself varies more.
    spread_sd : float
        Robust standard deviations of the population within which size, content and elongation are accepted in any case; 0 or more.
    outlier_sd : float
        Standard deviations from the median in size, content and thickness together beyond which a marker among 20 or more is rejected;
        above 0.
    max_deviation : float
        Largest standard deviation of the centre, in diameters, along the second most uncertain axis; above 0. What is no blob fits worse.
    min_distance : float
        Distance of two fits, in diameters, below which they are one marker; 0 or more.
    above_chance : float
        By how much, in standard deviations, half of the markers must exceed the strongest peak expected of noise alone; 0 or more.
    """

    min_contrast: float = 4.0
    size_range: tuple[float, float] = (0.4, 2.2)
    size_ratio: float = 1.28
    content_ratio: float = 1.8
    elongation_ratio: float = 1.5
    spread_sd: float = 5.0
    outlier_sd: float = 7.5
    max_deviation: float = 0.08
    min_distance: float = 0.45
    above_chance: float = 5.5

    def __post_init__(self) -> None:
        for name in ("min_contrast", "outlier_sd", "max_deviation"):
            require_positive(name, getattr(self, name))
        for name in ("size_ratio", "content_ratio", "elongation_ratio"):
            require_between(name, getattr(self, name), 1.0, np.inf)
        for name in ("spread_sd", "min_distance", "above_chance"):
            require_between(name, getattr(self, name), 0.0, np.inf)
        if len(self.size_range) != 2 or not 0.0 < self.size_range[0] < self.size_range[1]:
            raise InputError(f"size_range must be two increasing positive numbers, in diameters, not {self.size_range}")


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSettings:
    """How `naibu.imaging.markers.linking.point_matching.link_markers` links the markers of two states.

    Attributes
    ----------
    assign_up_to : int
        Number of markers up to which all are assigned at once; 0 or more. Beyond it links grow from seeds, which is faster and does not
        need a start.
    search_radii : tuple of float
        Distances from their expected position, in spacings, within which seeds are tried in turn where links grow; above 0, increasing.
    min_agreement : float
        Least fraction of the neighbours of a seed that one affine motion must find again, 0 to 1.
    residual_factor : float
        A link is rejected where its residual from the local affine fit exceeds so many medians of all residuals; above 0. Where all markers
        are assigned at once the residual is that from a thin-plate spline, and the factor `spline_residual_factor`.
    residual_bounds : tuple of float
        Least and largest such limit, in spacings; 0 or more, increasing.
    spline_residual_factor : float
        As `residual_factor`, where all markers are assigned at once.
    spline_residual_bounds : tuple of float
        As `residual_bounds`, where all markers are assigned at once.
    min_mean_confidence : float
        Mean probability of the links below which two states have no common structure, 0 to 1.
    """

    assign_up_to: int = 600
    search_radii: tuple[float, ...] = (4.0, 8.0, 16.0, np.inf)
    min_agreement: float = 0.55
    residual_factor: float = 4.5
    residual_bounds: tuple[float, float] = (0.15, 0.8)
    spline_residual_factor: float = 15.0
    spline_residual_bounds: tuple[float, float] = (0.25, 0.6)
    min_mean_confidence: float = 0.7

    def __post_init__(self) -> None:
        require_between("assign_up_to", self.assign_up_to, 0, np.inf)
        for name in ("min_agreement", "min_mean_confidence"):
            require_between(name, getattr(self, name), 0.0, 1.0)
        for name in ("residual_factor", "spline_residual_factor"):
            require_positive(name, getattr(self, name))
        for name in ("residual_bounds", "spline_residual_bounds"):
            bounds = getattr(self, name)
            if len(bounds) != 2 or not 0.0 <= bounds[0] < bounds[1]:
                raise InputError(f"{name} must be two increasing numbers, in spacings, 0 or more, not {bounds}")
        radii = self.search_radii
        if not radii or not radii[0] > 0.0 or (np.diff(radii) <= 0.0).any():
            raise InputError(f"search_radii must be increasing positive numbers, in spacings, not {radii}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SequenceSettings:
    """How `naibu.imaging.markers.sequences.sequence_tracking.track_sequence` finds and follows echoes.

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
        Largest number of principal motions, shared by all markers, that fill gaps; 0 or more. 0 interpolates linearly in time.
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
            require_positive(name, getattr(self, name))
        for name in ("longest_gap", "shared_motions"):
            if getattr(self, name) != int(getattr(self, name)):
                raise InputError(f"{name} must be a whole number, not {getattr(self, name):g}")
