"""A lock between processes, held through an open file: the system releases it when its process ends."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from pathlib import Path

if sys.platform == "win32":
    import msvcrt

    def _take(descriptor: int) -> None:
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except PermissionError as error:  # another process holds it
            raise BlockingIOError from error

    def _give(descriptor: int) -> None:
        os.lseek(descriptor, 0, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_UNLCK, 1)

else:
    import fcntl

    def _take(descriptor: int) -> None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def _give(descriptor: int) -> None:
        fcntl.flock(descriptor, fcntl.LOCK_UN)  # a process forked meanwhile has the file open too


class ProcessLock:
    """A lock that one process holds at a time, best effort.

    Where locks do not work (some network file systems, folders that cannot be written to) or the wait takes too long, work goes on without:
    work under this lock may be done twice, but is done.

    Parameters
    ----------
    path : Path
        The file; it is made, and removed when the lock is released.
    longest_wait_s : float
        After so many seconds work goes on without the lock.
    """

    def __init__(self, path: Path, longest_wait_s: float) -> None:
        self._path, self._longest = path, longest_wait_s
        self._descriptor: int | None = None
        self._held = False

    def __enter__(self) -> ProcessLock:
        try:
            self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError:
            return self
        start = time.monotonic()
        try:
            while True:
                try:
                    _take(self._descriptor)
                except BlockingIOError:
                    if time.monotonic() - start > self._longest:
                        break
                    time.sleep(0.02)
                except OSError:
                    break
                else:
                    self._held = True
                    break
        except BaseException:  # interrupted while it waited
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        descriptor, held, self._descriptor, self._held = self._descriptor, self._held, None, False
        if descriptor is None:
            return
        with contextlib.suppress(OSError):
            if held:
                # who waits for this very file takes it and finds the work done; who comes later makes a new one
                self._path.unlink(missing_ok=True)
                _give(descriptor)
        with contextlib.suppress(OSError):
            os.close(descriptor)
        if held:
            with contextlib.suppress(OSError):  # Windows removes no open file
                self._path.unlink(missing_ok=True)
