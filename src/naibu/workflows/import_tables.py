"""Import of marker tables: an experiment folder from tables of other programs, whose labels and units are checked by their motion."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from naibu.core.errors import InputError
from naibu.core.markers import Markers
from naibu.imaging.markers.motion_coherence import require_coherent, strays_named
from naibu.imaging.markers.tracking import FEWEST_COMMON
from naibu.io.marker_tables import import_markers, write_experiment_folder

MOST_STRAYS = 0.2  # fraction of stray markers from which on the labels are not believed


def import_tables(
    initial: str | os.PathLike[str],
    loaded: Sequence[str | os.PathLike[str]],
    *,
    out: str | os.PathLike[str],
    unit: str | None = None,
    **description: Any,
) -> tuple[str, ...]:
    """Make an experiment folder from tables of marker positions.

    Parameters
    ----------
    initial : path-like
        Table of the unloaded state.
    loaded : sequence of path-like
        Tables of the loaded states, which are named after their files.
    out : path-like
        Folder to make.
    unit : str, optional
        Unit of the coordinates, if the column names do not state it.
    **description
        See `naibu.io.write_experiment_folder`.

    Returns
    -------
    tuple of str
        What should be looked at: markers that move unlike their neighbours.

    Raises
    ------
    InputError
        Two states of one name, tables that cannot be read, labels that do not correspond, states in other units or mirrored. No folder is
        made then.
    """
    names = [Path(table).stem for table in loaded]
    if len(set(names)) < len(names):
        raise InputError(f"two tables would both be the state {max(names, key=names.count)!r}; rename one file")
    first = import_markers(initial, unit=unit)
    states = {name: import_markers(table, unit=unit) for name, table in zip(names, loaded, strict=True)}
    notes = [note for name, markers in states.items() if (note := _checked(first, markers, Path(initial).name, name))]
    write_experiment_folder(out, first, states, **description)
    return tuple(notes)


def _checked(first: Markers, markers: Markers, initial: str, name: str) -> str:
    """Refuse a state that does not follow from the first by the motion of a body; return a note about stray markers."""
    before, after = first.aligned(markers.ids), markers.aligned(markers.ids)
    common = int((np.isfinite(before) & np.isfinite(after)).any(axis=1).sum())
    if common < FEWEST_COMMON:
        raise InputError(
            f"state {name!r} against {initial}: only {common} markers are in both tables, {FEWEST_COMMON} are needed; check their numbers"
        )
    axes = slice(0, 2 if np.isnan(before[:, 2] + after[:, 2]).all() else 3)  # markers seen in one plane have no z
    found = require_coherent(before[:, axes], after[:, axes], f"state {name!r} against {initial}")
    if not len(found.strays):
        return ""
    named = strays_named(markers.ids, found)
    if len(found.strays) > MOST_STRAYS * len(found.judged):
        raise InputError(
            f"state {name!r} against {initial}: {len(found.strays)} of {len(found.judged)} markers move unlike their neighbours "
            f"({named}); correct their numbers in one of the tables"
        )
    return f"{name}: marker {named} moved unlike its neighbours; check its number and its coordinates, or mark it as suspect"
