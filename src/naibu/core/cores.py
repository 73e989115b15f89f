"""How many processor cores this process may use."""

from __future__ import annotations

import os


def usable_cores() -> int:
    """Return how many cores this process may use: those that the system gives it, and not more than ``NUMBA_NUM_THREADS`` states."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    stated = os.environ.get("NUMBA_NUM_THREADS", "").strip()
    return max(1, min(count, int(stated))) if stated.isdecimal() else count
