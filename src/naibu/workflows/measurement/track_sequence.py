"""Marker tracking in an image sequence, such as B-mode ultrasound: from a file to a table of tracks and a page."""

from __future__ import annotations

import csv
import io
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from naibu.core.arrays import AnyArray, FloatArray, require_lengths, require_within
from naibu.core.progress import Progress, report_progress
from naibu.imaging.markers.sequences.sequence_tracking import EchoPolarity, TrackedSequence, lengths_mm, track_sequence
from naibu.imaging.markers.settings import SequenceSettings
from naibu.io.files.atomic import write_atomically
from naibu.io.files.provenance import input_record
from naibu.io.images import read_volume
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.chapters.chapter_page import write_chapter
from naibu.viewer.tables import Cell, Table
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

FRAME_RATES_HZ = 1e-6, 1e9
COLUMNS = ("frame", "time_s", "marker", "x_mm", "y_mm", "sd_mm", "seen")


@dataclass(frozen=True, slots=True)
class SequenceRun:
    """Tracks of markers and the files that hold them.

    Attributes
    ----------
    tracked : TrackedSequence
        Positions in every frame.
    columns : tuple of str
        Headers of `rows`, with units.
    rows : tuple of tuple
        One row a marker.
    page, table : Path
        ``tracks.html`` and ``tracks.csv``.
    """

    tracked: TrackedSequence
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    page: Path
    table: Path


@no_empty_folders()
def track_sequence_file(
    frames: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    pixel_mm: float | Sequence[float],
    diameter_mm: float | Sequence[float],
    frame_rate_hz: float = 1.0,
    region_mm: Sequence[float] | None = None,
    count: int | None = None,
    polarity: EchoPolarity = "bright",
    settings: SequenceSettings | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> SequenceRun:
    """Track markers through a stack of images, and write ``tracks.csv``, ``tracks.html`` and ``tracks.json``.

    Parameters
    ----------
    frames : path-like
        Stack of images (see `naibu.io.images.read_volume`), time along its third axis.
    out : path-like
        Folder for the files.
    frame_rate_hz : float
        Frames per second, from 1e-6 to 1e9.
    overwrite : bool
        Whether results, or other files of these names, that `out` holds already are replaced.
    pixel_mm, diameter_mm, region_mm, count, polarity, settings, progress
        See `naibu.imaging.markers.sequences.sequence_tracking.track_sequence`.

    Returns
    -------
    SequenceRun
        Tracks and files.

    Raises
    ------
    InputError
        A stack that cannot be read, an argument out of range, markers that cannot be found, or a folder that cannot be written to. No
        file is then written.
    """
    rate = require_within("frame_rate_hz", frame_rate_hz, *FRAME_RATES_HZ, "frames per second")
    require_lengths(pixel_mm=pixel_mm, diameter_mm=diameter_mm)
    dx, dy = (float(v) for v in lengths_mm("pixel_mm", pixel_mm))
    folder = output_folder(out, ("tracks.csv", "tracks.html", "tracks.json"), overwrite=overwrite)
    report_progress(progress, "reading")
    stack = read_volume(frames, spacing_mm=(dx, dy, 1.0)).values
    tracked = track_sequence(
        stack, pixel_mm=pixel_mm, diameter_mm=diameter_mm, region_mm=region_mm, count=count, polarity=polarity, settings=settings,
        progress=progress,
    )  # fmt: skip
    report_progress(progress, "writing")
    times = np.arange(len(stack)) / rate
    table = write_atomically(folder / "tracks.csv", _csv(tracked, times))
    columns, rows = _summary(tracked)
    described: dict[str, Cell] = {"frames": len(stack), "frame rate, Hz": rate, "pixel, mm": f"{dx:g}, {dy:g}"}
    described |= {"diameter, mm": f"{diameter_mm}", **input_record({"images": frames})}
    caption = f"{len(tracked)} markers in {len(stack)} frames"
    section = Section(
        "Markers",
        ("Markers are numbered from left to right; x points right and y down the image, from the centre of its first pixel.",),
        (Table("Tracks", columns, rows, caption=caption, note=f"Rejected tracks: {_rejections(tracked)}."),),
        (_figure(tracked, stack, times, dx, dy),),
    )
    page, _ = write_chapter(Chapter("tracks", "Markers tracked through an image sequence", (section,), described), folder)
    return SequenceRun(tracked, columns, rows, page, table)


def _summary(tracked: TrackedSequence) -> tuple[tuple[str, ...], tuple[tuple[Cell, ...], ...]]:
    """Return headers and one row a marker."""
    columns = ("marker", "seen in frames", "largest displacement, mm", "standard deviation (median), mm", "contrast")
    moved = np.linalg.norm(tracked.points - tracked.points[0], axis=-1).max(axis=0)
    rows = tuple(
        (i + 1, int(tracked.seen[:, i].sum()), float(moved[i]), float(np.median(tracked.sd_mm[:, i])), float(tracked.strength[i]))
        for i in range(len(tracked))
    )
    return columns, rows


def _rejections(tracked: TrackedSequence) -> str:
    """Return how many tracks were rejected for which reason."""
    return "; ".join(f"{n} {why}" for why, n in Counter(r.reason for r in tracked.rejected).items()) or "none"


def _csv(tracked: TrackedSequence, times: FloatArray) -> str:
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for t, time in enumerate(times):
        for i, (x, y) in enumerate(tracked.points[t]):
            writer.writerow([t, f"{time:.6g}", i + 1, f"{x:.5g}", f"{y:.5g}", f"{tracked.sd_mm[t, i]:.3g}", int(tracked.seen[t, i])])
    return stream.getvalue()


def _figure(tracked: TrackedSequence, stack: AnyArray, times: FloatArray, dx: float, dy: float) -> Figure:
    def draw(canvas: Canvas) -> None:
        image, along, down = canvas.subplots(1, 3, width_ratios=[1.2, 1.0, 1.0])
        _, ny, nx = stack.shape
        extent = (-0.5 * dx, (nx - 0.5) * dx, (ny - 0.5) * dy, -0.5 * dy)
        image.imshow(np.asarray(stack[0], dtype=float), cmap="gray", extent=extent)
        for i in range(len(tracked)):
            colour = f"C{i % 10}"
            path = tracked.points[:, i]
            image.plot(path[:, 0], path[:, 1], "-", color=colour, lw=1.5)
            image.annotate(str(i + 1), path[0], color="white", fontsize=8, xytext=(4, 4), textcoords="offset points")
            for axis, k in ((along, 0), (down, 1)):
                change = path[:, k] - path[0, k]
                axis.plot(times, np.where(tracked.seen[:, i], change, np.nan), color=colour, lw=1.2, label=f"{i + 1}")
                axis.plot(times, np.where(tracked.seen[:, i], np.nan, change), color=colour, lw=1.2, ls=":")
        image.set(xlabel="x, mm", ylabel="y, mm", title="first frame and paths")
        along.set(xlabel="time, s", ylabel="displacement along x, mm")
        down.set(xlabel="time, s", ylabel="displacement along y, mm")
        down.legend(title="marker", fontsize=7, ncols=2, frameon=False)

    caption = "Dotted where a marker was not seen and its position was filled in from the motion of the others."
    return Figure("Tracks", caption, draw, (11.0, 4.0))
