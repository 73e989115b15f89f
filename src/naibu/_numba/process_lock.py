"""A lock among processes, held by an open file: whoever dies lets go of it."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

if sys.platform == "win32":
    import msvcrt

    def _take(descriptor: int) -> None:
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)

else:
    import fcntl

    def _take(descriptor: int) -> None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


class ProcessLock:
    """A lock that one process holds at a time.

    Parameters
    ----------
    path : Path
        The file; it is made, and stays.
    longest_wait_s : float
        After so many seconds `acquire` gives up.
    """

    def __init__(self, path: Path, longest_wait_s: float) -> None:
        self._path, self._longest = path, longest_wait_s
        self._descriptor: int | None = None

    def acquire(self) -> bool:
        """Take the lock, waiting for it; return whether it was taken by another process meanwhile, so that work may have been done.

        Where locks do not work (some network file systems) or the wait is too long, go on without.
        """
        try:
            self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o600)
        except OSError:
            return False
        start, waited = time.monotonic(), False
        while time.monotonic() - start < self._longest:
            try:
                _take(self._descriptor)
            except BlockingIOError:
                waited = True
                time.sleep(0.02)
            except OSError:
                return waited
            else:
                return True
        return waited

    def release(self) -> None:
        """Let go of the lock; nothing happens where it is not held."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
