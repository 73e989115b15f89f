"""Worker processes that stay for several rounds of tasks: each starts, imports and loads its kernels once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType

from naibu.core.cores import usable_cores
from naibu.workflows.parallel.local_worker import LocalWorker


class WorkerPool:
    """Processes of this computer, lent to one round of tasks after another; they end with the context of the pool."""

    def __init__(self) -> None:
        self._workers: list[LocalWorker] = []
        self._threads = 0

    @contextmanager
    def lent(self, count: int) -> Iterator[list[LocalWorker]]:
        """Lend so many workers, which share the cores; after an error all are ended, for one of them may still compute.

        Parameters
        ----------
        count : int
            Their number. Where it changes the threads that each may use, they start anew.
        """
        threads = max(1, usable_cores() // count)
        if threads != self._threads:
            self.close()
        self._threads = threads
        self._workers += [LocalWorker(threads) for _ in range(len(self._workers), count)]
        try:
            yield self._workers[:count]
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End all processes."""
        for worker in self._workers:
            worker.stop()
        self._workers = []

    def __enter__(self) -> WorkerPool:
        """Lend workers until the context ends."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """End all processes."""
        self.close()
