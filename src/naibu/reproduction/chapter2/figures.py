"""Figures of chapter 2."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.reproduction.chapter2.marker_measurements import MarkerMeasurement
from naibu.reproduction.chapter2.simulations import PHASES_S, Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

Draw = Callable[["Canvas"], None]
SHOWN_S = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)


def snapshots(study: Study) -> Draw:
    """Draw the deformed mesh at seven times, coloured by the area ratio of the cells."""

    def draw(canvas: Canvas) -> None:
        points, cells = study.mesh.points, study.mesh.cells
        pushed, side = float(np.abs(study.series.displacement[..., 1]).max()), float(np.ptp(points[:, 0]))
        axes = canvas.subplots(1, len(SHOWN_S), sharey=True)
        shading: Any = None
        for axis, time in zip(axes, SHOWN_S, strict=True):
            moved = points + study.series.displacement[int(np.argmin(np.abs(study.series.times - time)))]
            ratio = _areas(moved, cells) / _areas(points, cells)
            limits = {"vmin": 0.6, "vmax": 1.4}
            shading = axis.tripcolor(*moved.T, cells, facecolors=ratio, cmap="cividis", edgecolors="white", linewidth=0.1, **limits)
            axis.set(
                title=f"{time:g} s",
                aspect="equal",
                xlabel="x, mm",
                xlim=(-0.75 * side, 0.75 * side),
                ylim=(-0.03 * side, side + 0.5 * pushed),
            )
        axes[0].set_ylabel("y, mm")
        canvas.colorbar(shading, ax=list(axes), label="area ratio", shrink=0.8)

    return draw


def curves(studies: Sequence[Study]) -> Draw:
    """Draw displacement of the loaded point and force of the indenter against time."""

    def draw(canvas: Canvas) -> None:
        left, right = canvas.subplots(1, 2)
        for study, line in zip(studies, ("-", "--", "-."), strict=False):
            series = study.series
            left.plot(series.times, series.displacement[:, study.middle_top, 1], line, label=study.name, lw=1.2)
            acts = series.times <= PHASES_S[1]
            right.plot(series.times[acts], -series.force("indenter")[acts, 1], line, lw=1.2)
        for axis in (left, right):
            for time in PHASES_S[:2]:
                axis.axvline(time, color="0.8", lw=0.8, zorder=0)
        left.set(xlabel="time, s", ylabel="displacement, mm", title="middle of the top")
        right.set(xlabel="time, s", ylabel="force, mN per mm of thickness", title="indenter")
        left.legend(frameon=False)

    return draw


def measured_markers(trials: Mapping[str, MarkerMeasurement]) -> Draw:
    """Draw the marker positions of every trial before and after loading."""

    def draw(canvas: Canvas) -> None:
        for axis, (name, seen) in zip(np.atleast_1d(canvas.subplots(1, len(trials), sharey=True)), trials.items(), strict=True):
            end = seen.start + seen.displacement
            axis.quiver(*seen.start.T, *seen.displacement.T, angles="xy", scale_units="xy", scale=1.0, width=0.004, color="0.5")
            axis.plot(*seen.start.T, "o", ms=4, label="before")
            axis.plot(*end.T, "s", ms=4, label="after 6 s")
            axis.set(title=name, xlabel="x from the middle, mm", ylim=(8, 24))
            axis.grid(alpha=0.3)
        canvas.axes[0].set_ylabel("height above the floor, mm")
        canvas.axes[0].legend(frameon=False)

    return draw


def deformed_block(study: Study, time_s: float) -> Draw:
    """Draw the undeformed outline and the deformed mesh."""

    def draw(canvas: Canvas) -> None:
        axis, points = canvas.subplots(), study.mesh.points
        moved = points + study.series.displacement[int(np.argmin(np.abs(study.series.times - time_s)))]
        (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
        axis.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], "--", color="0.6", lw=1.0)
        axis.triplot(*moved.T, study.mesh.cells, lw=0.5, color="C0")
        axis.set(aspect="equal", xlabel="x, mm", ylabel="y, mm", title=f"{time_s:g} s after the start of loading")

    return draw


def marker_paths(middle: Study, left: Study, trials: Mapping[str, MarkerMeasurement], markers: Sequence[int]) -> Draw:
    """Draw the simulated paths of markers, and their measured displacements."""

    def draw(canvas: Canvas) -> None:
        for axis, marker in zip(canvas.subplots(1, len(markers), sharey=True), markers, strict=True):
            for study, line, label in ((middle, "-", "middle"), (left, "--", "one mesh left")):
                point = [(10.0 * (marker - 3), 20.0)]
                path = np.array([study.displacement_at(point, time)[0] for time in study.series.times])
                axis.plot(*path.T, line, color="C0", lw=1.2, label=label)
            for sign, (name, seen) in zip("x+", trials.items(), strict=False):
                axis.plot(*seen.displacement[int(np.searchsorted(seen.ids, marker))], sign, color="C1", ms=7, label=f"measured, {name}")
            axis.set(title=f"marker {marker}", xlabel="x, mm", xlim=(-4.5, 4.5))
            axis.grid(alpha=0.3)
        canvas.axes[0].set_ylabel("y, mm")
        canvas.axes[-1].legend(frameon=False, fontsize=7)

    return draw


def cross_section(study: Study, start: FloatArray, measured: FloatArray, simulated: FloatArray, trusted: BoolArray) -> Draw:
    """Draw measured and simulated displacements of markers in the cross-section, magnified threefold."""

    def draw(canvas: Canvas) -> None:
        axis = canvas.subplots()
        axis.triplot(*study.mesh.points.T, study.mesh.cells, lw=0.3, color="0.85")
        arrow: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0 / 3.0, "width": 0.003}
        axis.quiver(*start[trusted].T, *measured[trusted].T, color="C0", label="measured", **arrow)
        axis.quiver(*start.T, *simulated.T, color="C1", label="simulated", **arrow)
        axis.plot(*start[trusted].T, "o", ms=3, color="0.3")
        axis.plot(*start[~trusted].T, "o", ms=3, mfc="none", color="0.3", label="suspect")
        axis.set(aspect="equal", xlabel="x from the middle, mm", ylabel="height, mm")
        axis.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))

    return draw


def _areas(points: FloatArray, cells: IntArray) -> FloatArray:
    a, b = points[cells[:, 1]] - points[cells[:, 0]], points[cells[:, 2]] - points[cells[:, 0]]
    return np.asarray(0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
