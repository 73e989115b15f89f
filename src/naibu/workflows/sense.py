"""Sense the displacement between two scans from files to files: fields for other programs, numbers, and a page of slices."""

from __future__ import annotations

import io
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from naibu._version import __version__
from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.markers import Markers
from naibu.core.mesh import Mesh
from naibu.core.volume import Volume
from naibu.imaging.displacement.accuracy import check_point_errors, end_point_error, intensity_rms
from naibu.imaging.displacement.strain import folded_share, green_lagrange_strain_of
from naibu.imaging.measure_displacement import Method, Sensed, measure_displacement
from naibu.imaging.preprocessing.resampling import positions, warped
from naibu.io.files.atomic import write_atomically
from naibu.io.files.provenance import input_record
from naibu.io.images import read_displacement, read_volume, write_displacement, write_volume
from naibu.io.marker_tables import import_markers, write_markers
from naibu.io.vtk_files import write_vtu
from naibu.meshing.primitives import grid_cells
from naibu.viewer.slices import Overlay, SliceView, slices_html
from naibu.viewer.tables import Cell, Table
from naibu.workflows.result_folder import result_folder

Progress = Callable[[str], None]
MESH_CELLS = 60_000  # of the file for ParaView
FIELD_POINTS = 40_000  # of the field for the identification
MARKER_TABLES, MARKERS = ("initial", "pressed"), 250
LEAST_CERTAIN = 4.0  # times the median standard deviation: places known worse make no markers


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two scans on one grid, the mask of the object before, and what is known of the truth."""

    before: Volume
    after: Volume
    mask: BoolArray | None
    inputs: dict[str, str]
    names: tuple[str, str]
    truth: FloatArray | None = None
    check_points: tuple[FloatArray, FloatArray] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SenseRun:
    """A displacement with its numbers and, where asked for, its files."""

    sensed: Sensed
    seconds: float
    figures: dict[str, float | int | str | None]
    files: tuple[Path, ...] = ()


def read_pair(
    before: str | os.PathLike[str],
    after: str | os.PathLike[str],
    *,
    mask: str | os.PathLike[str] | None = None,
    truth: str | os.PathLike[str] | None = None,
    check_points: tuple[str | os.PathLike[str], str | os.PathLike[str]] | None = None,
    spacing_mm: Sequence[float] | None = None,
) -> Pair:
    """Read two scans and what goes with them.

    Parameters
    ----------
    before, after : path-like
        Volumes (see `naibu.io.images.read_volume`).
    mask : path-like, optional
        Volume on the grid of the first, not zero where the object is.
    truth : path-like, optional
        Known displacement on that grid, an image of vectors, mm.
    check_points : two path-like, optional
        Tables of points before and after (see `naibu.io.marker_tables.import_markers`); the same points bear the same numbers.
    spacing_mm : sequence of float, optional
        Distance of voxels along x, y, z, mm, for files that do not say.

    Raises
    ------
    InputError
        A file that cannot be read, or a mask or truth on another grid.
    """
    a, b = (read_volume(p, spacing_mm=spacing_mm) for p in (before, after))
    inside = None
    if mask is not None:
        m = read_volume(mask, spacing_mm=spacing_mm)
        _same(m, a, Path(mask), Path(before))
        inside = np.asarray(m.values != 0)
    known = None
    if truth is not None:
        known, grid = read_displacement(truth)
        _same(grid, a, Path(truth), Path(before))
    points = None if check_points is None else _common_points(*check_points)
    files = {"before": before, "after": after, "mask": mask, "truth": truth}
    tables = dict(zip(("check points before", "check points after"), check_points or (), strict=False))
    return Pair(a, b, inside, input_record(files | tables), (Path(before).name, Path(after).name), known, points)


def _common_points(before: str | os.PathLike[str], after: str | os.PathLike[str]) -> tuple[FloatArray, FloatArray]:
    a, b = import_markers(before), import_markers(after)
    _, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
    known = np.isfinite(a.points[i]).all(axis=1) & np.isfinite(b.points[j]).all(axis=1)
    if not known.any():
        raise InputError(f"{Path(before).name} and {Path(after).name} have no point number in common, of {len(a.ids)} and {len(b.ids)}")
    return a.points[i][known], b.points[j][known]


def _same(grid: Volume, other: Volume, file: Path, reference: Path) -> None:
    if not grid.same_grid(other):
        raise InputError(
            f"{file.name} has {grid.shape[::-1]} voxels of {grid.spacing_mm.tolist()} mm, {reference.name} {other.shape[::-1]} of "
            f"{other.spacing_mm.tolist()} mm from {other.origin_mm.tolist()}; both must lie on one grid"
        )


def sense(
    reference: str | os.PathLike[str],
    deformed: str | os.PathLike[str],
    *,
    method: Method = "default",
    mask: str | os.PathLike[str] | None = None,
    truth: str | os.PathLike[str] | None = None,
    check_points: tuple[str | os.PathLike[str], str | os.PathLike[str]] | None = None,
    spacing_mm: Sequence[float] | None = None,
    out: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
) -> SenseRun:
    """Measure the displacement between two scans, by digital volume correlation or a classic method, and write it.

    Parameters
    ----------
    reference, deformed, mask, truth, check_points, spacing_mm
        See `read_pair`.
    method, out, progress
        See `sense_pair`.

    Raises
    ------
    InputError
        As `read_pair` and `sense_pair`.
    """
    pair = read_pair(reference, deformed, mask=mask, truth=truth, check_points=check_points, spacing_mm=spacing_mm)
    return sense_pair(pair, method=method, out=out, progress=progress)


def sense_pair(
    pair: Pair, *, method: Method = "default", out: str | os.PathLike[str] | None = None, progress: Progress | None = None
) -> SenseRun:
    """Sense the displacement of a pair, and write it.

    Parameters
    ----------
    pair : Pair
        From `read_pair`.
    method : str
        See `naibu.imaging.measure_displacement.measure_displacement`.
    out : path-like, optional
        Folder for ``displacement.mha``, ``standard_deviation.mha`` (where the method states one), ``displacement.vtu`` (of volumes),
        ``field.npz``, ``initial.csv`` and ``pressed.csv`` (places in the object as markers), ``sense.json`` and the page ``report.html``.
    progress : callable, optional
        Told what begins.

    Raises
    ------
    InputError
        As `naibu.imaging.measure_displacement.measure_displacement`; also a folder that cannot be written to.
    """
    folder = None if out is None else result_folder(out)
    began = time.perf_counter()
    sensed = measure_displacement(pair.before, pair.after, method=method, mask=pair.mask, progress=progress)
    run = SenseRun(sensed, time.perf_counter() - began, figures(pair, sensed))
    return run if folder is None else SenseRun(sensed, run.seconds, run.figures, tuple(_written(pair, run, folder)))


def figures(pair: Pair, sensed: Sensed) -> dict[str, float | int | str | None]:
    """Return what can be said of a displacement: size, what it leaves unexplained, folding, and errors where the truth is known."""
    u, inside = sensed.displacement.vectors, sensed.mask & sensed.displacement.valid
    size, sd = np.linalg.norm(u[inside], axis=1), sensed.displacement.largest_sd_mm
    out: dict[str, float | int | str | None] = {
        "measured share": float(inside.sum() / sensed.mask.sum()),
        "displacement, median, mm": float(np.median(size)),
        "displacement, largest, mm": float(size.max()),
        "grey RMS before": intensity_rms(pair.before, pair.after, np.zeros_like(u), region=sensed.mask, frame="initial"),
        "grey RMS after": intensity_rms(pair.before, pair.after, u, region=sensed.mask, frame="initial"),
        "folded share": folded_share(u, pair.before, sensed.mask),
        "stated sd, median, mm": None if sd is None else float(np.nanmedian(sd[inside])),
    }
    if pair.truth is not None:
        e = end_point_error(u, pair.truth, sensed.mask)
        out |= {"error, mean, mm": e.mean_mm, "error, median, mm": e.median_mm, "error, 95 %, mm": e.p95_mm}
    if pair.check_points is not None:
        e = check_point_errors(u, pair.before, *pair.check_points)
        out |= {"check points, mean, mm": e.mean_mm, "check points, 95 %, mm": e.p95_mm}
    return out


def _written(pair: Pair, run: SenseRun, folder: Path) -> list[Path]:
    sensed, grid = run.sensed, pair.before
    files = [
        write_atomically(folder / "report.html", slices_html(slice_view(pair, run))),
        write_displacement(folder / "displacement.mha", sensed.displacement.vectors, grid),
    ]
    sd = sensed.displacement.largest_sd_mm
    if sd is not None:
        files.append(write_volume(folder / "standard_deviation.mha", grid.with_values(np.nan_to_num(sd).astype(np.float32))))
    if min(grid.shape) > 1:  # between the voxels of a single slice there are no cells
        files.append(_vtu(folder / "displacement.vtu", grid, sensed))
    files.append(_npz(folder / "field.npz", sensed))
    files += [
        write_markers(folder / f"{name}.csv", markers) for name, markers in zip(MARKER_TABLES, _as_markers(sensed, grid), strict=True)
    ]
    numbers = {
        "naibu": __version__,
        "method": sensed.method,
        "mask": "given" if pair.mask is not None else "found",
        "inputs": pair.inputs,
        "seed": "none: the search is deterministic",
        "seconds": round(run.seconds, 2),
        "units": "mm; displacement is that of the material before: x is found at x + u(x)",
        "figures": run.figures,
        "method's own": sensed.facts,
    }
    text = json.dumps(_plain(numbers), indent=1, ensure_ascii=False) + "\n"
    return [*files, write_atomically(folder / "sense.json", text)]


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def _vtu(path: Path, grid: Volume, sensed: Sensed) -> Path:
    """The object as hexahedra between voxels, as many as ParaView shows at once."""
    known = np.isfinite(sensed.displacement.vectors).all(axis=-1) & sensed.mask
    step = 1
    while known[::step, ::step, ::step].sum() > MESH_CELLS:
        step += 1
    some = (slice(None, None, step),) * 3
    nz, ny, nx = known[some].shape
    cells = grid_cells(nx - 1, ny - 1, nz - 1)
    cells = cells[known[some].ravel()[cells].all(axis=1)]
    if not len(cells):
        raise InputError("the displacement is known at too few neighbouring voxels for a mesh; enlarge the mask")
    used, numbers = np.unique(cells, return_inverse=True)
    mesh = Mesh.from_arrays(positions(grid)[some].reshape(-1, 3)[used], numbers.reshape(cells.shape), "hexahedron")
    strain = green_lagrange_strain_of(sensed.gradient[some].reshape(-1, 3, 3)[used])
    data: dict[str, FloatArray] = {
        "displacement_mm": sensed.displacement.vectors[some].reshape(-1, 3)[used],
        "green_lagrange_strain": strain,
    }
    if (covariance := sensed.displacement.covariance) is not None:
        data["displacement_covariance_mm2"] = covariance[some].reshape(-1, 3, 3)[used]
    write_vtu(path, mesh, data)
    return path


def _npz(path: Path, sensed: Sensed) -> Path:
    """The field as the identification takes it: `naibu.core.displacement_field.DisplacementField.from_arrays` on its arrays."""
    step = 1
    while (sensed.mask & sensed.displacement.valid)[::step, ::step, ::step].sum() > FIELD_POINTS:
        step += 1
    field = sensed.displacement.at_points(step=step)
    stream = io.BytesIO()
    arrays: dict[str, Any] = {"points": field.points, "vectors": field.vectors, "valid": field.valid}
    if field.covariance is not None:
        arrays["covariance"] = field.covariance
    np.savez_compressed(stream, **arrays)
    return write_atomically(path, stream.getvalue())


def _as_markers(sensed: Sensed, grid: Volume) -> tuple[Markers, Markers]:
    """Some 250 places on a lattice in the object, before and after, as markers for `naibu import` and `naibu identify`."""
    good = sensed.mask & sensed.displacement.valid
    if (sd := sensed.displacement.largest_sd_mm) is not None:
        good &= np.nan_to_num(sd, nan=np.inf) <= LEAST_CERTAIN * np.nanmedian(sd[good])
    apart = (good.sum() * float(np.prod(grid.spacing_mm)) / MARKERS) ** (1.0 / 3.0)
    every = np.maximum(1, np.round(apart / grid.spacing_mm)).astype(int)[::-1]
    some = np.zeros(grid.shape, dtype=bool)
    some[tuple(slice(k // 2, None, k) for k in every)] = True
    some &= good
    points, ids = positions(grid)[some], np.arange(1, int(some.sum()) + 1)
    return Markers.from_arrays(ids, points), Markers.from_arrays(ids, points + sensed.displacement.vectors[some])


def slice_view(pair: Pair, run: SenseRun) -> SliceView:
    """Return what the page of a run shows."""
    sensed, grid = run.sensed, pair.before
    box = _box(sensed.mask)
    u = sensed.displacement.vectors
    back = warped(pair.after, np.nan_to_num(u), grid)
    strain = green_lagrange_strain_of(sensed.gradient)
    inside = sensed.mask & np.isfinite(strain).all(axis=(-2, -1))
    principal = np.full((*grid.shape, 3), np.nan)
    principal[inside] = np.linalg.eigvalsh(strain[inside])
    ratio = np.full(grid.shape, np.nan)
    ratio[inside] = np.linalg.det(np.eye(3) + sensed.gradient[inside])
    overlays = [
        Overlay("displacement, mm", np.linalg.norm(u, axis=-1)[box]),
        Overlay("largest principal Green-Lagrange strain", principal[..., 2][box]),
        Overlay("smallest principal Green-Lagrange strain", principal[..., 0][box]),
        Overlay("volume ratio J", ratio[box], middle=1.0),
    ]
    if (sd := sensed.displacement.largest_sd_mm) is not None:
        overlays.append(Overlay("standard deviation of the displacement, mm", np.where(sensed.mask, sd, np.nan)[box]))
    images = [("before", pair.before.values), ("after", pair.after.values), ("after, carried back", back)]
    return SliceView(
        title=f"Displacement from {pair.names[0]} to {pair.names[1]}",
        sentences=_sentences(run),
        spacing_mm=grid.spacing_mm,
        images=[(name, np.asarray(v, dtype=np.float32)[box]) for name, v in images],
        displacement=(u @ grid.direction)[box],
        overlays=overlays,
        tables=[_table(run)],
        difference=(("before minus after", 0, 1), ("before minus after, carried back", 0, 2)),
    )


def _box(mask: BoolArray, margin: int = 4) -> tuple[slice, ...]:
    inside = np.argwhere(mask)
    return tuple(slice(max(0, int(a) - margin), int(b) + 1 + margin) for a, b in zip(inside.min(axis=0), inside.max(axis=0), strict=True))


def _sentences(run: SenseRun) -> list[str]:
    f = run.figures
    told = [
        f"Method {run.sensed.method}, {run.seconds:.1f} s. The object moved by {f['displacement, median, mm']:.2f} mm (median), at most "
        f"{f['displacement, largest, mm']:.2f} mm; the difference of grey values inside it fell from {f['grey RMS before']:.4g} to "
        f"{f['grey RMS after']:.4g} (root mean square)."
    ]
    if f["stated sd, median, mm"] is not None:
        told.append(
            f"The displacement is known to {f['stated sd, median, mm']:.3f} mm (standard deviation along the least certain axis, median)."
        )
    else:
        told.append("This method states no uncertainty.")
    if isinstance(f["folded share"], float) and f["folded share"] > 0.0:
        told.append(f"The field folds at {f['folded share']:.2%} of the voxels: do not trust it there.")
    return told


def _table(run: SenseRun) -> Table:
    rows: list[tuple[Cell, ...]] = [(name, value) for name, value in {**run.figures, **run.sensed.facts}.items()]
    return Table("Numbers", ("what", "value"), tuple(rows))
