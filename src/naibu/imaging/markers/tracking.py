"""Marker tracking from volume to volume: detected in each, linked to the first, and located in all of them together.

The result is what an experiment folder holds: the same label is the same marker in all states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.markers import Markers
from naibu.core.progress import Progress, report_progress
from naibu.core.volume import Volume
from naibu.imaging.markers.detection import DetectedMarkers, Polarity, detect_markers
from naibu.imaging.markers.joint_localization import joint_positions
from naibu.imaging.markers.linking.point_matching import Links, link_markers
from naibu.imaging.markers.linking.thin_plate_assignment import spline_through
from naibu.imaging.markers.peaks import POPULATION
from naibu.imaging.markers.settings import DetectionSettings, LinkSettings, require_between

FEWEST_COMMON = 4  # markers in common with the reference state that an experiment needs: those of one tetrahedron
NEARLY_ALL = 0.97  # fraction of linked markers from which on links by way of the previous state are taken as they are; empirical


@dataclass(frozen=True, slots=True, eq=False)
class TrackedMarkers:
    """Markers of one object in several states.

    Attributes
    ----------
    names : tuple of str
        Names of the states, the reference state first.
    markers : tuple of Markers
        Of every state: positions, mm, under the same labels, NaN where a marker was not found. Uncertain links are not trusted.
    covariance : ndarray, shape (s, n, 3, 3)
        Of the positions, mm^2; NaN where there is none.
    confidence : ndarray, shape (s, n)
        Probability that the link to the reference state is right; 1 in the reference state, 0 where there is no link.
    residual_mm : ndarray, shape (s, n)
        Residual from the local affine fit to the neighbours, before the joint localisation, mm; NaN where there is no link. See
        `naibu.imaging.markers.linking.point_matching.Links`.
    flags : ndarray of str, shape (s, n)
        ``"ok"``, ``"missing"`` or ``"suspect"``.
    found : tuple of DetectedMarkers
        Detections in every state, with rejected candidates.
    """

    names: tuple[str, ...]
    markers: tuple[Markers, ...]
    covariance: FloatArray
    confidence: FloatArray
    residual_mm: FloatArray
    flags: NDArray[np.str_]
    found: tuple[DetectedMarkers, ...]

    @property
    def ids(self) -> IntArray:
        """Labels (n,), 1 for the lowest marker of the reference state."""
        return self.markers[0].ids

    @property
    def points(self) -> FloatArray:
        """Positions (s, n, 3), mm, trusted or not."""
        return np.stack([m.points for m in self.markers])

    @property
    def sd_mm(self) -> FloatArray:
        """Standard deviation of every coordinate (s, n, 3), mm."""
        return np.asarray(np.sqrt(np.einsum("snii->sni", self.covariance)))

    @property
    def typical_sd_mm(self) -> tuple[float, float]:
        """Root mean square standard deviation of a trusted coordinate across and along z, mm."""
        x, y, z = np.nanmean(np.where((self.flags == "ok")[:, :, None], self.sd_mm, np.nan) ** 2, axis=(0, 1))
        return float(np.sqrt(0.5 * (x + y))), float(np.sqrt(z))

    @property
    def states(self) -> dict[str, Markers]:
        """Markers of the states after the first by name, in order, as `naibu.io.write_experiment_folder` takes them."""
        return dict(zip(self.names[1:], self.markers[1:], strict=True))


def track_markers(
    volumes: Sequence[Volume],
    *,
    diameter_mm: float,
    thickness_mm: float | None = None,
    polarity: Polarity = "auto",
    masks: Sequence[ArrayLike | None] | None = None,
    count: int | None = None,
    names: Sequence[str] | None = None,
    joint: bool = True,
    seed: int = 0,
    min_confidence: float = 0.5,
    detection: DetectionSettings | None = None,
    linking: LinkSettings | None = None,
    progress: Progress | None = None,
) -> TrackedMarkers:
    """Detect equal markers in the volumes of several states of an object, and link them between the states.

    Parameters
    ----------
    volumes : sequence of Volume
        The reference state first, then the others in the order in which they were reached: each is linked by way of the previous one.
    diameter_mm, thickness_mm, polarity, count
        See `naibu.imaging.markers.detection.detect_markers`. The polarity that ``"auto"`` finds in the first volume holds for all.
        Fewer than five markers are all suspect unless `count` says how many there are.
    masks : sequence of array_like of bool or None, optional
        Where markers may lie, for every volume.
    names : sequence of str, optional
        Names of the states; ``initial``, ``state_1``, ... by default.
    joint : bool
        Whether positions are improved by all states together, through the smooth motion between them: matters most for washers thinner
        than the slices. See `naibu.imaging.markers.joint_localization`.
    seed : int
        Of the random choice of the points from which links grow.
    min_confidence : float
        Probability below which a link is flagged as suspect, 0 to 1.
    detection : DetectionSettings, optional
        How markers are separated from other peaks.
    linking : LinkSettings, optional
        How links are searched for.
    progress : callable, optional
        Called with a `naibu.core.progress.ProgressReport` before each state.

    Returns
    -------
    TrackedMarkers
        Markers of the reference state that were found in at least one other, with their positions in every state.

    Raises
    ------
    InputError
        Fewer than two volumes, lists of other lengths, volumes without markers (the state is named), or a state with fewer than four
        markers in common with the reference state.
    """
    require_between("min_confidence", min_confidence, 0.0, 1.0)
    states = _names(volumes, masks, names)
    where = list(masks) if masks is not None else [None] * len(volumes)
    found: list[DetectedMarkers] = []
    for number, (name, volume, mask) in enumerate(zip(states, volumes, where, strict=True)):
        report_progress(progress, f"detecting markers in {name}", done=number, total=len(volumes))
        sign: Polarity = found[0].polarity if found else polarity
        try:
            markers = detect_markers(
                volume, diameter_mm=diameter_mm, thickness_mm=thickness_mm, polarity=sign, mask=mask, count=count, settings=detection
            )
        except InputError as error:
            raise InputError(f"state {name!r}: {error}") from error
        if len(markers) < FEWEST_COMMON:
            raise InputError(
                f"state {name!r}: only {len(markers)} markers were found, {FEWEST_COMMON} are needed to follow them; "
                "check diameter_mm and polarity, or the mask"
            )
        found.append(markers)
    link, confidence, residual = linked_states([m.points for m in found], names=states, seed=seed, settings=linking)
    report_progress(progress, "linking markers", done=len(volumes), total=len(volumes))
    if count is None and min(len(markers) for markers in found) < POPULATION:
        confidence[1:] = 0.0  # bubbles and other structures are not told from so few markers
    return _tracked(states, tuple(found), link, confidence, residual, joint=joint, min_confidence=min_confidence)


def linked_states(
    points: Sequence[ArrayLike], *, names: Sequence[str] | None = None, seed: int = 0, settings: LinkSettings | None = None
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Link the markers of every state to those of the first, by way of the previous state where that helps.

    Parameters
    ----------
    points : sequence of array_like, shape (n_s, d)
        Markers of every state, mm, in any order.
    names : sequence of str, optional
        Names of the states, for messages.
    seed, settings
        See `naibu.imaging.markers.linking.point_matching.link_markers`.

    Returns
    -------
    link : ndarray, shape (s, n), int64
        Index, among the markers of state s, of every marker of the first state; -1 where it has none.
    confidence, residual_mm : ndarray, shape (s, n)
        See `TrackedMarkers`.

    Raises
    ------
    InputError
        A state has fewer than four markers in common with the first.
    """
    clouds = [np.asarray(p, dtype=float) for p in points]
    states = list(names) if names is not None else _numbered(len(clouds))
    n = len(clouds[0])
    link, confidence = np.full((len(clouds), n), -1, dtype=np.int64), np.zeros((len(clouds), n))
    residual = np.full((len(clouds), n), np.nan)
    link[0], confidence[0], residual[0] = np.arange(n), 1.0, 0.0
    for s in range(1, len(clouds)):
        try:
            links = _linked(clouds, link, s, seed, settings)
        except InputError as error:
            raise InputError(f"state {states[s]!r} against {states[0]!r}: {error}") from error
        if len(links) < FEWEST_COMMON:
            raise InputError(
                f"states {states[0]!r} ({n} markers) and {states[s]!r} ({len(clouds[s])} markers) have only {len(links)} in common, "
                f"{FEWEST_COMMON} are needed; check that both show the same object, or add a state between them"
            )
        here = links.pairs[:, 0]
        link[s, here], confidence[s, here], residual[s, here] = links.pairs[:, 1], links.confidence, links.residual_mm
    return link, confidence, residual


def _linked(clouds: list[FloatArray], link: IntArray, s: int, seed: int, settings: LinkSettings | None) -> Links:
    """Link state s to the first: from the positions in the previous state, or directly, whichever has the larger total confidence."""
    tried: list[Links] = []
    if s > 1:
        seen = link[s - 1] >= 0
        here = clouds[s - 1][link[s - 1, seen]]
        before = link_markers(here, clouds[s], seed=seed, settings=settings) if seen.sum() >= FEWEST_COMMON else None
        if before is not None and len(before) >= FEWEST_COMMON:
            known = np.flatnonzero(seen)[before.pairs[:, 0]]
            expected = spline_through(clouds[0], known, clouds[s][before.pairs[:, 1]])
            tried.append(link_markers(clouds[0], clouds[s], predicted=expected, seed=seed, settings=settings))
            if len(tried[0]) >= NEARLY_ALL * min(len(clouds[0]), len(clouds[s])):
                return tried[0]
    tried.append(link_markers(clouds[0], clouds[s], seed=seed, settings=settings))
    return max(tried, key=lambda links: float(links.confidence.sum()))


def _tracked(
    names: tuple[str, ...],
    found: tuple[DetectedMarkers, ...],
    link: IntArray,
    confidence: FloatArray,
    residual: FloatArray,
    *,
    joint: bool,
    min_confidence: float,
) -> TrackedMarkers:
    keep = np.flatnonzero((link[1:] >= 0).any(axis=0))
    link, confidence, residual = link[:, keep], confidence[:, keep], residual[:, keep]
    points, covariance = np.full((*link.shape, 3), np.nan), np.full((*link.shape, 3, 3), np.nan)
    for s, markers in enumerate(found):
        seen = link[s] >= 0
        points[s, seen], covariance[s, seen] = markers.points[link[s, seen]], markers.covariance[link[s, seen]]
    doubtful = confidence < min_confidence
    if joint:
        usable = np.where(doubtful[:, :, None], np.nan, points)
        better = joint_positions(usable, covariance)
        sure = ~doubtful
        points[sure], covariance[sure] = better.points[sure], better.covariance[sure]
        doubtful |= better.outliers
    flags = np.where(link < 0, "missing", np.where(doubtful, "suspect", "ok"))
    ids = np.arange(1, len(keep) + 1)
    states = tuple(Markers.from_arrays(ids, p, f != "suspect") for p, f in zip(points, flags, strict=True))
    return TrackedMarkers(names, states, covariance, confidence, residual, flags, found)


def _names(volumes: Sequence[Volume], masks: Sequence[ArrayLike | None] | None, names: Sequence[str] | None) -> tuple[str, ...]:
    if len(volumes) < 2:
        raise InputError(f"volumes must be at least two to track markers, not {len(volumes)}; to detect them in one, use detect_markers")
    for what, given in (("masks", masks), ("names", names)):
        if given is not None and len(given) != len(volumes):
            raise InputError(f"{what} has {len(given)} entries for {len(volumes)} volumes; give one for each")
    states = tuple(names) if names is not None else tuple(_numbered(len(volumes)))
    if len(set(states)) < len(states):
        raise InputError(f"names must differ: {', '.join(states)}")
    return states


def _numbered(n: int) -> list[str]:
    return ["initial", *(f"state_{s}" for s in range(1, n))]
