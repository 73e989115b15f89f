"""Draw the picture of the README: ``naibu demo``, then ``python docs/readme_figure.py naibu-demo docs/_static/readme.png``."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from naibu.viewer.result_page.payload import Scene
from naibu.viewer.result_page.reading import report_from_json

TITLES = {
    "ct_two_material_1": "bar on hard over soft",
    "ct_two_material_2": "plate on hard over soft",
    "ct_two_material_3": "plate on hard, soft, hard",
}


def draw(axes: plt.Axes, scene: Scene) -> None:
    """Draw the markers of one state seen from the front, with the model's outline."""
    last = scene.steps[-1]
    front = scene.reference_surface[:, 1] < scene.reference_surface[:, 1].min() + 1e-6
    for face in scene.faces[front[scene.faces].all(axis=1)]:
        axes.fill(*last.surface[face][:, [0, 2]].T, color="0.93", lw=0, zorder=0)
    axes.plot(scene.initial_markers[:, 0], scene.initial_markers[:, 2], ".", color="0.7", ms=3, label="unloaded")
    axes.plot(scene.measured[:, 0], scene.measured[:, 2], "o", mfc="none", mec="#0072B2", ms=6, label="measured under load")
    axes.plot(last.markers[:, 0], last.markers[:, 2], "x", color="#D55E00", ms=4, label="model")
    residual = scene.residual_mm
    whole = np.isfinite(residual).all(axis=1)
    rms = np.sqrt((residual[whole] ** 2).sum(axis=1).mean())
    axes.set_title(f"{TITLES.get(scene.experiment, scene.experiment)}: {rms:.2f} mm", fontsize=10)
    axes.set_aspect("equal")
    axes.set_xlim(-42, 42)
    axes.set_ylim(-2, 56)
    axes.set_xlabel("x, mm")


def main() -> None:
    """Read the report's data and write the picture."""
    scenes = report_from_json((Path(sys.argv[1]) / "report.json").read_text(encoding="utf-8")).scenes
    figure, axes = plt.subplots(1, len(scenes), figsize=(3.5 * len(scenes), 3.3), layout="constrained")
    for ax, scene in zip(np.atleast_1d(axes), scenes, strict=True):
        draw(ax, scene)
    np.atleast_1d(axes)[0].set_ylabel("z, mm")
    figure.legend(*np.atleast_1d(axes)[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(sys.argv[2], dpi=130)


if __name__ == "__main__":
    main()
