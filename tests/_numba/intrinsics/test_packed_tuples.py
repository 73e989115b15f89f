"""A kernel takes a packed tuple apart as it does the tuple itself, and changes the same arrays."""

from __future__ import annotations

import pickle
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

from naibu._numba.compilation import njit
from naibu._numba.intrinsics import _packed_type, packed_tuples
from naibu._numba.intrinsics.packed_tuples import packed, packed_items


@njit
def _scaled(pair: Any, factor: Any) -> Any:
    matrix, vector = pair
    total = 0.0
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            vector[i] += factor * matrix[i, j]
            total += matrix[i, j]
    return total + matrix.size + vector.itemsize


@njit
def kernel(data: Any) -> Any:
    (first, second), (step, count, known), cube, empty = data
    turned, part = cube[:, ::-1, 1], data[0][:1]
    found = _scaled(first, step) + _scaled(second, 2.0 * step) + _scaled(part[0], 1.0)
    return found, len(data), len(empty), count + cube.ndim, known, turned.sum(), data[-2].strides[0], data[2][1:].shape[0]


def arguments() -> Any:
    rng = np.random.default_rng(3)
    first = rng.standard_normal((3, 4)), np.zeros(3)
    second = rng.standard_normal((5, 2)).astype(np.float32), np.ones(5, np.float32)
    return (first, second), (0.25, 7, True), rng.integers(0, 9, (2, 3, 4)), np.zeros((0, 3), np.int64)


def test_packed_tuples_are_what_tuples_are() -> None:
    assert packed_tuples.PACKED
    plain, given = arguments(), arguments()
    wanted, found = kernel(plain), kernel(packed(*given))
    assert found == wanted
    for a, b in zip((*plain[0][0], *plain[0][1]), (*given[0][0], *given[0][1]), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(given[0][0][1], arguments()[0][0][1])


class _Named(NamedTuple):
    values: Any
    factor: float


@njit
def _named_kernel(data: Any, inner: Any) -> Any:
    values, factor = data
    inner.nested.values[0] += data.factor * data.values[1]
    return values[2] * factor + inner.nested.factor + len(inner.nested)


def test_named_items_are_read_by_their_names() -> None:
    class Outer(NamedTuple):
        other: int
        nested: _Named

    plain, given = (
        (_Named(np.arange(3.0), 2.0), Outer(1, _Named(np.ones(1), 0.5))),
        (_Named(np.arange(3.0), 2.0), Outer(1, _Named(np.ones(1), 0.5))),
    )
    assert _named_kernel(*map(packed_items, given)) == _named_kernel(*plain) == 6.5
    assert given[1].nested.values[0] == plain[1].nested.values[0] == 3.0
    assert packed_items(given[0]).kind != packed(*given[0]).kind
    with pytest.raises(numba.TypingError, match="nothing"):
        njit(lambda data: data.nothing)(packed_items(given[0]))


def test_arrays_stay_alive_and_may_change_between_calls() -> None:
    given = packed(*arguments())
    values = given.kept[2]
    before = kernel(given)
    values += 1
    assert kernel(given)[5] == before[5] + values[:, :, 1].size


def test_one_type_for_all_tuples_of_the_same_kinds() -> None:
    one, other = packed(*arguments()), packed(*arguments())
    assert one.kind == other.kind and one.kind.name == other.kind.name
    again = pickle.loads(pickle.dumps(one.kind))
    assert again == one.kind and again.name == one.kind.name
    single = packed(np.zeros(3, np.float32))
    assert single.kind != packed(np.zeros(3)).kind and single.kind.name != packed(np.zeros(3)).kind.name


def test_types_are_told_apart_as_numba_does() -> None:
    fixed = np.zeros((2, 3))
    fixed.setflags(write=False)
    told = [fixed, np.zeros((2, 3)), np.zeros(2), np.zeros((2, 3), np.int32), 1.0, np.float32(1.0), 2, 2**63, True, (np.zeros(2), 1)]
    for one in told:
        assert packed(one).kind == packed(one).kind == numba.typeof(_packed_type.packed((one,)))
    assert len({packed(one).kind for one in told}) == len(told)


def test_arrays_with_gaps_are_refused() -> None:
    with pytest.raises(ValueError, match=r"contiguous; one has the shape \(3,\)"):
        packed((np.arange(6.0)[::2],))
