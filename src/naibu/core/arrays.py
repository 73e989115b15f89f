"""Array types for annotations, and checks of the shape and the values of arrays that callers hand in."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from naibu.core.errors import InputError

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
AnyFloatArray = NDArray[np.floating[Any]]
BoolArray = NDArray[np.bool_]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
Int32Array = NDArray[np.int32]
Int16Array = NDArray[np.int16]
Int8Array = NDArray[np.int8]
UInt16Array = NDArray[np.uint16]
AnyArray = NDArray[Any]
LENGTHS_MM = 1e-6, 1e5


def as_points(name: str, values: ArrayLike, dimension: int | None = None, *, least: int = 0) -> FloatArray:
    """Return finite positions or vectors as a new float64 array of shape (n, d).

    Parameters
    ----------
    name : str
        What they are called in messages: the caller's argument.
    values : array_like, shape (n, d)
        Positions or vectors.
    dimension : int, optional
        d; 2 or 3 where it is not given.
    least : int
        Smallest n.

    Raises
    ------
    InputError
        Another shape, fewer rows, or a value that is not finite; the message names the first such row.
    """
    array = np.array(values, dtype=np.float64)
    wanted = (dimension,) if dimension is not None else (2, 3)
    if array.ndim != 2 or array.shape[1] not in wanted:
        raise InputError(f"{name} must have shape {' or '.join(f'(n, {d})' for d in wanted)}, not {array.shape}")
    if len(array) < least:
        raise InputError(f"{name} has {len(array)} rows; at least {least} are needed")
    return require_finite(name, array)


def as_vector(name: str, values: ArrayLike, length: int = 3) -> FloatArray:
    """Return `length` finite numbers as a new float64 array.

    Raises
    ------
    InputError
        Another shape, or a value that is not finite.
    """
    array = np.array(values, dtype=np.float64)
    if array.shape != (length,):
        raise InputError(f"{name} must be {length} numbers, not an array of shape {array.shape}")
    return require_finite(name, array)


def length_of(vector: FloatArray) -> float:
    """Return the Euclidean length of a vector (k,): of a short one in a fraction of the time that `numpy.linalg.norm` takes."""
    return math.sqrt(vector @ vector)


def require_finite(name: str, array: FloatArray) -> FloatArray:
    """Return an array that holds neither NaN nor infinity.

    Raises
    ------
    InputError
        There is such a value; the message names the first.
    """
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        at = f"[{', '.join(map(str, index))}]" if index else ""
        raise InputError(f"{name}{at} is {array[index]}; every value must be a finite number")
    return array


def require_shape(name: str, array: AnyArray, shape: tuple[int, ...]) -> None:
    """Refuse an array of another shape.

    Raises
    ------
    InputError
        The shape differs.
    """
    if array.shape != shape:
        raise InputError(f"{name} must have shape {shape}, not {array.shape}")


def require_positive(name: str, value: float, unit: str = "") -> float:
    """Return a number that is finite and above zero.

    Raises
    ------
    InputError
        It is not.
    """
    if not (np.isfinite(value) and value > 0.0):
        raise InputError(f"{name} must be positive{f', {unit}' if unit else ''}, not {value:g}")
    return float(value)


def as_mask(name: str, values: ArrayLike, shape: tuple[int, ...]) -> BoolArray:
    """Return booleans of a given shape; numbers are taken as such if they are 0 and 1 only.

    Raises
    ------
    InputError
        Another shape, other numbers, or no element that is true.
    """
    array = np.asarray(values)
    require_shape(name, array, shape)
    if array.dtype != bool and not np.isin(array, (0, 1)).all():
        raise InputError(f"{name} must be boolean, or hold 0 and 1 only; it is {array.dtype} from {array.min()} to {array.max()}")
    mask = array.astype(bool)
    if not mask.any():
        raise InputError(f"{name} is empty: no element is true")
    return mask


def require_within(name: str, value: float, low: float, high: float, unit: str = "") -> float:
    """Return a number between two bounds, or say that it is none, or too small or too large to be meant.

    Raises
    ------
    InputError
        It is not.
    """
    if not low <= value <= high:  # also where it is not a number
        raise InputError(f"{name} is {value:g}; give a number from {low:g} to {high:g}{f' {unit}' if unit else ''}")
    return float(value)


def require_lengths(**lengths: float | Iterable[float] | None) -> None:
    """Refuse lengths that are not between a nanometre and 100 m: no object or scan has such, so the unit, or the number, is another.

    Parameters
    ----------
    **lengths : float, iterable of float, or None
        Lengths by the names of arguments, mm; None is skipped.

    Raises
    ------
    InputError
        One is not.
    """
    for name, value in lengths.items():
        for length in [] if value is None else np.ravel(np.asarray(value, dtype=float)).tolist():
            require_within(name, length, *LENGTHS_MM, "mm")


def require_count(name: str, value: int, least: int = 1) -> int:
    """Return a whole number, or say that it is none, or too small.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    value : int
        Number.
    least : int
        Smallest allowed value.

    Raises
    ------
    InputError
        It is not a whole number of at least `least`.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise InputError(f"{name} is {value}; give a whole number of at least {least}")
    return int(value)
