"""Marker tracking from scans of several states to an experiment folder, with a page of detections, links and rejections."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from naibu.core.arrays import require_count, require_lengths
from naibu.core.errors import InputError
from naibu.core.experiment import Layer, Loading, Shape
from naibu.core.progress import Progress, report_progress
from naibu.imaging.markers.detection import Polarity
from naibu.imaging.markers.tracking import FEWEST_COMMON, TrackedMarkers, track_markers
from naibu.io.files.paths import require_usable_path
from naibu.io.files.provenance import input_record
from naibu.io.images import read_volume
from naibu.io.marker_tables import write_experiment_folder, write_markers
from naibu.viewer.chapter import Chapter, Figure, Section
from naibu.viewer.chapter_page import write_chapter
from naibu.viewer.tables import Cell, Table
from naibu.workflows.results.output_folder import output_folder
from naibu.workflows.tilted_tables import Vertical, upright_tables

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

ENDINGS = (".nii.gz", ".ome.tif", ".ome.tiff")


@dataclass(frozen=True, slots=True)
class ObjectDescription:
    """The object of an experiment folder, besides its markers; see `naibu.core.experiment.Experiment`.

    Attributes
    ----------
    shape : Shape
        Kind and extents, mm.
    loading : Loading
        How it is loaded.
    layers : tuple of Layer
        Materials from the base up.
    stated_mm : mapping of str to float, optional
        Stated platen positions by name of the state, mm.
    vertical : sequence of float or "found", optional
        Direction away from the base in the axes of the scans, if it is not z, as of `naibu.workflows.import_tables.import_tables`.
    title : str
        Title of the experiment.
    """

    shape: Shape
    loading: Loading
    layers: tuple[Layer, ...] = ()
    stated_mm: Mapping[str, float] | None = None
    vertical: Vertical = None
    title: str = "Markers tracked through scans"


@dataclass(frozen=True, slots=True)
class TrackRun:
    """Markers in every state and the files that hold them.

    Attributes
    ----------
    tracked : TrackedMarkers
        Positions, links and rejected candidates.
    columns : tuple of str
        Headers of `rows`, with units.
    rows : tuple of tuple
        One row a state.
    page : Path
        ``tracking.html``.
    files : tuple of Path
        All others.
    notes : tuple of str
        How the markers were turned, and whether the object seems to stand tilted.
    """

    tracked: TrackedMarkers
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    page: Path
    files: tuple[Path, ...]
    notes: tuple[str, ...] = ()


def track(
    scans: Sequence[str | os.PathLike[str]],
    *,
    out: str | os.PathLike[str],
    diameter_mm: float,
    thickness_mm: float | None = None,
    polarity: Polarity = "auto",
    count: int | None = None,
    mask: str | os.PathLike[str] | None = None,
    spacing_mm: Sequence[float] | None = None,
    description: ObjectDescription | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> TrackRun:
    """Track equal markers through scans of several states, and write an experiment folder.

    Parameters
    ----------
    scans : sequence of path-like
        Volumes of the states, the reference state first, then in the order in which they were reached.
    out : path-like
        Folder to make: an experiment folder where a description is given, the tables of the states alone otherwise; beside them the page
        ``tracking.html`` and the numbers ``tracking.json``.
    diameter_mm, thickness_mm, polarity, count
        See `naibu.imaging.markers.detection.detect_markers`.
    mask : path-like, optional
        Volume on the grid of every scan, nonzero where markers may lie.
    spacing_mm : sequence of float, optional
        Voxel spacing along x, y, z, mm, for files without it.
    description : ObjectDescription, optional
        Shape, loading and layers.
    overwrite : bool
        Whether `out` may be a folder that is not empty: files of the same names are replaced, others stay.
    progress : callable, optional
        Called with a `naibu.core.progress.ProgressReport` at every stage.

    Returns
    -------
    TrackRun
        Tracks and files.

    Raises
    ------
    InputError
        Scans that cannot be read, two of one name, markers that cannot be found, linked or trusted, or a folder that is not empty.
    """
    require_lengths(diameter_mm=diameter_mm, thickness_mm=thickness_mm, spacing_mm=spacing_mm)
    if description is not None:
        require_lengths(size_mm=description.shape.size_mm, bar_width_mm=description.loading.bar_width_mm)
    if count is not None:
        require_count("count", count)
    target = require_usable_path(out, written=True)
    if not overwrite and target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(
            f"{target}: exists and is not an empty folder; choose a new folder as `out`, or allow this one to be used with `overwrite`"
        )
    names = _states(scans)
    report_progress(progress, "reading")
    volumes = [read_volume(path, spacing_mm=spacing_mm) for path in scans]
    masks = None
    if mask is not None:
        where = read_volume(mask, spacing_mm=spacing_mm)
        for path, volume in zip(scans, volumes, strict=True):
            if different := where.grid_difference(volume):
                place = f"{Path(mask).name} does not lie on the grid of {Path(path).name}"
                raise InputError(f"{place}: {different}; resample the mask, or leave it out")
        masks = [where.values != 0] * len(volumes)
    tracked = track_markers(
        volumes, diameter_mm=diameter_mm, thickness_mm=thickness_mm, polarity=polarity, count=count, masks=masks, names=names,
        progress=progress,
    )  # fmt: skip
    _require_trusted(tracked)
    report_progress(progress, "writing")
    files, notes = _written(target, tracked, description, overwrite)
    columns, rows = _table(tracked)
    settings: dict[str, Cell] = {"diameter, mm": diameter_mm, "thickness, mm": thickness_mm, "polarity": tracked.found[0].polarity}
    settings |= input_record({**{f"scan of {name}": scan for name, scan in zip(names, scans, strict=True)}, "mask": mask})
    page, numbers = write_chapter(
        Chapter("tracking", "Markers tracked through scans", (_section(tracked, columns, rows),), settings), target
    )
    return TrackRun(tracked, columns, rows, page, (*files, numbers), notes)


def _require_trusted(tracked: TrackedMarkers) -> None:
    """Refuse tracks of which nothing can be used."""
    for name, flags in zip(tracked.names[1:], tracked.flags[1:], strict=True):
        trusted, linked = int((flags == "ok").sum()), int((flags != "missing").sum())
        if trusted < FEWEST_COMMON:
            raise InputError(
                f"state {name!r}: {linked} markers were followed, but only {trusted} of them are trusted, {FEWEST_COMMON} are needed; "
                "fewer than five cannot be told from bubbles or texture: where there are no more, give their number as `count`, otherwise "
                "check diameter_mm and `polarity`"
            )


def _states(scans: Sequence[str | os.PathLike[str]]) -> list[str]:
    """Return the names of the states: ``initial``, then the names of the files."""
    names = ["initial"]
    for scan in scans[1:]:
        name = Path(scan).name
        ending = next((e for e in ENDINGS if name.lower().endswith(e)), Path(scan).suffix)
        names.append(name[: len(name) - len(ending)] or name)
    if len(set(names)) < len(names):
        raise InputError(f"two scans would both be the state {max(names, key=names.count)!r}; rename one")
    return names


def _written(
    target: Path, tracked: TrackedMarkers, description: ObjectDescription | None, overwrite: bool
) -> tuple[list[Path], tuple[str, ...]]:
    """Write the tables, or the experiment folder; return the files and what should be known of them."""
    if description is None:
        output_folder(target)
        return [write_markers(target / f"{n}.csv", m) for n, m in zip(tracked.names, tracked.markers, strict=True)], ()
    d, (xy_sd, z_sd) = description, tracked.typical_sd_mm
    upright = upright_tables(dict(zip(tracked.names, tracked.markers, strict=True)), d.vertical, shape=d.shape, loading=d.loading)
    xy_sd, z_sd = upright.turned_lengths(xy_sd, z_sd)
    first, *others = tracked.names
    write_experiment_folder(
        target, upright.tables[first], {n: upright.tables[n] for n in others}, title=d.title, shape=d.shape, loading=d.loading,
        layers=d.layers, stated_mm=d.stated_mm, xy_sd_mm=xy_sd, z_sd_mm=z_sd, overwrite=overwrite,
    )  # fmt: skip
    return [target / "meta.toml", *(target / f"{n}.csv" for n in tracked.names)], (
        *([upright.told] if upright.told else []),
        *upright.notes,
    )


def _table(tracked: TrackedMarkers) -> tuple[tuple[str, ...], tuple[tuple[Cell, ...], ...]]:
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


def _section(tracked: TrackedMarkers, columns: tuple[str, ...], rows: tuple[tuple[Cell, ...], ...]) -> Section:
    words = (
        f"{len(tracked.ids)} markers of the reference state were found again in at least one other state. A link is suspect where its "
        "probability is below one half, or where the marker is an outlier to the smooth motion of its neighbours; suspect markers are not "
        "used by an identification.",
    )
    table = Table("Markers", columns, rows, caption="found in every scan, and linked to the reference state")
    return Section("Markers", words, (table,), tuple(_figure(tracked, s) for s in range(1, len(tracked.names))))


def _figure(tracked: TrackedMarkers, s: int) -> Figure:
    before, after, flags = tracked.points[0], tracked.points[s], tracked.flags[s]

    def draw(canvas: Canvas) -> None:
        for axis, (a, b) in zip(canvas.subplots(1, 3), ((0, 2), (1, 2), (0, 1)), strict=True):
            _projection(axis, before, after, flags, a, b)
        handles, names = canvas.axes[0].get_legend_handles_labels()
        canvas.legend(handles, names, loc="outside lower left", ncols=4, frameon=False)

    caption = "Displacement of the markers from the reference state, seen along y, x and z."
    return Figure(f"State {tracked.names[s]}", caption, draw, (10.5, 4.2))


def _projection(axis: Axes, before: np.ndarray, after: np.ndarray, flags: np.ndarray, a: int, b: int) -> None:
    for flag, colour, label in (("ok", "#2a788e", "linked"), ("suspect", "#d95f02", "suspect")):
        some = flags == flag
        if not some.any():
            continue
        p, q = before[some], after[some]
        axis.quiver(
            p[:, a], p[:, b], (q - p)[:, a], (q - p)[:, b], angles="xy", scale_units="xy", scale=1.0, width=0.004, color=colour, label=label
        )
    lost = flags == "missing"
    if lost.any():
        axis.plot(before[lost, a], before[lost, b], "x", color="#7f7f7f", ms=4, label="not found")
    # arrows do not widen the axes
    both = np.concatenate([before, after])
    axis.plot(both[:, a], both[:, b], ".", ms=0.1, alpha=0.0)
    axis.set(xlabel=f"{'xyz'[a]}, mm", ylabel=f"{'xyz'[b]}, mm", aspect="equal")
