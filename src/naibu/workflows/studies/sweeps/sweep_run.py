"""One run of a sweep: a lattice study with some numbers changed, and the figures that are kept of it."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import numpy as np

from naibu.core.errors import ConvergenceError, InputError
from naibu.core.progress import Progress, report_progress
from naibu.mechanics.lattices.simulation.loading_history import run_study
from naibu.workflows.studies.lattice_study import PreparedStudy, prepared_document

AXES = ("x", "y", "z")


def with_values(document: dict[str, Any], values: dict[str, float], source: str) -> dict[str, Any]:
    """Return the tables of a study with some numbers changed.

    Parameters
    ----------
    document : dict
        Tables of the study.
    values : dict
        Numbers by their key: the names of tables and key joined by dots, ``parameters.K`` or ``parameters.K.short``; an indenter is named
        by its name or by its number, from 1; a component of a list by its number, from 1, or by x, y, z.
    source : str
        File of the sweep, for messages.

    Raises
    ------
    InputError
        A key that leads to no number.
    """
    changed = deepcopy(document)
    for key, value in values.items():
        *path, last = key.split(".")
        place: Any = changed
        for part in path:
            place = _entry(place, part, key, source)
        before = _entry(place, last, key, source, absent_is_none=isinstance(place, dict) and bool(path))
        numeric = isinstance(before, int | float) and not isinstance(before, bool)
        by_class = isinstance(before, dict) and bool(path)  # numbers by class of elements, for which one number stands as well
        if before is not None and not numeric and not by_class:
            raise InputError(f"{source}: [[parameter]] key = {key!r}: holds {before!r}, which is no number; name a key that holds one")
        whole = isinstance(before, int) and float(value).is_integer()
        place[_position(place, last, key, source)] = int(value) if whole else float(value)
    return changed


def _entry(place: Any, part: str, key: str, source: str, *, absent_is_none: bool = False) -> Any:
    position = _position(place, part, key, source)
    if isinstance(place, dict) and position not in place:
        if absent_is_none:  # left to its default by the study; the check of the whole study tells whether there is such a key
            return None
        raise InputError(f"{source}: [[parameter]] key = {key!r}: the study has no {part!r} there, but {', '.join(map(str, place))}")
    return place[position]


def _position(place: Any, part: str, key: str, source: str) -> Any:
    if isinstance(place, dict):
        return part
    if isinstance(place, list):
        names = [entry.get("name") if isinstance(entry, dict) else None for entry in place]
        numbers = {str(k + 1): k for k in range(len(place))} | {axis: k for k, axis in enumerate(AXES) if k < len(place)}
        if part in names:
            return names.index(part)
        if part in numbers:
            return numbers[part]
        known = [name or str(k + 1) for k, name in enumerate(names)]
        raise InputError(f"{source}: [[parameter]] key = {key!r}: there is no {part!r} there; use one of {', '.join(known)}")
    raise InputError(f"{source}: [[parameter]] key = {key!r}: {part!r} stands below {place!r}, which is no table; shorten the key")


def quantities_of(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the figures of a run, with units, for bodies of these names."""
    of_body = ("largest force of {}, mN", "force of {} at the end, mN", "work of {}, mN mm")
    whole = ("largest displacement, mm", "largest displacement at the end, mm", "energy of the springs at the end, mN mm")
    return (*(text.format(name) for name in names for text in of_body), *whole)


def run_of_sweep(source: str, document: dict[str, Any], progress: Progress | None) -> tuple[dict[str, float], str]:
    """Compute one run; return its figures by name, and why there are none, empty when all went well.

    Parameters
    ----------
    source : str
        Name or file of the study.
    document : dict
        Its tables.
    progress : callable, optional
        Gets a report after every frame.
    """
    try:
        return _figures(prepared_document(source, document), progress), ""
    except (ConvergenceError, InputError) as error:
        return {}, str(error)


def _figures(prepared: PreparedStudy, progress: Progress | None) -> dict[str, float]:
    study = prepared.study
    names = [body.name for body in study.bodies]
    largest = np.zeros(len(names))
    last = np.zeros(len(names))
    work, moved, most, spring = np.zeros(len(names)), 0.0, 0.0, 0.0
    for frame in run_study(study):
        size = np.linalg.norm(frame.force, axis=2)
        if len(size):
            largest, last = np.maximum(largest, size.max(axis=0)), size[-1]
        moved = float(np.linalg.norm(frame.state.lattice.position - study.lattice.points, axis=1).max())
        most, spring, work = max(most, moved), frame.spring, frame.state.work
        report_progress(progress, f"simulate {prepared.name}", done=frame.state.frame, total=study.frames)
    numbers = [float(value) for row in zip(largest, last, work, strict=True) for value in row] + [most, moved, float(spring)]
    return dict(zip(quantities_of(names), numbers, strict=True))
