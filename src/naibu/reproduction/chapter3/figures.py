"""Figures of chapter 3: meshes, moduli of single tetrahedra and their distribution, deformed cubes, and the marker mesh."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.reproduction.chapter3.cell_identification import CellResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

Ranges = Mapping[str, tuple[tuple[float, float], tuple[float, float]]]


def meshes(canvas: Canvas, shown: Mapping[str, Mesh]) -> None:
    """Draw the edges of three faces of cubes, in oblique projection."""
    for axes, (name, mesh) in zip(np.atleast_1d(canvas.subplots(1, len(shown))), shown.items(), strict=True):
        for axis, end, shade in ((1, 0.0, "0.95"), (2, mesh.points[:, 2].max(), "1"), (0, mesh.points[:, 0].max(), "0.88")):
            for a, b, c in face_triangles(mesh, axis, float(end)):
                axes.fill(*_oblique(mesh.points[[a, b, c]]).T, facecolor=shade, edgecolor="k", linewidth=0.7)
        axes.set(title=name, aspect="equal")
        axes.axis("off")


def face_triangles(mesh: Mesh, axis: int, coordinate: float) -> IntArray:
    """Return the faces (k, 3) of tetrahedra in the plane where coordinate `axis` has a value, mm."""
    faces = mesh.cells[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3)
    return np.asarray(faces[(np.abs(mesh.points[faces, axis] - coordinate) < 1e-9).all(axis=1)])


def _oblique(points: FloatArray) -> FloatArray:
    return np.column_stack([points[:, 0] + 0.4 * points[:, 1], points[:, 2] + 0.4 * points[:, 1]])


def by_cell(canvas: Canvas, result: CellResult, layer: str) -> None:
    """Draw the moduli of the tetrahedra of a layer, and the true ones."""
    panels = canvas.subplots(2, 1, sharex=True)
    at, (e, nu) = result.layer(layer), result.body.truth[layer]
    values = (1e3 * result.estimate.young_modulus[at], result.estimate.poisson_ratio[at])
    for axes, found, true, label in zip(panels, values, (1e3 * e, nu), ("Young's modulus (Pa)", "Poisson's ratio"), strict=True):
        axes.plot(np.arange(1, len(found) + 1), found, ".", markersize=4, label="identified")
        axes.axhline(true, color="k", linewidth=0.8, label="true")
        axes.set(ylabel=label)
    panels[0].legend()
    panels[1].set_xlabel("tetrahedron")


def histograms(canvas: Canvas, result: CellResult, layer: str, printed: Ranges) -> None:
    """Draw the distribution of the moduli of a layer, the true values and the printed ranges."""
    panels = canvas.subplots(1, 2, sharey=True)
    at, (e, nu) = result.layer(layer), result.body.truth[layer]
    values = (1e3 * result.estimate.young_modulus[at], result.estimate.poisson_ratio[at])
    labels, widths = ("Young's modulus (Pa)", "Poisson's ratio"), (10.0, 0.01)
    for axes, found, true, label, width, span in zip(panels, values, (1e3 * e, nu), labels, widths, printed[layer], strict=True):
        low, high = np.floor(min(found.min(), span[0]) / width), np.ceil(max(found.max(), span[1]) / width)
        axes.axvspan(*span, color="0.9", label="range printed")
        axes.hist(found, bins=width * np.arange(low, high + 1.5), label="ours")
        axes.axvline(true, color="k", linewidth=0.8, label="true")
        axes.set(xlabel=label)
    panels[0].set_ylabel("tetrahedra")
    panels[0].legend()


def deformed(canvas: Canvas, result: CellResult) -> None:
    """Draw the front of the deformed cube with the true and with the identified moduli."""
    axes = canvas.add_subplot()
    mesh = result.body.mesh
    triangles = face_triangles(mesh, 1, 0.0)
    for displacement, style, label in ((result.displacement, "k-", "true moduli"), (result.again, "C1--", "identified moduli")):
        _outline(axes, (mesh.points + displacement)[:, [0, 2]], triangles, style, label)
    axes.set(xlabel="x (mm)", ylabel="z (mm)", aspect="equal")
    axes.legend()


def _outline(axes: Axes, points: FloatArray, triangles: IntArray, style: str, label: str) -> None:
    """Draw the edges of triangles, each once."""
    edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    lines = np.full((3 * len(edges), 2), np.nan)
    lines[0::3], lines[1::3] = points[edges[:, 0]], points[edges[:, 1]]
    axes.plot(*lines.T, style, linewidth=0.9, label=label)


def marker_mesh_views(canvas: Canvas, points: FloatArray, moved: FloatArray, interpolated: BoolArray) -> None:
    """Draw a marker grid (planes, rows, columns, 3), mm, from above and from the side, before and after loading, with interface nodes."""
    panels = canvas.subplots(1, 2)
    middle = points.shape[1] // 2
    for position, style, label in ((points, "0.6", "unloaded"), (moved, "C0", "loaded")):
        panels[0].plot(*_mesh_lines(position[0][..., :2]).T, color=style, linewidth=0.9, label=label)
        panels[1].plot(*_mesh_lines(position[:, middle][..., [0, 2]]).T, color=style, linewidth=0.9, label=label)
        on = position[interpolated][:, middle]
        panels[1].plot(on[..., 0].ravel(), on[..., 2].ravel(), "o", color=style, markersize=4)
    panels[0].set(title="lowest layer", xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
    panels[1].set(title="middle row; dots: nodes on the interface", xlabel="x (mm)", ylabel="z (mm)", aspect="equal")
    panels[0].legend()


def _mesh_lines(grid: FloatArray) -> FloatArray:
    """Return lines (k, 2) along rows and columns of a grid (rows, columns, 2), separated by NaN."""
    parts = []
    for lines in (grid, np.swapaxes(grid, 0, 1)):
        broken = np.full((lines.shape[0], lines.shape[1] + 1, 2), np.nan)
        broken[:, :-1] = lines
        parts.append(broken.reshape(-1, 2))
    return np.concatenate(parts)


def efficiencies(canvas: Canvas, cases: Mapping[str, tuple[float, float]]) -> None:
    """Draw root mean square errors over the Cramér-Rao bound, of least squares and of the weighted equilibrium gap."""
    axes = canvas.add_subplot()
    position = np.arange(len(cases))
    for shift, name, index in ((-0.2, "least squares (report)", 0), (0.2, "weighted by the noise", 1)):
        axes.bar(position + shift, [values[index] for values in cases.values()], width=0.38, label=name)
    axes.axhline(1.0, color="k", linewidth=0.8, label="Cramer-Rao bound")
    axes.set_xticks(position, list(cases))
    axes.set(ylabel="root mean square error / bound", yscale="log")
    axes.legend()
