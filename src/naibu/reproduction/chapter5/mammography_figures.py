"""Figures of chapter 5.4: markers of the phantom, and points of a scan in a mammogram."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.reproduction.chapter5.scanned_breasts import ScannedBreastStudy

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

Draw = Callable[["Canvas"], None]


def moved_markers(before: FloatArray, after: FloatArray, predicted: FloatArray, layer: BoolArray) -> Draw:
    """Draw markers (n, 3), mm, from above those of one layer (n,), and from the side those half-way between the plates."""

    def draw(canvas: Canvas) -> None:
        above, side = canvas.subplots(1, 2)
        middle = np.abs(before[:, 1]) < 6.0
        for axes, chosen, x, y in ((above, layer, 1, 0), (side, middle, 0, 2)):
            axes.plot(before[chosen, x], before[chosen, y], "o", color="0.7", ms=4, label="at rest")
            for a, b in zip(before[chosen], after[chosen], strict=True):
                axes.plot([a[x], b[x]], [a[y], b[y]], color="0.8", lw=0.8, zorder=0)
            axes.plot(after[chosen, x], after[chosen, y], "o", color="C0", ms=4, label="measured, plates 100 mm apart")
            axes.plot(predicted[chosen, x], predicted[chosen, y], "x", color="C1", ms=5, label="predicted by the equilibrium")
            axes.set_aspect("equal")
        above.set(title="lowest layer, from above", xlabel="along the compression, mm", ylabel="across the compression, mm")
        side.set(title="half-way between the plates", xlabel="across the compression, mm", ylabel="above the table, mm")
        canvas.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=8)

    return draw


def scanned_points(study: ScannedBreastStudy, names: tuple[str, ...]) -> Draw:
    """Draw the true places of points in CC, and lines from there to the places that each prediction gives."""

    def draw(canvas: Canvas) -> None:
        outline, truth = study.outlines[0], study.truth[0]
        for axes, name in zip(canvas.subplots(1, len(names), sharey=True), names, strict=True):
            axes.plot(*outline.polygon.T, color="k", lw=1.0)
            axes.axvline(0.0, color="0.6", lw=2.0)
            for a, b in zip(truth, study.predicted[name][0], strict=True):
                axes.plot([a[0], b[0]], [a[1], b[1]], color="C1", lw=1.0)
            axes.plot(*study.predicted[name][0].T, "x", color="C1", ms=4, label="predicted")
            axes.plot(*truth.T, ".", color="C0", ms=5, label="true")
            axes.set(title=name.replace(", ", ",\n"), xlabel="from the chest wall, mm", aspect="equal")
            axes.title.set_fontsize(9)
        canvas.axes[0].set_ylabel("laterally from the nipple, mm")
        canvas.legend(*canvas.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=8)

    return draw
