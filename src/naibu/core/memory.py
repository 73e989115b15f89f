"""How much address space a process may still take, and which errors are those of too little memory.

Under a limit of the address space (``ulimit -v``, batch systems) libraries in C end the process with messages of their own, or wait for
ever; what they need is therefore asked for before they are loaded. Only POSIX systems have such limits.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import sys
from pathlib import Path

MEGABYTE = 2**20
LIBRARIES_MB = 640  # for Python, NumPy, SciPy and LLVM: they do not load with 450 MB, small computations run with 700
_SIGNS = ("failed to map segment", "cannot allocate memory", "can't start new thread", "unable to allocate", "not enough memory")


def address_space() -> tuple[float, float]:
    """Return how much address space the process may take and how much it has taken, MB; infinite and 0 where there is no limit."""
    if sys.platform == "win32":
        return float("inf"), 0.0
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return float("inf"), 0.0
    try:
        taken = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    except OSError:  # no such file on macOS
        taken = 0
    return limit / MEGABYTE, taken / MEGABYTE


def available_memory_mb() -> float:
    """Return the memory that can be taken without swapping, MB: what is free, or what a container leaves; infinite where nothing tells."""
    room = [address_space()[0] - address_space()[1]]
    with contextlib.suppress(OSError, ValueError):  # another system: nothing tells
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        room += [float(line.split()[1]) / 1024.0 for line in lines if line.startswith("MemAvailable:")]
    with contextlib.suppress(OSError, ValueError):  # no container
        limit, used = (Path(f"/sys/fs/cgroup/memory.{name}").read_text(encoding="ascii").strip() for name in ("max", "current"))
        room += [(float(limit) - float(used)) / MEGABYTE] if limit != "max" else []
    return min(room)


def return_freed_memory() -> None:
    """Give memory that was freed back to the system, where the C library can: glibc keeps arrays of up to 32 MB for later ones.

    Larger arrays are never kept: what lies free among small ones is no room for them.
    """
    if not sys.platform.startswith("linux"):
        return
    with contextlib.suppress(OSError, AttributeError):  # another C library has no such function
        ctypes.CDLL(None).malloc_trim(0)


def require_address_space(needed_mb: float, what: str) -> None:
    """Raise an error unless a limit of the address space leaves enough room.

    Parameters
    ----------
    needed_mb : float
        Room that `what` takes, MB.
    what : str
        What takes it, for the message.

    Raises
    ------
    MemoryError
        Too little room is left.
    """
    limit, taken = address_space()
    if limit - taken < needed_mb:
        raise MemoryError(
            f"{what} take {needed_mb:.0f} MB of address space, and {max(limit - taken, 0.0):.0f} MB of a limit of {limit:.0f} MB are left: "
            "raise the limit (ulimit -v)"
        )


def reserve_work_space() -> None:
    """Under a limit of the address space, let the copies of OpenBLAS in NumPy and SciPy take their work space while there is some.

    They take it at their first use, keep it, and try for ever where there is none.
    """
    if address_space()[0] == float("inf"):
        return
    import numpy as np
    import scipy.linalg

    matrix = np.eye(512)  # large enough for all their threads
    np.linalg.cholesky(matrix @ matrix)
    scipy.linalg.cholesky(matrix)


def is_out_of_memory(error: BaseException) -> bool:
    """Tell whether an error, or one that caused it, is that of too little memory, whatever its class."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, MemoryError) or (isinstance(seen, OSError) and seen.errno == errno.ENOMEM):
            return True
        if isinstance(seen, OSError | ImportError | RuntimeError) and any(sign in str(seen).lower() for sign in _SIGNS):
            return True
        seen = seen.__cause__ or seen.__context__
    return False
