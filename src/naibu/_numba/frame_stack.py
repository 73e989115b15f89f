"""Room for the frames of deep calls of Python, in one piece.

CPython keeps frames in pieces of 16 KB, and hands a piece back to the operating system as soon as the first frame in it has returned: where
a loop calls functions from just below the end of a piece, each call maps and unmaps one. Numba's compiler is some hundred calls deep where
kernels call kernels, and a compilation of 168 of them mapped 400 000 pieces: a sixth of its time. A frame that needs more than a piece gets
one that is twice as large or more (`push_chunk` in CPython's ``pystate.c``), and later frames find room in its rest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")

ROOM = 2**17  # numbers of 8 bytes in a frame, of which nothing is ever touched; as many are left for later frames


def with_room(call: Callable[[], Result]) -> Result:
    """Return what a call returns, with room for 1 MB of frames in one piece."""
    return call()


with_room.__code__ = with_room.__code__.replace(co_stacksize=ROOM)
