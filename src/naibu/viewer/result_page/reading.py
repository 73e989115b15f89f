"""Reading of reports stored by `naibu.viewer.result_page.payload.report_json`, to rewrite the page without solving again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.viewer.result_page.payload import Report
from naibu.viewer.tables import Cell

# arrays of positions, whose second axis is lost in JSON when they are empty
_OF_POINTS = {"faces", "reference_surface", "surface", "markers", "initial_markers", "measured", "residual_mm"}


def report_from_json(text: str) -> Report:
    """Return the report that `naibu.viewer.result_page.payload.report_json` wrote; null becomes NaN where a number is needed.

    Raises
    ------
    InputError
        Not JSON, or not a complete report; the message names the part.
    """
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"the stored report is not JSON ({error})") from error
    report: Report = _record(Report, data, "report")
    return report


def _record(kind: Any, data: object, where: str) -> Any:
    """Return the record of type `kind`, every field of which must be in `data`."""
    hints = get_type_hints(kind)
    names = [f.name for f in fields(kind)]
    if not isinstance(data, Mapping) or set(data) != set(names):
        raise InputError(f"the stored report is damaged: {where} does not consist of {', '.join(names)}")
    return kind(**{name: _value(hints[name], data[name], f"{where}.{name}") for name in names})


def _value(kind: Any, data: Any, where: str) -> Any:
    """Return the value of a field of type `kind`."""
    if kind == Cell or get_origin(kind) is Mapping:
        return data
    if get_origin(kind) in (UnionType, Union):
        return None if data is None else _value(next(k for k in get_args(kind) if k is not NoneType), data, where)
    if is_dataclass(kind):
        return _record(kind, data, where)
    try:
        if kind in (FloatArray, IntArray):
            array = np.array(data, dtype=np.float64 if kind == FloatArray else np.int64)
            return array.reshape(0, 3) if where.rpartition(".")[2] in _OF_POINTS and array.size == 0 else array
        if get_origin(kind) is tuple:
            inner = get_args(kind)[0]
            return tuple(_value(inner, entry, f"{where}[{i}]") for i, entry in enumerate(data))
        return np.nan if kind is float and data is None else kind(data)
    except (TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"the stored report is damaged: {where} cannot be read ({error})") from error
