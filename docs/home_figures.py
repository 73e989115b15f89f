"""Draw the pictures of the home page from an identification.

``naibu new -o gel && naibu identify gel -k gel=200 -o out && python docs/home_figures.py out docs/_static``
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from naibu.viewer.result_page.payload import Scene
from naibu.viewer.result_page.reading import report_from_json

SIZE, FRAMES = (4.0, 3.6), 18
LEGEND = {"frameon": False, "fontsize": 13, "markerscale": 1.8, "handletextpad": 0.1, "borderpad": 0.1}


def axes_of(figure: plt.Figure, scene: Scene) -> plt.Axes:
    """Return empty axes in which the object fits in all states."""
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d")
    axes.set_axis_off()
    axes.view_init(elev=16, azim=-62)
    reach = 0.62 * np.ptp(scene.reference_surface[:, 0])
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(0.0, 1.75 * reach))
    axes.set_box_aspect((2.0, 2.0, 1.75), zoom=1.22)
    return axes


def body(axes: plt.Axes, surface: np.ndarray, faces: np.ndarray) -> None:
    """Draw the skin of the object."""
    axes.add_collection3d(Poly3DCollection(surface[faces], facecolor="#9db2c6", edgecolor="none", alpha=0.10))


def goes_in(scene: Scene, file: Path) -> None:
    """Draw the measured markers, unloaded and pressed."""
    figure = plt.figure(figsize=SIZE)
    axes = axes_of(figure, scene)
    body(axes, scene.reference_surface, scene.faces)
    axes.scatter(*scene.initial_markers.T, s=10, c="0.65", depthshade=False, label="unloaded")
    axes.scatter(*scene.measured.T, s=12, c="#0072B2", depthshade=False, label="under load")
    axes.legend(loc="upper left", **LEGEND)
    figure.savefig(file, dpi=110)


def comes_out(scene: Scene, file: Path) -> None:
    """Draw measured and predicted markers, with residuals enlarged."""
    figure = plt.figure(figsize=SIZE)
    axes, last = axes_of(figure, scene), scene.steps[-1]
    body(axes, last.surface, scene.faces)
    axes.scatter(*scene.measured.T, s=16, facecolors="none", edgecolors="#0072B2", depthshade=False, label="measured")
    axes.scatter(*last.markers.T, s=9, c="#D55E00", marker="x", linewidths=0.9, depthshade=False, label="model")
    rms = np.sqrt(np.nanmean(((last.markers - scene.measured) ** 2).sum(axis=1)))
    axes.legend(loc="upper left", **LEGEND, title=f"{rms:.2f} mm RMS", title_fontsize=13)
    figure.savefig(file, dpi=110)


def moves(scene: Scene, file: Path) -> None:
    """Draw the model on its way to the full load and back."""
    loads = np.array([step.load_mm for step in scene.steps])
    figure = plt.figure(figsize=SIZE)

    def frame(k: int) -> None:
        figure.clear()
        axes = axes_of(figure, scene)
        load = 0.5 * (1.0 - np.cos(2.0 * np.pi * k / FRAMES)) * loads[-1]
        at = int(np.clip(np.searchsorted(loads, load) - 1, 0, len(loads) - 2))
        share = (load - loads[at]) / (loads[at + 1] - loads[at])
        a, b = scene.steps[at], scene.steps[at + 1]
        markers = (1.0 - share) * a.markers + share * b.markers
        body(axes, (1.0 - share) * a.surface + share * b.surface, scene.faces)
        moved = np.linalg.norm(markers - scene.steps[0].markers, axis=1)
        axes.scatter(*markers.T, c=moved, s=14, cmap="viridis", vmin=0.0, vmax=loads[-1], depthshade=False)
        axes.text2D(0.03, 0.93, f"pressed by {load:.0f} mm", transform=axes.transAxes, fontsize=14)

    FuncAnimation(figure, frame, frames=FRAMES).save(file, writer=PillowWriter(fps=12), dpi=75)


def main() -> None:
    """Read the report's data and write the pictures."""
    scene = report_from_json((Path(sys.argv[1]) / "report.json").read_text(encoding="utf-8")).scenes[0]
    folder = Path(sys.argv[2])
    goes_in(scene, folder / "home_markers.png")
    comes_out(scene, folder / "home_model.png")
    moves(scene, folder / "home_motion.gif")


if __name__ == "__main__":
    main()
