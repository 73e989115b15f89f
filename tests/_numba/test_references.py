"""Kernels that count no references are refused where that would free memory in use, or lose it."""

from __future__ import annotations

import numpy as np
import pytest

from naibu._numba import versions
from naibu._numba.compilation import COUNTED, UNCOUNTED, njit

pytestmark = pytest.mark.skipif(not versions.tested(), reason="on this Numba all kernels count references")


@njit(cache=True, **UNCOUNTED)
def _half(x):  # type: ignore[no-untyped-def]
    return x[: len(x) // 2], len(x)


@njit(cache=True, **COUNTED)
def _zeros(count):  # type: ignore[no-untyped-def]
    return np.zeros(count)


@njit(cache=True, **UNCOUNTED)
def _sum_of_zeros(count):  # type: ignore[no-untyped-def]
    return _zeros(count).sum()


@njit(cache=True)
def _length(x):  # type: ignore[no-untyped-def]
    return len(_half(x)[0]) + len(_zeros(2))


@njit(cache=True, **COUNTED)
def _first_of_zeros(count):  # type: ignore[no-untyped-def]
    return _zeros(count)[0]


@njit(cache=True, **UNCOUNTED)
def _first(x):  # type: ignore[no-untyped-def]
    return x[0] + _first_of_zeros(3)


def test_a_kernel_that_counts_no_references_returns_no_arrays() -> None:
    for kernel in (_half, _length):  # called by Python, and by a kernel
        with pytest.raises(Exception, match=r"_half returns .* not counted"):
            kernel(np.arange(4.0))


def test_a_kernel_that_counts_no_references_takes_no_new_arrays() -> None:
    for _ in range(2):  # also once the other kernel is compiled
        with pytest.raises(Exception, match=r"_zeros returns .* does not give it back"):
            _sum_of_zeros(3)


def test_numbers_are_handed_over() -> None:
    assert _first(np.arange(2.0) + 1.0) == 1.0
