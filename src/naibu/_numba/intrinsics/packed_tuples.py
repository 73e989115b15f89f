"""Packed tuples: many arguments of a kernel as the address of one record in memory.

Numba hands over an array as seven numbers and more, and a tuple as those of all its arrays, to the kernel and to every kernel that this
one calls. A hundred arrays make thousands of arguments, which take the compiler minutes, and each call microseconds. Of a packed tuple the
address is handed over; a kernel takes it apart as it does a tuple, and reads from memory what it uses. Where the type does not work with
this version of Numba (`PACKED` is False), kernels take the tuples as they are.
"""

from __future__ import annotations

from typing import Any

import numba

from naibu._numba.versions import passes

try:
    from naibu._numba.intrinsics import _packed_type
except Exception:  # whatever a changed interface raises
    PACKED = False
else:
    PACKED = not getattr(numba.config, "DISABLE_JIT", 0) and passes(_packed_type.trial)


def packed(*items: Any) -> Any:
    """Return arrays, numbers and nested tuples of them as one argument of a kernel.

    Parameters
    ----------
    *items : ndarray, number or tuple
        Arrays are contiguous and kept alive; what they hold may change. Numbers stay what they are now.

    Raises
    ------
    ValueError
        An array that is not contiguous.
    """
    return _packed_type.packed(*items) if PACKED else items
