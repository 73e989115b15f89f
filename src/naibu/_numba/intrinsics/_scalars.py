"""One number at a time in place of eight: the substitute of `naibu._numba.intrinsics._vectors` where its intrinsics do not work."""

from __future__ import annotations

import math

import numpy as np

from naibu._numba.compilation import njit

WIDTH = 1


@njit(cache=True)
def load(array, index):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return array[index]."""
    return array[index]


@njit(cache=True)
def store(array, index, value):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set array[index]."""
    array[index] = value


@njit(cache=True)
def splat(value):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the number."""
    return value


@njit(cache=True)
def total(value):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the number."""
    return value


@njit(cache=True)
def single(value):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the number rounded to single precision."""
    return np.float32(value)


@njit(cache=True)
def double(value):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the number in double precision."""
    return np.float64(value)


@njit(cache=True)
def inverse_root(value):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return 1 / sqrt(value) of a positive number; smaller ones than 1e-30 count as that."""
    return 1.0 / math.sqrt(max(value, 1e-30))
