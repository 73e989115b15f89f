"""Several ways of sensing on one pair of scans: a table and pictures, as a page and as numbers."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import NaibuError
from naibu.imaging.displacement.accuracy import end_point_error
from naibu.imaging.measure_displacement import Method
from naibu.imaging.preprocessing.resampling import warped
from naibu.viewer.chapter import Chapter, Figure, Section
from naibu.viewer.chapter_page import write_chapter
from naibu.viewer.tables import Cell, Table
from naibu.workflows.result_folder import result_folder
from naibu.workflows.sense import Pair, SenseRun, sense_pair

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

OMITTED = ("grey RMS before", "displacement, median, mm", "displacement, largest, mm")


@dataclass(frozen=True, slots=True)
class MethodComparison:
    """The table, the page and the file of numbers."""

    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    page: Path
    numbers: Path


def compare_methods(
    pair: Pair, methods: Sequence[Method], *, out: str | os.PathLike[str], tell: Callable[[str], None] | None = None
) -> MethodComparison:
    """Sense one pair by several methods, one after the other, and write ``methods.html`` and ``methods.json``.

    A method that cannot be used on the pair has its reason in the table and does not stop the others.

    Parameters
    ----------
    pair : Pair
        From `naibu.workflows.sense.read_pair`.
    methods : sequence of str
        Among `naibu.imaging.measure_displacement.METHODS`.
    out : path-like
        Folder for the page and the numbers.
    tell : callable, optional
        Told the name of every method when it begins.

    Raises
    ------
    InputError
        A folder that cannot be written to, or no method that could be used.
    """
    folder = result_folder(out)
    runs: dict[Method, SenseRun] = {}
    failures: dict[Method, str] = {}
    wanted = tuple(dict.fromkeys(methods))
    for method in wanted:
        if tell is not None:
            tell(method)
        try:
            runs[method] = sense_pair(pair, method=method)
        except NaibuError as error:
            failures[method] = str(error)
            if len(failures) == len(wanted):
                raise
    columns, rows = _table(pair, runs)
    note = " ".join(f"{name} could not be used: {why}." for name, why in failures.items())
    caption = f"{pair.names[0]} to {pair.names[1]}; 'rigid' moves the object as one piece."
    table = Table("Methods", columns, rows, caption=caption, note=note)
    figures = tuple(_figure(pair, name, run) for name, run in runs.items())
    section = Section("Methods side by side", _words(pair), (table,), figures)
    settings: dict[str, Cell] = {**pair.inputs, "mask": "given" if pair.mask is not None else "found"}
    page, numbers = write_chapter(Chapter("methods", "Ways of sensing compared", (section,), settings), folder)
    return MethodComparison(columns, rows, page, numbers)


def _words(pair: Pair) -> tuple[str, ...]:
    first = (
        "Every method gets the same scans, the same mask and, but for the default, the same rigid motion to start from. The grey "
        "RMS is the root mean square difference of grey values inside the object after the second scan was carried back."
    )
    if pair.truth is None and pair.check_points is None:
        return (first, "The truth is not known: a small grey RMS alone proves nothing, since a field may explain noise by folding.")
    return (first,)


def _table(pair: Pair, runs: dict[Method, SenseRun]) -> tuple[tuple[str, ...], tuple[tuple[Cell, ...], ...]]:
    shared = [name for name in next(iter(runs.values())).figures if name not in OMITTED]
    best = runs.get("default")
    columns = ["method", "time, s", *shared, *(["from the default, mean, mm"] if best is not None else [])]
    rows = []
    for name, run in runs.items():
        row: list[Cell] = [name, run.seconds, *(run.figures[c] for c in shared)]
        if best is not None:
            u = best.sensed.displacement.vectors
            row.append(None if run is best else end_point_error(run.sensed.displacement.vectors, u, best.sensed.mask & known(u)).mean_mm)
        rows.append(tuple(row))
    return tuple(columns), tuple(rows)


def known(vectors: FloatArray) -> BoolArray:
    """Where a displacement (nz, ny, nx, 3) is known."""
    return np.asarray(np.isfinite(vectors).all(axis=-1))


def _figure(pair: Pair, name: Method, run: SenseRun) -> Figure:
    u, mask = run.sensed.displacement.vectors, run.sensed.mask
    z = int(np.argmax(mask.sum(axis=(1, 2))))
    inside = np.argwhere(mask[z])
    rows, columns = (slice(int(a), int(b) + 1) for a, b in zip(inside.min(axis=0), inside.max(axis=0), strict=True))
    size = np.where(mask, np.linalg.norm(u, axis=-1), np.nan)[z, rows, columns]
    back = warped(pair.after, np.nan_to_num(u), pair.before)
    rest = np.where(mask, back - pair.before.values, np.nan)[z, rows, columns]
    grey = float(np.ptp(np.percentile(pair.before.values[mask], (1, 99))))
    off = None if pair.truth is None else np.where(mask, np.linalg.norm(u - pair.truth, axis=-1), np.nan)[z, rows, columns]
    dx, dy = pair.before.spacing_mm[:2]
    extent = (0.0, dx * size.shape[1], dy * size.shape[0], 0.0)

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots(1, 2 if off is None else 3, squeeze=False)[0]
        shown = [(size, "displacement, mm", "viridis", 0.0, None), (rest, "grey difference left", "RdBu_r", -0.5 * grey, 0.5 * grey)]
        if off is not None:
            shown.append((off, "error, mm", "magma", 0.0, 3.0))
        for axis, (values, label, colours, low, high) in zip(axes, shown, strict=True):
            image = axis.imshow(values, cmap=colours, vmin=low, vmax=high, extent=extent, interpolation="nearest")
            canvas.colorbar(image, ax=axis, label=label, shrink=0.75, extend="max" if label.startswith("error") else "neither")
            axis.set(xlabel="x, mm", ylabel="y, mm")

    return Figure(name, f"Slice {z}, the one with most of the object.", draw, (10.0, 3.3))
