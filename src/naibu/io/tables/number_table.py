"""Read tables of numbers without labels: paths of tools, and records over time."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Sequence
from io import StringIO
from pathlib import Path

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.io.files.reading import read_bytes

MOST_ROWS = 100_000


def read_numbers(path: str | os.PathLike[str], columns: Sequence[str], *, units: Sequence[str] | None = None) -> FloatArray:
    """Read a table of numbers with given columns.

    Parameters
    ----------
    path : path-like
        Rows of numbers. Rows that begin with ``#``, and a first row of names, are passed over.
    columns : sequence of str
        What the columns hold, for messages.
    units : sequence of str, optional
        Of the columns, such as ``V``: names of columns must not tell others, as ``F_z_mV`` or ``F_z (mV)`` do.

    Returns
    -------
    ndarray, shape (r, c)
        The numbers.

    Raises
    ------
    InputError
        Not a readable text, a cell that is no finite number, no rows, another number of columns, or a name that tells another unit.
    """
    rows = read_number_rows(path)
    if units is not None:
        _require_units(Path(path), units)
    if len(rows) == 0 or rows.shape[1] != len(columns):
        raise InputError(f"{path}: has {len(rows)} rows of {rows.shape[1]} numbers; it needs rows of {len(columns)}: {'; '.join(columns)}")
    return rows


def read_number_rows(path: str | os.PathLike[str]) -> FloatArray:
    """Read rows of numbers.

    Parameters
    ----------
    path : path-like
        Separated by commas, or by semicolons or tabs with a decimal comma or point; rows that begin with ``#``, and a first row of names,
        are passed over.

    Returns
    -------
    ndarray, shape (r, c)
        The numbers; (0, 0) where there are none.

    Raises
    ------
    InputError
        Not a readable text, a cell that is no finite number, or rows of different length.
    """
    file = Path(path)
    try:
        text = read_bytes(file).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: is not UTF-8 text ({error.reason} at byte {error.start}); save the table as CSV in UTF-8") from error
    rows: list[list[float]] = []
    separator = _separator(text)
    try:
        for line, written in enumerate(csv.reader(StringIO(text), delimiter=separator), start=1):
            cells = written if separator == "," else [cell.replace(",", ".") for cell in written]
            if not any(cell.strip() for cell in cells) or cells[0].lstrip().startswith("#") or (not rows and _names(cells)):
                continue
            rows.append([_number(file, line, cell) for cell in cells])
            if len(rows[-1]) != len(rows[0]):
                raise InputError(f"{file}: row {line} has {len(rows[-1])} numbers, the first has {len(rows[0])}; give each row the same")
            if len(rows) > MOST_ROWS:
                raise InputError(f"{file}: has more than {MOST_ROWS} rows; keep every tenth or so")
    except csv.Error as error:
        raise InputError(f"{file}: is no table of comma-separated values ({error}); save it as CSV") from error
    return np.array(rows).reshape(len(rows), -1 if rows else 0)


def _require_units(file: Path, units: Sequence[str]) -> None:
    text = read_bytes(file).decode("utf-8-sig")
    names = next(csv.reader(StringIO(text), delimiter=_separator(text)), [])
    for name, unit in zip(names, units, strict=False):
        others = "|min|h" if unit == "s" else ""
        told = re.search(rf"(?:^|[_\W])([a-zA-Zµμ]?{re.escape(unit)}{others})\W*$", name)
        if told is not None and told[1] != unit:
            raise InputError(f"{file}: column {name.strip()[:40]!r} is in {told[1]}; convert it to {unit}, and name it so")


def _separator(text: str) -> str:
    """What separates the cells of a table: a tab or semicolon where its first row has one, as spreadsheets write beside decimal commas."""
    first = next((line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
    return next((mark for mark in "\t;" if mark in first), ",")


def _names(cells: list[str]) -> bool:
    """Whether a row names columns: none of its cells is a number."""

    def is_number(cell: str) -> bool:
        try:
            float(cell)
        except ValueError:
            return False
        return True

    return not any(is_number(cell) for cell in cells)


def _number(file: Path, line: int, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"{file}: row {line} has {cell.strip()[:40]!r} where a number belongs")
    return value
