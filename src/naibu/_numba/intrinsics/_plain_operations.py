"""Plain operations for one thread: the substitutes of intrinsics (`_atomic_intrinsics`, `_control_register`) where these do not work."""

from __future__ import annotations

from naibu._numba.compilation import njit


@njit(cache=True)
def look(array, index):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return array[index]."""
    return array[index]


@njit(cache=True)
def post(array, index, value):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set array[index]."""
    array[index] = value


@njit(cache=True)
def add(array, index, value):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add to array[index] and return what it was."""
    before = array[index]
    array[index] = before + value
    return before


@njit(cache=True)
def swap(array, index, old, new):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set array[index] to `new` if it is `old`, and return whether it was."""
    same = array[index] == old
    if same:
        array[index] = new
    return same


@njit(cache=True)
def nap(microseconds):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return at once: no other thread is waited for."""


@njit(cache=True)
def ticks():  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return 0: nothing is done in turn that would have to be timed."""
    return 0


@njit(cache=True)
def relax():  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return at once: no other thread is waited for."""


@njit(cache=True)
def flush_subnormals():  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return 0: subnormal numbers stay what they are."""
    return 0


@njit(cache=True)
def restore(before):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return at once: nothing was changed."""
