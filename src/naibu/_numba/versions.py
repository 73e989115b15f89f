"""Which versions of Numba the intrinsics and the kernel cache were tested with, and what happens on others.

Intrinsics (`naibu._numba.intrinsics`) write LLVM instructions, and the cache serializes compiled functions; both rely on interfaces
that Numba may change from one minor version to the next. On a tested version they are used as they are; on another one only after a trial,
otherwise the plain substitute is used.
"""

from __future__ import annotations

from collections.abc import Callable

import numba

FIRST_TESTED, FIRST_UNTESTED = (0, 59), (0, 69)
TESTED = ">=0.59,<0.69"  # as in pyproject.toml


def tested() -> bool:
    """Tell whether this version of Numba is one of those that naibu was tested with."""
    return FIRST_TESTED <= version() < FIRST_UNTESTED


def version() -> tuple[int, int]:
    """Return major and minor version of Numba."""
    major, minor = (int(part) for part in numba.__version__.split(".")[:2])
    return major, minor


def passes(trial: Callable[[], bool]) -> bool:
    """Return True on a tested version; on another one, whether the trial returns True and raises nothing."""
    if tested():
        return True
    try:
        return trial()
    except Exception:  # whatever a changed interface raises
        return False
