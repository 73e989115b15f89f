"""Measure the displacement between two scans, from files to files: fields for other programs, numbers, and a page of slices."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from naibu._version import __version__
from naibu.core.arrays import BoolArray, FloatArray, IntArray, require_lengths
from naibu.core.errors import InputError
from naibu.core.markers import Markers
from naibu.core.mesh import Mesh
from naibu.core.progress import Progress
from naibu.core.volume import Volume
from naibu.imaging.displacement.accuracy import check_point_errors, end_point_error, intensity_rms
from naibu.imaging.displacement.strain import folded_fraction, green_lagrange_strain_of
from naibu.imaging.measure_displacement import FACTS, MeasuredDisplacement, Method, measure_displacement
from naibu.imaging.preprocessing.resampling import on_voxels_of
from naibu.imaging.preprocessing.volume_pair import on_reference_grid
from naibu.io.displacement_fields import write_field
from naibu.io.files.atomic import write_atomically
from naibu.io.files.provenance import input_record
from naibu.io.images import read_displacement, read_volume, write_displacement, write_volume
from naibu.io.tables.marker_tables import import_markers, write_markers
from naibu.io.vtk_files import write_vtu
from naibu.meshing.primitives import grid_cells
from naibu.viewer.notebook import ShownInNotebook, empty_figure
from naibu.viewer.result_figures import draw_slices
from naibu.viewer.slices import slices_html
from naibu.viewer.tables import Cell
from naibu.workflows.measurement.sense_page import middle_slice, slice_view
from naibu.workflows.results.files_together import written_together
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

# bounds of the size of files: hexahedra for ParaView, and points of the field for the identification
MESH_CELLS, FIELD_POINTS = 60_000, 40_000
MARKER_TABLES, MARKERS = ("initial", "pressed"), 250
FILES = (
    *("report.html", "displacement.mha", "standard_deviation.mha", "displacement.vtu", "field.h5", "mask.mha", "sense.json"),
    *(f"{table}.csv" for table in MARKER_TABLES),
)
LEAST_CERTAIN = 4.0  # median standard deviations; positions of a larger one make no markers; empirical
# what the figures of a run mean, with their units
FIGURES = {
    "measured_fraction": "measured fraction of the object",
    "median_displacement_mm": "median displacement, mm",
    "largest_displacement_mm": "largest displacement, mm",
    "initial_residual_rms": "intensity residual RMS without displacement",
    "residual_rms": "intensity residual RMS",
    "folded_fraction": "folded fraction",
    "median_sd_mm": "stated SD, median, mm",
    "median_strain_sd": "stated SD of a component of strain, median",
    "mean_error_mm": "mean error, mm",
    "median_error_mm": "median error, mm",
    "p95_error_mm": "95th percentile of the error, mm",
    "mean_check_point_error_mm": "mean error of the check points, mm",
    "p95_check_point_error_mm": "95th percentile of the error of the check points, mm",
}


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two volumes on one grid, the mask of the object in the reference, and true displacements where they are known.

    `notes` are sentences on what was done to bring them onto one grid.
    """

    reference: Volume
    deformed: Volume
    mask: BoolArray | None
    inputs: dict[str, str]
    names: tuple[str, str]
    truth: FloatArray | None = None
    check_points: tuple[FloatArray, FloatArray] | None = None
    deformed_mask: BoolArray | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class SenseRun(ShownInNotebook):
    """Measured displacement with its figures (see `FIGURES`), files, and the volumes that it belongs to."""

    measured: MeasuredDisplacement
    seconds: float
    figures: dict[str, float | int | str | None]
    pair: Pair
    files: tuple[Path, ...] = ()

    def rows(self) -> list[tuple[str, Cell]]:
        """Return figures and diagnostics of the method, each with its meaning and unit."""
        figures = [(FIGURES[name], value) for name, value in self.figures.items()]
        return figures + [(FACTS[name], value) for name, value in self.measured.facts.items()]

    def page_html(self) -> str:
        """Return the page of the result, a whole HTML document."""
        return slices_html(slice_view(self.pair, self))

    def plot(self) -> Canvas:
        """Return a figure of the slice with most of the object: displacement, largest principal strain, standard deviation."""
        canvas = empty_figure(11.0, 3.6)
        draw_slices(canvas, middle_slice(self.pair, self), self.pair.reference.spacing_mm)
        return canvas

    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return one row a figure or diagnostic: quantity with unit, and value."""
        return tuple({"quantity": name, "value": value} for name, value in self.rows())


def read_pair(
    reference: str | os.PathLike[str],
    deformed: str | os.PathLike[str],
    *,
    mask: str | os.PathLike[str] | None = None,
    deformed_mask: str | os.PathLike[str] | None = None,
    truth: str | os.PathLike[str] | None = None,
    check_points: tuple[str | os.PathLike[str], str | os.PathLike[str]] | None = None,
    spacing_mm: Sequence[float] | None = None,
) -> Pair:
    """Read the volumes of a pair, and its mask and true displacements.

    Parameters
    ----------
    reference, deformed : path-like
        Volumes before and after the deformation (see `naibu.io.images.read_volume`); NaN where they were not measured. The deformed one is
        resampled to the grid of the reference where it lies on another, and `Pair.notes` says so.
    mask : path-like, optional
        Volume on the grid of the reference, not zero in the object.
    deformed_mask : path-like, optional
        The same for the deformed scan: digital volume correlation starts from its position and outline.
    truth : path-like, optional
        True displacement on that grid, an image of vectors, mm.
    check_points : two path-like, optional
        Tables of points in the reference and in the deformed configuration (see `naibu.io.import_markers`), with one number
        for each point.
    spacing_mm : sequence of float, optional
        Voxel spacing along x, y, z, mm, for files without it.

    Raises
    ------
    InputError
        A file that cannot be read, a mask or truth on another grid, or scans whose grids contradict each other.
    """
    require_lengths(spacing_mm=spacing_mm)
    a, b = (read_volume(p, spacing_mm=spacing_mm, missing=True) for p in (reference, deformed))
    masks: list[BoolArray | None] = [None, None]
    for k, (path, grid, scan) in enumerate(((mask, a, reference), (deformed_mask, b, deformed))):
        if path is not None:
            m = read_volume(path, spacing_mm=spacing_mm)
            _same(m, grid, Path(path), Path(scan))
            masks[k] = np.asarray(m.values != 0)
    moved, told = on_reference_grid(a, b)
    if told and masks[1] is not None:
        masks[1] = np.asarray(on_voxels_of(b.with_values(masks[1]), a).values > 0.5)
    known = None
    if truth is not None:
        known, grid = read_displacement(truth)
        _same(grid, a, Path(truth), Path(reference))
    points = None if check_points is None else common_points(*check_points)
    files = {"reference": reference, "deformed": deformed, "mask": mask, "deformed_mask": deformed_mask, "truth": truth}
    tables = dict(zip(("reference_check_points", "deformed_check_points"), check_points or (), strict=False))
    names = (Path(reference).name, Path(deformed).name)
    return Pair(a, moved, masks[0], input_record(files | tables), names, known, points, masks[1], (told,) if told else ())


def common_points(reference: str | os.PathLike[str], deformed: str | os.PathLike[str]) -> tuple[FloatArray, FloatArray]:
    """Return the points (n, 3), mm, that two tables have in common, in both configurations."""
    a, b = import_markers(reference), import_markers(deformed)
    _, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
    known = np.isfinite(a.points[i]).all(axis=1) & np.isfinite(b.points[j]).all(axis=1)
    if not known.any():
        raise InputError(
            f"{Path(reference).name} and {Path(deformed).name} have no point number in common, of {len(a.ids)} and {len(b.ids)}"
        )
    return a.points[i][known], b.points[j][known]


def _same(grid: Volume, other: Volume, file: Path, reference: Path) -> None:
    if different := grid.grid_difference(other):
        raise InputError(f"{file.name} does not lie on the grid of {reference.name}: {different}; resample it to that grid")


@no_empty_folders()
def sense(
    reference: str | os.PathLike[str],
    deformed: str | os.PathLike[str],
    *,
    method: Method = "default",
    mask: str | os.PathLike[str] | None = None,
    deformed_mask: str | os.PathLike[str] | None = None,
    truth: str | os.PathLike[str] | None = None,
    check_points: tuple[str | os.PathLike[str], str | os.PathLike[str]] | None = None,
    spacing_mm: Sequence[float] | None = None,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> SenseRun:
    """Measure the displacement between two scans, by digital volume correlation or a classic method, and write it.

    Parameters
    ----------
    reference, deformed : path-like
        Volumes before and after the deformation: MetaImage, NIfTI, NRRD, TIFF, HDF5, Zarr or a folder of DICOM. A deformed scan on another
        grid is resampled to that of the reference, and a warning says so.
    method : str
        ``"default"`` for digital volume correlation, or a classic method (see `naibu.imaging.measure_displacement`).
    mask : path-like, optional
        Volume on the grid of the reference, not zero in the object; by default the object is segmented.
    deformed_mask : path-like, optional
        The same for the deformed scan: digital volume correlation starts from its position and outline.
    truth : path-like, optional
        True displacement on that grid, an image of vectors, mm, to compare with.
    check_points : two path-like, optional
        Tables of points in the reference and in the deformed configuration, with one number for each point, to compare with.
    spacing_mm : sequence of float, optional
        Voxel spacing along x, y, z, mm, for files without it.
    out : path-like, optional
        Folder for fields, markers, numbers and the page of slices (see `naibu.workflows.measurement.sense.sense_pair`).
    overwrite : bool
        Whether results, or other files of these names, that `out` holds already are replaced.
    progress : Progress, optional
        Called at the beginning of every stage.

    Returns
    -------
    SenseRun
        The displacement (``measured.displacement``), figures and files.

    Raises
    ------
    InputError
        A file that cannot be read; volumes, mask or truth on different grids; volumes that cannot be compared; a folder that cannot be
        written to.
    """
    pair = read_pair(
        reference, deformed, mask=mask, deformed_mask=deformed_mask, truth=truth, check_points=check_points, spacing_mm=spacing_mm
    )
    return sense_pair(pair, method=method, out=out, overwrite=overwrite, progress=progress)


@no_empty_folders()
def sense_pair(
    pair: Pair,
    *,
    method: Method = "default",
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> SenseRun:
    """Measure the displacement of a pair, and write it.

    Parameters
    ----------
    pair : Pair
        From `read_pair`.
    method : str
        See `naibu.imaging.measure_displacement.measure_displacement`.
    out : path-like, optional
        Folder for ``displacement.mha``, ``standard_deviation.mha`` (where the method states one), ``displacement.vtu`` (of volumes),
        ``field.h5``, ``mask.mha`` (the object), ``initial.csv`` and ``pressed.csv`` (positions in the object as markers), ``sense.json``,
        ``report.html``.
    overwrite : bool
        Whether results, or other files of these names, that `out` holds already are replaced.
    progress : Progress, optional
        Called at the beginning of every stage.

    Raises
    ------
    InputError
        As `naibu.imaging.measure_displacement.measure_displacement`; also one scan given twice, and a folder that cannot be written to.
    """
    folder = None if out is None else output_folder(out, FILES, overwrite=overwrite)
    began = time.perf_counter()
    try:
        measured = measure_displacement(
            pair.reference, pair.deformed, method=method, mask=pair.mask, deformed_mask=pair.deformed_mask, progress=progress
        )
    except InputError as error:  # that they were brought onto one grid may be why
        if not pair.notes:
            raise
        raise InputError(". ".join([str(error), *pair.notes])) from error
    measured = replace(measured, warnings=(*pair.notes, *measured.warnings))
    return recorded(pair, measured, time.perf_counter() - began, folder)


def recorded(pair: Pair, measured: MeasuredDisplacement, seconds: float, folder: Path | None) -> SenseRun:
    """Return a measured displacement with its figures, and write it where a folder is given (see `sense_pair`)."""
    if not (measured.mask & measured.displacement.valid).any():
        nowhere = "the displacement was found nowhere in the object: check that both scans show the same object"
        raise InputError(". ".join([nowhere, *pair.notes]))
    if np.array_equal(pair.reference.values, pair.deformed.values, equal_nan=True):
        first, second = pair.names
        raise InputError(f"{first} and {second} hold the same intensities at every voxel, so that nothing moved; is one scan given twice?")
    run = SenseRun(measured, seconds, figures(pair, measured), pair)
    return run if folder is None else replace(run, files=written_together(folder, FILES, lambda at: _written(pair, run, at)))


def figures(pair: Pair, measured: MeasuredDisplacement) -> dict[str, float | int | str | None]:
    """Return the figures of a displacement (see `FIGURES`): size, residual, folding, and errors where the truth is known."""
    u, inside = measured.displacement.vectors, measured.mask & measured.displacement.valid
    size, sd = np.linalg.norm(u[inside], axis=1), measured.displacement.largest_sd_mm
    out: dict[str, float | int | str | None] = {
        "measured_fraction": float(inside.sum() / measured.mask.sum()),
        "median_displacement_mm": float(np.median(size)),
        "largest_displacement_mm": float(size.max()),
        "initial_residual_rms": intensity_rms(
            pair.reference, pair.deformed, np.broadcast_to(0.0, u.shape), region=measured.mask, frame="reference"
        ),
        "residual_rms": intensity_rms(pair.reference, pair.deformed, u, region=measured.mask, frame="reference"),
        "folded_fraction": folded_fraction(u, pair.reference, measured.mask),
        "median_sd_mm": None if sd is None else float(np.nanmedian(sd[inside])),
        "median_strain_sd": None if measured.strain_sd is None else float(np.nanmedian(measured.strain_sd[inside])),
    }
    if pair.truth is not None:
        e = end_point_error(u, pair.truth, measured.mask)
        out |= {"mean_error_mm": e.mean_mm, "median_error_mm": e.median_mm, "p95_error_mm": e.p95_mm}
    if pair.check_points is not None:
        e = check_point_errors(u, pair.reference, *pair.check_points)
        out |= {"mean_check_point_error_mm": e.mean_mm, "p95_check_point_error_mm": e.p95_mm}
    return out


def _written(pair: Pair, run: SenseRun, folder: Path) -> list[Path]:
    measured, grid = run.measured, pair.reference
    # what cannot be written is refused before the first file; between the voxels of a single slice there are no cells
    cells = _cells(measured, grid) if min(grid.shape) > 1 else None
    files = [
        write_atomically(folder / "report.html", slices_html(slice_view(pair, run))),
        write_displacement(folder / "displacement.mha", measured.displacement.vectors, grid),
    ]
    sd = measured.displacement.largest_sd_mm
    if sd is not None:
        files.append(write_volume(folder / "standard_deviation.mha", grid.with_values(np.nan_to_num(sd).astype(np.float32))))
    if cells is not None:
        files.append(_vtu(folder / "displacement.vtu", grid, measured, *cells))
    files.append(_field(folder / "field.h5", pair, measured))
    files.append(write_volume(folder / "mask.mha", grid.with_values(measured.mask.astype(np.uint8))))
    files += [
        write_markers(folder / f"{name}.csv", markers) for name, markers in zip(MARKER_TABLES, _as_markers(measured, grid), strict=True)
    ]
    numbers = {
        "naibu": __version__,
        "method": measured.method,
        "mask": "given" if pair.mask is not None else "found",
        "inputs": pair.inputs,
        "seed": "none: the search is deterministic",
        "seconds": round(run.seconds, 2),
        "units": "mm; displacement u of the reference configuration: the material at x is found at x + u(x)",
        "figures": run.figures,
        "diagnostics": measured.facts,
        "warnings": list(measured.warnings),
    }
    text = json.dumps(_plain(numbers), indent=1, ensure_ascii=False) + "\n"
    return [*files, write_atomically(folder / "sense.json", text)]


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def _cells(measured: MeasuredDisplacement, grid: Volume) -> tuple[IntArray, int]:
    """Return hexahedra (n, 8) between some voxels of the object, and that these are every so many."""
    known = np.isfinite(measured.displacement.vectors).all(axis=-1) & measured.mask
    step = 1
    while known[::step, ::step, ::step].sum() > MESH_CELLS:
        step += 1
    some = (slice(None, None, step),) * 3
    nz, ny, nx = known[some].shape
    cells = grid_cells(nx, ny, nz)
    cells = cells[known[some].ravel()[cells].all(axis=1)]
    if not len(cells):
        raise InputError(
            f"the displacement was found at {known.sum()} of {measured.mask.sum()} voxels of the object only, too few for a mesh: "
            "check that both scans show the same object, or enlarge the mask"
        )
    return cells, step


def _vtu(path: Path, grid: Volume, measured: MeasuredDisplacement, cells: IntArray, step: int) -> Path:
    """Write the object as hexahedra between voxels, subsampled for ParaView."""
    some = (slice(None, None, step),) * 3
    used, numbers = np.unique(cells, return_inverse=True)
    mesh = Mesh.from_arrays(grid.positions()[some].reshape(-1, 3)[used], numbers.reshape(cells.shape), "hexahedron")
    data: dict[str, FloatArray] = {
        "displacement_mm": measured.displacement.vectors[some].reshape(-1, 3)[used],
        "green_lagrange_strain": green_lagrange_strain_of(measured.gradient[some].reshape(-1, 3, 3)[used]),
    }
    if (covariance := measured.displacement.covariance) is not None:
        data["displacement_covariance_mm2"] = covariance[some].reshape(-1, 3, 3)[used].astype(np.float64)
    if measured.strain_sd is not None:
        data["strain_standard_deviation"] = measured.strain_sd[some].ravel()[used].astype(np.float64)
    write_vtu(path, mesh, data)
    return path


def _field(path: Path, pair: Pair, measured: MeasuredDisplacement) -> Path:
    """Write the field as the identification takes it (`naibu.io.read_field`): blocks with independent errors, or else some voxels."""
    provenance = {"naibu": __version__, "method": measured.method, "inputs": pair.inputs}
    if measured.blocks is not None and measured.blocks.valid.any():
        return write_field(path, measured.blocks, provenance=provenance | {"points": "blocks of voxels with independent errors"})
    known, step = measured.mask & measured.displacement.valid, 1
    while known[::step, ::step, ::step].sum() > FIELD_POINTS:
        step += 1
    return write_field(path, measured.displacement.at_points(step=step), provenance=provenance | {"points": f"every voxel of {step}"})


def _as_markers(measured: MeasuredDisplacement, grid: Volume) -> tuple[Markers, Markers]:
    """Return some 250 positions on a lattice in the object and their displaced positions, as markers for `naibu import`."""
    good = measured.mask & measured.displacement.valid
    if (sd := measured.displacement.largest_sd_mm) is not None:
        good &= np.nan_to_num(sd, nan=np.inf) <= LEAST_CERTAIN * np.nanmedian(sd[good])
    apart = (good.sum() * float(np.prod(grid.spacing_mm)) / MARKERS) ** (1.0 / 3.0)
    every = np.maximum(1, np.round(apart / grid.spacing_mm)).astype(int)[::-1]
    some = np.zeros(grid.shape, dtype=bool)
    some[tuple(slice(k // 2, None, k) for k in every)] = True
    some &= good
    points, ids = grid.to_physical(np.argwhere(some)[:, ::-1]), np.arange(1, int(some.sum()) + 1)
    return Markers.from_arrays(ids, points), Markers.from_arrays(ids, points + measured.displacement.vectors[some])
