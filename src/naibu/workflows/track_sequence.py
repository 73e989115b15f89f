"""Follow markers through a sequence of images, such as ultrasound, from a file to a table and a page."""

from __future__ import annotations

import csv
import io
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from naibu.core.arrays import FloatArray
from naibu.imaging.markers.sequence_tracking import TrackedSequence, track_sequence
from naibu.io.files.atomic import write_atomically
from naibu.io.files.provenance import input_record
from naibu.io.images import read_volume
from naibu.viewer.chapter import Chapter, Figure, Section
from naibu.viewer.chapter_page import write_chapter
from naibu.viewer.tables import Cell, Table
from naibu.workflows.result_folder import result_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

COLUMNS = ("frame", "time_s", "marker", "x_mm", "y_mm", "sd_mm", "seen")


@dataclass(frozen=True, slots=True)
class SequenceRun:
    """Tracks, a row for each marker, and the files."""

    tracked: TrackedSequence
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    page: Path
    table: Path


def track_sequence_file(
    frames: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    pixel_mm: float | Sequence[float],
    diameter_mm: float | Sequence[float],
    frame_rate_hz: float = 1.0,
    region_mm: Sequence[float] | None = None,
    count: int | None = None,
    polarity: Literal["bright", "dark"] = "bright",
) -> SequenceRun:
    """Follow markers through the images of a stack, and write ``tracks.csv``, ``tracks.html`` and ``tracks.json``.

    Parameters
    ----------
    frames : path-like
        A stack of images (see `naibu.io.images.read_volume`), the times along its third axis.
    out : path-like
        Folder for the files.
    frame_rate_hz : float
        Frames a second.
    pixel_mm, diameter_mm, region_mm, count, polarity
        See `naibu.imaging.markers.sequence_tracking.track_sequence`.

    Raises
    ------
    InputError
        A stack that cannot be read, markers that cannot be found, or a folder that cannot be written to.
    """
    folder = result_folder(out)
    dx, dy = np.broadcast_to(np.asarray(pixel_mm, dtype=float), 2)
    stack = read_volume(frames, spacing_mm=(dx, dy, 1.0)).values
    tracked = track_sequence(stack, pixel_mm=pixel_mm, diameter_mm=diameter_mm, region_mm=region_mm, count=count, polarity=polarity)
    times = np.arange(len(stack)) / frame_rate_hz
    table = write_atomically(folder / "tracks.csv", _csv(tracked, times))
    columns = ("marker", "seen in frames", "largest displacement, mm", "standard deviation (median), mm", "contrast")
    moved = np.linalg.norm(tracked.points - tracked.points[0], axis=-1).max(axis=0)
    rows = tuple(
        (i + 1, int(tracked.seen[:, i].sum()), float(moved[i]), float(np.median(tracked.sd_mm[:, i])), float(tracked.strength[i]))
        for i in range(len(tracked))
    )
    settings: dict[str, Cell] = {"frames": len(stack), "frame rate, Hz": frame_rate_hz, "pixel, mm": f"{dx:g}, {dy:g}"}
    settings |= {"diameter, mm": f"{diameter_mm}", **input_record({"images": frames})}
    rejected = "; ".join(f"{n} {why}" for why, n in Counter(r.reason for r in tracked.rejected).items()) or "none"
    section = Section(
        "Markers",
        ("Numbers run from left to right; x points right and y down the image, from the centre of its first pixel.",),
        (Table("Tracks", columns, rows, caption=f"{len(tracked)} markers in {len(stack)} frames", note=f"Rejected tracks: {rejected}."),),
        (_figure(tracked, stack, times, float(dx), float(dy)),),
    )
    page, _ = write_chapter(Chapter("tracks", "Markers followed through a sequence", (section,), settings), folder)
    return SequenceRun(tracked, columns, rows, page, table)


def _csv(tracked: TrackedSequence, times: FloatArray) -> str:
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for t, time in enumerate(times):
        for i, (x, y) in enumerate(tracked.points[t]):
            writer.writerow([t, f"{time:.6g}", i + 1, f"{x:.5g}", f"{y:.5g}", f"{tracked.sd_mm[t, i]:.3g}", int(tracked.seen[t, i])])
    return stream.getvalue()


def _figure(tracked: TrackedSequence, stack: NDArray[np.generic], times: FloatArray, dx: float, dy: float) -> Figure:
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

    return Figure(
        "Tracks", "Dotted where a marker was not seen and its place was filled in by the motion of the others.", draw, (11.0, 4.0)
    )
