"""Commands of the live page: JSON messages of a fixed vocabulary, checked before anything acts on them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass

from naibu.core.errors import InputError

LARGEST = 1e6  # mm; of a coordinate
MOST_TURN = 3.0  # rad; of a command
LONGEST_NAME = 40
MOST_EDGES = 200  # of a cut

# what each command carries
VOCABULARY: Mapping[str, str] = {
    "next": "",
    "tool": "name",
    "move": "vector",
    "turn": "rotation",
    "grip": "number",
    "pull": "vector",
    "release": "",
    "pause": "switch",
    "record": "switch",
    "replay": "",
    "reset": "",
    "undo": "",
    "cut": "edges",
    "colour": "name",
}


Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class LiveCommand:
    """A checked command.

    Attributes
    ----------
    kind : str
        A word of `VOCABULARY`.
    vector : tuple of float
        Position, mm, of ``move`` and ``pull``; rotation vector, rad, of ``turn``.
    number : int
        Node, of ``grip``.
    name : str
        Tool, or quantity of the colours.
    switch : bool
        Of ``pause`` and ``record``.
    edges : tuple
        Positions of the blade's edge, a polyline in each pose, mm, of ``cut``.
    """

    kind: str
    vector: Vector = (0.0, 0.0, 0.0)
    number: int = 0
    name: str = ""
    switch: bool = False
    edges: tuple[tuple[Vector, ...], ...] = ()


def read_command(text: str) -> LiveCommand:
    """Read a command.

    Raises
    ------
    InputError
        No JSON object, an unknown command, or a value that it cannot carry.
    """
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError("a command must be a JSON object") from error
    kind = data.get("type") if isinstance(data, dict) else None
    if not isinstance(kind, str) or kind not in VOCABULARY:
        raise InputError(f"a command must be an object whose type is one of {', '.join(VOCABULARY)}")
    match VOCABULARY[kind]:
        case "vector":
            return LiveCommand(kind, vector=_vector(f"{kind}: at", data.get("at")))
        case "rotation":
            return LiveCommand(kind, vector=_vector(f"{kind}: by", data.get("by"), MOST_TURN, "rad"))
        case "edges":
            return LiveCommand(kind, edges=_edges(kind, data.get("edges")))
        case "number":
            return LiveCommand(kind, number=_number(kind, data.get("node")))
        case "name":
            name = data.get("name")
            if not isinstance(name, str) or len(name) > LONGEST_NAME:
                raise InputError(f"{kind}: name must be a text of at most {LONGEST_NAME} characters")
            return LiveCommand(kind, name=name)
        case "switch":
            if not isinstance(data.get("on"), bool):
                raise InputError(f"{kind}: on must be true or false")
            return LiveCommand(kind, switch=data["on"])
    return LiveCommand(kind)


def _number(kind: str, value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**31:
        raise InputError(f"{kind}: node must be a whole number that is not negative")
    return value


def _edges(kind: str, value: object) -> tuple[tuple[Vector, ...], ...]:
    """Read poses of an edge; all of them have as many vertices."""
    if not isinstance(value, list) or not 2 <= len(value) <= MOST_EDGES or not all(isinstance(edge, list) for edge in value):
        raise InputError(f"{kind}: edges must be a list of 2 to {MOST_EDGES} edges")
    if not 2 <= len(value[0]) <= MOST_EDGES or any(len(edge) != len(value[0]) for edge in value):
        raise InputError(f"{kind}: each of the edges must have the same number of vertices, 2 to {MOST_EDGES}")
    return tuple(tuple(_vector(f"{kind}: edges", vertex) for vertex in edge) for edge in value)


def _vector(what: str, value: object, largest: float = LARGEST, unit: str = "mm") -> Vector:
    if not isinstance(value, list) or len(value) != 3:
        raise InputError(f"{what} must be three numbers")
    for number in value:
        if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number) or abs(number) > largest:
            raise InputError(f"{what} must be three finite numbers of at most {largest:g} {unit}")
    x, y, z = (float(v) for v in value)
    return x, y, z
