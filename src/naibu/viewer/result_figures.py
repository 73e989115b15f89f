"""Figures of results for notebooks and scripts, drawn on a figure of matplotlib that is given."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from naibu.core.arrays import AnyFloatArray, FloatArray
from naibu.viewer.result_page.payload import ParameterRow, Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


def draw_estimates(canvas: Canvas, parameters: Sequence[ParameterRow], scenes: Sequence[Scene]) -> None:
    """Draw estimates with 95 % intervals, one panel a unit, and the distance of predicted from measured markers in every state."""
    units = list(dict.fromkeys(p.unit for p in parameters))
    panels = canvas.subplots(1, len(units) + 1, squeeze=False)[0]
    for axes, unit in zip(panels, units, strict=False):
        rows = [p for p in parameters if p.unit == unit]
        for k, p in enumerate(rows):
            below, above = (max(0.0, s) if np.isfinite(s) else np.nan for s in (p.estimate - p.lower, p.upper - p.estimate))
            axes.errorbar(p.estimate, k, xerr=[[below], [above]], fmt="o", capsize=3, color="#0b5c8f")
        axes.set(yticks=range(len(rows)), yticklabels=[p.label for p in rows], ylim=(len(rows) - 0.5, -0.5))
        axes.set_xlabel(f"estimate, 95 % interval{f' ({unit})' if unit else ''}")
    distance = [np.sqrt(np.nanmean(np.sum(s.residual_mm**2, axis=1))) if np.isfinite(s.residual_mm).any() else np.nan for s in scenes]
    panels[-1].barh([s.label for s in scenes], distance, color="#0b5c8f")
    panels[-1].invert_yaxis()
    panels[-1].set_xlabel("predicted from measured markers, RMS (mm)")


def draw_marker_motion(canvas: Canvas, before: FloatArray, after: FloatArray, flags: Sequence[str]) -> None:
    """Draw displacements of markers (n, 3), mm, seen along y, x and z, or (n, 2); flags are ``"ok"``, ``"suspect"`` or ``"missing"``."""
    kind = np.asarray(flags)
    views = ((0, 2), (1, 2), (0, 1)) if before.shape[1] == 3 else ((0, 1),)
    for axes, (a, b) in zip(canvas.subplots(1, len(views), squeeze=False)[0], views, strict=True):
        for flag, colour, label in (("ok", "#0b5c8f", "linked"), ("suspect", "#d55e00", "suspect")):
            p, q = before[kind == flag], after[kind == flag]
            if len(p):
                axes.plot(p[:, a], p[:, b], ".", color=colour, ms=4)
                axes.quiver(
                    p[:, a], p[:, b], (q - p)[:, a], (q - p)[:, b], angles="xy", scale_units="xy", scale=1.0, width=0.004, color=colour,
                    label=label,
                )  # fmt: skip
        lost = before[kind == "missing"]
        if len(lost):
            axes.plot(lost[:, a], lost[:, b], "x", color="#7f7f7f", ms=4, label="not found")
        axes.set(xlabel=f"{'xyz'[a]} (mm)", ylabel=f"{'xyz'[b]} (mm)", aspect="equal")
        axes.margins(0.1)
    handles, names = canvas.axes[0].get_legend_handles_labels()
    canvas.legend(handles, names, loc="outside lower center", ncols=3, frameon=False)


def draw_slices(canvas: Canvas, fields: Sequence[tuple[str, AnyFloatArray, str]], spacing_mm: AnyFloatArray) -> None:
    """Draw plane fields (ny, nx), each with its name and colour map, side by side; spacing along x and y, mm."""
    panels = canvas.subplots(1, len(fields), squeeze=False)[0]
    for axes, (name, values, colours) in zip(panels, fields, strict=True):
        extent = (0.0, spacing_mm[0] * values.shape[1], spacing_mm[1] * values.shape[0], 0.0)
        image = axes.imshow(values, cmap=colours, extent=extent, interpolation="nearest")
        canvas.colorbar(image, ax=axes, label=name, shrink=0.8)
        axes.set(xlabel="x (mm)", ylabel="y (mm)")


def draw_forces(canvas: Canvas, times: FloatArray, forces: dict[str, FloatArray], unit: str) -> None:
    """Draw the size of forces (t, 3) on the object over time, s."""
    axes = canvas.subplots()
    for name, force in forces.items():
        axes.plot(times, np.linalg.norm(force, axis=1), label=name)
    axes.set(xlabel="time (s)", ylabel=f"force on the object ({unit})")
    axes.legend(frameon=False)
