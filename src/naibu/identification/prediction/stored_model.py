"""Checks of a stored calibrated model: types, ranges, and a covariance that is one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, get_args

import numpy as np

from naibu.core.errors import InputError
from naibu.core.parameters import Scale
from naibu.identification.from_markers.specimen.specimen_model import ContactModel
from naibu.mechanics.finite_elements.hyperelasticity import LAWS

UNITS = "mm, kg, s, mN, kPa"
SYMMETRIC = 1e-6  # largest difference of two halves of a covariance, by the standard deviations
INDEFINITE = 1e-6  # most negative eigenvalue of a correlation matrix that rounding explains
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
    _require(data.get("units", UNITS) == UNITS, "units", data.get("units"), f"must be {UNITS!r}")
    _check_settings(_mapping(data, "settings"))
    for key, value in _mapping(data, "noise").items():
        _number(f"noise {key}", value, 0.0, 1e3)
    _number("noise_factor", data.get("noise_factor"), 0.0, 1e12)
    known = _mapping(data, "known")
    for name, modulus in _mapping(known, "young_moduli").items():
        _number(f"young_moduli {name!r}", modulus, 1e-12, 1e12)
    _require(isinstance(known.get("scale_is_absolute"), bool), "scale_is_absolute", known.get("scale_is_absolute"), "must be true or false")
    cases = _rows(data, "load_cases")
    _require(all(isinstance(case, str) for case in cases), "load_cases", cases, "must be names")
    _mapping({"provenance": {}, **data}, "provenance")
    rows = _rows(data, "parameters")
    for row in rows:
        _check_parameter(row)
    _check_covariance(data.get("covariance"), [row["name"] for row in rows if not row["fixed"]])
    if data.get("predictive") is not None:
        _check_predictive(_mapping(data, "predictive"))


def _check_predictive(predictive: Mapping[str, Any]) -> None:
    names = _rows(predictive, "names")
    _require(all(isinstance(name, str) for name in names), "predictive names", names, "must be names")
    _check_covariance(predictive.get("covariance"), names)
    _number("predictive discrepancy_mm", predictive.get("discrepancy_mm"), 0.0, 1e6)
    _number("predictive noise_factor", predictive.get("noise_factor"), 0.0, 1e12)
    steps = predictive.get("mesh_step", [])
    _require(isinstance(steps, list) and len(steps) in (0, len(names)), "predictive mesh_step", steps, "must be a number for each name")
    for step in steps:
        _number("predictive mesh_step", step, -1e6, 1e6)
    for label, state in _mapping(predictive, "states").items():
        _require(isinstance(state, Mapping), f"predictive state {label!r}", state, "must be a table")
        _number(f"predictive state {label!r} strain", state.get("strain"), 0.0, 1e3)


def _check_settings(settings: Mapping[str, Any]) -> None:
    choices = {"law": tuple(LAWS), "contact": get_args(ContactModel), "joined": ("tied", "sliding"), "pixel_scale": ("given", "sought")}
    ranges = {
        "element_size_mm": (0.0, 1e4),
        "normal_stiffness": (1e-9, 1e12),
        "tangential_stiffness": (0.0, 1e12),
        "density": (0.0, DENSEST),
    }
    for key, value in settings.items():
        if key in choices:
            _require(value in choices[key], f"settings {key}", value, f"must be one of {', '.join(choices[key])}")
        elif key in ranges:
            _number(f"settings {key}", value, *ranges[key])


def _check_parameter(row: Any) -> None:
    _require(isinstance(row, dict) and isinstance(row.get("name"), str), "parameters", row, "must be tables with a name")
    name = f"parameter {row['name']!r}"
    _require(row.get("scale") in get_args(Scale), f"{name} scale", row.get("scale"), f"must be one of {', '.join(get_args(Scale))}")
    _require(isinstance(row.get("fixed"), bool), f"{name} fixed", row.get("fixed"), "must be true or false")
    _require(isinstance(row.get("unit"), str), f"{name} unit", row.get("unit"), "must be a text")
    least = {"log": 1e-300, "incompressibility": -1.0, "linear": -1e12}[row["scale"]]
    _number(f"{name} value", row.get("value"), least, 1e12)
    if row.get("prior_sd") is not None:
        _number(f"{name} prior_sd", row["prior_sd"], 1e-300, 1e300)


def _check_covariance(entries: Any, names: Sequence[str]) -> None:
    """Refuse a matrix that is no covariance of the free parameters."""
    try:
        matrix = np.array(entries, dtype=float)
    except (TypeError, ValueError) as error:
        raise _wrong("covariance", entries, "must be a table of numbers") from error
    n = len(names)
    if n == 0 and matrix.size == 0:
        return
    _require(
        matrix.shape == (n, n), "covariance", f"a table of shape {matrix.shape}", f"must have {n} rows and columns, one per free parameter"
    )
    _require(bool(np.isfinite(matrix).all()), "covariance", matrix.tolist(), "must be finite; the data did not determine the model")
    variance = np.diag(matrix)
    for name, value in zip(names, variance.tolist(), strict=True):
        _require(value >= 0.0, f"covariance of {name!r} with itself", value, "must not be negative")
    sd = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    correlation = matrix / np.outer(sd, sd)
    apart = float(np.abs(correlation - correlation.T).max())
    _require(apart <= SYMMETRIC, "covariance", f"a matrix whose halves differ by {apart:.3g} of its scale", "must be symmetric")
    least = float(np.linalg.eigvalsh(0.5 * (correlation + correlation.T)).min())
    _require(least >= -INDEFINITE, "covariance", f"a matrix with the eigenvalue {least:.3g} (scaled)", "must be positive semidefinite")


def _mapping(data: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = data.get(key)
    _require(isinstance(value, Mapping), key, value, "must be a table")
    return value if isinstance(value, Mapping) else {}


def _rows(data: Mapping[str, Any], key: str) -> list[Any]:
    value = data.get(key)
    _require(isinstance(value, list), key, value, "must be a list")
    return value if isinstance(value, list) else []


def _number(name: str, value: Any, low: float, high: float) -> None:
    """Refuse what is not a number of a closed range."""
    good = isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
    _require(good, name, value, f"must be a finite number between {low:g} and {high:g}")


def _require(good: bool, name: str, value: object, rule: str) -> None:
    if not good:
        raise _wrong(name, value, rule)


def _wrong(name: str, value: object, rule: str) -> InputError:
    return InputError(f"{name} = {repr(value)[:80]}: {rule}; the model file was changed or damaged, identify the model again")
