"""Read the path of a blade or of a tool's tip: a table with one pose a row, and x, y, z of the vertices of its edge in the columns."""

from __future__ import annotations

import csv
import os
from io import StringIO
from pathlib import Path

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.io.files.reading import read_bytes

MOST_ROWS = 100_000


def read_blade_path(path: str | os.PathLike[str]) -> FloatArray:
    """Read the path of a blade, from a table of comma-separated numbers.

    Parameters
    ----------
    path : path-like
        Each row is a pose: x, y and z, mm, of the first vertex of the edge, then of the second, and so on. Rows that begin with ``#``,
        and a first row of names, are passed over.

    Returns
    -------
    ndarray, shape (p, e, 3)
        Vertices of the edge in every pose, mm.

    Raises
    ------
    InputError
        Not a readable text, a cell that is no finite number, rows of different length, fewer than two poses or two vertices.
    """
    rows = _rows(path)
    if len(rows) < 2 or rows.shape[1] < 6 or rows.shape[1] % 3:
        tip = "; one vertex is the path of a tip, which cuts surfaces, not solids" if rows.shape[1] == 3 else ""
        raise InputError(
            f"{path}: has {_size(rows)}; a path needs at least two poses, each with x, y, z of at least two vertices of the edge{tip}"
        )
    return rows.reshape(len(rows), -1, 3)


def read_tip_path(path: str | os.PathLike[str]) -> FloatArray:
    """Read the path of a tool's tip, from a table of comma-separated numbers.

    Parameters
    ----------
    path : path-like
        Each row has x, y and z of the tip, mm. Rows that begin with ``#``, and a first row of names, are passed over.

    Returns
    -------
    ndarray, shape (p, 3)
        Tips, mm.

    Raises
    ------
    InputError
        Not a readable text, a cell that is no finite number, rows of different length, fewer than two rows, or other than three columns.
    """
    rows = _rows(path)
    if len(rows) < 2 or rows.shape[1] != 3:
        blade = (
            "; rows of several vertices are the path of a blade, which cuts solids: name a mesh of tetrahedra (.vtu, .msh), or keep the "
            "vertex that touches the surface"
        )
        raise InputError(
            f"{path}: has {_size(rows)}; the path of a tip over a surface needs at least two rows of x, y, z"
            f"{blade if rows.shape[1] >= 6 and rows.shape[1] % 3 == 0 else ''}"
        )
    return rows


def _size(rows: FloatArray) -> str:
    return f"{len(rows)} rows of {rows.shape[1]} numbers"


def _rows(path: str | os.PathLike[str]) -> FloatArray:
    """Read rows (p, c) of numbers."""
    file = Path(path)
    try:
        text = read_bytes(file).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: is not UTF-8 text ({error.reason} at byte {error.start}); save the table as CSV in UTF-8") from error
    rows: list[list[float]] = []
    try:
        for line, cells in enumerate(csv.reader(StringIO(text)), start=1):
            if not any(cell.strip() for cell in cells) or cells[0].lstrip().startswith("#") or (not rows and _names(cells)):
                continue
            rows.append([_number(file, line, cell) for cell in cells])
            if len(rows[-1]) != len(rows[0]):
                raise InputError(f"{file}: row {line} has {len(rows[-1])} numbers, the first has {len(rows[0])}; give each pose the same")
            if len(rows) > MOST_ROWS:
                raise InputError(f"{file}: has more than {MOST_ROWS} poses; keep every tenth or so")
    except csv.Error as error:
        raise InputError(f"{file}: is no table of comma-separated values ({error}); save it as CSV") from error
    return np.array(rows).reshape(len(rows), -1 if rows else 0)


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
        raise InputError(f"{file}: row {line} has {cell.strip()[:40]!r} where a number in mm belongs")
    return value
