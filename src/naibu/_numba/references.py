# mypy: disallow-untyped-calls=False, warn-unused-ignores=False
"""Kernels whose references are not counted neither return arrays nor call kernels that return new ones.

Who calls a kernel takes over a reference to each array that it returns. One that was never counted is given back once too often, and the
array is freed while it is in use; one that was counted for a caller who does not count is never given back, and its memory is lost.
"""

from __future__ import annotations

from typing import Any

import numba
from numba.core.targetconfig import ConfigStack

COUNTING = "_nrt"  # option of Numba's kernels


def holds_arrays(kind: Any) -> bool:
    """Tell whether values of a Numba type are arrays, or tuples with some."""
    if isinstance(kind, numba.types.BaseTuple):
        items: Any = kind
        return any(holds_arrays(item) for item in items.types)
    return isinstance(kind, numba.types.Array)


def require_no_arrays(label: str, options: dict[str, Any], return_type: Any) -> None:
    """Raise TypeError if a kernel whose references are not counted returns arrays.

    Parameters
    ----------
    label : str
        Name of the kernel.
    options : dict
        What it was decorated with.
    return_type : numba type
        Of its result.
    """
    if options.get(COUNTING) is False and holds_arrays(return_type):
        raise TypeError(
            f"{label} returns {return_type}, whose references are not counted; "
            "make it without UNCOUNTED, or let it fill an array of its caller"
        )


def require_counting_caller(label: str, options: dict[str, Any], return_type: Any) -> None:
    """Raise TypeError if the kernel that is being compiled counts no references, and calls one that counts them and returns arrays.

    Parameters are those of `require_no_arrays`, of the kernel that is called.
    """
    caller = ConfigStack.top_or_none()
    if options.get(COUNTING) and caller is not None and not caller.nrt and holds_arrays(return_type):
        raise TypeError(
            f"{label} returns {return_type} to a kernel that does not give it back, being UNCOUNTED; hand it arrays to be filled instead"
        )
