"""Checks of a stored calibrated model: types, ranges, and a covariance that is one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args

from naibu.core.parameters import Scale
from naibu.identification.from_markers.specimen.specimen_model import ContactModel
from naibu.identification.stored_values import UNITS, check_covariance, require, require_number, rows_of, table_of
from naibu.mechanics.finite_elements.hyperelasticity import LAWS

NEEDED_SETTINGS = ("law", "contact", "joined")  # what parameters are parameters of
DENSEST = 3e-5  # kg/mm3; nothing that is pressed by hand is denser, so the unit must be another


def check_stored_model(data: Mapping[str, Any]) -> None:
    """Refuse a stored model with a value that cannot be.

    Parameters
    ----------
    data : mapping
        As `naibu.identification.prediction.calibrated_model.CalibratedModel.to_dict` wrote it.

    Raises
    ------
    InputError
        A missing entry, one of another type or out of its range, or a covariance that is not symmetric positive semidefinite.
    """
    require(data.get("units", UNITS) == UNITS, "units", data.get("units"), f"must be {UNITS!r}")
    _check_settings(table_of(data, "settings"))
    for key, value in table_of(data, "noise").items():
        require_number(f"noise {key}", value, 0.0, 1e3)
    require_number("noise_factor", data.get("noise_factor"), 0.0, 1e12)
    require(isinstance(data.get("reservation", ""), str), "reservation", data.get("reservation"), "must be a text")
    known = table_of(data, "known")
    for name, modulus in table_of(known, "young_moduli").items():
        require_number(f"young_moduli {name!r}", modulus, 1e-12, 1e12)
    require(isinstance(known.get("scale_is_absolute"), bool), "scale_is_absolute", known.get("scale_is_absolute"), "must be true or false")
    cases = rows_of(data, "load_cases")
    require(all(isinstance(case, str) for case in cases), "load_cases", cases, "must be names")
    table_of({"provenance": {}, **data}, "provenance")
    rows = rows_of(data, "parameters")
    for row in rows:
        _check_parameter(row)
    free = [row["name"] for row in rows if not row["fixed"]]
    check_covariance(data.get("covariance"), free)
    if data.get("law_covariance") is not None:
        _check_law_covariance(data["law_covariance"], len(free))
    if data.get("predictive") is not None:
        _check_predictive(table_of(data, "predictive"))


def _check_law_covariance(rows: Any, size: int) -> None:
    """Refuse anything but a table of numbers; parameters without influence of the law have rows of rounding errors, of any sign."""
    table = isinstance(rows, list) and all(isinstance(row, list) and len(row) == size for row in rows) and len(rows) == size
    require(table, "law_covariance", rows, f"must have {size} rows and columns, one per free parameter")
    for row in rows:
        for value in row:
            require_number("law_covariance", value, -1e12, 1e12)


def _check_predictive(predictive: Mapping[str, Any]) -> None:
    names = rows_of(predictive, "names")
    require(all(isinstance(name, str) for name in names), "predictive names", names, "must be names")
    check_covariance(predictive.get("covariance"), names)
    require_number("predictive discrepancy_mm", predictive.get("discrepancy_mm"), 0.0, 1e6)
    require_number("predictive noise_factor", predictive.get("noise_factor"), 0.0, 1e12)
    steps = predictive.get("mesh_step", [])
    require(isinstance(steps, list) and len(steps) in (0, len(names)), "predictive mesh_step", steps, "must be a number for each name")
    for step in steps:
        require_number("predictive mesh_step", step, -1e6, 1e6)
    for label, state in table_of(predictive, "states").items():
        require(isinstance(state, Mapping), f"predictive state {label!r}", state, "must be a table")
        require_number(f"predictive state {label!r} strain", state.get("strain"), 0.0, 1e3)


def _check_settings(settings: Mapping[str, Any]) -> None:
    choices = {
        "law": tuple(LAWS),
        "contact": get_args(ContactModel),
        "joined": ("tied", "sliding"),
        "pixel_scale": ("given", "sought"),
        "modulus": ("automatic", "given", "weighed"),
    }
    ranges = {
        "element_size_mm": (0.0, 1e4),
        "normal_stiffness": (1e-9, 1e12),
        "tangential_stiffness": (0.0, 1e12),
        "density": (0.0, DENSEST),
    }
    for key in NEEDED_SETTINGS:
        require(key in settings, f"settings {key}", None, "must be there: parameters mean nothing without it")
    for key, value in settings.items():
        if key in choices:
            require(value in choices[key], f"settings {key}", value, f"must be one of {', '.join(choices[key])}")
        elif key in ranges:
            require_number(f"settings {key}", value, *ranges[key])


def _check_parameter(row: Any) -> None:
    require(isinstance(row, dict) and isinstance(row.get("name"), str), "parameters", row, "must be tables with a name")
    name = f"parameter {row['name']!r}"
    require(row.get("scale") in get_args(Scale), f"{name} scale", row.get("scale"), f"must be one of {', '.join(get_args(Scale))}")
    require(isinstance(row.get("fixed"), bool), f"{name} fixed", row.get("fixed"), "must be true or false")
    require(isinstance(row.get("unit"), str), f"{name} unit", row.get("unit"), "must be a text")
    least = {"log": 1e-300, "incompressibility": -1.0, "linear": -1e12}[row["scale"]]
    require_number(f"{name} value", row.get("value"), least, 1e12)
    if row.get("prior_sd") is not None:
        require_number(f"{name} prior_sd", row["prior_sd"], 1e-300, 1e300)
