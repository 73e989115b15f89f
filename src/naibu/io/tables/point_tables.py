"""Tables of points with displacements and standard deviations where they have them; columns are recognised by their names."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.io.tables.stated_units import in_pixels, with_short_units, with_stated_units
from naibu.io.tables.table_cells import HEADER_WITHIN, decimal_mark, excel_rows, number, text_rows, unit_factor, without_unit

TEXT, EXCEL = (".csv", ".tsv", ".txt"), (".xlsx",)
_PLACE = r"(?:pos(?:ition)?|coor(?:d(?:inate)?s?)?|centroid|cent(?:er|re)|points?|location)?"
_DISPLACEMENT = r"disp(?:l|lacement)?s?"
_MOVED = rf"(?:{_DISPLACEMENT}|delta|(?:directional\s)?deformation|u|d|v)"
_SD = r"(?:sd|std|std[\s_.]?dev|stdev|std[\s_.]?err|sigma|se|err(?:or)?|uncertainty|standard[\s_](?:deviation|error))"
_GAP = r"[\s_.:-]*"


def _patterns(number: int, axis: str, component: str) -> dict[str, re.Pattern[str]]:
    # ParaView counts components from 0 (Points:0, displacement_0), Abaqus from 1 (COORD1, U1, U-U1)
    texts = {
        "points": rf"{_PLACE}{_GAP}{axis}{_GAP}{_PLACE}|points?[:_]{number}|coord?{number + 1}",
        "vectors": rf"{component}|{_MOVED}{_GAP}{axis}|{axis}{_GAP}{_DISPLACEMENT}|{_DISPLACEMENT}{_GAP}{component}"
        rf"|(?:{_DISPLACEMENT}|u)[:_]{number}|(?:u{_GAP})?u{number + 1}",
        "sd": rf"{_SD}{_GAP}{_MOVED}?{_GAP}(?:{axis}|(?<=[\s_.:-]){component})|(?:{_MOVED}?{_GAP}{axis}|{component}){_GAP}{_SD}",
    }
    return {name: re.compile(text, re.IGNORECASE) for name, text in texts.items()}


_ONE_SD = re.compile(rf"(?:sd|uncertainty)(?:{_GAP}(?:u|{_DISPLACEMENT}))?", re.IGNORECASE)  # of each component
# columns that say which points were measured: SPAM's (2: converged), DaVis's
_STATUS: tuple[tuple[re.Pattern[str], Callable[[FloatArray], BoolArray]], ...] = (
    (re.compile(r"returnStatus|(?:SubPix)?ReturnStat", re.IGNORECASE), lambda status: status == 2),
    (re.compile(r"is[\s_]?valid", re.IGNORECASE), lambda status: status > 0.5),
)
_MASK = re.compile(r"mask(?:ed)?", re.IGNORECASE)
COLUMNS = {axis: _patterns(k, axis, component) for k, (axis, component) in enumerate(zip("xyz", "uvw", strict=True))}


@dataclass(frozen=True, slots=True, eq=False)
class PointTable:
    """Positions (n, d), displacements (n, d), standard deviations (n, d), mm, and which points were measured (n,).

    None where the table has no such columns; NaN for blank cells.
    `in_voxels` says that lengths are in voxels, as SPAM writes them and TrackMate may.
    """

    points: FloatArray
    vectors: FloatArray | None
    sd: FloatArray | None
    valid: BoolArray | None = None
    in_voxels: bool = False


def read_point_table(path: Path, *, unit: str | None = None, displacements: bool = True) -> PointTable:
    """Read a table of points in two or three dimensions.

    Parameters
    ----------
    path : Path
        ``.csv``, ``.tsv``, ``.txt`` or ``.xlsx``. Columns of position, displacement and standard deviation are recognised by their
        names, in any order; two or three columns of numbers without names are x, y and z.
    unit : str, optional
        Unit of lengths: mm, cm, m, um or inch. By default the unit in the column name, in a row below the names (TrackMate) or in a column
        of units (Imaris), else mm.
    displacements : bool
        Whether to read them; otherwise columns that look like them are passed over.

    Raises
    ------
    InputError
        A table without positions, a column that two names fit, or a cell that is no number.
    """
    rows = excel_rows(path, None) if path.suffix.lower() in EXCEL else text_rows(path, None)
    if _is_numeric(rows[0][1]):
        columns = len(rows[0][1])
        if columns not in (2, 3):
            names = "x_mm, y_mm, z_mm" + displacements * ", ux_mm, uy_mm, uz_mm"
            raise InputError(f"{path}: has no names of columns, and {columns} of them; name them in the first line: {names}")
        rows = [(0, list("xyz"[:columns])), *rows]
    rows[:HEADER_WITHIN] = [(line, [with_short_units(cell) for cell in row]) for line, row in rows[:HEADER_WITHIN]]
    start, where = _header(path, rows)
    header, body = with_stated_units(path, rows[start][1], rows[start + 1 :], where["points"])
    where["vectors"] = where["vectors"] if displacements else []
    if not body:
        raise InputError(f"{path}: no rows follow the header {', '.join(header)}")
    return assembled(path, header, where, lambda at, unit: _column(path, header, body, at, unit), unit)


def assembled(
    path: Path, names: list[str], where: dict[str, list[int]], column: Callable[[int, str | None], FloatArray], unit: str | None
) -> PointTable:
    """Return a table of points from its columns.

    Parameters
    ----------
    path : Path
        The file, for messages.
    names : list of str
        Names of the columns.
    where : dict
        From `columns_of`.
    column : callable
        Returns the column of an index, in mm for a unit, or as it stands for None.
    unit : str, optional
        Unit of lengths where the names state none.

    Raises
    ------
    InputError
        Columns for some of the coordinates only.
    """
    d = len(where["points"])
    parts = {}
    for name, some in where.items():
        if len(some) not in (0, d):
            raise InputError(f"{path}: has {d} coordinates, but {len(some)} columns of {_WORDS[name]}; give one for each coordinate")
        parts[name] = np.column_stack([column(c, unit) for c in some]) if some else None
    status = next(((at, test) for at, name in enumerate(names) for pattern, test in _STATUS if pattern.fullmatch(name.strip())), None)
    valid = None if status is None else np.asarray(status[1](column(status[0], None)))
    if valid is None and parts["vectors"] is not None:
        valid = _unmasked(path, names, parts["vectors"], lambda at: column(at, None))
    points = parts["points"]
    assert points is not None
    in_voxels = {"zpos", "zdisp"} <= {name.strip().lower() for name in names} or any(in_pixels(names[at]) for at in where["points"])
    return PointTable(points, parts["vectors"], parts["sd"], valid, in_voxels)


def _unmasked(path: Path, names: list[str], vectors: FloatArray, column: Callable[[int], FloatArray]) -> BoolArray | None:
    """Return which points a column "mask" leaves (n,).

    Some programs mark what is masked, some what is left; they write zeros or blanks where nothing was measured.

    Raises
    ------
    InputError
        The displacements do not tell which of its values is which.
    """
    at = next((k for k, name in enumerate(names) if _MASK.fullmatch(_plain(name))), None)
    if at is None or len(values := np.unique(column(at))) == 1:
        return None
    nothing = ~np.isfinite(vectors).all(axis=1) | (vectors == 0.0).all(axis=1)
    empty = [value for value in values if nothing[column(at) == value].all()]
    if len(values) != 2 or len(empty) != 1:
        raise InputError(
            f"{path}: the column {names[at]!r} does not tell which points were measured: none of its values stands only where "
            "displacements are 0 or missing; name it isValid, 1 where a point was measured and 0 elsewhere"
        )
    return np.asarray(column(at) != empty[0])


_WORDS = {"points": "positions", "vectors": "displacements", "sd": "standard deviations"}


def columns_of(names: list[str], what: str) -> dict[str, list[int]]:
    """Return the columns of positions, displacements and standard deviations, along x, y and z, among names of columns.

    Parameters
    ----------
    names : list of str
        Names of the columns.
    what : str
        The file, for messages.

    Raises
    ------
    InputError
        Two columns may be the same quantity.
    """
    found: dict[str, list[int]] = {name: [] for name in _WORDS}
    for name, columns in found.items():
        for axis, patterns in COLUMNS.items():
            fitting = [at for at, cell in enumerate(names) if patterns[name].fullmatch(_plain(cell))]
            if len(fitting) > 1:
                both = " and ".join(repr(names[at]) for at in fitting[:2])
                raise InputError(f"{what}: both {both} may be the {axis} of {_WORDS[name]}; rename one of them")
            columns += fitting
    if found["vectors"] and not found["sd"]:
        single = [at for at, cell in enumerate(names) if _ONE_SD.fullmatch(_plain(cell))]
        found["sd"] = single * len(found["points"]) if len(single) == 1 else []
    return found


def _plain(name: str) -> str:
    """Return the name of a column without its unit, and without the mark of a comment before the first one."""
    return without_unit(name).strip().lstrip("%#").strip()


def _header(path: Path, rows: list[tuple[int, list[str]]]) -> tuple[int, dict[str, list[int]]]:
    for at, (_, row) in enumerate(rows[:HEADER_WITHIN]):
        where = columns_of(row, str(path))
        if len(where["points"]) in (2, 3):
            return at, where
    raise InputError(f"{path}: cannot recognise the columns of x, y and z among {', '.join(rows[0][1])[:200]}; name them x_mm, y_mm, z_mm")


def _is_numeric(cells: list[str]) -> bool:
    try:
        [float(cell) for cell in cells]
    except ValueError:
        return False
    return True


def _column(path: Path, header: list[str], body: list[tuple[int, list[str]]], at: int, unit: str | None) -> FloatArray:
    """Return a column in mm."""
    cells = [row[at] if at < len(row) else "" for _, row in body]
    try:
        values = np.array(cells, dtype=float)
    except ValueError:
        mark = decimal_mark(cells)
        values = np.array(
            [number(f"{path}: line {line}, column {header[at]!r}", cell, mark) for (line, _), cell in zip(body, cells, strict=True)]
        )
    if np.isinf(values).any():
        line = body[int(np.flatnonzero(np.isinf(values))[0])][0]
        raise InputError(f"{path}: line {line}, column {header[at]!r} is not finite; correct it, or leave the cell blank")
    return np.asarray(values * unit_factor(path, header[at], unit))
