"""Read captured surfaces: clouds of points that cameras or scanners saw at a few instants, from CSV or PLY."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from naibu.core.arrays import LENGTHS_MM, FloatArray
from naibu.core.errors import InputError
from naibu.io.files.reading import guarded_reading, read_bytes
from naibu.io.mesh_formats import ply
from naibu.io.tables.named_columns import ColumnKind, read_named_columns

LENGTH_UNITS = {"": 1.0, "mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 1e-3, "µm": 1e-3}
TIME_UNITS = {"": 1.0, "s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}
LONGEST_S = 1e6
_AXES = {axis: ColumnKind((axis,), LENGTH_UNITS) for axis in "xyz"}
_TIME = ColumnKind(("time", "t"), TIME_UNITS, needed=False)


@dataclass(frozen=True, slots=True, eq=False)
class CapturedSurface:
    """Points of a surface at one instant.

    Attributes
    ----------
    time_s : float
        When, s.
    points : ndarray, shape (k, 3)
        mm.
    """

    time_s: float
    points: FloatArray


def read_captured_shapes(sources: Sequence[str | os.PathLike[str]]) -> tuple[CapturedSurface, ...]:
    """Read captured points, sorted by time.

    Parameters
    ----------
    sources : sequence of path-like
        CSV tables with the columns ``time_s``, ``x_mm``, ``y_mm`` and ``z_mm`` (other units where the names state them: ``x_cm``,
        ``Time (ms)``), any number of instants in one; or, of one instant each, ``"TIME=FILE"`` with the time in s, a CSV table without a
        column of time or a PLY file of points in mm.

    Raises
    ------
    InputError
        A file that cannot be read, points without a time, with two times or far beyond any object, or no points.
    """
    parts = [part for source in sources for part in _parts(os.fspath(source))]
    if not parts:
        raise InputError("shapes: there is no file of captured points; give at least one")
    times = np.array([part.time_s for part in parts])
    return tuple(
        CapturedSurface(float(time), np.concatenate([part.points for part in parts if part.time_s == time])) for time in np.unique(times)
    )


def _parts(source: str) -> list[CapturedSurface]:
    path, time = _timed(source)
    if not path.exists():
        raise InputError(f"`shapes` {source!r}: there is no such file; check the path")
    if path.suffix.lower() == ".ply":
        if time is None:
            raise InputError(f"{path}: a PLY file states no time; write 'TIME={path}' with the time of the capture, in s")
        with guarded_reading(path, "a PLY file"):
            points, _ = ply.read(str(path), read_bytes(path))
        return [CapturedSurface(time, _checked(path, points))]
    table = read_named_columns(path, {"time": _TIME, **_AXES})
    points = _checked(path, np.stack([table.numbers[axis] for axis in "xyz"], axis=1))
    own = table.numbers.get("time")
    if (own is None) == (time is None):
        raise InputError(
            f"{path}: has no column time_s; add it, or write 'TIME={path}' with the time of the capture, in s"
            if own is None
            else f"{path}: has a column of time, and the time {time:g} s is given as well; give one of the two"
        )
    if own is None:
        assert time is not None
        return [CapturedSurface(time, points)]
    bad = (own < 0.0) | (own > LONGEST_S)
    if bad.any():
        raise InputError(f"{path}: has the time {own[bad][0]:g} s; times run from 0, the beginning of the motion, to {LONGEST_S:g} s")
    return [CapturedSurface(float(t), points[own == t]) for t in np.unique(own)]


def _timed(source: str) -> tuple[Path, float | None]:
    """Return the file and the time of ``TIME=FILE``, or the file alone."""
    first, mark, rest = source.partition("=")
    if not mark or Path(source).exists():
        return Path(source), None
    try:
        time = float(first.strip().removesuffix("s"))
    except ValueError:
        time = np.nan
    if not 0.0 <= time <= LONGEST_S:
        raise InputError(f"`shapes` {source!r}: {first!r} is no time in s; write 'TIME=FILE', such as '0.5=shape.ply'")
    return Path(rest), time


def _checked(path: Path, points: FloatArray) -> FloatArray:
    if len(points) == 0:
        raise InputError(f"{path}: holds no points; export it again")
    bad = ~(np.abs(points) <= LENGTHS_MM[1]).all(axis=1)
    if bad.any():
        raise InputError(
            f"{path}: point {int(np.argmax(bad)) + 1} is at {points[bad][0].tolist()} mm; coordinates are finite and at most "
            f"{LENGTHS_MM[1]:g} mm; if their unit is another one than the columns say, rename these, as in x_mm"
        )
    return points
