"""Import of marker tables: an experiment folder from tables of other programs, whose labels and units are checked by their motion."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from naibu.core.arrays import FloatArray, require_lengths
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, Loading, Shape
from naibu.core.markers import Markers
from naibu.imaging.markers.linking.motion_coherence import require_coherent, strays_named
from naibu.imaging.markers.tracking import FEWEST_COMMON
from naibu.io.experiment_folder.reader import META_FILE, read_experiment
from naibu.io.tables.marker_tables import import_markers, state_name, write_experiment_folder
from naibu.io.tables.table_cells import MM_PER_UNIT
from naibu.viewer.tables import Cell, Table
from naibu.workflows.markers.experiments import doubts_of_markers
from naibu.workflows.markers.tilted_tables import UprightTables, Vertical, upright_tables

LEAST_SHARE = 0.15  # of the object's extent, which markers span; below, another unit is suspected
INITIAL = "initial"
MOST_STRAYS = 0.2  # fraction of stray markers from which on the labels are not believed


def import_tables(
    initial: str | os.PathLike[str],
    loaded: Sequence[str | os.PathLike[str]],
    *,
    out: str | os.PathLike[str],
    unit: str | None = None,
    vertical: Vertical = None,
    **description: Any,
) -> tuple[str, ...]:
    """Make an experiment folder from tables of marker positions.

    Parameters
    ----------
    initial : path-like
        Table of the unloaded state.
    loaded : sequence of path-like
        Tables of the loaded states, which are named after their files.
    out : path-like
        Folder to make.
    unit : str, optional
        Unit of the coordinates, if the column names do not state it.
    vertical : sequence of float or "found", optional
        Direction away from the base in the axes of the tables, if it is not z; or that it is found from the lattice of the markers (where
        `spacing_mm` is given) or the direction of compression (`naibu.imaging.found_orientation`). All tables are then turned into the axes
        of the object.
    **description
        See `naibu.io.write_experiment_folder`.

    Returns
    -------
    tuple of str
        What should be looked at: markers that move unlike their neighbours, what `naibu.identify` will doubt or refuse (exchanged states).

    Raises
    ------
    InputError
        Two states of one name, tables that cannot be read, labels that do not correspond, states in other units or mirrored, an object that
        stands tilted in its scan. No folder is made then.
    """
    first, *others = tables = _read(initial, loaded, unit, description["shape"])
    checked = (_checked(tables[first], tables[name], Path(initial).name, name) for name in others)
    notes = [note for note in checked if note]
    upright = _upright(tables, vertical, description)
    if description.get("xy_step_mm") and description.get("z_step_mm"):
        steps = upright.turned_lengths(description["xy_step_mm"], description["z_step_mm"])
        description |= {"xy_step_mm": steps[0], "z_step_mm": steps[1]}
    description["stated_mm"] = {state_name(name): height for name, height in (description.get("stated_mm") or {}).items()}
    experiment = _rehearsed(out, upright.tables, description, dict(zip(tables, (initial, *loaded), strict=True)))
    write_experiment_folder(out, upright.tables[first], {name: upright.tables[name] for name in others}, **description)
    return (*notes, *upright.notes, *doubts_of_markers(experiment))


def _rehearsed(
    out: str | os.PathLike[str],
    tables: Mapping[str, Markers],
    description: Mapping[str, Any],
    sources: Mapping[str, str | os.PathLike[str]],
) -> Experiment:
    """Return the experiment that the folder `out` will hold; what is wrong with a table is told of the file that it came from."""
    first, *others = tables
    with TemporaryDirectory() as place:
        folder = Path(place) / (Path(out).resolve().name or "experiment")
        try:
            write_experiment_folder(folder, tables[first], {name: tables[name] for name in others}, **description)
            return read_experiment(folder)
        except InputError as error:
            told = str(error).replace(f" in {META_FILE}", "")
            for name, source in sources.items():
                told = told.replace(str(folder / f"{name}.csv"), str(source))
            raise InputError(told.replace(f"{place}{os.sep}", "")) from error


def rehearsed_import(
    initial: str | os.PathLike[str], loaded: Sequence[str | os.PathLike[str]], *, out: str | os.PathLike[str], **options: Any
) -> tuple[str, ...]:
    """Return what `import_tables` would, or refuse what it would; the folder is made elsewhere, and removed again.

    Parameters
    ----------
    initial, loaded, out, **options
        As of `import_tables`; of `out` only the name is used.

    Raises
    ------
    InputError
        As of `import_tables`.
    """
    with TemporaryDirectory() as place:
        try:
            return import_tables(initial, loaded, out=Path(place) / (Path(out).name or "experiment"), **options)
        except InputError as error:
            raise InputError(str(error).replace(f"{place}{os.sep}", "")) from error


def preview_tables(
    initial: str | os.PathLike[str],
    loaded: Sequence[str | os.PathLike[str]],
    *,
    unit: str | None = None,
    vertical: Vertical = None,
    **description: Any,
) -> Table:
    """Return what tables of marker positions hold, beside the size of the object: what to look at before they are imported.

    Parameters
    ----------
    initial, loaded, unit, vertical, **description
        As of `import_tables`; of the description ``shape`` is needed. What is shown is turned already.

    Raises
    ------
    InputError
        Tables that cannot be read, positions that are in another unit than they say, or a vertical that cannot be found.
    """
    tables = _read(initial, loaded, unit, description["shape"])
    upright = _upright(tables, vertical, description)
    size = " x ".join(f"{edge:g}" for edge in description["shape"].size_mm)
    note = f"The object measures {size} mm. Spacing: median distance to the nearest marker. Rigid motion of the scan is part of 'moved'."
    notes = [note, *(f"{text[:1].upper()}{text[1:]}." for text in (upright.told, *upright.notes) if text)]
    rows = [_seen(name, markers, upright.tables[INITIAL]) for name, markers in upright.tables.items()]
    columns = ("state", "markers", "in common", "span x, mm", "span y, mm", "span z, mm", "spacing, mm", "moved (median), mm")
    return Table("Tables as they are read", columns, tuple(rows), note=" ".join(notes))


def _read(initial: str | os.PathLike[str], loaded: Sequence[str | os.PathLike[str]], unit: str | None, shape: Shape) -> dict[str, Markers]:
    """Return the markers of all states by name, the unloaded one first."""
    names = [INITIAL, *(state_name(Path(table).stem) for table in loaded)]
    if len(set(names)) < len(names):
        raise InputError(f"two tables would both be the state {max(names, key=names.count)!r}; rename one file")
    require_lengths(size_mm=shape.size_mm)
    first = import_markers(initial, unit=unit)
    if unit is None:
        _require_plausible_unit(first, shape.size_mm, Path(initial).name)
    return {INITIAL: first} | {name: import_markers(table, unit=unit) for name, table in zip(names[1:], loaded, strict=True)}


def _upright(tables: Mapping[str, Markers], vertical: Vertical, description: Mapping[str, Any]) -> UprightTables:
    shape, loading, spacing_mm = description["shape"], description.get("loading", Loading("plate")), description.get("spacing_mm")
    return upright_tables(tables, vertical, shape=shape, loading=loading, spacing_mm=spacing_mm)


def _seen(name: str, markers: Markers, first: Markers) -> tuple[Cell, ...]:
    points = markers.points[np.isfinite(markers.points[:, :2]).all(axis=1)]
    moved = np.linalg.norm(np.nan_to_num(markers.points - first.aligned(markers.ids)), axis=1)
    common = np.isfinite(markers.points[:, :2] + first.aligned(markers.ids)[:, :2]).all(axis=1)
    spacing = _nearest(np.nan_to_num(points)) if len(points) > 1 else None
    median = float(np.median(moved[common])) if common.any() else None
    return (name, len(markers.ids), int(common.sum()), *_span(markers), spacing, median)


def _nearest(points: FloatArray) -> float:
    """Median distance from a point (n, 3) to its nearest neighbour, mm."""
    distance, _ = cKDTree(points).query(points, k=2)
    return float(np.median(np.asarray(distance)[:, 1]))


def _span(markers: Markers) -> tuple[float, float, float]:
    """Extent of the markers along x, y, z, mm; NaN along z of markers in one plane."""
    known = [column[np.isfinite(column)] for column in markers.points.T]
    x, y, z = (float(np.ptp(column)) if len(column) else np.nan for column in known)
    return x, y, z


def _require_plausible_unit(first: Markers, size_mm: Sequence[float], name: str) -> None:
    """Refuse positions that fill the object only in another unit; fewer markers than a deformation needs are refused elsewhere."""
    if len(first.ids) < FEWEST_COMMON:
        return
    share = np.nanmax(np.array(_span(first)) / np.array(size_mm, dtype=float))
    for unit in ("cm", "m", "inch"):
        if share < LEAST_SHARE and 2.0 * LEAST_SHARE < share * MM_PER_UNIT[unit] <= 1.05:
            span, size = (" x ".join(f"{edge:.3g}" for edge in edges) for edges in (_span(first), size_mm))
            raise InputError(
                f"{name}: the markers span {span} mm, a small part of an object whose size_mm is {size}; in "
                f"{unit} they would fill it. Give `unit` as {unit}, or as mm if they are so close together"
            )


def _checked(first: Markers, markers: Markers, initial: str, name: str) -> str:
    """Refuse a state that does not follow from the first by the motion of a body; return a note about stray markers."""
    before, after = first.aligned(markers.ids), markers.aligned(markers.ids)
    common = int((np.isfinite(before) & np.isfinite(after)).any(axis=1).sum())
    if common < FEWEST_COMMON:
        raise InputError(
            f"state {name!r} against {initial}: only {common} markers are in both tables, {FEWEST_COMMON} are needed; check their numbers"
        )
    axes = slice(0, 2 if np.isnan(before[:, 2] + after[:, 2]).all() else 3)  # markers seen in one plane have no z
    found = require_coherent(before[:, axes], after[:, axes], f"state {name!r} against {initial}")
    if not len(found.strays):
        return ""
    named = strays_named(markers.ids, found)
    if len(found.strays) > MOST_STRAYS * len(found.judged):
        raise InputError(
            f"state {name!r} against {initial}: {len(found.strays)} of {len(found.judged)} markers move unlike their neighbours "
            f"({named}); correct their numbers in one of the tables"
        )
    return f"{name}: marker {named} moved unlike its neighbours; check its number and its coordinates, or mark it as suspect"
