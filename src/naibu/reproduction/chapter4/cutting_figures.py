"""Figures of cut surfaces."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.meshing.cutting.surfaces.surface_result import Groove, SurfaceCut

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

Draw = Callable[["Canvas"], None]
LIGHT = np.array([0.25, -0.35, 0.9])
SKIN, WALL = np.array([0.93, 0.80, 0.70]), np.array([0.75, 0.20, 0.18])
MARGIN_MM = 6.0


def whole(points: FloatArray, triangles: IntArray, cut: SurfaceCut) -> Draw:
    """Return what draws a surface before and after the cut."""

    def draw(canvas: Canvas) -> None:
        for k, (p, t, title) in enumerate(((points, triangles, "before"), (cut.points, cut.triangles, "after the cut"))):
            axes = canvas.add_subplot(1, 2, k + 1, projection="3d")
            _shaded(axes, p, t, np.tile(SKIN, (len(t), 1)), 0.15)
            if k:
                for line in cut.cut_edges:
                    axes.plot(*line.T, color=WALL, linewidth=1.6, zorder=9)
            _framed(axes, points)
            axes.view_init(elev=62.0, azim=-90.0)
            axes.set_title(title, fontsize=9)

    return draw


def compared(cuts: Mapping[str, SurfaceCut], tips: FloatArray) -> Draw:
    """Return what draws cuts beside the path of the tool, seen from above."""

    def draw(canvas: Canvas) -> None:
        from matplotlib.collections import LineCollection, PolyCollection

        low, high = tips[:, :2].min(axis=0) - MARGIN_MM, tips[:, :2].max(axis=0) + MARGIN_MM
        for axes, (name, cut) in zip(canvas.subplots(1, len(cuts)), cuts.items(), strict=True):
            corners = cut.points[cut.triangles]
            up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0.0
            axes.add_collection(PolyCollection(list(corners[up][:, :, :2]), facecolors=[*SKIN, 1.0], edgecolors="0.45", linewidths=0.3))
            axes.add_collection(LineCollection(list(cut.cut_edges[:, :, :2]), colors=[WALL], linewidths=1.8, label="cut"))
            axes.plot(tips[:, 0], tips[:, 1], color="#1f4e9c", linewidth=0.9, label="path of the tool")
            axes.set(xlabel="x, mm", ylabel="y, mm", title=name, aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            axes.legend(fontsize=8, loc="upper left")

    return draw


def opened_groove(cut: SurfaceCut, made: Groove, moved: FloatArray) -> Draw:
    """Return what draws the surface near the cut with its groove, opened."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.add_subplot(projection="3d")
        near = cut.points[np.unique(cut.lips)]
        low, high = near.min(axis=0) - 2.0 * MARGIN_MM, near.max(axis=0) + 2.0 * MARGIN_MM
        middle = moved[cut.triangles].mean(axis=1)
        shown = ((middle > low) & (middle < high)).all(axis=1)
        triangles = np.concatenate([cut.triangles[shown], made.triangles])
        colours = np.concatenate([np.tile(SKIN, (int(shown.sum()), 1)), np.tile(WALL, (len(made.triangles), 1))])
        _shaded(axes, moved, triangles, colours, 0.2)
        _framed(axes, near)
        axes.view_init(elev=48.0, azim=-125.0)

    return draw


def _shaded(axes, points: FloatArray, triangles: IntArray, colours: FloatArray, width: float) -> None:  # type: ignore[no-untyped-def]
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

    corners = points[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    bright = 0.55 + 0.45 * np.clip(normal @ (LIGHT / np.linalg.norm(LIGHT)), 0.0, 1.0)
    axes.add_collection3d(
        Poly3DCollection(corners, facecolors=bright[:, None] * colours, edgecolors=(0, 0, 0, 0.5), linewidths=width, clip_on=False)
    )


def _framed(axes, points: FloatArray) -> None:  # type: ignore[no-untyped-def]
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = 0.5 * (low + high), 0.42 * float((high - low).max())
    axes.set(**{f"{a}lim": (m - half, m + half) for a, m in zip("xyz", middle, strict=True)})
    axes.set_axis_off()
