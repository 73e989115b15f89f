"""Loading of an experiment, from its keys or, where a key is missing, from the free-text description of the indenter."""

from __future__ import annotations

import re
from pathlib import Path
from typing import cast

from naibu.core.errors import InputError
from naibu.core.experiment import Axis, Loading, LoadingKind
from naibu.io.experiment_folder.schema import Meta

# the first phrase that occurs decides; two plates before plate
_KINDS: tuple[tuple[str, LoadingKind], ...] = (
    (r"\btwo\b.*\bplates\b", "side_plates"),
    (r"\bbar\b", "bar"),
    (r"\bcylinder\b", "cylinder"),
    (r"\bplate\b", "plate"),
    (r"^as condition 3\b", "plate"),
)
_NUMBER = r"(\d+(?:\.\d+)?)"


def read_loading(path: Path, meta: Meta, up: Axis) -> Loading:
    """Return the loading; every value taken from free text instead of a key is recorded in `Loading.assumed`.

    Parameters
    ----------
    path : Path
        `meta.toml`, only named in errors.
    up : str
        Axis that points up.

    Raises
    ------
    InputError
        Neither the keys nor the free text give the kind, the width of a bar or its axis, or the axis is vertical.
    """
    table, assumed = meta.loading, list[str]()
    kind = table.kind or _kind(path, table.indenter, assumed)
    width = table.bar_width_mm
    if kind in ("bar", "cylinder") and width is None:
        width = _width(path, kind, table.indenter, assumed)
    axis: Axis = "y"
    if kind in ("bar", "side_plates"):
        axis = table.bar_axis or _axis(path, kind, meta, assumed)
        if axis == up:
            raise InputError(f"{path}: [loading] bar_axis = {axis!r} is the vertical axis; write a horizontal one")
    return Loading(kind, width, axis, table.counter_material, table.base_material, tuple(assumed))


def read_joints(meta: Meta, assumed: list[str]) -> tuple[float, ...]:
    """Return the heights of unbonded interfaces between blocks, mm; a value taken from free text is recorded in `assumed`."""
    if meta.object.joined_at_mm is not None:
        return tuple(meta.object.joined_at_mm)
    found = re.search(rf"the two {_NUMBER} mm halves lie on each other", meta.loading.contact)
    if not found:
        return ()
    assumed.append(f"The blocks are taken to lie on each other, not joined, at {found[1]} mm, because contact says {found[0]!r}.")
    return (float(found[1]),)


def read_up_axis(meta: Meta, assumed: list[str]) -> Axis:
    """Return the vertical axis: from the key, else from the free text in `axes`, else z."""
    if meta.coordinates.up_axis:
        return meta.coordinates.up_axis
    found = re.search(r"\b([xyz]) up\b", meta.coordinates.axes)
    axis = cast(Axis, found[1]) if found else "z"
    if axis != "z":
        assumed.append(f"{axis} is taken as the upward axis, because axes says '{axis} up'.")
    return axis


def _kind(path: Path, indenter: str, assumed: list[str]) -> LoadingKind:
    for phrase, kind in _KINDS:
        if found := re.search(phrase, indenter):
            assumed.append(f"The loading is taken as {kind!r}, because the indenter is described as {found[0]!r}.")
            return kind
    raise InputError(
        f"{path}: [loading] indenter = {indenter!r} does not name a known kind of loading; "
        'add kind = "plate", "bar", "side_plates" or "cylinder" under [loading]'
    )


def _width(path: Path, kind: str, indenter: str, assumed: list[str]) -> float:
    found = re.search(rf"{_NUMBER} mm wide|diameter {_NUMBER} mm", indenter)
    if not found:
        raise InputError(f"{path}: [loading] bar_width_mm of the {kind} is missing; add it, for example bar_width_mm = 13")
    width = float(found[1] or found[2])
    assumed.append(f"The width of the {kind} is taken as {width:g} mm, because the indenter is described as {found[0]!r}.")
    return width


def _axis(path: Path, kind: str, meta: Meta, assumed: list[str]) -> Axis:
    indenter = meta.loading.indenter
    if kind == "bar":
        # "lies along y ... its width is along x": the axis that it lies along counts
        found = re.search(r"\blies along ([xyz])\b", indenter) or re.search(r"\balong ([xyz])\b", indenter)
        source = "indenter"
    else:
        found = re.search(r"\b([xyz]) along the long axis\b", meta.coordinates.axes) if "long axis" in indenter else None
        source = "the plates are normal to the long axis, and axes"
    if not found:
        raise InputError(f'{path}: [loading] bar_axis of the {kind} is missing; add the axis it lies or presses along, as bar_axis = "x"')
    axis = cast(Axis, found[1])
    does = "bar is taken to lie" if kind == "bar" else "side plates are taken to press"
    assumed.append(f"The {does} along {axis}, because {source} says {found[0]!r}.")
    return axis
