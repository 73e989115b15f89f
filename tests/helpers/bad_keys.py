"""Bad values of the keys of study files and experiment folders, as tables: which key of which file gets which value."""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from lattice_studies import STUDY

BIG = 10**400
FLOATS = (-1.0, float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 1e-300, BIG, -BIG, "5", "nan", True, [], [[1.0]], {})
POSITIVE = (0, -0.0, *FLOATS)
ANY_SIGN = tuple(v for v in FLOATS if v not in (-1.0, 1e-300))
FROM_ZERO = tuple(v for v in FLOATS if v != 1e-300)
COUNTS = (0, -1, 2.5, 1e308, float("nan"), BIG, "5", True, [], {})
Place = tuple[str | int, ...]

BALL = {"name": "ball", "shape": "sphere", "radius_mm": 8.0, "centre_mm": [10.0, 10.0, 28.5]}
BOX = {"shape": "box", "size_mm": [5.0, 5.0, 5.0], "centre_mm": [10.0, 10.0, 30.5]}
CYLINDER = {"shape": "cylinder", "radius_mm": 4.0, "length_mm": 5.0, "axis": [0.0, 0.0, 1.0], "centre_mm": [10.0, 10.0, 30.5]}
PUSHED = {**BALL, "force": [[0.0, 0.0], [0.1, 5.0]], "direction": [0.0, 0.0, -1.0], "mass_g": 20.0}
STEERED = {**BALL, "velocity": [[0.0, 0.0, 0.0, -5.0], [0.1, 0.0, 0.0, 0.0]]}
TIED = {**BOX, "contact": "tied", "until_s": 0.1, "centre_mm": [10.0, 10.0, 22.5]}
POINTS = {
    **BOX,
    "contact": "points",
    "centre_mm": [10.0, 10.0, 22.5],
    "points_mm": 2.5,
    "path": [[0.0, 0.0, 0.0, 0.0], [0.1, 0.0, 0.0, -1.0]],
}
LAYERS = {"labels": "labels.mha", "density_g_per_cm3": 1.0}
CELLS = {"cells": [3, 2, 2], "density_g_per_cm3": 1.0}


@dataclass(frozen=True)
class BadKey:
    """A file with one bad value.

    Attributes
    ----------
    file : dict
        Content of the file, with the bad value.
    key : str
        The key that the message must name.
    value : object
        The value.
    """

    file: dict[str, Any]
    key: str
    value: object


MODULI: dict[str, Any] = {"parameters": None, "material": {"young_modulus_kPa": 12.0}}  # in place of the parameters of elements
PRESSED = {"indenter": [POINTS], "floor": {}}
STUDY_KEYS: tuple[tuple[dict[str, Any], Place, tuple[object, ...]], ...] = (
    ({}, ("object", "size_mm", 0), POSITIVE), ({}, ("object", "size_mm"), POSITIVE), ({}, ("object", "mass_g"), POSITIVE),
    ({"object": CELLS}, ("object", "cells", 1), COUNTS), ({"object": CELLS}, ("object", "density_g_per_cm3"), POSITIVE),
    ({}, ("lattice", "spacing_mm"), POSITIVE), ({}, ("parameters", "K"), tuple(v for v in FROM_ZERO if v != {})),
    ({}, ("parameters", "C1"), tuple(v for v in FROM_ZERO if v != {})),
    ({}, ("parameters", "C2"), tuple(v for v in POSITIVE if v not in ({}, float("inf")))),
    ({}, ("simulation", "duration_s"), POSITIVE), ({}, ("simulation", "step_s"), POSITIVE),
    ({}, ("simulation", "tolerance"), POSITIVE), ({}, ("simulation", "gravity_mm_per_s2"), FROM_ZERO),
    ({}, ("floor", "static_friction"), FROM_ZERO), ({}, ("floor", "kinetic_friction"), FROM_ZERO),
    ({}, ("floor", "pull_stiffness_mN_per_mm"), FROM_ZERO), ({}, ("floor", "pull_damping_mN_s_per_mm"), FROM_ZERO),
    ({}, ("floor", "pull_speed_mm_per_s"), FROM_ZERO), ({}, ("indenter", 0, "radius_mm"), POSITIVE),
    ({}, ("indenter", 0, "centre_mm", 2), ANY_SIGN), ({}, ("indenter", 0, "centre_mm"), ANY_SIGN),
    ({}, ("indenter", 0, "path", 1, 0), ANY_SIGN), ({}, ("indenter", 0, "path", 1, 3), ANY_SIGN),
    ({}, ("indenter", 0, "path"), tuple(v for v in ANY_SIGN if v != [])),
    ({"indenter": [BOX]}, ("indenter", 0, "size_mm", 2), POSITIVE), ({"indenter": [CYLINDER]}, ("indenter", 0, "length_mm"), POSITIVE),
    ({"indenter": [CYLINDER]}, ("indenter", 0, "axis", 0), ANY_SIGN), ({"indenter": [PUSHED]}, ("indenter", 0, "mass_g"), POSITIVE),
    ({"indenter": [PUSHED]}, ("indenter", 0, "force", 1, 1), ANY_SIGN), ({"indenter": [PUSHED]}, ("indenter", 0, "direction", 2), ANY_SIGN),
    ({"indenter": [STEERED]}, ("indenter", 0, "velocity", 0, 3), ANY_SIGN),
    ({"indenter": [TIED], "floor": {}}, ("indenter", 0, "until_s"), FROM_ZERO), ({}, ("output", "every_s"), POSITIVE),
    ({}, ("output", "forces_every_s"), POSITIVE),
    (MODULI, ("material", "young_modulus_kPa"), tuple(v for v in POSITIVE if v != "5" and v != "nan")),
    (MODULI, ("material", "retardation_s"), FROM_ZERO),
    (MODULI, ("material", "relaxation_s"), tuple(v for v in POSITIVE if v != float("inf"))), (MODULI, ("material", "K"), (40.0,)),
    (MODULI | {"object": LAYERS}, ("material", "young_modulus_kPa", "1"), tuple(v for v in POSITIVE if not isinstance(v, str))),
    (MODULI | {"object": LAYERS}, ("material", "young_modulus_kPa", "gel"), (5.0,)),
    (PRESSED, ("indenter", 0, "points_mm"), POSITIVE), (PRESSED, ("indenter", 0, "mass_g"), (5.0,)),
    (PRESSED, ("indenter", 0, "shape"), ("cone", "", 5)), (PRESSED, ("indenter", 0, "until_s"), FROM_ZERO),
    (PRESSED, ("indenter", 0, "contact"), ("touching", "", 5, [])),
)  # fmt: skip
INDENTATION = """
[solid]
size_mm = [20.0, 20.0, 10.0]
element_mm = 5.0
held_below_mm = 1.0
[[material]]
young_modulus_kPa = 10.0
poisson_ratio = 0.45
[[indenter]]
shape = "sphere"
radius_mm = 4.0
centre_mm = [10.0, 10.0, 14.0]
travel_mm = [0.0, 0.0, -1.0]
friction = 0.3
[refinement]
tolerance = 0.3
max_unknowns = 2000
fraction = 0.6
[output]
steps = 2
"""
BAR = {"shape": "bar", "radius_mm": 4.0, "length_mm": 30.0, "axis": [0.0, 1.0, 0.0], "centre_mm": [10.0, 10.0, 14.0]}
BAR |= {"travel_mm": [0.0, 0.0, -1.0]}
INDENTATION_KEYS: tuple[tuple[dict[str, Any], Place, tuple[object, ...]], ...] = (
    ({}, ("solid", "size_mm", 0), POSITIVE), ({}, ("solid", "size_mm"), POSITIVE), ({}, ("solid", "element_mm"), POSITIVE),
    ({}, ("solid", "held_below_mm"), FROM_ZERO), ({}, ("solid", "mesh"), ("nosuch.vtu", "", 5)),
    ({}, ("material", 0, "young_modulus_kPa"), POSITIVE), ({}, ("material", 0, "poisson_ratio"), (*FROM_ZERO, 0.4995, 0.5)),
    ({}, ("material", 0, "law"), ("mooney", "", 5)), ({}, ("material", 0, "region"), ("nosuch", "", 5)),
    ({}, ("indenter", 0, "shape"), ("cone", "", 5)), ({}, ("indenter", 0, "radius_mm"), POSITIVE),
    ({}, ("indenter", 0, "centre_mm", 2), ANY_SIGN), ({}, ("indenter", 0, "travel_mm", 2), ANY_SIGN),
    ({}, ("indenter", 0, "travel_mm"), ANY_SIGN), ({}, ("indenter", 0, "friction"), FROM_ZERO),
    ({"indenter": [BAR]}, ("indenter", 0, "length_mm"), POSITIVE), ({"indenter": [BAR]}, ("indenter", 0, "axis", 1), ANY_SIGN),
    ({}, ("refinement", "tolerance"), POSITIVE), ({}, ("refinement", "max_unknowns"), (*COUNTS, 99)),
    ({}, ("refinement", "fraction"), POSITIVE), ({}, ("refinement", "goal"), ("stress", "", 5)), ({}, ("output", "steps"), COUNTS),
)  # fmt: skip
META_KEYS: tuple[tuple[Place, tuple[object, ...]], ...] = (
    (("coordinates", "pixel_mm"), POSITIVE), (("coordinates", "xy_step_mm"), POSITIVE), (("coordinates", "step_mm"), POSITIVE),
    (("coordinates", "z_step_mm"), POSITIVE), (("coordinates", "z_base_est_mm"), ANY_SIGN),
    (("coordinates", "xy_scale_probable"), POSITIVE), (("object", "size_mm"), POSITIVE), (("object", "size_mm", 1), POSITIVE),
    (("object", "joined_at_mm"), tuple(v for v in POSITIVE if v != [])), (("object", "mass_g"), POSITIVE),
    (("markers", "count"), COUNTS), (("markers", "nominal_spacing_mm"), POSITIVE), (("markers", "nominal_margin_mm"), FROM_ZERO),
    (("markers", "depth_below_top_mm"), POSITIVE), (("layer", 0, "from_base_mm", 0), FROM_ZERO),
    (("layer", 0, "from_base_mm", 1), POSITIVE), (("loading", "bar_width_mm"), POSITIVE), (("state", 1, "height_stated_mm"), POSITIVE),
    (("state", 1, "height_est_mm"), POSITIVE), (("dimensions",), COUNTS), (("title",), (5, True, [], {})),
    (("units",), ("cm", "", 5, [])), (("state",), ([], {}, 5, "initial")), (("layer",), ({}, 5, "a", [5])),
    (("loading", "kind"), ("push", "", 5, [])), (("object", "shape"), ("blob", "", 5, [])),
)  # fmt: skip


def bad_studies() -> Iterator[BadKey]:
    """Yield study files with one bad value each."""
    for changes, place, values in STUDY_KEYS:
        base = {name: table for name, table in (tomllib.loads(STUDY) | copy.deepcopy(changes)).items() if table is not None}
        if "floor" in changes:
            base["floor"] = {"contact": "sticking"}
        for value in values:
            yield BadKey(_changed(base, place, value), _key(place), value)
    for changes, place, values in INDENTATION_KEYS:
        for value in values:
            yield BadKey(_changed(tomllib.loads(INDENTATION) | copy.deepcopy(changes), place, value), _key(place), value)


def bad_descriptions(meta: str) -> Iterator[BadKey]:
    """Yield contents of meta.toml with one bad value each."""
    for place, values in META_KEYS:
        for value in values:
            yield BadKey(_changed(tomllib.loads(meta), place, value), _key(place), value)


def _key(place: Place) -> str:
    return [str(step) for step in place if not isinstance(step, int)][-1]


def _changed(file: dict[str, Any], place: Place, value: object) -> dict[str, Any]:
    changed: Any = copy.deepcopy(file)
    inner = changed
    for step in place[:-1]:
        if isinstance(inner, dict) and not isinstance(inner.get(step), dict | list):
            inner[step] = {}
        inner = inner[step]
    inner[place[-1]] = value
    return dict(changed)


def toml(value: object) -> str:
    """Return TOML of plain values, tables within arrays inline."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {toml(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, str):
        return f'"{value}"'
    return str(value).lower() if isinstance(value, bool | float) else str(value)


def document(file: dict[str, Any]) -> str:
    """Return the text of a TOML file."""
    return "".join(f"{key} = {toml(value)}\n" for key, value in file.items())
