"""Plain JSON values of records, arrays and mappings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass

import numpy as np


def jsonable(value: object, digits: int = 6) -> object:
    """Turn records, arrays and mappings into what JSON can hold.

    Parameters
    ----------
    value : object
        A dataclass instance, or anything made of mappings, sequences, arrays, numbers, text and None.
    digits : int
        Significant digits kept of a float.

    Returns
    -------
    object
        NaN and infinities become None; an object of an unknown type becomes its text.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: jsonable(getattr(value, f.name), digits) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): jsonable(entry, digits) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return jsonable(value.tolist(), digits)
    if isinstance(value, list | tuple | set | frozenset):
        return [jsonable(entry, digits) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if np.isfinite(value) else None
    return value if value is None or isinstance(value, str | bool | int) else str(value)
