"""Comparison of methods that measure displacement, on one pair of volumes: table and images, as a page and as numbers."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import NaibuError
from naibu.core.progress import Progress, ProgressReport, report_progress
from naibu.imaging.displacement.accuracy import end_point_error
from naibu.imaging.measure_displacement import Method
from naibu.imaging.preprocessing.resampling import warped
from naibu.imaging.preprocessing.volume_pair import require_contrast, require_one_grid
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.chapters.chapter_page import write_chapter
from naibu.viewer.tables import Cell, Table
from naibu.workflows.measurement.sense import FIGURES, Pair, SenseRun, sense_pair
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

TOLD = ("residual_rms", "median_sd_mm", "mean_error_mm", "p95_error_mm", "p95_check_point_error_mm")  # figures told as they come
OMITTED = ("initial_residual_rms", "median_displacement_mm", "largest_displacement_mm")  # the same for all methods, or nearly so


@dataclass(frozen=True, slots=True)
class MethodComparison:
    """Table, page and file of numbers of a comparison."""

    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    page: Path
    numbers: Path


@no_empty_folders()
def compare_methods(
    pair: Pair,
    methods: Sequence[Method],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    progress: Progress | None = None,
    told: Callable[[str], None] | None = None,
) -> MethodComparison:
    """Measure the displacement of one pair by several methods, one after the other, and write ``methods.html`` and ``methods.json``.

    Both files are written again after every method, so that an interruption loses only the one that is running. A method that cannot be
    used on the pair is listed with the reason, and does not stop the others.

    Parameters
    ----------
    pair : Pair
        From `naibu.workflows.measurement.sense.read_pair`.
    methods : sequence of str
        Among `naibu.imaging.measure_displacement.METHODS`.
    out : path-like
        Folder for the page and the numbers.
    overwrite : bool
        Whether results, or other files of these names, that `out` holds already are replaced.
    progress : Progress, optional
        Called with the share done.
    told : callable, optional
        Called with a sentence on every method as soon as it is done.

    Raises
    ------
    InputError
        A folder that cannot be written to, or no method that could be used.
    """
    require_one_grid(pair.reference, pair.deformed)  # told once, not by every method
    for volume, name in ((pair.reference, "reference"), (pair.deformed, "deformed")):
        require_contrast(volume, name)
    folder = output_folder(out, ("methods.html", "methods.json"), overwrite=overwrite)
    runs: dict[Method, SenseRun] = {}
    failures: dict[Method, str] = {}
    wanted = tuple(dict.fromkeys(methods))
    for k, method in enumerate(wanted):
        report_progress(progress, method, done=k / len(wanted), total=1)
        try:
            runs[method] = sense_pair(pair, method=method, progress=_within(progress, method, k, len(wanted)))
        except NaibuError as error:
            failures[method] = str(error)
            if len(failures) == len(wanted):
                raise
        if runs:
            done = _written(pair, runs, failures, folder)
        if told is not None:
            told(_sentence(method, runs.get(method), failures.get(method, "")))
    return done


def _within(progress: Progress | None, method: str, k: int, methods: int) -> Progress:
    """Return a callback that turns the share done of one method into that of all; the stages of a method are not known beforehand."""

    def report(part: ProgressReport) -> None:
        report_progress(progress, f"{method}: {part.stage}", done=k / methods, total=1)

    return report


def _sentence(method: str, run: SenseRun | None, failure: str) -> str:
    if run is None:
        return f"{method}: could not be used: {failure}"
    told = [f"{FIGURES[name]} {run.figures[name]:.3g}" for name in TOLD if run.figures.get(name) is not None]
    return f"{method}: {run.seconds:.1f} s, {', '.join(told)}"


def _written(pair: Pair, runs: dict[Method, SenseRun], failures: dict[Method, str], folder: Path) -> MethodComparison:
    columns, rows = _table(pair, runs)
    note = " ".join(f"{name} could not be used: {why}." for name, why in failures.items())
    caption = f"{pair.names[0]} to {pair.names[1]}; 'rigid' is the rigid motion of the whole object."
    table = Table("Methods", columns, rows, caption=caption, note=note)
    ends = _largest_displacement(runs), _largest_error(pair, runs)
    figures = tuple(_figure(pair, name, run, *ends) for name, run in runs.items())
    section = Section("Comparison of methods", (_verdict(pair, runs), *_words(pair)), (table,), figures)
    settings: dict[str, Cell] = {**pair.inputs, "mask": "given" if pair.mask is not None else "found"}
    page, numbers = write_chapter(Chapter("methods", "Methods of measuring displacement", (section,), settings), folder)
    return MethodComparison(columns, rows, page, numbers)


def _largest_displacement(runs: dict[Method, SenseRun]) -> float:
    """Return the end of the common colour scale, mm: the 99th percentile over all methods but what failed methods made up."""
    sizes = [np.linalg.norm(run.measured.displacement.vectors[run.measured.mask], axis=-1) for run in runs.values()]
    return float(np.median([np.nanpercentile(size, 99.0) for size in sizes])) or 1.0


def _largest_error(pair: Pair, runs: dict[Method, SenseRun]) -> float:
    """Return the end of the common colour scale of errors, mm: the largest 99th percentile of the methods, at most 3 mm."""
    if pair.truth is None:
        return 1.0
    errors = [np.linalg.norm(run.measured.displacement.vectors - pair.truth, axis=-1)[run.measured.mask] for run in runs.values()]
    return min(3.0, max(float(np.nanpercentile(error, 99.0)) for error in errors)) or 1.0


def _verdict(pair: Pair, runs: dict[Method, SenseRun]) -> str:
    """Return which method was nearest to the truth; where none is known, that nothing is decided."""
    name = next((n for n in ("p95_error_mm", "p95_check_point_error_mm") if all(n in run.figures for run in runs.values())), None)
    if name is None:
        return "Which method is best cannot be told: the true displacement is not known (a truth or check points may be given)."
    best = min(runs, key=lambda method: _figure_of(runs[method], name))
    mean = name.replace("p95", "mean")
    return (
        f"Nearest to the truth by the 95th percentile of the error: {best}, with {_figure_of(runs[best], name):.3g} mm (mean "
        f"{_figure_of(runs[best], mean):.3g} mm). A mean alone hides large errors of small parts."
    )


def _figure_of(run: SenseRun, name: str) -> float:
    value = run.figures[name]
    return float(value) if isinstance(value, float | int) and np.isfinite(value) else np.inf


def _words(pair: Pair) -> tuple[str, ...]:
    first = (
        "Every method has the same volumes, the same mask and, but for the default, the same rigid registration to start from. The "
        "intensity residual RMS is the root mean square difference inside the object after the deformed volume was warped back."
    )
    if pair.truth is None and pair.check_points is None:
        return (
            first,
            "The true displacement is not known: a small residual alone proves nothing, since a field may match noise by folding.",
        )
    return (first,)


def _table(pair: Pair, runs: dict[Method, SenseRun]) -> tuple[tuple[str, ...], tuple[tuple[Cell, ...], ...]]:
    shared = [name for name in next(iter(runs.values())).figures if name not in OMITTED]
    best = runs.get("default")
    names = (FIGURES[name] for name in shared)
    apart = ["mean distance from the default, mm", "95th percentile of it, mm"] if best is not None else []
    columns = ["method", "time, s", *names, *apart]
    rows = []
    for name, run in runs.items():
        row: list[Cell] = [name, float(f"{run.seconds:.2g}"), *(run.figures[c] for c in shared)]
        if best is not None:
            u = best.measured.displacement.vectors
            e = end_point_error(run.measured.displacement.vectors, u, best.measured.mask & known(u))
            row += [None, None] if run is best else [e.mean_mm, e.p95_mm]
        rows.append(tuple(row))
    return tuple(columns), tuple(rows)


def known(vectors: FloatArray) -> BoolArray:
    """Where a displacement (nz, ny, nx, 3) is known."""
    return np.asarray(np.isfinite(vectors).all(axis=-1))


def _figure(pair: Pair, name: Method, run: SenseRun, largest: float, worst: float) -> Figure:
    u, mask = run.measured.displacement.vectors, run.measured.mask
    z = int(np.argmax(mask.sum(axis=(1, 2))))
    inside = np.argwhere(mask[z])
    rows, columns = (slice(int(a), int(b) + 1) for a, b in zip(inside.min(axis=0), inside.max(axis=0), strict=True))
    size = np.where(mask, np.linalg.norm(u, axis=-1), np.nan)[z, rows, columns]
    back = warped(pair.deformed, np.nan_to_num(u), pair.reference)
    rest = np.where(mask, back - pair.reference.values, np.nan)[z, rows, columns]
    contrast = float(np.ptp(np.percentile(pair.reference.values[mask], (1, 99))))
    off = None if pair.truth is None else np.where(mask, np.linalg.norm(u - pair.truth, axis=-1), np.nan)[z, rows, columns]
    dx, dy = pair.reference.spacing_mm[:2]
    extent = (0.0, dx * size.shape[1], dy * size.shape[0], 0.0)

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots(1, 2 if off is None else 3, squeeze=False)[0]
        shown = [
            (size, "displacement, mm", "viridis", 0.0, largest),
            (rest, "intensity residual", "RdBu_r", -0.5 * contrast, 0.5 * contrast),
        ]
        if off is not None:
            shown.append((off, "error, mm", "magma", 0.0, worst))
        for axis, (values, label, colours, low, high) in zip(axes, shown, strict=True):
            image = axis.imshow(values, cmap=colours, vmin=low, vmax=high, extent=extent, interpolation="nearest")
            canvas.colorbar(image, ax=axis, label=label, shrink=0.75, extend="both" if low < 0.0 else "max")
            axis.set(xlabel="x, mm", ylabel="y, mm")

    return Figure(name, f"Slice {z}, the one with most of the object.", draw, (10.0, 3.3))
