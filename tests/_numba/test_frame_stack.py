"""Frames of deep calls lie in one piece: no loop of calls maps and unmaps memory, as the operating system counts it."""

import sys
from collections.abc import Callable

import pytest

from naibu._numba.frame_stack import with_room

resource = pytest.importorskip("resource", reason="page faults are counted on POSIX systems")
CALLS, DEPTH = 200, 400


def _nothing() -> None:
    pass


# larger than a frame of the recursion, so that at some depth the first does not fit where the second did
_nothing.__code__ = _nothing.__code__.replace(co_stacksize=200)


def _faults_at_each_depth(depth: int) -> list[int]:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(CALLS):
        _nothing()
    here = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
    return [here, *(_faults_at_each_depth(depth - 1) if depth else [])]


@pytest.mark.skipif(
    sys.implementation.name != "cpython" or sys.version_info >= (3, 14), reason="frames are kept by CPython in pieces of 16 KB"
)
def test_calls_from_any_depth_map_no_memory() -> None:
    called: Callable[[], list[int]] = lambda: _faults_at_each_depth(DEPTH)  # noqa: E731
    assert max(called()) >= CALLS  # without room, each call from just below the end of a piece maps a page
    assert max(with_room(called)) < CALLS / 2


def test_a_call_with_room_returns_and_raises_as_without() -> None:
    assert with_room(lambda: 3) == 3
    with pytest.raises(ZeroDivisionError):
        with_room(lambda: 1 // 0)
