"""Figures of two mammographic views and of the unloaded breast."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from naibu.applications.mammography.breast_outline import BreastOutline
from naibu.applications.mammography.breast_shape import BreastShape
from naibu.applications.mammography.epipolar import EpipolarCurve, Projection
from naibu.core.arrays import FloatArray

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure as Canvas


def draw_views(
    canvas: Canvas,
    outlines: tuple[BreastOutline, BreastOutline],
    places: tuple[FloatArray | None, FloatArray | None],
    curves: tuple[EpipolarCurve | None, EpipolarCurve | None],
    projection: Projection | None,
) -> None:
    """Draw CC and MLO in image coordinates, mm, with the points, the curve and band of the point of the other view, and a scan's point."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    axis_names = ("along the chest wall, laterally (mm)", "along the chest wall, upwards (mm)")
    for k, (axes, name) in enumerate(zip(canvas.subplots(1, 2), ("CC", "MLO"), strict=True)):
        outline, curve, place = outlines[k], curves[1 - k], places[k]
        axes.plot(*outline.to_image(outline.polygon).T, color="k", linewidth=1.0, label="outline")
        axes.axvline(outline.wall_mm, color="0.6", linewidth=2.0, label="chest wall")
        if curve is not None:
            band = Path.make_compound_path_from_polys(outline.to_image(curve.strips))
            axes.add_patch(PathPatch(band, facecolor="C0", alpha=0.2, linewidth=0, label="95 % band"))
            axes.plot(*outline.to_image(curve.curve).T, color="C0", label="epipolar curve")
        if place is not None:
            axes.plot(*outline.to_image(place), "C3x", markersize=9, markeredgewidth=2, label="point")
        if projection is not None:
            axes.fill(*outline.to_image(projection.regions[k]).T, color="C2", alpha=0.2, linewidth=0, label="95 % region")
            axes.plot(*outline.to_image(projection.places[k]), "C2+", markersize=10, markeredgewidth=2, label="point of the scan")
        axes.set(title=name, xlabel="perpendicular to the chest wall (mm)", ylabel=axis_names[k], aspect="equal")
    labels: dict[str, Artist] = {}
    for axes in canvas.axes:  # what is in one view may be missing in the other
        handles, names = axes.get_legend_handles_labels()
        labels = dict(zip(names, handles, strict=True)) | labels
    canvas.legend(list(labels.values()), list(labels), loc="outside lower center", ncols=4, frameon=False)


def draw_breast(canvas: Canvas, shape: BreastShape, curve: EpipolarCurve | None, lesion: FloatArray | None) -> None:
    """Draw the unloaded breast: ellipses from the front, and both profiles, with the points of the curve and the lesion."""
    front, top, side = canvas.subplots(1, 3)
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    for k in np.linspace(0, len(shape.depths) - 2, 7).round().astype(int):
        xx, yy, xy = shape.squares[k]
        root = np.linalg.cholesky(np.array([[xx, xy], [xy, yy]]) + 1e-9 * np.eye(2))
        front.plot(*(shape.centres[k][:, None] + root @ np.array([np.cos(turn), np.sin(turn)])), color="0.5", linewidth=0.8)
    for axes, axis in ((top, 0), (side, 1)):
        reach = np.sqrt(shape.squares[:, axis])
        for sign in (-1.0, 1.0):
            axes.plot(shape.depths, shape.centres[:, axis] + sign * reach, color="0.5", linewidth=0.8)
    planes = ((front, (0, 1)), (top, (2, 0)), (side, (2, 1)))
    for axes, pair in planes:
        if curve is not None:
            axes.plot(*curve.points[:, pair].T, color="C0")
        if lesion is not None:
            axes.plot(*lesion[list(pair)], "C3x", markersize=9, markeredgewidth=2)
        axes.set_aspect("equal")
    front.set(title="from the front", xlabel="laterally (mm)", ylabel="upwards (mm)")
    top.set(title="from above", xlabel="from the chest wall (mm)", ylabel="laterally (mm)")
    side.set(title="from the side", xlabel="from the chest wall (mm)", ylabel="upwards (mm)")
