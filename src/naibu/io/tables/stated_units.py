"""Units that tables of other programs state beside the names of columns: TrackMate in a row of its own, Imaris in a column."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from naibu.core.errors import InputError
from naibu.io.tables.table_cells import ABSENT, MM_PER_UNIT, without_unit

_MICRONS = re.compile(r"(?<![a-z])(?:microns?|micromet(?:er|re)s?)(?=[\])]?$)", re.IGNORECASE)
_BARE = re.compile(r"[\[(]?\s*(?P<unit>[^\])]*?)\s*[\])]?")
_UNITS = re.compile("units?", re.IGNORECASE)
_NO_DIGIT = re.compile(r"[^0-9]*[^\W\d_][^0-9]*")
PIXELS = ("px", "pixel", "pixels", "voxel", "voxels")
DESCRIBED_BY = 3  # rows below the names, at most: TrackMate's long names, short names and units


def with_short_units(cell: str) -> str:
    """Return the name of a column, or a unit, with ``um`` for microns at its end."""
    return _MICRONS.sub("um", cell)


def with_stated_units(
    path: Path, names: list[str], body: list[tuple[int, list[str]]], positions: Sequence[int]
) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the names of columns, with the units of positions that the table states elsewhere, and the rows of numbers.

    Parameters
    ----------
    path : Path
        The file, for messages.
    names : list of str
        Names of the columns.
    body : list of tuple
        Rows below them, with their lines.
    positions : sequence of int
        Columns of positions. Up to three rows in which all of these are words are descriptions of the columns.

    Raises
    ------
    InputError
        A column of units that names several.
    """
    named = list(names)
    rows = 0
    while rows < min(DESCRIBED_BY, len(body)) and all(_is_word(body[rows][1], at) for at in positions):
        for at in positions:
            _state(named, at, body[rows][1][at])
        rows += 1
    units = next((at for at, name in enumerate(names) if _UNITS.fullmatch(name)), None)
    if units is not None and named == names:
        told = {row[units] for _, row in body[rows:] if units < len(row) and row[units]}
        if len(told) > 1:
            raise InputError(f"{path}: the column {names[units]!r} names several units ({', '.join(sorted(told))}); convert to one")
        for at in positions:
            _state(named, at, *told)
    return named, body[rows:]


def _is_word(row: list[str], at: int) -> bool:
    return at < len(row) and row[at].lower().lstrip("+-") not in (*ABSENT, "inf", "infinity") and bool(_NO_DIGIT.fullmatch(row[at]))


def _state(names: list[str], at: int, told: str = "") -> None:
    """Add a unit to a column's name that states none, if what is told is a unit of length, or pixels."""
    matched = _BARE.fullmatch(with_short_units(told.strip()))
    if matched is not None and without_unit(names[at]) == names[at] and matched["unit"].lower() in (*MM_PER_UNIT, *PIXELS):
        names[at] = f"{names[at]} ({matched['unit'].lower()})"


def in_pixels(name: str) -> bool:
    """Return whether the name of a column, as `with_stated_units` returns it, says pixels or voxels."""
    return name.endswith(tuple(f"({unit})" for unit in PIXELS))
