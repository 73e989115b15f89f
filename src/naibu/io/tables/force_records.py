"""Read records of force sensors: three forces, or three forces and three moments, over a time base of the sensor's own."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.io.tables.captured_shapes import LONGEST_S, TIME_UNITS
from naibu.io.tables.named_columns import ColumnKind, read_named_columns

FORCE_UNITS = {"": 1.0, "mn": 1.0, "n": 1e3, "kn": 1e6, "gf": 9.80665, "kgf": 9806.65}
MOMENT_UNITS = {"": 1.0, "mn_mm": 1.0, "mn mm": 1.0, "mnmm": 1.0, "n_mm": 1e3, "n mm": 1e3, "nmm": 1e3, "n_m": 1e6, "n m": 1e6, "nm": 1e6}
LARGEST_MN = 1e9
_KINDS = {
    "time": ColumnKind(("time", "t"), TIME_UNITS),
    **{f"f{a}": ColumnKind((f"f{a}", f"force {a}"), FORCE_UNITS) for a in "xyz"},
    **{f"m{a}": ColumnKind((f"m{a}", f"t{a}", f"moment {a}", f"torque {a}"), MOMENT_UNITS, needed=False) for a in "xyz"},
}
_LABELS = ("indenter", "sensor", "body")


@dataclass(frozen=True, slots=True, eq=False)
class ForceRecord:
    """What one force sensor recorded.

    Attributes
    ----------
    indenter : str
        Which indenter bears the sensor; empty where the file does not say.
    times_s : ndarray, shape (n,)
        Growing, s.
    force : ndarray, shape (n, 3)
        Of the indenter on the object, mN.
    moment : ndarray, shape (n, 3), or None
        mN mm, of sensors of six axes.
    """

    indenter: str
    times_s: FloatArray
    force: FloatArray
    moment: FloatArray | None


def read_force_records(sources: Sequence[str | os.PathLike[str]]) -> tuple[ForceRecord, ...]:
    """Read records of force sensors.

    Parameters
    ----------
    sources : sequence of path-like
        CSV tables with the columns ``time_s``, ``fx_mN``, ``fy_mN`` and ``fz_mN``, and ``mx_mN_mm`` and so on of sensors of six axes; other
        units where the names state them (``Fx (N)``, ``Time (ms)``). A column ``indenter`` names the one that a row belongs to, or
        ``"NAME=FILE"`` that of the whole file.

    Raises
    ------
    InputError
        A file that cannot be read, times that do not grow, forces beyond 1e9 mN, fewer than two rows of an indenter, or an indenter with
        two records.
    """
    records = [record for source in sources for record in _records(os.fspath(source))]
    names = [record.indenter for record in records]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"forces: {f'indenter {twice!r} has' if twice else 'without a name there are'} two records; give one, or names")
    return tuple(records)


def _records(source: str) -> list[ForceRecord]:
    name, mark, rest = source.partition("=")
    path = Path(rest if mark and not Path(source).exists() else source)
    if not path.exists():
        raise InputError(f"`forces` {source!r}: there is no such file; check the path")
    given = name.strip() if str(path) != source else ""
    table = read_named_columns(path, _KINDS, _LABELS)
    numbers, labels = table.numbers, table.labels
    force = np.stack([numbers[f"f{a}"] for a in "xyz"], axis=1)
    large = np.abs(force).max(axis=1) > LARGEST_MN
    if large.any():
        raise InputError(
            f"{path}: force {force[large][0].tolist()} mN is beyond {LARGEST_MN:g} mN; name the unit of the column, as in fx_N"
        )
    moments = [numbers.get(f"m{a}") for a in "xyz"]
    moment = np.stack([m for m in moments if m is not None], axis=1) if all(m is not None for m in moments) else None
    if labels is not None and given:
        raise InputError(f"`forces` {source!r}: the file names the indenter of every row itself; give it without a name")
    rows = np.array(labels if labels is not None else [given] * len(force))
    return [_one(path, str(label), rows == label, numbers["time"], force, moment) for label in dict.fromkeys(rows.tolist())]


def _one(path: Path, label: str, mine: np.ndarray, times: FloatArray, force: FloatArray, moment: FloatArray | None) -> ForceRecord:
    own = times[mine]
    whose = f" of {label!r}" if label else ""
    if len(own) < 2:
        raise InputError(f"{path}: has {len(own)} rows{whose}; a record of forces needs at least two")
    back = np.flatnonzero(np.diff(own) <= 0.0)
    if len(back):
        raise InputError(f"{path}: the times{whose} do not grow: {own[back[0]]:g} s is followed by {own[back[0] + 1]:g} s; sort the rows")
    if np.abs(own).max() > LONGEST_S:
        raise InputError(f"{path}: has the time {own[np.argmax(np.abs(own))]:g} s; name the unit of the column, as in time_ms")
    return ForceRecord(label, own, force[mine], None if moment is None else moment[mine])
