"""Checks of stored models that all kinds of them share: types, ranges, and covariances that are some."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError

UNITS = "mm, kg, s, mN, kPa"
SYMMETRIC = 1e-6  # largest difference of two halves of a covariance, by the standard deviations
INDEFINITE = 1e-6  # most negative eigenvalue of a correlation matrix that rounding explains


def check_covariance(entries: Any, names: Sequence[str]) -> None:
    """Refuse a matrix that is no covariance of the numbers of these names.

    Raises
    ------
    InputError
        Another shape, or a matrix that is not finite, symmetric and positive semidefinite.
    """
    try:
        matrix = np.array(entries, dtype=float)
    except (TypeError, ValueError) as error:
        raise wrong("covariance", entries, "must be a table of numbers") from error
    n = len(names)
    if n == 0 and matrix.size == 0:
        return
    require(
        matrix.shape == (n, n), "covariance", f"a table of shape {matrix.shape}", f"must have {n} rows and columns, one per free parameter"
    )
    require(bool(np.isfinite(matrix).all()), "covariance", matrix.tolist(), "must be finite; the data did not determine the model")
    variance = np.diag(matrix)
    for name, value in zip(names, variance.tolist(), strict=True):
        require(value >= 0.0, f"covariance of {name!r} with itself", value, "must not be negative")
    sd = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    correlation = matrix / np.outer(sd, sd)
    apart = float(np.abs(correlation - correlation.T).max())
    require(apart <= SYMMETRIC, "covariance", f"a matrix whose halves differ by {apart:.3g} of its scale", "must be symmetric")
    least = float(np.linalg.eigvalsh(0.5 * (correlation + correlation.T)).min())
    require(least >= -INDEFINITE, "covariance", f"a matrix with the eigenvalue {least:.3g} (scaled)", "must be positive semidefinite")


def table_of(data: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return an entry that is a table."""
    value = data.get(key)
    require(isinstance(value, Mapping), key, value, "must be a table")
    return value if isinstance(value, Mapping) else {}


def rows_of(data: Mapping[str, Any], key: str) -> list[Any]:
    """Return an entry that is a list."""
    value = data.get(key)
    require(isinstance(value, list), key, value, "must be a list")
    return value if isinstance(value, list) else []


def require_number(name: str, value: Any, low: float, high: float) -> None:
    """Refuse what is not a number of a closed range."""
    good = isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
    require(good, name, value, f"must be a finite number between {low:g} and {high:g}")


def require(good: bool, name: str, value: object, rule: str) -> None:
    """Refuse a value that breaks a rule."""
    if not good:
        raise wrong(name, value, rule)


def wrong(name: str, value: object, rule: str) -> InputError:
    """Return what is said of a value that breaks a rule."""
    return InputError(f"{name} = {repr(value)[:80]}: {rule}; the model file was changed or damaged, identify the model again")


def array_of(data: Mapping[str, Any], key: str, shape: Sequence[int | None]) -> FloatArray:
    """Return an entry that is a table of finite numbers of some shape, None standing for any length.

    Raises
    ------
    InputError
        Anything else.
    """
    try:
        values = np.array(data.get(key), dtype=float)
    except (TypeError, ValueError) as error:
        raise wrong(key, data.get(key), "must be a table of numbers") from error
    if not values.size and shape[0] is None:
        return np.zeros([n or 0 for n in shape])
    fits = values.ndim == len(shape) and all(n is None or n == have for n, have in zip(shape, values.shape, strict=True))
    wanted = " x ".join("any" if n is None else str(n) for n in shape)
    require(fits, key, f"a table of shape {values.shape}", f"must have the shape {wanted}")
    require(bool(np.isfinite(values).all()), key, "not finite", "must be finite")
    return values
