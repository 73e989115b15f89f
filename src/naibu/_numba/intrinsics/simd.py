"""Single instruction, multiple data: `WIDTH` numbers at a time in Numba kernels.

LLVM does not vectorize loops whose arrays may overlap, so kernels name the vectors. They work on every processor; LLVM splits them where
registers are shorter. Use inside `naibu._numba.compilation.njit` functions only::

    distance = load(x, j) - load(x, i)     # x[j : j + WIDTH] - x[i : i + WIDTH]
    store(x, i, load(x, i) + distance)

The operators ``+``, ``-`` and ``*`` join two vectors of one precision; `splat` makes one of a number. Where the intrinsics do not work
with this version of Numba (`VECTORS` is False), `WIDTH` is 1 and a vector is a number.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from naibu._numba.intrinsics import _scalars
from naibu._numba.versions import passes

_chosen: Any = _scalars
try:
    from naibu._numba.intrinsics import _vectors
except Exception:  # whatever a changed interface raises
    VECTORS = False
else:
    VECTORS = passes(_vectors.trial)
    _chosen = _vectors if VECTORS else _scalars

WIDTH: int = _chosen.WIDTH
load, store, splat, total = _chosen.load, _chosen.store, _chosen.splat, _chosen.total
single, double, inverse_root = _chosen.single, _chosen.double, _chosen.inverse_root


def aligned(shape: tuple[int, ...], kind: Any) -> Any:
    """Return zeros that begin at the start of a cache line."""
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    raw = np.zeros(size + 64, dtype=np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + size].view(kind).reshape(shape)
