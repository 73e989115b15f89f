"""Marker tracking from scans of several states to an experiment folder, with a page of detections, links and rejections."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from naibu.core.arrays import require_count, require_lengths
from naibu.core.errors import InputError
from naibu.core.experiment import Layer, Loading, Shape
from naibu.core.progress import Progress, report_progress
from naibu.imaging.markers.detection import Polarity
from naibu.imaging.markers.tracking import FEWEST_COMMON, TrackedMarkers, track_markers
from naibu.io.experiment_folder.reader import read_experiment
from naibu.io.files.paths import require_usable_path
from naibu.io.files.provenance import input_record
from naibu.io.images import read_volume
from naibu.io.tables.marker_tables import state_name, write_experiment_folder, write_markers
from naibu.viewer.chapters.chapter_page import write_chapter
from naibu.viewer.notebook import ShownInNotebook, empty_figure
from naibu.viewer.result_figures import draw_marker_motion
from naibu.viewer.tables import Cell, Table
from naibu.workflows.markers.experiments import doubts_of_markers
from naibu.workflows.markers.tilted_tables import Vertical, upright_tables
from naibu.workflows.measurement.track_page import track_chapter, track_rows
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

if TYPE_CHECKING:
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
        Direction away from the base in the axes of the scans, if it is not z, as of `naibu.workflows.markers.import_tables.import_tables`.
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
class TrackRun(ShownInNotebook):
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

    def page_html(self) -> str:
        """Return the page of the result, a whole HTML document."""
        return self.page.read_text(encoding="utf-8")

    def plot(self) -> Canvas:
        """Return a figure of the displacement of the markers from the first to the last state, seen along y, x and z."""
        canvas = empty_figure(10.5, 4.2)
        draw_marker_motion(canvas, self.tracked.points[0], self.tracked.points[-1], self.tracked.flags[-1])
        return canvas

    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return one row a marker and state: state, marker, position and standard deviations, mm, confidence and flag."""
        t = self.tracked
        names = ("state", "marker", "x_mm", "y_mm", "z_mm", "sd_x_mm", "sd_y_mm", "sd_z_mm", "confidence", "flag")
        return tuple(
            dict(zip(names, (name, int(i), *p.tolist(), *sd.tolist(), float(confidence), str(flag)), strict=True))
            for name, points, sds, sure, flags in zip(t.names, t.points, t.sd_mm, t.confidence, t.flags, strict=True)
            for i, p, sd, confidence, flag in zip(t.ids, points, sds, sure, flags, strict=True)
        )

    notes: tuple[str, ...] = ()


@no_empty_folders()
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
    columns, rows = track_rows(tracked)
    settings: dict[str, Cell] = {"diameter, mm": diameter_mm, "thickness, mm": thickness_mm, "polarity": tracked.found[0].polarity}
    settings |= input_record({**{f"scan of {name}": scan for name, scan in zip(names, scans, strict=True)}, "mask": mask})
    table = Table("Markers", columns, rows, caption="found in every scan, and linked to the reference state")
    page, numbers = write_chapter(track_chapter(tracked, volumes, diameter_mm, table, settings), target)
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
        names.append(state_name(name[: len(name) - len(ending)] or name))
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
    stated = {state_name(name): height for name, height in (d.stated_mm or {}).items()}
    first, *others = tracked.names
    write_experiment_folder(
        target, upright.tables[first], {n: upright.tables[n] for n in others}, title=d.title, shape=d.shape, loading=d.loading,
        layers=d.layers, stated_mm=stated, xy_sd_mm=xy_sd, z_sd_mm=z_sd, overwrite=overwrite,
    )  # fmt: skip
    return [target / "meta.toml", *(target / f"{n}.csv" for n in tracked.names)], (
        *([upright.told] if upright.told else []),
        *upright.notes,
        *doubts_of_markers(read_experiment(target)),
    )
