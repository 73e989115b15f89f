"""Subnormal numbers, below 1.2e-38 in single precision, taken for zeros in Numba kernels.

Processors compute with them many times slower than with others. Where a wave spreads through a large model, they stand before its front::

    before = flush_subnormals()  # of this thread
    ...
    restore(before)

Where the intrinsics do not work with this version of Numba or on this processor (`FLUSHES` is False), nothing changes.
"""

from __future__ import annotations

from typing import Any

from naibu._numba.intrinsics import _plain_operations
from naibu._numba.versions import passes

_chosen: Any = _plain_operations
try:
    from naibu._numba.intrinsics import _control_register
except Exception:  # whatever a changed interface raises
    FLUSHES = False
else:
    FLUSHES = _control_register.SUPPORTED and passes(_control_register.trial)
    _chosen = _control_register if FLUSHES else _plain_operations

flush_subnormals, restore = _chosen.flush_subnormals, _chosen.restore
