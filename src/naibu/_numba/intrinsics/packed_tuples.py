"""Packed tuples: many arguments of a kernel as the address of one record in memory.

Numba hands over an array as seven numbers and more, and a tuple as those of all its arrays, to the kernel and to every kernel that this
one calls. A hundred arrays make thousands of arguments, which take the compiler minutes, and each call microseconds. Of a packed tuple the
address is handed over; a kernel takes it apart as it does a tuple, and reads from memory what it uses. Where the type does not work with
this version of Numba (`PACKED` is False), kernels take the tuples as they are.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from naibu._numba.versions import passes

try:
    from naibu._numba.intrinsics import _packed_type
except Exception:  # whatever a changed interface raises
    PACKED = False
else:
    PACKED = not getattr(numba.config, "DISABLE_JIT", 0) and passes(_packed_type.trial)
_CLASSES: dict[tuple[Any, ...], Any] = {}  # of packed tuples, by what their types depend on


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
    return packed_items(items)


def packed_items(items: Any) -> Any:
    """Return a tuple, named or not, as one argument of a kernel, which reads named items by their names, too; see `packed`.

    Parameters
    ----------
    items : tuple or named tuple
        Of arrays, numbers and such tuples.
    """
    if not PACKED:
        return items
    kind = _of_kind(items)
    if kind not in _CLASSES:
        _CLASSES[kind] = type(_packed_type.packed(items))
    own = _CLASSES[kind]
    memory = np.zeros(max(own.kind.starts[-1], 1), dtype=np.int64)
    _packed_type._fill(memory, own.kind, items)
    made = own("q", memory.tobytes())
    made.kept, made.address = items, made.buffer_info()[0]
    return made


def _of_kind(items: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return what the type of a packed tuple depends on; Numba takes milliseconds to find and to compare types of a hundred arrays."""
    found: list[Any] = [getattr(items, "_fields", ())]
    for one in items:
        if type(one) is np.ndarray:
            flags = one.flags
            found.append((one.dtype, one.ndim, flags.c_contiguous, flags.writeable, flags.aligned))
        else:
            found.append(_of_kind(one) if isinstance(one, tuple) else numba.typeof(one))  # type: ignore[no-untyped-call]
    return tuple(found)
