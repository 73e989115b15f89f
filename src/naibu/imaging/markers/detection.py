"""Marker detection in CT and MR volumes :cite:p:`hirai2008` (chapter 2): washers and beads, dark or bright, located to sub-voxel accuracy.

The volume is smoothed to the size of the markers, and local maxima are candidates, as in particle tracking :cite:p:`crocker1996`. Their
contrast is that to the shell around them, so that edges of the object, slow shading and noise do not count; the threshold is the valley
below the population of strongest peaks. A Gaussian blob is fitted to each peak by the Levenberg-Marquardt method :cite:p:`marquardt1963`,
with its neighbours subtracted, so that markers that touch are separated. Blobs that differ from the population in size, shape or content
(bubbles, streaks, specks) are rejected, and reported as such. Washers thinner than a slice are located by `naibu.imaging.markers.washers`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.progress import Progress, report_progress
from naibu.core.volume import Volume
from naibu.imaging.markers._blob_kernels import BLOB_PARAMETERS, fit_blobs
from naibu.imaging.markers.peaks import POPULATION, SMOOTHING, Peaks, find_peaks, noise_level, shell_reach, valley
from naibu.imaging.markers.settings import DetectionSettings
from naibu.imaging.markers.washers import placed_plates
from naibu.imaging.preprocessing.filters import smoothed
from naibu.imaging.preprocessing.resampling import require_mask

Polarity = Literal["bright", "dark", "auto"]

# Empirical values, judged by tests/imaging/markers/test_detection.py and benchmarks/sense_markers.py, unless said otherwise.
MANY_ALIKE = 20  # markers from which on outliers in size, content and thickness together are sought
# standard deviations of the logarithms of size, content and thickness that are assumed at least: 4 % and 10 %
SIZE_SD, CONTENT_SD, THICKNESS_SD = 0.04, 0.1, 0.1
# plates whose fitted width is below the second of these, in slices, and that lie this close (cosine) to an axis of the volume, are located
# across it by their radial profile; below the first one along it, too
HIDDEN, UNRESOLVED, UPRIGHT = 0.6, 1.0, 0.94
# thickness of a washer of which only the diameter is known, in diameters: that of an M1 washer, 0.3 mm of 2.8 mm
THIN = 0.11
SAMPLED = 0.08  # bias, in slices, of the Gaussian fit to a plate that two slices show, whose profile is not Gaussian
THINNEST = 0.3  # least width of a fitted blob, voxels
MOST_SHARED = 50.0  # largest number of voxels with common noise, which is estimated from what smoothing leaves of the noise
CONSTRAINED, FREE = 1e12, 1.0  # weight of the prior on the axes of a blob: those of the volume, or any
# windows of the fits: half their width in diameters, and voxels besides; the first is for a quick look
ROUNDS = ((0.55, 0.5), (0.75, 1.0))
# after the first look: fraction of the valley of the scores below which no blob is fitted again, and fraction of the better polarity's
# energy that the other one must reach to be fitted again
HOPELESS, WORTH = 0.4, 0.25
NO_BLOB, FAINTER = "no blob of that size fits", "fainter than the others"


class Rejected(NamedTuple):
    """A candidate that is no marker: its position (3,), mm, and why it was rejected."""

    point: FloatArray
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class DetectedMarkers:
    """Markers of one volume, in the order of z, y, x.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Centres in the frame of the scan, mm.
    covariance : ndarray, shape (n, 3, 3)
        Of the centres, mm^2; includes the uncertainty along an axis on which the slices are thicker than a marker.
    size_mm : ndarray, shape (n,)
        Diameter of the disc as wide as the marker in the image, blur included.
    score : ndarray, shape (n,)
        Signal to noise: root of the sum of squares of the fitted blob over its voxels, by the standard deviation of a voxel's noise.
    polarity : str
        ``"bright"`` or ``"dark"``.
    rejected : tuple of Rejected
        Candidates that are no markers.
    """

    points: FloatArray
    covariance: FloatArray
    size_mm: FloatArray
    score: FloatArray
    polarity: Literal["bright", "dark"]
    rejected: tuple[Rejected, ...]

    def __len__(self) -> int:
        return len(self.points)

    @property
    def sd_mm(self) -> FloatArray:
        """Standard deviation of every coordinate (n, 3), mm."""
        return np.asarray(np.sqrt(np.einsum("nii->ni", self.covariance)))


@dataclass(frozen=True, slots=True, eq=False)
class _Fits:
    """Blobs fitted to peaks; positions are index times spacing, mm."""

    centres: FloatArray
    widths: FloatArray  # (n, 3), from the widest axis to the thinnest
    axes: FloatArray  # (n, 3, 3), columns in the same order
    content: FloatArray
    covariance: FloatArray
    score: FloatArray

    @property
    def size(self) -> FloatArray:
        """Diameter (n,), mm, of the disc that is as wide."""
        return np.asarray(4.0 * np.sqrt(self.widths[:, 0] * self.widths[:, 1]))

    def chosen(self, which: IntArray) -> _Fits:
        return _Fits(*(getattr(self, name)[which] for name in _Fits.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """Peaks of one polarity and the blobs fitted to them so far (n, 11), NaN where none fits."""

    sign: float
    smooth_noise: float
    strongest: float
    voxels: int
    noise: float
    spacing: FloatArray
    starts: FloatArray
    fits: FloatArray
    covariance: FloatArray

    def chosen(self, which: IntArray) -> _Look:
        return replace(self, starts=self.starts[which], fits=self.fits[which], covariance=self.covariance[which])

    def shape(self, good: BoolArray) -> _Fits:
        return _shape(self.fits[good], self.covariance[good], self.noise, self.spacing)


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Markers of one polarity, and rejected candidates."""

    sign: float
    kept: _Fits
    rejected: tuple[Rejected, ...]

    @property
    def energy(self) -> float:
        return float((self.kept.score**2).sum())

    @property
    def summary(self) -> str:
        """How many candidates were rejected and why, in words."""
        reasons = [r.reason for r in self.rejected]
        counts = {reason: reasons.count(reason) for reason in dict.fromkeys(reasons)}
        return "rejected: " + ", ".join(f"{n} {reason}" for reason, n in counts.items()) if counts else "there was no other candidate"


def detect_markers(
    volume: Volume,
    *,
    diameter_mm: float,
    thickness_mm: float | None = None,
    polarity: Polarity = "auto",
    mask: ArrayLike | None = None,
    count: int | None = None,
    settings: DetectionSettings | None = None,
    progress: Progress | None = None,
) -> DetectedMarkers:
    """Detect equal markers in a volume, to sub-voxel accuracy.

    Parameters
    ----------
    volume : Volume
        CT, MR or microscope scan.
    diameter_mm : float
        Diameter of a bead, or outer diameter of a washer, mm; an error of 30 % does little harm.
    thickness_mm : float, optional
        Thickness of a washer, mm, at most its diameter: locates it better along an axis on which the slices are thicker.
    polarity : {"auto", "bright", "dark"}
        Whether markers are brighter or darker than their surroundings; ``"auto"`` takes the one with more contrast.
    mask : array_like of bool, shape (nz, ny, nx), optional
        Where markers may lie.
    count : int, optional
        Number of markers, 1 or more: the `count` strongest are kept.
    settings : DetectionSettings, optional
        How markers are separated from other peaks.
    progress : callable, optional
        Called with a `naibu.core.progress.ProgressReport` at every stage.

    Returns
    -------
    DetectedMarkers
        Centres, covariances, sizes and scores.

    Raises
    ------
    InputError
        No marker found, or fewer than `count`; a diameter below the size of a voxel or beyond that of the volume; a thickness that is not
        positive or above the diameter; an empty mask or one of another shape; a volume that is not finite or without contrast.
    """
    allowed = _checked(volume, diameter_mm, thickness_mm, polarity, mask, count)
    how = settings if settings is not None else DetectionSettings()
    report_progress(progress, "finding peaks", done=0, total=3)
    values = np.ascontiguousarray(volume.values, dtype=np.float32)
    smooth = smoothed(values, SMOOTHING * diameter_mm / volume.spacing_mm)
    signs = {"bright": (1.0,), "dark": (-1.0,), "auto": (1.0, -1.0)}[polarity]
    peaks = [find_peaks(smooth, sign, allowed, volume.spacing_mm, diameter_mm, how.min_contrast) for sign in signs]
    looks = [_first_look(values, some, volume, diameter_mm) for some in peaks]
    worth = WORTH * max(_settled(look, diameter_mm, count, how)[0].energy for look in looks)
    looks = [look for look in looks if len(looks) == 1 or _settled(look, diameter_mm, count, how)[0].energy >= worth]
    report_progress(progress, "fitting blobs", done=1, total=3)
    found = max((_found(values, look, volume, diameter_mm, count, how) for look in looks), key=lambda f: f.energy)
    if count is not None and len(found.kept.score) < count:
        raise InputError(
            f"{len(found.kept.score)} markers found, {count} asked for; {found.summary}. Lower `count`, or check diameter_mm and `mask`"
        )
    if not len(found.kept.score):
        what = "bright or dark" if polarity == "auto" else polarity
        strongest, noise = max((look.strongest, look.smooth_noise) for look in looks)
        raise InputError(
            f"no {what} marker of about {diameter_mm:g} mm was found: the strongest peak of that size has a contrast of {strongest:.3g}, "
            f"{strongest / noise:.1f} times the noise ({how.min_contrast:g} times are needed); {found.summary}. "
            "Check diameter_mm, `polarity` and `mask`"
        )
    report_progress(progress, "locating markers", done=2, total=3)
    centres, covariance = _located(values * np.float32(found.sign), found.kept, volume.spacing_mm, diameter_mm, thickness_mm)
    report_progress(progress, "locating markers", done=3, total=3)
    return _reported(volume, found, centres, covariance)


def _checked(
    volume: Volume, diameter_mm: float, thickness_mm: float | None, polarity: str, mask: ArrayLike | None, count: int | None
) -> BoolArray:
    if min(volume.shape) < 3:
        raise InputError(f"volume must have at least 3 voxels along every axis, not {volume.shape} (z, y, x)")
    spacing, extent = volume.spacing_mm, volume.spacing_mm * np.array(volume.shape[::-1])
    if not (np.isfinite(diameter_mm) and 1.2 * spacing.min() <= diameter_mm <= 0.5 * extent.max()):
        raise InputError(
            f"diameter_mm is {diameter_mm:g}: with voxels of {spacing.round(4).tolist()} mm and a volume of {extent.round(1).tolist()} mm "
            f"it must lie between {1.2 * spacing.min():.3g} and {0.5 * extent.max():.3g}"
        )
    if thickness_mm is not None and not 0.0 < thickness_mm <= diameter_mm:
        raise InputError(
            f"thickness_mm is {thickness_mm:g}; it must be positive and at most the diameter {diameter_mm:g} mm (leave it out for beads)"
        )
    if polarity not in ("bright", "dark", "auto"):
        raise InputError(f"polarity must be 'bright', 'dark' or 'auto', not {polarity!r}")
    if count is not None and count < 1:
        raise InputError(f"count is {count}; leave it out where the number of markers is not known")
    if volume.values.dtype.kind == "f" and not np.isfinite(volume.values).all():
        raise InputError("volume holds values that are not finite; mask or repair them")
    allowed = np.ones(volume.shape, dtype=bool) if mask is None else require_mask(mask, volume)
    if float(np.ptp(volume.values[allowed])) == 0.0:
        raise InputError(f"all voxels of volume are {volume.values[allowed][0]}: there is nothing to find")
    return allowed


def _first_look(values: Float32Array, peaks: Peaks, volume: Volume, diameter: float) -> _Look:
    """Fit a blob to the inner part of every peak above the threshold, each by itself."""
    spacing = volume.spacing_mm
    some = peaks.contrast >= peaks.threshold
    at = peaks.index[some, ::-1] * spacing
    blobs = np.zeros((len(at), BLOB_PARAMETERS))
    blobs[:, 0], blobs[:, 1], blobs[:, 2:5] = peaks.level[some], peaks.contrast[some], at
    blobs[:, [5, 7, 10]] = 1.0 / np.maximum(SMOOTHING * diameter, 0.5 * spacing)
    noise = noise_level(values, np.ones(values.shape, dtype=bool), shell_reach(diameter, spacing))
    look = _Look(peaks.sign, peaks.noise, peaks.strongest, values.size, noise, spacing, blobs, blobs, np.zeros((len(at), 3, 3)))
    return _fitted_again(values, look, diameter, ROUNDS[0], CONSTRAINED, alone=True) if len(at) else look


def _found(values: Float32Array, look: _Look, volume: Volume, diameter: float, count: int | None, how: DetectionSettings) -> _Found:
    """Fit blobs again, in wider windows, with the neighbours' last fits subtracted; return the markers and the rejected candidates.

    Their axes are those of the volume, and in the last round free where the markers are not thinner than the slices.
    """
    spacing = volume.spacing_mm
    failed: list[Rejected] = []
    for window, tilt in ((ROUNDS[1], CONSTRAINED), (ROUNDS[1], FREE)):
        good = np.isfinite(look.fits[:, 0])
        failed += [Rejected(p, NO_BLOB) for p in look.starts[~good, 2:5]]
        if not good.any():
            return _Found(look.sign, look.shape(good), tuple(failed))
        score = look.shape(good).score
        strong = np.sort(score)[::-1][: count or len(score)]
        hopeless = score < HOPELESS * min(valley(score), strong[-1] if count else np.inf)
        failed += [Rejected(p, FAINTER) for p in look.fits[good][hopeless, 2:5]]
        look = look.chosen(np.flatnonzero(good)[~hopeless])
        thin = tilt == FREE and _thin(look.shape(np.isfinite(look.fits[:, 0])), spacing) is not None
        look = _fitted_again(values, look, diameter, window, CONSTRAINED if thin else tilt, alone=False)
    found, failures = _settled(look, diameter, count, how)
    return _Found(found.sign, found.kept, (*failed, *failures, *found.rejected))


def _settled(look: _Look, diameter: float, count: int | None, how: DetectionSettings) -> tuple[_Found, list[Rejected]]:
    """Return the fits that are markers, and the peaks to which no blob fits."""
    good = np.isfinite(look.fits[:, 0])
    fits = look.shape(good)
    keep, rejected = _population(fits, diameter, count, how)
    # the largest of n standard normal variables seldom exceeds sqrt(2 log n)
    room = np.prod(np.maximum(2.0 * np.sqrt(np.pi) * SMOOTHING * diameter / look.spacing, 1.0))
    shared = np.clip((look.smooth_noise / look.noise) ** 2 * room, 1.0, MOST_SHARED)
    above = fits.score[keep] / np.sqrt(shared) - np.sqrt(2.0 * np.log(look.voxels))
    by_chance = np.full(len(keep), True) if len(keep) and np.median(above) < how.above_chance else above < 0.0
    rejected += [Rejected(p, "no stronger than noise") for p in fits.centres[keep[by_chance]]]
    keep = keep[~by_chance]
    # noise alone leaves a blob that stands out less uncertain: more says that what was fitted is no blob
    vague = np.sqrt(shared * np.linalg.eigvalsh(fits.covariance[keep])[:, 1]) > how.max_deviation * diameter
    rejected += [Rejected(p, NO_BLOB) for p in fits.centres[keep[vague]]]
    kept = fits.chosen(keep[~vague])
    kept.covariance[:] *= shared
    return _Found(look.sign, kept, tuple(rejected)), [Rejected(p, NO_BLOB) for p in look.starts[~good, 2:5]]


def _fitted_again(values: Float32Array, look: _Look, diameter: float, window: tuple[float, float], tilt: float, *, alone: bool) -> _Look:
    """Fit every blob within a window of so many diameters and voxels, those near it subtracted unless `alone`."""
    known = np.isfinite(look.fits)
    start = np.where(known, look.fits, look.starts)
    reach = 2.0 * float((window[0] * diameter + window[1] * look.spacing).max())
    pairs = np.zeros((0, 2), dtype=np.int64) if alone else cKDTree(look.starts[:, 2:5]).query_pairs(reach, output_type="ndarray")
    first, near = _neighbours(pairs, known[:, 0])
    fits, covariance = np.full_like(start, np.nan), np.zeros((len(start), 3, 3))
    radius, least = window[0] * diameter + window[1] * look.spacing, THINNEST * look.spacing
    fit_blobs(values, look.sign, look.noise**2, tilt, start, first, near, look.spacing, radius, least, fits, covariance)
    return replace(look, fits=fits, covariance=covariance)


def _shape(fits: FloatArray, covariance: FloatArray, noise: float, spacing: FloatArray) -> _Fits:
    """Return widths, axes, content and score of fitted parameters (n, 11)."""
    factor = np.zeros((len(fits), 3, 3))
    factor[:, [0, 1, 1, 2, 2, 2], [0, 0, 1, 0, 1, 2]] = fits[:, 5:]
    inverse_square, axes = np.linalg.eigh(factor @ factor.transpose(0, 2, 1))
    widths = 1.0 / np.sqrt(inverse_square)
    room = widths.prod(axis=1)
    score = fits[:, 1] * np.sqrt(np.pi**1.5 * room / spacing.prod()) / noise  # root of the sum of squares over the voxels
    return _Fits(fits[:, 2:5], widths, axes, fits[:, 1] * room, covariance, score)


def _thin(fits: _Fits, spacing: FloatArray) -> int | None:
    """Return the axis (0, 1, 2 for x, y, z) along which most markers are plates thinner than the slices; None where they are not."""
    if not len(fits.score):
        return None
    strong = fits.score > 0.5 * np.percentile(fits.score, 90)
    normals, widths = fits.axes[strong][:, :, 2], np.median(fits.widths[strong], axis=0)
    mean = np.abs(np.median(np.abs(normals), axis=0))
    axis = int(np.argmax(mean))
    upright = mean[axis] > UPRIGHT * np.linalg.norm(mean)
    return axis if upright and widths[2] < UNRESOLVED * spacing[axis] and widths[1] > 1.5 * widths[2] else None


def _neighbours(pairs: IntArray, present: BoolArray) -> tuple[IntArray, IntArray]:
    """Return lists of neighbours: those of b are ``near[first[b] : first[b + 1]]``."""
    both = np.concatenate([pairs, pairs[:, ::-1]]) if len(pairs) else np.zeros((0, 2), dtype=np.int64)
    both = both[present[both[:, 1]]]
    both = both[np.argsort(both[:, 0], kind="stable")]
    return np.searchsorted(both[:, 0], np.arange(len(present) + 1)), np.ascontiguousarray(both[:, 1], dtype=np.int64)


def _population(fits: _Fits, diameter: float, count: int | None, how: DetectionSettings) -> tuple[IntArray, list[Rejected]]:
    """Choose the fits that are markers: of the stated diameter, strong, similar to the others, and not the same twice."""
    reasons = np.full(len(fits.score), "", dtype=object)
    reasons[fits.size < how.size_range[0] * diameter] = "too small"
    reasons[fits.size > how.size_range[1] * diameter] = "too large"
    order = np.argsort(-fits.score, kind="stable")
    rank = np.empty(len(order), dtype=int)
    rank[order] = np.arange(len(order))
    for a, b in cKDTree(fits.centres).query_pairs(how.min_distance * diameter) if len(order) else ():
        reasons[a if rank[a] > rank[b] else b] = "same as a stronger one"
    good = reasons == ""
    if count is None and good.any():
        reasons[good & (fits.score < valley(fits.score[good]))] = FAINTER
    features = {
        "size differs from the others": (np.log(fits.size), np.log(how.size_ratio)),
        "content differs from the others": (np.log(fits.content), np.log(how.content_ratio)),
        "shape differs from the others": (np.log(fits.widths[:, 0] / fits.widths[:, 1]), np.log(how.elongation_ratio)),
    }
    for reason, (feature, tolerance) in features.items():
        good = reasons == ""
        if good.sum() < POPULATION:
            break
        likely = good & (rank < np.sort(rank[good])[min(count or good.sum(), good.sum()) - 1] + 1)
        middle = np.median(feature[likely])
        spread = 1.4826 * float(np.median(np.abs(feature[likely] - middle)))
        reasons[good & (np.abs(feature - middle) > max(tolerance, how.spread_sd * spread))] = reason
    good = reasons == ""
    if good.sum() >= MANY_ALIKE:
        apart = np.zeros(len(reasons))
        for feature, floor in (
            (np.log(fits.size), SIZE_SD),
            (np.log(fits.content), CONTENT_SD),
            (np.log(fits.widths[:, 2]), THICKNESS_SD),
        ):
            off = feature - np.median(feature[good])
            middle, tail = np.percentile(np.abs(off[good]), (50.0, 95.0))
            apart += (off / max(floor, 1.4826 * float(middle), 0.51 * float(tail))) ** 2  # both estimate the SD of a normal variable
        reasons[good & (apart > how.outlier_sd**2)] = "differs from the others in size, content and thickness together"
    keep = order[reasons[order] == ""]
    if count is not None:
        reasons[keep[count:]] = "weaker than those asked for"
        keep = keep[:count]
    return keep, [Rejected(fits.centres[i], str(reasons[i])) for i in np.flatnonzero(reasons != "")]


def _located(
    bright: Float32Array, fits: _Fits, spacing: FloatArray, diameter: float, thickness: float | None
) -> tuple[FloatArray, FloatArray]:
    """Return centres and covariances; plates thinner than the slices are located by `placed_plates`."""
    axis = _thin(fits, spacing)
    if axis is None:
        return fits.centres, fits.covariance
    thick = thickness if thickness is not None else THIN * diameter
    hidden = bool(np.median(fits.widths[:, 2]) < HIDDEN * spacing[axis])
    found = placed_plates(bright, spacing, fits.centres, axis=axis, diameter_mm=diameter, thickness_mm=thick, along=hidden)
    known = np.isfinite(found.centres_mm).all(axis=1)
    centres, covariance = fits.centres.copy(), fits.covariance.copy()
    centres[known] = found.centres_mm[known]
    variance = np.where(np.isfinite(found.sd_mm), found.sd_mm**2, np.einsum("nii->ni", fits.covariance))
    if not hidden:
        variance[:, axis] += (SAMPLED * spacing[axis]) ** 2
    covariance[known] = variance[known, :, None] * np.eye(3)
    return centres, covariance


def _reported(volume: Volume, found: _Found, centres: FloatArray, covariance: FloatArray) -> DetectedMarkers:
    """Return the markers in the frame of the scan."""
    points = volume.to_physical(centres / volume.spacing_mm)
    order = np.lexsort(np.round(points, 6).T)
    turned = volume.direction @ covariance @ volume.direction.T
    elsewhere = tuple(Rejected(volume.to_physical(r.point / volume.spacing_mm), r.reason) for r in found.rejected)
    polarity: Literal["bright", "dark"] = "bright" if found.sign > 0 else "dark"
    return DetectedMarkers(points[order], turned[order], found.kept.size[order], found.kept.score[order], polarity, elsewhere)
