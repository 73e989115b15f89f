"""Two clouds of particles, from files to files: links, displacement field with its covariance, strain, and a page."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from naibu._version import __version__
from naibu.core.arrays import FloatArray, require_lengths
from naibu.core.errors import InputError
from naibu.core.progress import Progress, report_progress
from naibu.core.volume import Volume
from naibu.imaging.markers.linking.local_kriging import KRIGED
from naibu.imaging.markers.linking.particle_motion import ParticleMotion, particle_motion
from naibu.io.displacement_fields import write_field
from naibu.io.files.atomic import write_atomically
from naibu.io.files.provenance import input_record
from naibu.io.images import write_volume
from naibu.io.tables.point_clouds import POINT_FILES, PointCloud, read_point_cloud
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.chapters.chapter_page import write_chapter
from naibu.viewer.notebook import ShownInNotebook, WrittenResult, empty_figure
from naibu.viewer.result_figures import draw_marker_motion
from naibu.viewer.tables import Cell, Table
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

FILES = ("field.h5", "links.csv", "mask.mha", "tracking.html", "tracking.json")
ARROWS, DOTS = 1500, 6000  # that a figure shows at most
DPI = 180  # of arrows and dots, which are too many for vector graphics
MASK_VOXELS = 2_000_000  # of the mask at most
REACH = 1.2  # mean distances from a particle within which there is material


@dataclass(frozen=True, slots=True, eq=False)
class CloudRun(WrittenResult, ShownInNotebook):
    """Motion of the particles, figures and files.

    Attributes
    ----------
    motion : ParticleMotion
        Field, links and gradients.
    rows : tuple of tuple
        What was found: quantity, value.
    page : Path
        ``tracking.html``.
    files : tuple of Path
        The page first.
    """

    motion: ParticleMotion
    rows: tuple[tuple[str, Cell], ...]
    page: Path
    files: tuple[Path, ...]

    def plot(self) -> Canvas:
        """Return a figure of the displacement of the particles, those whose link is not trusted marked as suspect."""
        field = self.motion.field
        flags = np.where(field.valid, "ok", "suspect").tolist()
        canvas = empty_figure(10.5 if field.points.shape[1] == 3 else 5.0, 4.2)
        draw_marker_motion(canvas, field.points, field.points + field.vectors, flags)
        return canvas

    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return one row a link: rows in the files, positions, displacement, its deviation, confidence, and strain, as in ``links.csv``."""
        return self._rows_of("links.csv")


def is_point_file(path: str | os.PathLike[str]) -> bool:
    """Return whether the name of a file is that of a cloud of points."""
    return Path(path).suffix.lower() in POINT_FILES


@no_empty_folders()
def track_clouds(
    reference: str | os.PathLike[str],
    deformed: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    unit: str | None = None,
    spacing_mm: Sequence[float] | None = None,
    variable: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> CloudRun:
    """Link the particles of two states, and write their displacement field, links, strain, and a page.

    Parameters
    ----------
    reference, deformed : path-like
        Positions of particles before and after the deformation, in any order (see `naibu.io.read_point_cloud`); labels are not used.
    out : path-like
        Folder for ``field.h5``, which `naibu.workflows.identify_fields` takes, ``links.csv``, ``mask.mha`` (1 within the cloud; of three
        dimensions), ``tracking.html`` and ``tracking.json``.
    unit : str, optional
        Unit of the coordinates: mm, cm, m, um or inch. By default that in the names of columns, else mm.
    spacing_mm : sequence of float, optional
        Size of a voxel along x, y, z, mm, where coordinates are in voxels.
    variable : str, optional
        Which array of an ``.npz`` or ``.mat`` file.
    overwrite : bool
        Whether these files may be there already.
    progress : callable, optional
        Called with a `naibu.core.progress.ProgressReport` at every stage.

    Returns
    -------
    CloudRun
        Motion, figures and files.

    Raises
    ------
    InputError
        Files that cannot be read; clouds of other dimensions, units or bodies, or mirror images of each other; a folder that holds results.
    """
    require_lengths(spacing_mm=spacing_mm)
    folder = output_folder(out, FILES, overwrite=overwrite)
    report_progress(progress, "reading")
    clouds = [read_point_cloud(path, unit=unit, spacing_mm=spacing_mm, variable=variable) for path in (reference, deformed)]
    names = [Path(path).name for path in (reference, deformed)]
    report_progress(progress, "linking particles")
    first, second = clouds
    try:
        _require_two_states(first, second)
        motion = particle_motion(first.points, second.points, reference_sd_mm=first.sd, deformed_sd_mm=second.sd)
    except InputError as error:
        raise InputError(f"{names[1]} against {names[0]}: {error}") from error
    report_progress(progress, "writing")
    inputs = input_record({"reference": reference, "deformed": deformed})
    rows = _rows(clouds, motion)
    files = [
        write_field(folder / "field.h5", motion.field, provenance={"naibu": __version__, "method": "particle tracking", "inputs": inputs}),
        write_atomically(folder / "links.csv", _links_table(clouds, motion)),
    ]
    if first.points.shape[1] == 3:
        files.append(write_volume(folder / "mask.mha", _mask(first.points)))
    settings: dict[str, Cell] = {**inputs, "unit": unit or "", "spacing_mm": "" if spacing_mm is None else ", ".join(map(str, spacing_mm))}
    page, numbers = write_chapter(
        Chapter("tracking", "Particles linked between two states", (_section(names, rows, motion),), settings), folder
    )
    return CloudRun(motion, rows, page, (page, *files, numbers))


def _require_two_states(first: PointCloud, second: PointCloud) -> None:
    """Refuse a plane cloud beside one in space, and one cloud given twice."""
    axes = [", ".join("xyz"[: c.points.shape[1]]) for c in (first, second)]
    if axes[0] != axes[1]:
        raise InputError(f"both must be of the same dimension, and one has {axes[1]}, the other {axes[0]}; give the same columns in both")
    if np.array_equal(first.points, second.points):
        raise InputError("both hold the same positions, so that nothing moved; is one file given twice?")


def _rows(clouds: Sequence[PointCloud], motion: ParticleMotion) -> tuple[tuple[str, Cell], ...]:
    """Return what was found, in words."""
    field, trusted = motion.field, motion.field.valid
    size, sd = np.linalg.norm(field.vectors[trusted], axis=1), field.standard_deviation
    assert sd is not None
    confidence = motion.links.confidence
    copies = [(f"copies of a point left out, {state}", c.copies) for state, c in zip(("reference", "deformed"), clouds, strict=True)]
    rows: list[tuple[str, Cell]] = [
        ("particles, reference", len(clouds[0])),
        ("particles, deformed", len(clouds[1])),
        ("extent of the reference, mm", " x ".join(f"{length:.4g}" for length in np.ptp(clouds[0].points, axis=0))),
        *(row for row in copies if row[1]),
        ("linked", len(motion.links)),
        ("of these trusted", int(trusted.sum())),
        ("expected wrong links, at most", round(float(np.sum(1.0 - confidence[trusted])), 1)),
        ("displacement, median, mm", f"{np.median(size):.4g}"),
        ("displacement, largest, mm", f"{size.max():.4g}"),
        *((f"stated SD along {a}, median, mm", f"{v:.3g}") for a, v in zip("xyz", np.median(sd[trusted], axis=0), strict=False)),
    ]
    strain = motion.strain[trusted]
    for k, axis in enumerate("xyz"[: field.points.shape[1]]):
        along = strain[:, k, k]
        if np.isfinite(along).any():
            low, middle, high = np.nanpercentile(along, (5.0, 50.0, 95.0))
            rows.append((f"strain E_{axis}{axis}: 5th percentile, median, 95th", f"{low:.4f}, {middle:.4f}, {high:.4f}"))
    doubt = motion.gradient_sd[trusted][np.isfinite(motion.gradient[trusted])]
    if len(doubt):
        rows.append(("SD of a displacement gradient, median", f"{np.median(doubt):.2g}"))
    return tuple(rows)


def _links_table(clouds: Sequence[PointCloud], motion: ParticleMotion) -> str:
    """Return a table of all links: rows in the files, positions, displacement, its deviation, confidence, and strain."""
    field, d = motion.field, motion.field.points.shape[1]
    pairs, sd = motion.links.pairs, field.standard_deviation
    assert sd is not None
    moved = clouds[1].points[pairs[:, 1]] - clouds[0].points[pairs[:, 0]]
    axes = "xyz"[:d]
    upper = [(a, b) for a in range(d) for b in range(a, d)]
    names = ["reference_row", "deformed_row", *(f"{a}_mm" for a in axes), *(f"u{a}_mm" for a in axes), *(f"sd_{a}_mm" for a in axes)]
    names += ["confidence", "trusted", "residual_mm", *(f"E_{axes[a]}{axes[b]}" for a, b in upper)]
    strain = np.column_stack([motion.strain[:, a, b] for a, b in upper])
    rows = [clouds[k].rows[pairs[:, k]] for k in range(2)]
    judged = [motion.links.confidence, field.valid, motion.links.residual_mm]
    stream = io.StringIO()
    formats = ["%d", "%d", *["%.9g"] * (2 * d), *["%.4g"] * d, "%.4f", "%d", "%.4g", *["%.6g"] * len(upper)]
    np.savetxt(stream, np.column_stack([*rows, field.points, moved, sd, *judged, strain]), fmt=formats, delimiter=",")
    return ",".join(names) + "\n" + stream.getvalue()


def _mask(points: FloatArray) -> Volume:
    """Return a volume that is 1 near the particles (n, 3) and in what they enclose."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    distance = float((np.maximum(extent, 1e-3 * extent.max()).prod() / len(points)) ** (1.0 / 3.0))
    step = max(0.5 * distance, float(((extent + 2.0 * distance).prod() / MASK_VOXELS) ** (1.0 / 3.0)))
    shape = np.ceil((extent + 2.0 * distance) / step).astype(int) + 1
    grid = Volume.from_array(np.zeros(tuple(shape[::-1]), np.uint8), spacing_mm=[step] * 3, origin_mm=low - distance)
    nearest = np.asarray(cKDTree(points).query(grid.positions().reshape(-1, 3), workers=-1)[0]).reshape(grid.shape)
    inside = ndimage.binary_erosion(ndimage.binary_fill_holes(nearest < REACH * distance), iterations=max(round(0.6 * distance / step), 1))
    return grid.with_values(inside.astype(np.uint8))


def _section(names: Sequence[str], rows: tuple[tuple[str, Cell], ...], motion: ParticleMotion) -> Section:
    words = (
        "Particles were linked by their arrangement and a motion that is continuous over a few particles. A link is trusted where its "
        "probability to be right, which errs on the low side, is at least one half; the others are not valid in the field.",
        "Standard deviations follow from how far each displacement is from what the particles around predict. The strain "
        f"(Green-Lagrange) is that of a motion through the {KRIGED[motion.field.points.shape[1]]} nearest linked particles, as rough as "
        "the motion is found to be there (kriging); its standard deviation includes what the motion varies between them.",
    )
    table = Table(f"{names[0]} to {names[1]}", ("quantity", "value"), rows)
    return Section("Particles", words, (table,), (_displacement(motion), _strain(motion), _quality(motion)))


def _chosen(motion: ParticleMotion, most: int) -> np.ndarray:
    trusted = np.flatnonzero(motion.field.valid)
    return np.asarray(trusted[np.unique(np.linspace(0, len(trusted) - 1, min(most, len(trusted))).astype(int))])


def _views(d: int) -> tuple[tuple[int, int], ...]:
    return ((0, 2), (1, 2), (0, 1)) if d == 3 else ((0, 1),)


def _displacement(motion: ParticleMotion) -> Figure:
    some = _chosen(motion, ARROWS)
    p, u = motion.field.points[some], motion.field.vectors[some]
    u = u - np.median(motion.field.vectors[motion.field.valid], axis=0)
    views = _views(p.shape[1])

    def draw(canvas: Canvas) -> None:
        canvas.set_dpi(DPI)
        size = np.linalg.norm(u, axis=1)
        for axis, (a, b) in zip(canvas.subplots(1, len(views), squeeze=False)[0], views, strict=True):
            arrows = axis.quiver(
                p[:, a], p[:, b], u[:, a], u[:, b], size, angles="xy", scale_units="xy", scale=1.0, width=0.003, cmap="viridis",
                rasterized=True,
            )  # fmt: skip
            arrows.set_in_layout(False)  # the layout need not go through all of them
            axis.set(xlabel=f"{'xyz'[a]}, mm", ylabel=f"{'xyz'[b]}, mm", aspect="equal")
        canvas.colorbar(arrows, ax=canvas.axes, label="displacement less its median, mm", shrink=0.7)

    caption = f"Displacement of {len(some)} trusted particles, less the median displacement, to scale."
    return Figure("Displacement", caption, draw, (11.0, 4.2) if len(views) == 3 else (6.0, 4.5))


def _strain(motion: ParticleMotion) -> Figure:
    points, d = motion.field.points, motion.field.points.shape[1]
    middle = np.ones(len(points), dtype=bool)
    if d == 3:
        low, high = np.percentile(points[:, 1], (40.0, 60.0))
        middle = (points[:, 1] >= low) & (points[:, 1] <= high)
    some = np.flatnonzero(motion.field.valid & middle & np.isfinite(motion.gradient).all(axis=(1, 2)))[:DOTS]
    strain = motion.strain[some]
    a, b = (0, 2) if d == 3 else (0, 1)

    def draw(canvas: Canvas) -> None:
        canvas.set_dpi(DPI)
        limit = float(np.percentile(np.abs(np.diagonal(strain, axis1=1, axis2=2)), 98.0)) if len(some) else 1.0
        for k, axis in enumerate(canvas.subplots(1, d, squeeze=False)[0]):
            dots = axis.scatter(points[some, a], points[some, b], c=strain[:, k, k], s=5.0, cmap="RdBu_r", vmin=-limit, vmax=limit)
            dots.set(rasterized=True, in_layout=False)
            axis.set(xlabel=f"{'xyz'[a]}, mm", ylabel=f"{'xyz'[b]}, mm", aspect="equal", title=f"$E_{{{'xyz'[k] * 2}}}$")
        canvas.colorbar(dots, ax=canvas.axes, label="strain", shrink=0.7, extend="both")

    where = " in the middle fifth along y" if d == 3 else ""
    return Figure("Strain", f"Green-Lagrange strain at the reference positions{where}.", draw, (11.0, 4.2) if d == 3 else (9.0, 4.2))


def _quality(motion: ParticleMotion) -> Figure:
    last = motion.field.points.shape[1] - 1
    at, sd, confidence = motion.field.points[:, last], motion.field.standard_deviation, motion.links.confidence
    assert sd is not None

    def draw(canvas: Canvas) -> None:
        left, right = canvas.subplots(1, 2)
        left.hist(confidence, bins=np.linspace(0.0, 1.0, 41), color="#2a788e")
        left.set(xlabel="probability that the link is right", ylabel="links", yscale="log", ylim=(0.5, None))
        edges = np.linspace(at.min(), at.max(), 13)
        bins = np.clip(np.digitize(at, edges) - 1, 0, 11)
        for k, colour in zip(range(last + 1), ("#440154", "#2a788e", "#d95f02"), strict=False):
            middles = [(0.5 * (edges[i] + edges[i + 1]), float(np.median(sd[bins == i, k]))) for i in range(12) if (bins == i).any()]
            right.plot(*zip(*middles, strict=True), "o-", ms=3, color=colour, label=f"along {'xyz'[k]}")
        right.set(xlabel=f"{'xyz'[last]}, mm", ylabel="SD of the displacement, mm", ylim=(0.0, 1.1 * right.dataLim.y1))
        right.legend(frameon=False)

    caption = "Confidence of the links, and standard deviation of the displacement from place to place (medians)."
    return Figure("Confidence and noise", caption, draw, (10.0, 3.6))
