"""The marker table of one state: ``marker,x_mm,y_mm,z_mm[,status,note]``."""

from __future__ import annotations

import csv
import difflib
import io
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from naibu.core.errors import InputError
from naibu.core.markers import Markers

COORDINATES = ("x_mm", "y_mm", "z_mm")
REQUIRED = ("marker", *COORDINATES)
OPTIONAL = ("status", "note")
STATUSES = ("ok", "repaired", "renumbered", "suspect", "missing")
_MAX_ID = 2**63 - 1


@dataclass(frozen=True, slots=True)
class _Row:
    """One line of the file, checked."""

    line: int
    marker: int
    xyz: tuple[float, float, float]
    trusted: bool


def parse_state_csv(path: Path, content: bytes, dimensions: int) -> Markers:
    """Parse and check the marker table of one state.

    Parameters
    ----------
    path : Path
        File of the table, only used in messages.
    content : bytes
        UTF-8 text. A blank coordinate or ``NaN`` is missing. A blank status means ``ok`` or, where a coordinate is missing, ``missing``.
    dimensions : int
        2 when z is not measured (and NaN throughout), else 3.

    Returns
    -------
    Markers
        Positions, shape (n, 3), mm; NaN where missing.

    Raises
    ------
    InputError
        A wrong header, row, label, number or status, or no position at all; the message names line, marker, value and correction.
    """
    lines = _numbered_lines(path, content)
    if not lines:
        raise InputError(f"{path}: the file is empty; its first line must be {','.join(REQUIRED)},status,note")
    header = _checked_header(path, lines[0][1])
    rows = [_row(path, line, dict(zip(header, _cells(path, line, header, row), strict=True)), dimensions) for line, row in lines[1:]]
    _refuse_duplicates(path, rows)
    points = np.array([row.xyz for row in rows], dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points[:, :dimensions]).all(axis=1).any():
        raise InputError(f"{path}: no marker has all its coordinates; fill them in, or set held_out = true and remove the file")
    return Markers.from_arrays([row.marker for row in rows], points, [row.trusted for row in rows])


def _numbered_lines(path: Path, content: bytes) -> list[tuple[int, list[str]]]:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start} is not UTF-8 text; save the table as UTF-8") from error
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        return [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"{path}: line {reader.line_num} is not readable CSV ({error}); look for an unclosed quotation mark") from error


def _checked_header(path: Path, cells: list[str]) -> list[str]:
    header = [cell.strip() for cell in cells]
    if len(header) == 1 and re.search(r"[;\t]", header[0]):
        raise InputError(f"{path}: the header {header[0]!r} has no commas; convert the table with `naibu import`")
    for name in header:
        _refuse_wrong_unit(path, name)
    for name in REQUIRED:
        if name not in header:
            raise InputError(f"{path}: column {name!r} is missing from {', '.join(header)}; write {','.join(REQUIRED)},status,note")
    for name in header:
        if name not in REQUIRED + OPTIONAL:
            close = difflib.get_close_matches(name, REQUIRED + OPTIONAL, n=1)
            mend = f"did you mean {close[0]!r}?" if close else f"remove it; known columns are {', '.join(REQUIRED + OPTIONAL)}"
            raise InputError(f"{path}: unknown column {name!r}; {mend}")
        if header.count(name) > 1:
            raise InputError(f"{path}: column {name!r} appears {header.count(name)} times; keep one")
    return header


def _refuse_wrong_unit(path: Path, name: str) -> None:
    found = re.fullmatch(r"([xyz])(?:[ _\[(]*(\w*?)[\])]*)", name, re.IGNORECASE)
    if not found or name in COORDINATES:
        return
    right = f"{found[1].lower()}_mm"
    if found[2].lower() in ("", "mm"):
        raise InputError(f"{path}: column {name!r} must be called {right!r}; rename it if its values are millimetres")
    raise InputError(f"{path}: column {name!r} is not in mm; convert it and call it {right!r} (`naibu import` does both)")


def _cells(path: Path, line: int, header: list[str], row: list[str]) -> list[str]:
    # a row may end after its last filled cell, as spreadsheets write it, but never before the coordinates
    needed = 1 + max(header.index(name) for name in REQUIRED)
    if not needed <= len(row) <= len(header):
        raise InputError(f"{path}: line {line} has {len(row)} cells, the header {len(header)}: {','.join(row)!r}; check the commas")
    return [cell.strip() for cell in row] + [""] * (len(header) - len(row))


def _row(path: Path, line: int, cells: dict[str, str], dimensions: int) -> _Row:
    marker = _label(path, line, cells["marker"])
    where = f"{path}: line {line}, marker {marker}"
    xyz = (_coordinate(where, cells, "x_mm"), _coordinate(where, cells, "y_mm"), _coordinate(where, cells, "z_mm"))
    absent = [name for name, value in zip(COORDINATES[:dimensions], xyz, strict=False) if math.isnan(value)]
    if dimensions == 2 and not math.isnan(xyz[2]):
        raise InputError(f"{where}: z_mm = {cells['z_mm']}, but meta.toml says dimensions = 2; write NaN, or dimensions = 3 in meta.toml")
    status = cells.get("status", "") or ("missing" if absent else "ok")
    if status not in STATUSES:
        close = difflib.get_close_matches(status.lower(), STATUSES, n=1)
        raise InputError(f"{where}: unknown status {status!r}; {f'did you mean {close[0]!r}?' if close else 'use ' + ', '.join(STATUSES)}")
    if absent and status in ("ok", "repaired", "renumbered"):
        raise InputError(f"{where}: {absent[0]} is NaN in a row with status {status!r}; give the number, or set status to missing")
    if status == "missing" and not absent:
        raise InputError(f"{where}: status is 'missing', but no coordinate is; set status to ok or suspect, or write NaN")
    return _Row(line, marker, xyz, is_trusted(status, cells.get("note", "")))


def is_trusted(status: str, note: str) -> bool:
    """Whether the coordinates of a row can be trusted: those of an incomplete row can, unless its note calls them suspect."""
    return status != "suspect" and not (status == "missing" and "suspect" in note.lower())


def _label(path: Path, line: int, text: str) -> int:
    if not re.fullmatch(r"[+-]?\d+", text) or abs(int(text)) > _MAX_ID:
        raise InputError(f"{path}: line {line}: marker = {text!r} is not a whole number; every row needs its marker's number")
    return int(text)


def _coordinate(where: str, cells: dict[str, str], name: str) -> float:
    text = cells[name]
    if text == "" or text.lower() == "nan":
        return math.nan
    try:
        # float() accepts 1_000, which is not a number in a table of measurements
        value = float(text) if "_" not in text else None
    except ValueError:
        value = None
    if value is None:
        comma = "write the decimal point as '.'" if re.fullmatch(r"[+-]?\d*,\d+", text) else "write a number, or NaN with status missing"
        raise InputError(f"{where}: {name} = {text!r} is not a number; {comma}")
    if math.isinf(value):
        raise InputError(f"{where}: {name} = {text!r} is infinite; write NaN and set status to missing")
    return value


def _refuse_duplicates(path: Path, rows: list[_Row]) -> None:
    seen: dict[int, int] = {}
    for row in rows:
        if row.marker in seen:
            raise InputError(f"{path}: marker {row.marker} is in lines {seen[row.marker]} and {row.line}; keep one of them")
        seen[row.marker] = row.line
