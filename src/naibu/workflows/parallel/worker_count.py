"""Where tasks run: so many processes here, or a cluster."""

from __future__ import annotations

import os
from dataclasses import dataclass

from naibu.core.cores import usable_cores
from naibu.core.errors import InputError
from naibu.core.memory import available_memory_mb

MOST_PER_CORE = 4  # processes


@dataclass(frozen=True, slots=True)
class Workers:
    """Where tasks run.

    Attributes
    ----------
    workers : int
        Processes on this computer: 1 for this process itself, 0 for as many as its cores and its free memory allow.
    cluster : str, optional
        Address of the scheduler of a Dask cluster, ``"tcp://HOST:PORT"``, instead.

    Raises
    ------
    InputError
        A number that cannot be, or both.
    """

    workers: int = 1
    cluster: str | None = None

    def __post_init__(self) -> None:
        most = max(MOST_PER_CORE * (os.cpu_count() or 1), 8)
        if isinstance(self.workers, bool) or not isinstance(self.workers, int) or not 0 <= self.workers <= most:
            raise InputError(
                f"`workers` is {self.workers!r}; give a number of processes from 1 to {most}, or 0 for what cores and memory allow"
            )
        if self.cluster is not None and self.workers != 1:
            raise InputError(f"`workers` is {self.workers} and `cluster` {self.cluster!r}; give one of the two")
        if self.cluster is not None and "://" not in self.cluster:
            raise InputError(f"`cluster` is {self.cluster!r}; give the address of a Dask scheduler, such as tcp://localhost:8786")

    @property
    def elsewhere(self) -> bool:
        """Whether tasks leave this process."""
        return self.cluster is not None or self.workers != 1

    def processes(self, tasks: int, memory_mb: float) -> int:
        """Return the number of processes for so many tasks.

        Parameters
        ----------
        tasks : int
            Their number.
        memory_mb : float
            Memory that one of them takes, MB.
        """
        if self.workers:
            return min(self.workers, tasks)
        return max(1, min(usable_cores(), tasks, int(available_memory_mb() // memory_mb)))


HERE = Workers()
