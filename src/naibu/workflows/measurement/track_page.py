"""The page of tracked markers: what to know first, the markers in 3-D, and the markers over slices of every scan."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.volume import Volume
from naibu.imaging.markers.tracking import TrackedMarkers
from naibu.viewer.cards import Card
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.marker_view import MarkerView
from naibu.viewer.result_page.payload import Scene, Step
from naibu.viewer.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

SLICES = 4  # at most, of every scan
MARGIN = 2.0  # diameters around the markers that a slice shows
LARGEST_SLICE = 500  # pixels along an axis
LABEL = 0.045  # height of a number over the extent of a slice; numbers nearer than that are left out
COLOURS = {"ok": "#e66100", "suspect": "#ff5fa2"}
WORDS: dict[str, str | list[str]] = {
    "choice": "State",
    "measured": "marker in the reference state",
    "predicted": "the same marker in this state",
    "arrow": "displacement",
    "difference": "displacement",
    "bar": "Displacement from the reference state (mm)",
    "part": "Displacements are shown at the end of the motion.",
    "none": "No marker was followed.",
    "lacking": "not followed",
    "missing": "markers were not followed into this state.",
    "groups": ["linked", "suspect"],
    "load": "Motion",
    "from": "reference",
    "to": "this state",
}


def track_chapter(
    tracked: TrackedMarkers, volumes: Sequence[Volume], diameter_mm: float, table: Table, settings: Mapping[str, Cell]
) -> Chapter:
    """Return the content of the page.

    Parameters
    ----------
    tracked : TrackedMarkers
        Markers of all states.
    volumes : sequence of Volume
        Scans of the states.
    diameter_mm : float
        Of the markers, mm.
    table : Table
        Counts of every state.
    settings : mapping
        How the markers were tracked.
    """
    words = (
        f"{len(tracked.ids)} markers of the reference state were found again in at least one other state. A link is suspect where its "
        "probability is below one half, or where the marker is an outlier to the smooth motion of its neighbours; suspect markers are not "
        "used by an identification.",
    )
    figures = tuple(_figure(tracked, s, volumes[s], diameter_mm) for s in range(len(tracked.names)))
    sections = (Section("Markers", words, (table,)), Section("Markers over slices of the scans", (), (), figures))
    view = MarkerView(tuple(_scene(tracked, s) for s in range(1, len(tracked.names)) if (tracked.flags[s] != "missing").any()), WORDS)
    return Chapter("tracking", "Markers tracked through scans", sections, dict(settings), _cards(tracked), view)


def track_rows(tracked: TrackedMarkers) -> tuple[tuple[str, ...], tuple[tuple[Cell, ...], ...]]:
    """Return headers and one row a state: numbers found, linked, suspect, missing and rejected, and the standard deviation."""
    columns = ("state", "found", "linked", "of these suspect", "missing", "rejected", "standard deviation x, y, z (median), mm")
    rows: list[tuple[Cell, ...]] = []
    for s, name in enumerate(tracked.names):
        flags, found = tracked.flags[s], tracked.found[s]
        known = flags != "missing"
        sd = np.nanmedian(tracked.sd_mm[s][known], axis=0)
        rejected = "; ".join(f"{n} {why}" for why, n in Counter(r.reason for r in found.rejected).most_common(3))
        summary = f"{len(found.rejected)}: {rejected}" if rejected else "0"
        doubtful, missing = int((flags == "suspect").sum()), int((~known).sum())
        rows.append((name, len(found), int(known.sum()), doubtful, missing, summary, ", ".join(f"{v:.3f}" for v in sd)))
    return columns, tuple(rows)


def _cards(tracked: TrackedMarkers) -> tuple[Card, ...]:
    trusted = (tracked.flags[1:] == "ok").sum(axis=1)
    moved = np.linalg.norm(tracked.points[1:] - tracked.points[0], axis=2)
    known = tracked.flags[1:] != "missing"
    xy_sd, z_sd = tracked.typical_sd_mm
    worst = int(np.argmin(trusted))
    return (
        Card("Markers trusted", f"{trusted[worst]} of {len(tracked.ids)}", f"in {tracked.names[1 + worst]}, where they are fewest"),
        Card("Suspect, missing", f"{int((tracked.flags == 'suspect').sum())}, {int((~known).sum())}", "over all states; not used"),
        Card("Displacement, median", f"{np.median(moved[known]):.3g} mm", f"at most {moved[known].max():.3g} mm"),
        Card("Standard deviation of a position", f"{xy_sd:#.2g} mm", f"across z; {z_sd:#.2g} mm along z"),
    )


def _scene(tracked: TrackedMarkers, s: int) -> Scene:
    known = tracked.flags[s] != "missing"
    before, after, name = tracked.points[0][known], tracked.points[s][known], tracked.names[s]
    none = np.zeros((0, 3), dtype=np.int64)
    steps = (Step(tracked.names[0], 0.0, before, before), Step(name, 1.0, after, after))
    variance = np.trace(tracked.covariance[s] + tracked.covariance[0], axis1=1, axis2=2)[known] / 3.0
    group = np.where(tracked.flags[s][known] == "suspect", 1, 0)
    return Scene(name, "", name, none, before, steps, tracked.ids[known], before, before, np.sqrt(variance), group)


def _figure(tracked: TrackedMarkers, s: int, volume: Volume, diameter_mm: float) -> Figure:
    known = tracked.flags[s] != "missing"
    index = volume.to_index(tracked.points[s][known])
    parts = np.array_split(np.sort(index[:, 2]), SLICES)
    chosen = np.unique([int(np.clip(round(float(np.median(p))), 0, volume.shape[0] - 1)) for p in parts if len(p)])
    spacing = np.asarray(volume.spacing_mm, dtype=np.float64)
    low = np.maximum(0, np.floor(index.min(axis=0) - MARGIN * diameter_mm / spacing)).astype(int)
    high = np.minimum(volume.shape[::-1], np.ceil(index.max(axis=0) + MARGIN * diameter_mm / spacing) + 1).astype(int)
    step = max(1, -(-int((high - low)[:2].max()) // LARGEST_SLICE))
    rejected = np.array([r.point for r in tracked.found[s].rejected]).reshape(-1, 3)
    others = volume.to_index(rejected) if len(rejected) else rejected
    images = [np.asarray(volume.values[k, low[1] : high[1] : step, low[0] : high[0] : step], dtype=np.float32) for k in chosen]
    flags, ids = tracked.flags[s][known], tracked.ids[known]

    def draw(canvas: Canvas) -> None:
        grey = np.nanpercentile(np.concatenate([im.ravel() for im in images]), (0.5, 99.5))
        left, right = spacing[0] * (low[0] - 0.5), spacing[0] * (high[0] - 0.5)
        top, bottom = spacing[1] * (low[1] - 0.5), spacing[1] * (high[1] - 0.5)
        for axis, k, image in zip(
            canvas.subplots(-(-len(images) // 2), 2, squeeze=False).ravel()[: len(images)], chosen, images, strict=True
        ):
            axis.imshow(image, cmap="gray", vmin=grey[0], vmax=grey[1], extent=(left, right, bottom, top), interpolation="nearest")
            here = np.abs(index[:, 2] - k) * spacing[2] <= 0.5 * max(diameter_mm, spacing[2])
            _circles(axis, spacing[:2] * index[here, :2], flags[here], ids[here], diameter_mm, max(right - left, bottom - top))
            near = np.abs(others[:, 2] - k) * spacing[2] <= 0.5 * max(diameter_mm, spacing[2])
            if near.any():
                axis.plot(*(spacing[:2] * others[near, :2]).T, "x", color="#56b4e9", ms=4, label="rejected")
            axis.set(
                title=f"slice {k}, z = {k * spacing[2]:.1f} mm", xlabel="x, mm", ylabel="y, mm", xlim=(left, right), ylim=(bottom, top)
            )
        for axis in canvas.axes[len(images) :]:
            axis.set_axis_off()
        handles = {n: h for axis in canvas.axes for h, n in zip(*axis.get_legend_handles_labels(), strict=True)}
        canvas.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=3, frameon=False)

    caption = (
        "Slices with most markers, along the axes of the scan and from its first voxel. Circles have the stated diameter; numbers that "
        "would overlap are left out."
    )
    return Figure(f"State {tracked.names[s]}", caption, draw, (8.4, 4.0 * -(-len(images) // 2) + 0.4))


def _circles(axis: Axes, points: FloatArray, flags: np.ndarray, ids: IntArray, diameter_mm: float, extent_mm: float) -> None:
    from matplotlib.collections import EllipseCollection
    from matplotlib.patheffects import withStroke

    for flag, colour in COLOURS.items():
        some = points[flags == flag]
        if len(some):
            size, label = np.full(len(some), diameter_mm), {"ok": "linked", "suspect": "suspect"}[flag]
            ring = EllipseCollection(
                size, size, np.zeros(len(some)), units="x", offsets=some, offset_transform=axis.transData, facecolors="none",
                edgecolors=colour, linewidths=1.3, linestyles="-" if flag == "ok" else "--",
            )  # fmt: skip
            axis.add_collection(ring)
            axis.plot([], [], "o", mfc="none", mec=colour, label=label)
    apart, placed = LABEL * extent_mm, np.zeros((0, 2))
    for point, label in zip(points, ids, strict=True):
        at = point + 0.5 * diameter_mm * np.array([0.75, -0.75])
        if len(placed) and (np.abs(placed - at) < (1.6 * apart, apart)).all(axis=1).any():
            continue
        placed = np.vstack([placed, at])
        axis.text(
            float(at[0]), float(at[1]), str(label), color="white", fontsize=7, path_effects=[withStroke(linewidth=1.5, foreground="black")]
        )
