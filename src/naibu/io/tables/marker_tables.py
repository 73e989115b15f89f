"""Import marker tables of other programs, and write naibu's marker tables and experiment folders."""

from __future__ import annotations

import csv
import difflib
import io
import json
import math
import os
import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from naibu.core.arrays import require_lengths
from naibu.core.errors import InputError
from naibu.core.experiment import Axis, Layer, Loading, Shape
from naibu.core.markers import Markers
from naibu.io.experiment_folder.reader import META_FILE, read_experiment
from naibu.io.experiment_folder.state_csv import COORDINATES, OPTIONAL, REQUIRED, STATUSES, is_trusted
from naibu.io.files.atomic import write_atomically
from naibu.io.files.paths import require_usable_path
from naibu.io.files.reading import guarded_reading
from naibu.io.tables.table_cells import (
    HEADER_WITHIN,
    decimal_mark,
    excel_rows,
    guessed_columns,
    number,
    text_rows,
    unit_factor,
    within_reach,
)  # fmt: skip

HIGHEST = 2.0  # of the longest edge of the object, that a plate may stand high


def import_markers(
    path: str | os.PathLike[str],
    columns: Mapping[str, str] | None = None,
    *,
    unit: str | None = None,
    delimiter: str | None = None,
    sheet: str | None = None,
) -> Markers:
    """Read markers from a table written by another program.

    Parameters
    ----------
    path : path-like
        Text table separated by commas, semicolons or tabs (decimal commas are recognised), an Excel file (.xlsx), or points of 3D Slicer
        (.mrk.json, .fcsv), which are turned from RAS into LPS where the file states RAS.
        Lines above the header are skipped.
    columns : mapping, optional
        Column of each quantity, for example ``{"marker": "No.", "x_mm": "X [mm]", "y_mm": "Y [mm]", "z_mm": "Z [mm]"}``; ``"status"`` and
        ``"note"`` are optional, and ``"z_mm"`` is omitted for markers in one plane. By default the columns are recognised by their names.
    unit : str, optional
        Unit of the coordinates: mm, cm, m, um or inch. By default the unit in the column name (``x_cm``, ``X [cm]``), else mm.
    delimiter : str, optional
        Cell separator; by default a tab, a semicolon or a comma, whichever gives the first lines equal numbers of cells.
    sheet : str, optional
        Sheet of an Excel file; by default the active one.

    Returns
    -------
    Markers
        Positions, shape (n, 3), mm; NaN where a cell is blank.

    Raises
    ------
    InputError
        The file, a column, a unit or a cell cannot be used; the message names it and the correction.
    MissingDependencyError
        An Excel file, and openpyxl is not installed.
    """
    source = Path(path)
    with guarded_reading(source, "a table"):
        rows = excel_rows(source, sheet) if source.suffix.lower() == ".xlsx" else text_rows(source, delimiter)
    start, where = _located(source, rows, columns)
    header = rows[start][1]
    body = [(line, row + [""] * (len(header) - len(row))) for line, row in rows[start + 1 :]]
    if not body:
        raise InputError(f"{source}: no rows follow the header {', '.join(header)}; a table needs one row per marker")
    factors = {name: unit_factor(source, header[at], unit) for name, at in where.items() if name in COORDINATES}
    mark = decimal_mark(row[where[name]] for _, row in body for name in factors)
    prefix = _common_prefix([row[where["marker"]] for _, row in body])
    ids = [_label(f"{source}: line {line}, column {header[where['marker']]!r}", row[where["marker"]], prefix) for line, row in body]
    points = np.full((len(body), 3), math.nan)
    for name, factor in factors.items():
        cells = [(f"{source}: line {line}, column {header[where[name]]!r}", row[where[name]]) for line, row in body]
        values = [within_reach(number(place, cell, mark), factor, place) for place, cell in cells]
        # rounding removes the floating-point error of the conversion (1.1 cm would be 11.000000000000002 mm)
        points[:, COORDINATES.index(name)] = np.round(np.array(values) * factor, 9)
    trusted = [_trusted(source, line, row, where) for line, row in body]
    try:
        return Markers.from_arrays(ids, points, trusted)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error


def state_name(file_name: str) -> str:
    """Return the name of a state from that of a file, with ``_`` for spaces and other characters that it may not have."""
    return re.sub(r"[^\w.-]+", "_", file_name).strip("_") or "state"


def write_markers(path: str | os.PathLike[str], markers: Markers) -> Path:
    """Write markers as a table ``marker,x_mm,y_mm,z_mm,status,note``; the file is written atomically.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    # where no marker has a z coordinate, the markers lie in one plane and z is not missing
    dimensions = 2 if np.isnan(markers.points[:, 2]).all() else 3
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(REQUIRED + OPTIONAL)
    for marker, point, trusted in zip(markers.ids, markers.points, markers.trusted, strict=True):
        whole = bool(np.isfinite(point[:dimensions]).all())
        status = ("ok" if trusted else "suspect") if whole else "missing"
        note = "" if whole or trusted else "the coordinates given are suspect"
        writer.writerow([int(marker), *("NaN" if math.isnan(v) else f"{v:.12g}" for v in point), status, note])
    return write_atomically(path, stream.getvalue())


def write_experiment_folder(
    folder: str | os.PathLike[str],
    initial: Markers,
    states: Mapping[str, Markers],
    *,
    title: str,
    shape: Shape,
    loading: Loading,
    source: str = "",
    layers: Sequence[Layer] = (),
    joined_at_mm: Sequence[float] = (),
    stated_mm: Mapping[str, float] | None = None,
    up_axis: Axis = "z",
    spacing_mm: float | None = None,
    xy_step_mm: float | None = None,
    z_step_mm: float | None = None,
    xy_sd_mm: float | None = None,
    z_sd_mm: float | None = None,
    overwrite: bool = False,
) -> Path:
    """Write an experiment folder that `read_experiment` reads: `meta.toml` and one marker table per state.

    Parameters
    ----------
    folder : path-like
        Folder to create; it must not exist or be empty, unless `overwrite` is true.
    initial : Markers
        Reference configuration (unloaded).
    states : mapping of str to Markers
        The loaded states by name, in order.
    title, source : str
        What was measured, and the origin of the numbers.
    shape, loading, layers, joined_at_mm, up_axis
        As in `naibu.core.experiment.Experiment`.
    stated_mm : mapping of str to float, optional
        Height of the plate or bar above the base, or distance of the side plates, mm, by name of the state.
    spacing_mm, xy_step_mm, z_step_mm : float, optional
        Spacing of the marker lattice and resolution of the coordinates, mm.
    xy_sd_mm, z_sd_mm : float, optional
        Standard deviation of a coordinate along x and y, and along z, mm, where it is known; both or neither.
    overwrite : bool
        Whether a folder that is not empty may be used: files of the same names are replaced, others stay.

    Returns
    -------
    Path
        `folder`.

    Raises
    ------
    InputError
        The folder is not empty, or the arguments do not form a valid experiment; nothing is left behind then.
    """
    require_lengths(
        size_mm=shape.size_mm, bar_width_mm=loading.bar_width_mm, spacing_mm=spacing_mm, xy_step_mm=xy_step_mm, z_step_mm=z_step_mm
    )
    for name, step in (("xy_step_mm", xy_step_mm), ("z_step_mm", z_step_mm), ("spacing_mm", spacing_mm)):
        if step is not None and step > max(shape.size_mm):
            raise InputError(f"{name} is {step:g}, more than the object's {max(shape.size_mm):g} mm; check the number and its unit, mm")
    target = require_usable_path(folder, written=True)
    if target.exists() and (not target.is_dir() or (not overwrite and any(target.iterdir()))):
        raise InputError(f"folder {target} exists and is not empty; choose a new name, or allow it to be used with `overwrite`")
    key = "width_stated_mm" if loading.kind == "side_plates" else "height_stated_mm"
    heights = dict(stated_mm or {})
    for name in heights:
        if name not in states:
            raise InputError(
                f"stated_mm names the state {name!r}, but the loaded states are {', '.join(states) or 'none'}; correct the name"
            )
    for name, height in heights.items():
        if height > HIGHEST * max(shape.size_mm):
            raise InputError(
                f"stated_mm of the state {name!r} is {height:g}, and the object measures {max(shape.size_mm):g} mm; "
                "check the number and its unit, mm"
            )
    size: dict[str, object] = {"shape": shape.kind, "size_mm": list(shape.size_mm)}
    if shape.straight_base_mm is not None:
        size["straight_base_mm"] = shape.straight_base_mm
    text = _document(
        {"title": title, "source": source, "dimensions": 2 if np.isnan(initial.points[:, 2]).all() else 3, "units": "mm"},
        ("[coordinates]", {"up_axis": up_axis, "xy_step_mm": xy_step_mm, "z_step_mm": z_step_mm, "xy_sd_mm": xy_sd_mm, "z_sd_mm": z_sd_mm}),
        ("[object]", size | {"size_axes": ["x", "y", "z"], "joined_at_mm": list(joined_at_mm)}),
        ("[markers]", {"nominal_spacing_mm": spacing_mm}),
        *(("[[layer]]", _layer_table(la)) for la in layers),
        ("[loading]", _loading_table(loading)),
        ("[[state]]", {"name": "initial", "what": "no load", "file": "initial.csv"}),
        *(("[[state]]", {"name": name, "file": f"{name}.csv", key: heights.get(name)}) for name in states),
    )
    _place_checked(target, text, {"initial": initial, **states})
    return target


def _layer_table(layer: Layer) -> dict[str, object]:
    table: dict[str, object] = {"material": layer.material, "from_base_mm": [layer.from_base_mm, layer.to_base_mm]}
    return table | ({"batch": layer.batch} if layer.batch else {})


def _loading_table(loading: Loading) -> dict[str, object]:
    table: dict[str, object] = {"kind": loading.kind, "bar_width_mm": loading.bar_width_mm}
    if loading.kind in ("bar", "side_plates"):
        table["bar_axis"] = loading.bar_axis
    return table | {"counter_material": loading.counter_material, "base_material": loading.base_material}


def _document(top: Mapping[str, object], *tables: tuple[str, Mapping[str, object]]) -> str:
    """Return TOML text; keys whose value is None are omitted."""
    blocks = [("", top), *tables]
    # JSON strings, numbers and lists of these are valid TOML
    lines = ((head, [f"{k} = {json.dumps(v, ensure_ascii=False)}" for k, v in table.items() if v is not None]) for head, table in blocks)
    return "\n".join("\n".join([*([head] if head else []), *pairs, ""]) for head, pairs in lines)


def _place_checked(target: Path, meta: str, states: Mapping[str, Markers]) -> None:
    """Write into a temporary folder, read it back, and only then rename it."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name}."))
    except OSError as error:
        raise InputError(f"{target}: cannot be created ({error.strerror}); choose a folder you may write to") from error
    try:
        write_atomically(aside / META_FILE, meta)
        for name, markers in states.items():
            write_markers(aside / f"{name}.csv", markers)
        read_experiment(aside)
        aside.chmod(0o755)
        if target.is_dir() and any(target.iterdir()):
            for file in sorted(aside.iterdir()):
                file.replace(target / file.name)
        else:
            aside.replace(target)
    except InputError as error:
        raise InputError(str(error).replace(str(aside), str(target))) from error
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror}); choose another folder") from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _located(path: Path, rows: list[tuple[int, list[str]]], columns: Mapping[str, str] | None) -> tuple[int, dict[str, int]]:
    """Return the index of the header among `rows`, and the cell index of each of naibu's columns."""
    for name in columns or {}:
        if name not in REQUIRED + OPTIONAL:
            raise InputError(f"columns names {name!r}; use {', '.join(REQUIRED + OPTIONAL)}")
    wanted = REQUIRED if columns is None else ("marker", "x_mm", "y_mm", *columns)
    for at, (_, row) in enumerate(rows[:HEADER_WITHIN]):
        where = guessed_columns(path, row) if columns is None else {n: row.index(c) for n, c in columns.items() if c in row}
        if all(name in where for name in wanted):
            return at, where
    header = rows[0][1]
    if columns is None:
        raise InputError(_unrecognised(path, header))
    absent = next((n for n in wanted if n not in columns), None)
    if absent:
        raise InputError(f"columns does not name {absent!r}; add the column of {path} that contains it")
    lost = next((c for c in columns.values() if c not in header), next(iter(columns.values())))
    close = difflib.get_close_matches(lost, header, n=1)
    mend = f"did you mean {close[0]!r}?" if close else f"it has {', '.join(header)}"
    raise InputError(f"{path}: there is no column {lost!r}; {mend}")


def _unrecognised(path: Path, header: list[str]) -> str:
    """Which columns are missing, what to call them, and what else takes positions without numbers."""
    words = {"marker": "the marker's number", "x_mm": "x", "y_mm": "y", "z_mm": "z"}
    found = guessed_columns(path, header)
    lost = [name for name in REQUIRED if name not in found]
    where = f"{path}: cannot recognise the columns of {', '.join(words[name] for name in lost)} among {', '.join(header)}"
    unnumbered = "; tables without common numbers are for naibu track" if lost == ["marker"] else ""
    return f'{where}; call them {", ".join(lost)} (in Python columns={{"{lost[0]}": ...}} does){unnumbered}'


def _common_prefix(labels: Sequence[str]) -> str:
    """Return the letters before the number that all labels have in common (``M001``); empty where they differ, for the rest may, too."""
    before = {re.sub(r"\d+$", "", label) for label in labels}
    first = next(iter(before))
    return first if len(before) == 1 and len(labels) > 1 else ""


def _label(where: str, text: str, prefix: str) -> int:
    # spreadsheets store whole numbers as 1.0
    found = re.fullmatch(r"(\d{1,18})(?:[.,]0*)?", text.removeprefix(prefix))
    if not found:
        raise InputError(
            f"{where} = {text!r} is not a whole number; every row needs its marker's number, alone or after the same letters in all rows"
        )
    return int(found[1])


def _trusted(path: Path, line: int, row: list[str], where: Mapping[str, int]) -> bool:
    status = row[where["status"]].lower() if "status" in where else ""
    if status and status not in STATUSES:
        raise InputError(f"{path}: line {line} has the status {status!r}; use {', '.join(STATUSES)}, or name the columns without status")
    return is_trusted(status, row[where["note"]] if "note" in where else "")
