"""Atomic operations on arrays of 64-bit integers in Numba kernels.

`look`, `post`, `add` and `swap` read, write, add and compare-and-swap one element; `nap` sleeps for some microseconds, `relax`
belongs into loops that wait, `ticks` is a
clock, ns. Where the intrinsics
do not work with this version of Numba (`ATOMIC` is False), they are plain operations, for one thread only.
"""

from __future__ import annotations

from typing import Any

from naibu._numba.intrinsics import _plain_operations
from naibu._numba.versions import passes

_chosen: Any = _plain_operations
try:
    from naibu._numba.intrinsics import _atomic_intrinsics
except Exception:  # whatever a changed interface raises
    ATOMIC = False
else:
    ATOMIC = passes(_atomic_intrinsics.trial)
    _chosen = _atomic_intrinsics if ATOMIC else _plain_operations

look, post, add, swap = _chosen.look, _chosen.post, _chosen.add, _chosen.swap
nap, relax, ticks = _chosen.nap, _chosen.relax, _chosen.ticks
