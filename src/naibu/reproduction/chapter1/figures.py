"""The figures of chapter 1 and of section 3.5, each a function that draws on a canvas."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from naibu.core.arrays import AnyArray, BoolArray, FloatArray
from naibu.core.volume import Volume
from naibu.imaging.displacement.accuracy import inverse_displacement
from naibu.imaging.preprocessing.resampling import warped
from naibu.reproduction.chapter1.calf_phantom import CalfCase
from naibu.reproduction.chapter1.matching import RIGHT_MM, CheckPoints, Matched

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas
    from matplotlib.image import AxesImage
    from matplotlib.quiver import Quiver

Draw = Callable[["Canvas"], None]
GREY: dict[str, Any] = {"cmap": "gray", "vmin": 0.0, "vmax": 255.0, "interpolation": "nearest"}
WORST_MM = 4.0
MARGIN_MM, ARROWS_APART_MM = 6.0, 5.0


class Found(Protocol):
    """A measured displacement, by method."""

    @property
    def name(self) -> str:
        """Of the method."""
        ...

    @property
    def vectors(self) -> FloatArray:
        """Displacement (nz, ny, nx, 3), mm."""
        ...

    @property
    def errors_mm(self) -> FloatArray:
        """Distance from the truth (nz, ny, nx), mm."""
        ...


def the_case(case: CalfCase, at: int) -> Draw:
    """Draw a slice of the reference and the deformed volume, and the displacement of its tissue."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots(1, 3, sharey=True)
        for axis, volume, title in zip(axes, (case.reference, case.deformed), ("before", "after"), strict=False):
            axis.imshow(volume.values[at], extent=_extent(volume), **GREY)
            axis.set(title=title)
        length = np.where(case.leg, np.linalg.norm(case.truth, axis=-1), np.nan)[at]
        shown = axes[2].imshow(length, extent=_extent(case.reference), cmap="viridis", vmin=0.0, interpolation="nearest")
        axes[2].set(title="true displacement")
        canvas.colorbar(shown, ax=axes[2], label="mm", shrink=0.8)
        for axis in axes:
            _about(axis, case, case.leg | case.tissue_after)

    return draw


def match_panels(case: CalfCase, chosen: Sequence[Matched]) -> Draw:
    """Draw the matches of strengths on the deformed image, from reference points to their matches."""

    def draw(canvas: Canvas) -> None:
        for axis, way in zip(np.atleast_1d(canvas.subplots(1, len(chosen), sharey=True)), chosen, strict=True):
            axis.imshow(case.deformed.values[0], extent=_extent(case.deformed), alpha=0.75, **GREY)
            right = way.errors_mm < RIGHT_MM
            for some, colour, label in ((right, "#56b4e9", "right"), (~right, "#e69f00", "wrong")):
                a, b = way.matches.reference_mm[some], way.matches.deformed_mm[some]
                axis.plot(*np.stack([a[:, :2], b[:, :2], np.full((len(a), 2), np.nan)], axis=1).reshape(-1, 2).T, color=colour, lw=1.3)
                axis.plot(*b[:, :2].T, "o", ms=2.5, color=colour, label=f"{label}: {some.sum()}")
            axis.set(title=way.name)
            axis.legend(loc="lower right", fontsize=8, facecolor="0.1", labelcolor="white", framealpha=0.7)
            _about(axis, case, case.leg | case.tissue_after)

    return draw


def energies(groups: Mapping[str, Sequence[Matched]]) -> Draw:
    """Draw the energy (1.5) and the size of the match set against iterations."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots(2, len(groups), squeeze=False, sharex=True)
        for (title, ways), (upper, lower) in zip(groups.items(), axes.T, strict=True):
            for way, line in zip(ways, ("-", "--", "-.", ":"), strict=False):
                number = np.arange(1, len(way.matches.energies) + 1)
                marker = "o" if len(number) < 10 else ""
                upper.plot(number, way.matches.energies, line, lw=1.4, marker=marker, ms=3, label=way.name)
                lower.plot(number, way.matches.counts, line, lw=1.4, marker=marker, ms=3)
            upper.set(title=title, yscale="log", ylabel="energy (1.5)")
            lower.set(xlabel="iteration", ylabel="matches")
            lower.yaxis.get_major_locator().set_params(integer=True)
        axes[0, 0].legend(frameon=False)

    return draw


def net_panels(case: CalfCase, chosen: Sequence[Matched]) -> Draw:
    """Draw the Delaunay net, the field inside it and its error, one strength a row."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots(len(chosen), 3, squeeze=False, sharex=True, sharey=True)
        extent = _extent(case.reference)
        largest = float(np.linalg.norm(case.truth[case.leg], axis=-1).max())
        for row, way in zip(axes, chosen, strict=True):
            inside = way.dense.valid[0] & case.leg[0]
            row[0].imshow(case.reference.values[0], extent=extent, alpha=0.7, **GREY)
            row[0].triplot(*way.net.points_mm[:, :2].T, way.net.simplices, lw=0.7, color="#56b4e9")
            row[0].set(title=f"{way.name}: {len(way.net.simplices)} triangles")
            length = np.linalg.norm(way.dense.vectors[0], axis=-1)
            error = np.linalg.norm(way.dense.vectors[0] - case.truth[0], axis=-1)
            for axis, values, title, colours, high in (
                (row[1], length, "displacement", "viridis", largest),
                (row[2], error, "error", "magma", WORST_MM),
            ):
                shown = axis.imshow(
                    np.where(inside, values, np.nan), extent=extent, cmap=colours, vmin=0.0, vmax=high, interpolation="nearest"
                )
                axis.set(title=title)
                canvas.colorbar(shown, ax=axis, label="mm", shrink=0.8, extend="max")
            for axis in row:
                _about(axis, case, case.leg)

    return draw


def check_panels(case: CalfCase, points: CheckPoints, back: Mapping[str, FloatArray]) -> Draw:
    """Draw check points and their positions moved back by the fields."""

    def draw(canvas: Canvas) -> None:
        for axis, (name, ends) in zip(np.atleast_1d(canvas.subplots(1, len(back), sharey=True)), back.items(), strict=True):
            axis.imshow(case.reference.values[0], extent=_extent(case.reference), alpha=0.75, **GREY)
            axis.plot(*points.reference_mm[:, :2].T, "+", ms=11, mew=1.6, color="#f0e442", label="where it was")
            axis.plot(*ends[:, :2].T, "x", ms=8, mew=1.6, color="#009e73", label="moved back")
            for number, point in enumerate(points.reference_mm):
                axis.annotate(str(number), point[:2], (6, 5), textcoords="offset points", color="white", fontsize=8)
            axis.set(title=name)
            _about(axis, case, case.leg)
        canvas.axes[0].legend(loc="lower right", fontsize=8, facecolor="0.1", labelcolor="white", framealpha=0.7)

    return draw


def node_displacements(chosen: Sequence[Matched]) -> Draw:
    """Draw the displacement of the nodes of the net in space."""

    def draw(canvas: Canvas) -> None:
        import matplotlib as mpl

        largest = 15.0
        for number, way in enumerate(chosen):
            axis: Any = canvas.add_subplot(1, len(chosen), number + 1, projection="3d")
            p, u = way.matches.reference_mm, way.matches.deformed_mm - way.matches.reference_mm
            colours = mpl.colormaps["viridis"](np.clip(np.linalg.norm(u, axis=1) / largest, 0.0, 1.0))
            # every arrow has a shaft and two strokes of its head
            axis.quiver(*p.T, *u.T, colors=np.concatenate([colours, np.repeat(colours, 2, axis=0)]), lw=0.8, arrow_length_ratio=0.25)
            axis.set(title=f"{way.name}: {len(way.net.simplices)} tetrahedra", xlabel="x, mm", ylabel="y, mm", zlabel="z, mm")
            axis.invert_yaxis()
            axis.set_box_aspect(np.ptp(p, axis=0) / np.ptp(p, axis=0).max())
            axis.view_init(elev=38.0, azim=-62.0)
            axis.zaxis.get_major_locator().set_params(nbins=3)
        scale = mpl.cm.ScalarMappable(mpl.colors.Normalize(0.0, largest), "viridis")
        canvas.colorbar(scale, ax=canvas.axes, label="displacement, mm", shrink=0.6, extend="max")

    return draw


def cuts(case: CalfCase, fields: Mapping[str, tuple[FloatArray, BoolArray]], at: int) -> Draw:
    """Draw the length of fields, where they were measured, and their errors, in a slice and in a cut along the leg; the truth first."""

    def draw(canvas: Canvas) -> None:
        largest = float(np.linalg.norm(case.truth[case.leg], axis=-1).max())
        axes = canvas.subplots(4, 1 + len(fields), squeeze=False, height_ratios=(1.0, 0.55, 1.0, 0.55))
        length, error = ({"cmap": c, "vmin": 0.0, "vmax": v} for c, v in (("viridis", largest), ("magma", WORST_MM)))
        true = np.where(case.leg, np.linalg.norm(case.truth, axis=-1), np.nan)
        images = [_slice_and_cut(axes[:2, 0], case, true, at, length, "truth: displacement")] * 2
        for axis in axes[2:, 0]:
            axis.set_axis_off()
        for column, (name, (vectors, measured)) in zip(axes.T[1:], fields.items(), strict=True):
            inside = measured & case.leg
            values = np.where(inside, np.linalg.norm(vectors, axis=-1), np.nan)
            wrong = np.where(inside, np.linalg.norm(vectors - case.truth, axis=-1), np.nan)
            images[0] = _slice_and_cut(column[:2], case, values, at, length, f"{name}: displacement")
            images[1] = _slice_and_cut(column[2:], case, wrong, at, error, f"{name}: error")
        canvas.colorbar(images[0], ax=list(axes[:2].ravel()), label="displacement, mm", shrink=0.7)
        canvas.colorbar(images[1], ax=list(axes[2:].ravel()), label="error, mm", shrink=0.7, extend="max")

    return draw


def _slice_and_cut(axes: AnyArray, case: CalfCase, values: FloatArray, at: int, how: dict[str, Any], title: str) -> AxesImage:
    """Show a slice and, below it, a cut along the leg at x = 0 of values (nz, ny, nx)."""
    grid, (nz, ny, nx) = case.reference, case.reference.shape
    shown: AxesImage = axes[0].imshow(values[at], extent=_extent(grid), interpolation="nearest", **how)
    _about(axes[0], case, case.leg)
    axes[0].set(title=title, xlabel="x, mm", ylabel="y, mm")
    low, high = grid.to_physical((-0.5, -0.5, -0.5)), grid.to_physical((nx - 0.5, ny - 0.5, nz - 0.5))
    column = round(float(grid.to_index((0.0, 0.0, 0.0))[0]))
    extent = (low[2], high[2], high[1], low[1])
    axes[1].imshow(values[:, :, column].T, extent=extent, aspect="auto", interpolation="nearest", **how)
    (_, (top, bottom)) = _window(case, case.leg)
    axes[1].set(xlabel="z, mm", ylabel="y, mm", ylim=(bottom, top))
    return shown


def resampled_slices(case: CalfCase, fields: Mapping[str, FloatArray], which: Sequence[int]) -> Draw:
    """Draw deformed slices, the reference volume warped by the fields, and the differences."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots(1 + 2 * len(fields), len(which), squeeze=False, sharex=True, sharey=True)
        extent = _extent(case.reference)
        shown: Any = None
        for axis, k in zip(axes[0], which, strict=True):
            axis.imshow(case.deformed.values[k], extent=extent, **GREY)
            axis.set(title=f"slice {k}: deformed")
        for number, (name, vectors) in enumerate(fields.items()):
            computed = warped(case.reference, inverse_displacement(vectors, case.reference), case.reference)
            for column, k in enumerate(which):
                upper, lower = axes[1 + 2 * number, column], axes[2 + 2 * number, column]
                upper.imshow(computed[k], extent=extent, **GREY)
                upper.set(title=f"computed: {name}")
                difference = np.where(case.tissue_after[k], computed[k] - case.deformed.values[k], np.nan)
                shown = lower.imshow(difference, extent=extent, cmap="RdBu_r", vmin=-120.0, vmax=120.0, interpolation="nearest")
                lower.set(title="computed less measured")
        for axis in axes.ravel():
            _about(axis, case, case.tissue_after)
        canvas.colorbar(shown, ax=list(axes.ravel()), label="intensity levels", shrink=0.35, extend="both")

    return draw


def flow_panels(case: CalfCase, chosen: Sequence[Found], at: int) -> Draw:
    """Draw displacements of a slice as arrows on its image, three methods a row, and their errors below."""

    def draw(canvas: Canvas) -> None:
        rows = -(-len(chosen) // 3)
        axes = canvas.subplots(2 * rows, 3, squeeze=False, sharex=True, sharey=True)
        pairs = [(axes[2 * row, column], axes[2 * row + 1, column]) for row in range(rows) for column in range(3)]
        arrows: Any = None
        shown: Any = None
        for (upper, lower), found in zip(pairs, chosen, strict=False):
            arrows, shown = _arrows(upper, case, found, at), _errors(lower, case, found, at)
            for axis in (upper, lower):
                _about(axis, case, case.leg)
        for pair in pairs[len(chosen) :]:
            for axis in pair:
                axis.set_axis_off()
        canvas.colorbar(arrows, ax=list(axes[:rows].ravel()), label="displacement, mm", shrink=0.5, extend="max")
        canvas.colorbar(shown, ax=list(axes[rows:].ravel()), label="error, mm", shrink=0.5, extend="max")

    return draw


def _arrows(axis: Axes, case: CalfCase, found: Found, at: int) -> Quiver:
    grid, u = case.reference, found.vectors[at]
    some = np.zeros(u.shape[:2], dtype=bool)
    every = max(round(ARROWS_APART_MM / grid.spacing_mm[0]), 1)
    some[::every, ::every] = True
    y, x = np.nonzero(some & np.isfinite(u).all(axis=-1) & case.leg[at])
    p = grid.to_physical(np.column_stack([x, y, np.full(len(x), at)]))
    largest = float(np.linalg.norm(case.truth[case.leg], axis=-1).max())
    axis.imshow(grid.values[at], extent=_extent(grid), alpha=0.5, **GREY)
    axis.set_title(found.name)
    return axis.quiver(
        *p[:, :2].T, *u[y, x, :2].T, np.linalg.norm(u[y, x], axis=1), cmap="viridis", clim=(0.0, largest),
        angles="xy", scale_units="xy", scale=1.0, width=0.006, headwidth=2.8, headlength=3.2,
    )  # fmt: skip


def _errors(axis: Axes, case: CalfCase, found: Found, at: int) -> AxesImage:
    extent = _extent(case.reference)
    axis.imshow(np.where(case.leg[at], 0.7, np.nan), extent=extent, cmap="gray", vmin=0.0, vmax=1.0)  # where nothing was measured
    error = np.where(case.leg[at], found.errors_mm[at], np.nan)
    return axis.imshow(error, extent=extent, cmap="magma", vmin=0.0, vmax=WORST_MM, interpolation="nearest")


def _extent(grid: Volume) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top of a slice, mm; y grows downwards."""
    _, ny, nx = grid.shape
    low, high = grid.to_physical((-0.5, -0.5, 0.0)), grid.to_physical((nx - 0.5, ny - 0.5, 0.0))
    return float(low[0]), float(high[0]), float(high[1]), float(low[1])


def _window(case: CalfCase, tissue: BoolArray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the limits along x and y of tissue (nz, ny, nx) with a margin, mm."""
    where = np.argwhere(tissue.any(axis=0))[:, ::-1]
    low, high = (case.reference.to_physical([*corner, 0.0])[:2] for corner in (where.min(axis=0), where.max(axis=0)))
    return (low[0] - MARGIN_MM, high[0] + MARGIN_MM), (low[1] - MARGIN_MM, high[1] + MARGIN_MM)


def _about(axis: Axes, case: CalfCase, tissue: BoolArray) -> None:
    """Show the tissue with a margin, and label the axes of a slice."""
    (x0, x1), (y0, y1) = _window(case, tissue)
    axis.set(xlim=(x0, x1), ylim=(y1, y0), aspect="equal")
    where = axis.get_subplotspec()
    if where is None or where.is_last_row() or not axis.get_shared_x_axes().get_siblings(axis)[1:]:
        axis.set_xlabel("x, mm")
    if where is None or where.is_first_col():
        axis.set_ylabel("y, mm")
