"""Markers followed from volume to volume: found in each, linked to the first, and placed in all of them together (spec S9).

The result is what an experiment folder holds: the same number is the same marker in all states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.markers import Markers
from naibu.core.volume import Volume
from naibu.imaging.markers.detection import DetectedMarkers, Polarity, detect_markers
from naibu.imaging.markers.joint_localization import joint_positions
from naibu.imaging.markers.point_matching import Links, link_markers
from naibu.imaging.markers.thin_plate_assignment import spline_through

FEWEST_COMMON = 4  # an experiment needs so many markers in common with the free state
SUSPECT = 0.5  # links less probable than this are suspect
NEARLY_ALL = 0.97  # share of the markers whose links from the state before need no comparison with direct ones


@dataclass(frozen=True, slots=True, eq=False)
class TrackedMarkers:
    """Markers of one object in several states.

    Attributes
    ----------
    names : tuple of str
        Names of the states, the free one first.
    markers : tuple of Markers
        Of every state: positions, mm, under the same labels, NaN where a marker was not found. Links in doubt are not trusted.
    covariance : ndarray, shape (s, n, 3, 3)
        Of the positions, mm^2; NaN where there is none.
    confidence : ndarray, shape (s, n)
        Probability that the link to the free state is right; 1 in the free state, 0 where there is no link.
    departure_mm : ndarray, shape (s, n)
        Distance of a marker from where its neighbours predict it, before positions were made better together; NaN where there is no link.
    flags : ndarray of str, shape (s, n)
        ``"ok"``, ``"missing"`` or ``"suspect"``.
    found : tuple of DetectedMarkers
        All that was found in every state, and what was rejected.
    """

    names: tuple[str, ...]
    markers: tuple[Markers, ...]
    covariance: FloatArray
    confidence: FloatArray
    departure_mm: FloatArray
    flags: NDArray[np.str_]
    found: tuple[DetectedMarkers, ...]

    @property
    def ids(self) -> IntArray:
        """Labels (n,), 1 for the lowest marker of the free state."""
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
    def steps_mm(self) -> tuple[float, float]:
        """Steps across and along z, mm, that leave coordinates rounded to them as uncertain as these are (median): root 12 of the sd."""
        x, y, z = np.sqrt(12.0) * np.nanmedian(self.sd_mm, axis=(0, 1))
        return 0.5 * float(x + y), float(z)

    @property
    def states(self) -> dict[str, Markers]:
        """Markers of the other states than the free one by name, in order: what `naibu.io.marker_tables.write_experiment_folder` takes."""
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
) -> TrackedMarkers:
    """Find equal markers in the volumes of several states of an object, and tell which is which.

    Parameters
    ----------
    volumes : sequence of Volume
        The free state first, then the others in the order in which they were reached: each is linked by way of the one before.
    diameter_mm, thickness_mm, polarity, count
        See `naibu.imaging.markers.detection.detect_markers`. What ``"auto"`` finds in the first volume holds for all.
    masks : sequence of array_like of bool or None, optional
        Where markers may lie, for every volume.
    names : sequence of str, optional
        Of the states; ``initial``, ``state_1``, ... where left out.
    joint : bool
        Whether positions are made better by all states together, through the smooth motion between them: matters most for washers thinner
        than the slices. See `naibu.imaging.markers.joint_localization`.
    seed : int
        Of the draw of the points from which links grow.

    Returns
    -------
    TrackedMarkers
        Markers of the free state that were found in at least one other, and where they are in every state.

    Raises
    ------
    InputError
        Fewer than two volumes, lists of other lengths, volumes without markers (the state is named), or a state with fewer than four
        markers in common with the free one.
    """
    states = _names(volumes, masks, names)
    where = list(masks) if masks is not None else [None] * len(volumes)
    found: list[DetectedMarkers] = []
    for name, volume, mask in zip(states, volumes, where, strict=True):
        sign: Polarity = found[0].polarity if found else polarity
        try:
            markers = detect_markers(volume, diameter_mm=diameter_mm, thickness_mm=thickness_mm, polarity=sign, mask=mask, count=count)
        except InputError as error:
            raise InputError(f"state {name!r}: {error}") from error
        if len(markers) < FEWEST_COMMON:
            raise InputError(
                f"state {name!r}: only {len(markers)} markers were found, {FEWEST_COMMON} are needed to follow them; "
                "check diameter_mm and polarity, or the mask"
            )
        found.append(markers)
    link, confidence, departure = linked_states([m.points for m in found], names=states, seed=seed)
    return _tracked(states, tuple(found), link, confidence, departure, joint=joint)


def linked_states(
    points: Sequence[ArrayLike], *, names: Sequence[str] | None = None, seed: int = 0
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Link the markers of every state to those of the first, by way of the state before where that helps.

    Parameters
    ----------
    points : sequence of array_like, shape (n_s, d)
        Markers of every state, mm, in any order.
    names : sequence of str, optional
        Of the states, for messages.
    seed : int
        See `naibu.imaging.markers.point_matching.link_markers`.

    Returns
    -------
    link : ndarray, shape (s, n), int64
        Number of every marker of the first state among those of state s; -1 where it has none.
    confidence, departure_mm : ndarray, shape (s, n)
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
    departure = np.full((len(clouds), n), np.nan)
    link[0], confidence[0], departure[0] = np.arange(n), 1.0, 0.0
    for s in range(1, len(clouds)):
        try:
            links = _linked(clouds, link, s, seed)
        except InputError as error:
            raise InputError(f"state {states[s]!r} against {states[0]!r}: {error}") from error
        if len(links) < FEWEST_COMMON:
            raise InputError(
                f"states {states[0]!r} ({n} markers) and {states[s]!r} ({len(clouds[s])} markers) have only {len(links)} in common, "
                f"{FEWEST_COMMON} are needed; check that both show the same object, or add a state between them"
            )
        here = links.pairs[:, 0]
        link[s, here], confidence[s, here], departure[s, here] = links.pairs[:, 1], links.confidence, links.departure_mm
    return link, confidence, departure


def _linked(clouds: list[FloatArray], link: IntArray, s: int, seed: int) -> Links:
    """Link state s to the first: from where the state before was, or directly, whichever gives more links that can be believed."""
    tried: list[Links] = []
    if s > 1:
        seen = link[s - 1] >= 0
        here = clouds[s - 1][link[s - 1, seen]]
        before = link_markers(here, clouds[s], seed=seed) if seen.sum() >= FEWEST_COMMON else None
        if before is not None and len(before) >= FEWEST_COMMON:
            known = np.flatnonzero(seen)[before.pairs[:, 0]]
            expected = spline_through(clouds[0], known, clouds[s][before.pairs[:, 1]])
            tried.append(link_markers(clouds[0], clouds[s], predicted=expected, seed=seed))
            if len(tried[0]) >= NEARLY_ALL * min(len(clouds[0]), len(clouds[s])):
                return tried[0]
    tried.append(link_markers(clouds[0], clouds[s], seed=seed))
    return max(tried, key=lambda links: float(links.confidence.sum()))


def _tracked(
    names: tuple[str, ...],
    found: tuple[DetectedMarkers, ...],
    link: IntArray,
    confidence: FloatArray,
    departure: FloatArray,
    *,
    joint: bool,
) -> TrackedMarkers:
    keep = np.flatnonzero((link[1:] >= 0).any(axis=0))
    link, confidence, departure = link[:, keep], confidence[:, keep], departure[:, keep]
    points, covariance = np.full((*link.shape, 3), np.nan), np.full((*link.shape, 3, 3), np.nan)
    for s, markers in enumerate(found):
        seen = link[s] >= 0
        points[s, seen], covariance[s, seen] = markers.points[link[s, seen]], markers.covariance[link[s, seen]]
    doubtful = confidence < SUSPECT
    if joint:
        usable = np.where(doubtful[:, :, None], np.nan, points)
        better = joint_positions(usable, covariance)
        sure = ~doubtful
        points[sure], covariance[sure] = better.points[sure], better.covariance[sure]
        doubtful |= better.departing
    flags = np.where(link < 0, "missing", np.where(doubtful, "suspect", "ok"))
    ids = np.arange(1, len(keep) + 1)
    states = tuple(Markers.from_arrays(ids, p, f != "suspect") for p, f in zip(points, flags, strict=True))
    return TrackedMarkers(names, states, covariance, confidence, departure, flags, found)


def _names(volumes: Sequence[Volume], masks: Sequence[ArrayLike | None] | None, names: Sequence[str] | None) -> tuple[str, ...]:
    if len(volumes) < 2:
        raise InputError(f"markers are followed through at least two volumes, not {len(volumes)}; to find them in one, use detect_markers")
    for what, given in (("masks", masks), ("names", names)):
        if given is not None and len(given) != len(volumes):
            raise InputError(f"{what} has {len(given)} entries for {len(volumes)} volumes; give one for each")
    states = tuple(names) if names is not None else tuple(_numbered(len(volumes)))
    if len(set(states)) < len(states):
        raise InputError(f"names must differ: {', '.join(states)}")
    return states


def _numbered(n: int) -> list[str]:
    return ["initial", *(f"state_{s}" for s in range(1, n))]
