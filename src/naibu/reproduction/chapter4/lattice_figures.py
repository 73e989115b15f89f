"""Figures of calibrated lattices: final shapes with the captured points that lie far from them, and forces over time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.identification.lattice_calibration.captured.shape_distance import closest_points
from naibu.identification.lattice_calibration.forward_model import SAMPLE_S, Capture, PushedLattice, Reproduced

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

Draw = Callable[["Canvas"], None]
FAR_MM = 2.5  # as in the report
SENSOR = 0  # the force of which indenter is drawn


@dataclass(frozen=True, slots=True, eq=False)
class FinalShape:
    """A computed shape at the last capture, and captured points that are `FAR_MM` or more away from it.

    Attributes
    ----------
    title : str
        Above it.
    position : ndarray, shape (n, 3)
        Nodes, mm.
    triangles : ndarray, shape (f, 3), int64
        Of the surface.
    far : ndarray, shape (k, 3)
        Points, mm.
    captured : int
        How many points were captured.
    """

    title: str
    position: FloatArray
    triangles: IntArray
    far: FloatArray
    captured: int

    @classmethod
    def of(cls, title: str, capture: Capture, pushed: PushedLattice, motion: Reproduced) -> FinalShape:
        """Return the last shape of a motion."""
        position, cloud = motion.positions[-1], capture.points[-1]
        away = np.abs(closest_points(cloud, pushed.hull, position).signed) >= FAR_MM
        return cls(title, position, pushed.hull.triangles, cloud[away], len(cloud))


@dataclass(frozen=True, slots=True, eq=False)
class ForceWave:
    """Magnitude of the force of an indenter, measured and computed, N, at times, s, (k,) each."""

    title: str
    times: FloatArray
    measured: FloatArray
    computed: FloatArray

    @classmethod
    def of(cls, title: str, capture: Capture, pushed: PushedLattice, motion: Reproduced) -> ForceWave:
        """Return the force of a motion while the indenters touch."""
        computed = np.repeat(motion.force, round(pushed.long_step / SAMPLE_S), axis=0)
        times = np.asarray(SAMPLE_S * (np.arange(len(computed)) + 0.5), dtype=np.float64)
        return cls(title, times, _newtons(capture.force[:, SENSOR]), _newtons(computed[:, SENSOR]))


def _newtons(force: FloatArray) -> FloatArray:
    """Return the sizes (k,), N, of forces (k, 3), mN."""
    return np.asarray(1e-3 * np.sqrt((force**2).sum(axis=1)), dtype=np.float64)


def final_shapes(shapes: Sequence[FinalShape]) -> Draw:
    """Return what draws shapes, two in a row, far points in orange."""

    def draw(canvas: Canvas) -> None:
        from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

        for k, shape in enumerate(shapes):
            axes = canvas.add_subplot((len(shapes) + 1) // 2, 2, k + 1, projection="3d", computed_zorder=False)
            faces = Poly3DCollection(shape.position[shape.triangles], facecolors="#b9cbd9", edgecolors="#5c7080", linewidths=0.2, alpha=0.6)
            axes.add_collection3d(faces)
            axes.scatter(*shape.far.T, s=3.0, c="#e8710a", depthshade=False, zorder=3)
            low, high = shape.position.min(axis=0), shape.position.max(axis=0)
            middle, half = 0.5 * (low + high), 0.45 * float((high - low).max())
            axes.set(**{f"{a}lim": (m - half, m + half) for a, m in zip("xyz", middle, strict=True)})
            axes.set_axis_off()
            axes.view_init(elev=22.0, azim=-58.0)
            axes.set_title(f"{shape.title}: {len(shape.far)} of {shape.captured} points", fontsize=9)
        canvas.set_layout_engine(None)  # axes that are not shown leave no room for themselves
        canvas.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=0.95, wspace=0.0, hspace=0.1)

    return draw


def force_waves(waves: Sequence[ForceWave]) -> Draw:
    """Return what draws measured and computed forces over time, two panels in a row."""

    def draw(canvas: Canvas) -> None:
        panels = np.atleast_1d(canvas.subplots((len(waves) + 1) // 2, 2, sharex=True)).ravel()
        for axes, wave in zip(panels, waves, strict=True):
            axes.plot(wave.times, wave.measured, color="0.6", linewidth=0.6, label="measured")
            axes.plot(wave.times, wave.computed, color="#1f5fa8", linewidth=1.2, label="computed")
            axes.set_title(wave.title, fontsize=9)
            axes.set(ylabel="force, N")
            axes.legend(fontsize=8)
        for axes in panels[-2:]:
            axes.set_xlabel("time, s")

    return draw
