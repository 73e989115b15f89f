"""Cells of tables of other programs: text or Excel, columns recognised by their names, units, decimal marks."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable
from pathlib import Path

from naibu.core.arrays import LENGTHS_MM
from naibu.core.errors import InputError, MissingDependencyError
from naibu.io.files.reading import read_bytes, require_regular
from naibu.io.tables import slicer_markups

MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "in": 25.4, "inch": 25.4}
_UNIT = re.compile(r"(?:[\s_,/]+|[\s_]*[\[(]\s*)(mm|cm|m|um|µm|μm|inch|in)\s*[\])]?$", re.IGNORECASE)
_PLACE = r"(?:pos(?:ition)?|coord(?:inate)?|centroid|cent(?:er|re))?"
_NAMES = {
    "marker": re.compile(r"(?=.)(?:marker|point|bead|particle|track)?[\s_]*(?:no\.?|nr\.?|number|id|label|index|#)?", re.IGNORECASE),
    **{f"{a}_mm": re.compile(rf"{_PLACE}[\s_.-]*{a}[\s_.-]*{_PLACE}", re.IGNORECASE) for a in "xyz"},
    "status": re.compile("status"),
    "note": re.compile("note"),
}
ABSENT = ("", "nan", "na", "n/a", "-", "--", "none", "null")
HEADER_WITHIN = 20


def text_rows(path: Path, delimiter: str | None) -> list[tuple[int, list[str]]]:
    """Return the lines of a text table with their numbers, blank ones left out; by default the delimiter is found.

    Points that were marked in 3D Slicer are rows in LPS, whatever frame the file states.
    """
    content = read_bytes(path)
    if b"\0" in content[:4096] and not content.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{path}: is not a text table; save it as CSV, or as .xlsx")
    text = _decoded(path, content)
    if slicer_markups.is_markups(path, text):
        return slicer_markups.rows_of(path, text)
    if delimiter is not None and len(delimiter) != 1:
        raise InputError(f"delimiter = {delimiter!r} must be one character, for example ';'")
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter or _delimiter(text))
    try:
        return _filled(path, ((reader.line_num, row) for row in reader))
    except csv.Error as error:
        raise InputError(f"{path}: line {reader.line_num} is not readable ({error}); look for an unclosed quotation mark") from error


def _delimiter(text: str) -> str:
    """Return the separator that gives most of the first lines the same number of cells; of equals, the one rarer within cells."""
    lines = text.splitlines()[:HEADER_WITHIN]

    def agreement(mark: str) -> int:
        counts = [len(row) for row in csv.reader(lines, delimiter=mark)]
        return max((counts.count(n) for n in set(counts) if n > 1), default=0)

    return max("\t;,", key=agreement)


def _decoded(path: Path, content: bytes) -> str:
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        try:
            return content.decode("utf-16")
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: byte {error.start} is not UTF-16 text; the file was truncated, or save it as UTF-8") from error
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        # older Western spreadsheets; only column names and notes can contain such letters
        return content.decode("latin-1")


def excel_rows(path: Path, sheet: str | None) -> list[tuple[int, list[str]]]:
    """Return the rows of a sheet of an Excel file with their numbers, blank ones left out."""
    try:
        import openpyxl
    except ImportError as error:
        raise MissingDependencyError(f'{path}: reading Excel files needs openpyxl; run: pip install "naibu[excel]"') from error
    require_regular(path)
    try:
        book = openpyxl.load_workbook(path, read_only=True, data_only=True)
    # openpyxl's zip and XML readers raise exceptions of many types
    except Exception as error:
        raise InputError(
            f"{path}: cannot be read as .xlsx ({error}); open it in a spreadsheet program and save it again, or as CSV"
        ) from error
    try:
        if sheet is not None and sheet not in book.sheetnames:
            raise InputError(f"{path}: there is no sheet {sheet!r}; it has {', '.join(book.sheetnames)}")
        page = book[sheet] if sheet is not None else book.active
        cells = ((n, ["" if v is None else str(v) for v in row]) for n, row in enumerate(page.iter_rows(values_only=True), start=1))
        return _filled(path, cells)
    finally:
        book.close()


def _filled(path: Path, rows: Iterable[tuple[int, list[str]]]) -> list[tuple[int, list[str]]]:
    kept = [(line, [cell.strip() for cell in row]) for line, row in rows if any(cell.strip() for cell in row)]
    if not kept:
        raise InputError(f"{path}: the table is empty; it needs a header and one row per marker")
    return kept


def guessed_columns(path: Path, header: list[str]) -> dict[str, int]:
    """Return the index of each of the columns of a marker table that a header names."""
    found: dict[str, int] = {}
    for at, cell in enumerate(header):
        plain = _UNIT.sub("", cell).strip()
        for name, pattern in _NAMES.items():
            if not pattern.fullmatch(cell if name == "marker" else plain):
                continue
            if name in found:
                raise InputError(
                    f"{path}: both {header[found[name]]!r} and {cell!r} may be {name!r}; say which: columns={{{name!r}: {cell!r}, ...}}"
                )
            found[name] = at
    return found


def without_unit(column: str) -> str:
    """Return the name of a column without its unit."""
    return _UNIT.sub("", column)


def unit_factor(path: Path, column: str, unit: str | None) -> float:
    """Return the length of the unit of a column, mm: the one in its name, else `unit`, else 1."""
    found = _UNIT.search(column)
    named = found[1].lower() if found else None
    if unit is not None and unit not in MM_PER_UNIT:
        raise InputError(f"unit = {unit!r} is not known; use one of {', '.join(dict.fromkeys(MM_PER_UNIT))}")
    if unit and named and MM_PER_UNIT[unit] != MM_PER_UNIT[named]:
        raise InputError(f"{path}: column {column!r} says {named}, but unit = {unit!r}; leave unit out, or correct the column's name")
    return MM_PER_UNIT[unit or named or "mm"]


def decimal_mark(cells: Iterable[str]) -> str:
    """Return the decimal mark: a comma where commas occur and points occur only as thousands separators."""
    seen = [c for c in cells if "," in c or "." in c]
    return "," if any("," in c for c in seen) and all(c.rfind(",") > c.rfind(".") for c in seen) else "."


def number(where: str, text: str, mark: str) -> float:
    """Return the number in a cell; NaN where it is blank."""
    if text.lower() in ABSENT:
        return math.nan
    # typographic minus sign, and spaces between thousands
    plain = re.sub(r"[\s\u00a0\u202f]", "", text).replace("\u2212", "-")
    other = "." if mark == "," else ","
    if re.fullmatch(rf"[+-]?\d{{1,3}}(\{other}\d{{3}})+(\{mark}\d*)?", plain):
        plain = plain.replace(other, "")
    plain = plain.replace(mark, ".")
    if not re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", plain):
        raise InputError(f"{where} = {text!r} is not a number (the table's decimal mark is {mark!r}); correct it, or leave the cell blank")
    return float(plain)


def within_reach(value: float, factor: float, where: str) -> float:
    """Return a coordinate that a scanner can hold; `factor` is the length of its unit, mm."""
    if abs(value) * factor > LENGTHS_MM[1]:
        raise InputError(f"{where} = {value:g} is more than {LENGTHS_MM[1] / factor:g}: no object is so large; correct it, or the unit")
    return value
