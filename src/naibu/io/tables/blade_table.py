"""Read the path of a blade or of a tool's tip: a table with one pose a row, and x, y, z of the vertices of its edge in the columns."""

from __future__ import annotations

import os

import numpy as np

from naibu.core.arrays import LENGTHS_MM, FloatArray
from naibu.core.errors import InputError
from naibu.io.tables.number_table import read_number_rows

FARTHEST_MM = LENGTHS_MM[1]


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
        Not a readable text, a cell that is no finite number or a place too far away,
        rows of different length, fewer than two poses or two vertices.
    """
    rows = _positions(path)
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
        Not a readable text, a cell that is no finite number or a place too far away,
        rows of different length, fewer than two rows, or other than three columns.
    """
    rows = _positions(path)
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


def _positions(path: str | os.PathLike[str]) -> FloatArray:
    """Read rows of coordinates, none of which is beyond what a scanner holds."""
    rows = read_number_rows(path)
    far = np.argwhere(np.abs(rows) > FARTHEST_MM)
    if len(far):
        value = rows[tuple(far[0])]
        raise InputError(f"{path}: pose {far[0][0] + 1} has the coordinate {value:g}; coordinates are in mm, at most {FARTHEST_MM:g}")
    return rows


def _size(rows: FloatArray) -> str:
    return f"{len(rows)} rows of {rows.shape[1]} numbers"
