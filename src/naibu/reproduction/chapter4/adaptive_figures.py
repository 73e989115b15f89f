"""Figures of adaptive mass-spring meshes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Protocol

import numpy as np

from naibu.core.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

Draw = Callable[["Canvas"], None]
LARGEST = 1.2  # stretch of the brightest colour


class Shape(Protocol):
    """A deformed mesh."""

    @property
    def position(self) -> FloatArray:
        """Positions (n, 3), mm."""

    @property
    def cells(self) -> IntArray:
        """Tetrahedra (m, 4)."""

    @property
    def faces(self) -> IntArray:
        """Boundary faces (f, 3)."""

    @property
    def stretch(self) -> FloatArray:
        """Largest edge stretch (f,) of the cells behind them."""


class Motion(Protocol):
    """A recorded motion."""

    @property
    def times(self) -> FloatArray:
        """Times (k,), s."""

    @property
    def watched(self) -> FloatArray:
        """Displacement (k, 3), mm."""

    @property
    def nodes(self) -> IntArray:
        """Numbers of nodes (k,)."""

    @property
    def step_ms(self) -> FloatArray:
        """Cost of a step (k,), ms."""

    @property
    def adaptation_ms(self) -> FloatArray:
        """Cost of the adaptation (k,), as a part of a step, ms."""

    @property
    def snapshots(self) -> tuple[Shape, ...]:
        """At the end of each part."""


def shapes(found: Mapping[str, Motion]) -> Draw:
    """Return what draws the meshes at the ends of the parts of the motions, one row a part."""

    def draw(canvas: Canvas) -> None:
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize
        from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

        scale = ScalarMappable(Normalize(1.0, LARGEST), "viridis")
        columns, rows = len(found), len(next(iter(found.values())).snapshots)
        for c, (name, motion) in enumerate(found.items()):
            for r, shape in enumerate(motion.snapshots):
                axes = canvas.add_subplot(rows, columns, r * columns + c + 1, projection="3d")
                colours = scale.to_rgba(shape.stretch)
                axes.add_collection3d(Poly3DCollection(shape.position[shape.faces], facecolors=colours, edgecolors="k", linewidths=0.2))
                low, high = shape.position.min(axis=0), shape.position.max(axis=0)
                middle, half = 0.5 * (low + high), 0.5 * float((high - low).max())
                axes.set(**{f"{a}lim": (m - half, m + half) for a, m in zip("xyz", middle, strict=True)})
                axes.set_axis_off()
                axes.view_init(elev=18.0, azim=-65.0)
                axes.set_title(f"{name}, {('released', 'returned')[r]}", fontsize=9)
        canvas.colorbar(scale, ax=canvas.axes, label="edge stretch", shrink=0.6, extend="max")

    return draw


def deflections(found: Mapping[str, Motion], label: str) -> Draw:
    """Return what draws the downward motions."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.add_subplot()
        for name, motion in found.items():
            axes.plot(motion.times, -motion.watched[:, 2], label=name)
        axes.set(xlabel="time, s", ylabel=label)
        axes.legend(fontsize=8)

    return draw


def costs(found: Mapping[str, Motion]) -> Draw:
    """Return what draws the cost of a step, and the number of nodes."""

    def draw(canvas: Canvas) -> None:
        left, right = canvas.subplots(1, 2)
        for name, motion in found.items():
            (line,) = left.plot(motion.times, motion.step_ms, label=f"{name}, step")
            if motion.adaptation_ms.max() > 0.1 * motion.step_ms.max():
                left.plot(motion.times, motion.step_ms + motion.adaptation_ms, ":", color=line.get_color(), label="and adaptation")
            right.plot(motion.times, motion.nodes, label=name)
        left.set(xlabel="time, s", ylabel="processor time of an iteration, ms", ylim=(0.0, None))
        right.set(xlabel="time, s", ylabel="nodes", ylim=(0.0, None))
        left.legend(fontsize=8)
        right.legend(fontsize=8)

    return draw


def contact(motion: Motion, side_mm: float) -> Draw:
    """Return what draws the cross-section through the middle at the ends of the parts of a motion."""

    def draw(canvas: Canvas) -> None:
        from matplotlib.collections import PolyCollection

        panels = canvas.subplots(1, len(motion.snapshots))
        for axes, shape, title in zip(panels, motion.snapshots, ("deepest", "after"), strict=True):
            polygons = cross_section(shape.position, shape.cells, 0.501 * side_mm)
            axes.add_collection(PolyCollection(polygons, facecolors="#dbe7f0", edgecolors="k", linewidths=0.5))
            axes.set(xlabel="x, mm", ylabel="z, mm", title=title, aspect="equal")
            axes.autoscale_view()

    return draw


def cross_section(position: FloatArray, cells: IntArray, y: float) -> list[FloatArray]:
    """Return the polygons (k, 2), in x and z, in which tetrahedra cut the plane of one y, mm."""
    first, second = np.triu_indices(4, 1)
    polygons = []
    for corners in position[cells]:
        p, q = corners[first], corners[second]
        crossing = (p[:, 1] - y) * (q[:, 1] - y) < 0.0
        if crossing.sum() < 3:
            continue
        t = (y - p[crossing, 1]) / (q[crossing, 1] - p[crossing, 1])
        points = (p[crossing] + t[:, None] * (q[crossing] - p[crossing]))[:, [0, 2]]
        offset = points - points.mean(axis=0)
        polygons.append(points[np.argsort(np.arctan2(offset[:, 1], offset[:, 0]))])
    return polygons
