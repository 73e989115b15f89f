"""Reports of compilations to whoever listens; imports nothing of Numba, so that listening costs nothing."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

Listener = Callable[[str, bool], None]
_listeners: list[Listener] = []


@contextlib.contextmanager
def reported_compilation(listener: Listener) -> Iterator[None]:
    """Within this context, call ``listener(kernel, done)`` before and after each compilation of a kernel, in the thread that compiles.

    Kernels that another kernel calls are compiled within it.
    """
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def report(kernel: str, done: bool) -> None:
    """Tell all listeners that a compilation begins, or has ended."""
    for listener in tuple(_listeners):
        listener(kernel, done)
