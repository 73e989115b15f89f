"""Points that were marked in 3D Slicer (``.mrk.json``, and the older ``.fcsv``), as rows of a table in the frame of naibu, LPS."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

from naibu.core.errors import InputError

HEADER = ["marker", "x_mm", "y_mm", "z_mm"]
_SIGNS = {"LPS": (1.0, 1.0, 1.0), "1": (1.0, 1.0, 1.0), "RAS": (-1.0, -1.0, 1.0), "0": (-1.0, -1.0, 1.0)}  # numbers: before version 4.11
_FIRST = re.compile(r"#\s*Markups fiducial file version", re.IGNORECASE)


def is_markups(path: Path, text: str) -> bool:
    """Whether a file is one of Slicer, by its ending or its first line."""
    return path.name.lower().endswith((".mrk.json", ".fcsv")) or _FIRST.match(text) is not None


def rows_of(path: Path, text: str) -> list[tuple[int, list[str]]]:
    """Return a header and a row for each point that is placed, with their numbers.

    Raises
    ------
    InputError
        No list of points, several of them, another unit than mm, or another coordinate system than LPS or RAS, or none.
    """
    found = _of_json(path, text) if path.suffix.lower() == ".json" else _of_table(path, text)
    return [(1, HEADER), *found]


def _of_json(path: Path, text: str) -> list[tuple[int, list[str]]]:
    try:
        lists = json.loads(text)["markups"]
        if len(lists) != 1:
            raise InputError(f"{path}: holds {len(lists)} lists of points; save one in a file")
        only = lists[0]
        units = only.get("coordinateUnits", "mm")
        if units not in ("mm", ["mm"] * 3):
            raise InputError(f"{path}: states its coordinates in {units}; save them in mm")
        points = [p for p in only["controlPoints"] if p.get("positionStatus", "defined") != "undefined"]
        system = str(only.get("coordinateSystem", ""))
        return [(k + 1, _row(path, system, str(p.get("label") or k + 1), p["position"])) for k, p in enumerate(points)]
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: is no list of points of 3D Slicer ({error!r}); save it there again") from error


def _of_table(path: Path, text: str) -> list[tuple[int, list[str]]]:
    stated = dict(re.findall(r"^#\s*(CoordinateSystem|columns)\s*=\s*(.*?)\s*$", text, re.MULTILINE))
    names = [name.strip() for name in stated.get("columns", "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID").split(",")]
    if any(axis not in names for axis in "xyz"):
        raise InputError(f"{path}: cannot recognise x, y and z among its columns {', '.join(names)[:200]}")
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.startswith("#"):
            cells = dict(zip(names, next(csv.reader([line])), strict=False))
            position = [cells.get(axis, "") for axis in "xyz"]
            label = cells.get("label") or cells.get("id") or str(len(rows) + 1)
            try:
                rows.append((number, _row(path, stated.get("CoordinateSystem", ""), label, position)))
            except InputError:
                raise
            except ValueError as error:
                raise InputError(f"{path}: line {number} holds no position ({line[:60]!r}); save it in 3D Slicer again") from error
    return rows


def _row(path: Path, system: str, label: str, position: Any) -> list[str]:
    signs = _SIGNS.get(system.upper())
    if signs is None:
        raise InputError(
            f"{path}: its coordinate system is {system or 'not stated'!r}, and x and y have other signs in RAS than in LPS; write LPS or "
            "RAS where it states CoordinateSystem"
        )
    return [label, *(repr(sign * float(value)) for sign, value in zip(signs, position, strict=True))]
