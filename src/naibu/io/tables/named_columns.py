"""Read tables of numbers by the names of their columns, with units: records of cameras and sensors."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.io.files.reading import read_bytes

MOST_ROWS = 5_000_000
_UNIT = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*)[\])]$")
_SHOWN = 40  # letters of a cell in a message
_DECIMAL_COMMA = re.compile(r"^(\s*[+-]?\d*),(\d+(?:[eE][+-]?\d+)?\s*)$")  # of a cell of a spreadsheet that separates cells otherwise


@dataclass(frozen=True, slots=True)
class ColumnKind:
    """What a column may be called, and the units that it may have.

    Attributes
    ----------
    names : tuple of str
        Its names, in small letters; the first is the one that messages state.
    units : mapping
        Factors of units to that of the numbers that are returned, by the unit's name in small letters.
    needed : bool
        Whether a table without it is refused.
    """

    names: tuple[str, ...]
    units: Mapping[str, float]
    needed: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class NamedColumns:
    """Numbers of a table by column, and one column of labels.

    Attributes
    ----------
    numbers : dict
        Arrays (rows,) by the key of their kind.
    labels : tuple of str, or None
        Of every row; None where no column holds them.
    """

    numbers: dict[str, FloatArray]
    labels: tuple[str, ...] | None


def read_named_columns(path: Path, kinds: Mapping[str, ColumnKind], labels: tuple[str, ...] = ()) -> NamedColumns:
    """Read the columns that are known by name.

    Parameters
    ----------
    path : Path
        Text with a row of names, such as ``time_s,fx_N,fy_N,fz_N`` or ``Time (ms);Fx [N];Fy [N];Fz [N]``, separated by commas, or by
        semicolons or tabs with decimal points or commas. Rows that begin with ``#`` are passed over, as are columns of other names.
    kinds : mapping
        What is looked for.
    labels : tuple of str
        Names of the column of labels, where one may be there.

    Raises
    ------
    InputError
        Not a readable text, no row of names, a column that is missing, twice there or of an unknown unit, a row that is too short, or a
        cell that is no finite number. The message names the file, the row and the column.
    """
    rows = _rows(path)
    if len(rows) < 2:
        raise InputError(f"{path}: has {len(rows)} line{'s' * (len(rows) != 1)}; it needs a row of names and rows of numbers")
    header = [cell.strip() for cell in rows[0][1]]
    found = {key: _located(path, header, kind) for key, kind in kinds.items()}
    missing = [kind.names[0] for key, kind in kinds.items() if kind.needed and found[key] is None]
    if missing:
        raise InputError(f"{path}: has no column {', '.join(missing)}; its first row must name them, and is {', '.join(header)[:200]!r}")
    numbers = {key: _column(path, rows[1:], header, place) for key, place in found.items() if place is not None}
    named = next((k for k, name in enumerate(header) if name.lower() in labels), None)
    told = None if named is None else tuple(cells[named].strip() if named < len(cells) else "" for _, cells in rows[1:])
    return NamedColumns(numbers, told)


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text ({error.reason} at byte {error.start}); save the table as CSV in UTF-8") from error
    first = next((line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
    mark = max(",;\t", key=first.count)
    try:
        rows = [
            (number, cells if mark == "," else [_DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in cells])
            for number, cells in enumerate(csv.reader(StringIO(text), delimiter=mark), start=1)
            if any(cell.strip() for cell in cells) and not cells[0].lstrip().startswith("#")
        ]
    except csv.Error as error:
        raise InputError(f"{path}: is no table of separated values ({error}); save it as CSV") from error
    if len(rows) > MOST_ROWS:
        raise InputError(f"{path}: has more than {MOST_ROWS} rows; keep every tenth or so")
    return rows


def _located(path: Path, header: list[str], kind: ColumnKind) -> tuple[int, float] | None:
    """Return the number of a column and the factor of its unit."""
    places = [(k, unit) for k, cell in enumerate(header) if (unit := _unit_of(cell, kind)) is not None]
    if not places:
        return None
    if len(places) > 1:
        raise InputError(f"{path}: columns {header[places[0][0]]!r} and {header[places[1][0]]!r} are both {kind.names[0]}; keep one")
    column, unit = places[0]
    if unit not in kind.units:
        told = ", ".join(name for name in kind.units if name)
        raise InputError(f"{path}: column {header[column]!r} is in {unit!r}; known units are {told}: convert it, and name the unit")
    return column, kind.units[unit]


def _unit_of(cell: str, kind: ColumnKind) -> str | None:
    """Return the unit in a column's name, empty where none is stated; None where the column is another."""
    name, unit = cell.lower(), ""
    if match := _UNIT.match(name):
        name, unit = match["name"].strip(), match["unit"].strip()
    if name in kind.names:
        return unit
    stem, separator, rest = name.partition("_")
    return rest if separator and stem in kind.names and not unit else None


def _column(path: Path, rows: list[tuple[int, list[str]]], header: list[str], place: tuple[int, float]) -> FloatArray:
    column, factor = place
    values = np.empty(len(rows))
    for k, (line, cells) in enumerate(rows):
        text = cells[column].strip() if column < len(cells) else ""
        try:
            values[k] = float(text)
        except ValueError:
            values[k] = np.nan
        if not np.isfinite(values[k]):
            raise InputError(
                f"{path}: row {line} has {text[:_SHOWN]!r} in the column {header[column]!r}, where a number belongs; "
                "leave out rows without one"
            )
    return factor * values
