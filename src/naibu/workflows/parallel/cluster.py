"""Tasks on a Dask cluster :cite:p:`rocklin2015`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any

from naibu.core.errors import InputError, WorkerLostError
from naibu.core.optional_packages import optional_package
from naibu.workflows.parallel.task import Outcome, Task

ANSWER_S = 10.0  # in which a scheduler has to answer


@dataclass(frozen=True, slots=True)
class Submitted:
    """Tasks that a cluster has.

    Attributes
    ----------
    messages : SimpleQueue
        Their indices and outcomes, as they are finished.
    hindrance : callable
        Says what keeps the cluster from computing, None where nothing does.
    """

    messages: SimpleQueue[Any]
    hindrance: Callable[[], str | None]


@contextmanager
def submitted(tasks: Sequence[Task], address: str) -> Iterator[Submitted]:
    """Give tasks to a cluster; on leaving, what is not finished is cancelled.

    Dask itself begins a task again whose worker died.

    Parameters
    ----------
    tasks : sequence of Task
        What is computed; functions and arguments are pickled, and naibu is installed on the workers.
    address : str
        Of the scheduler.

    Raises
    ------
    InputError
        Nobody answers there.
    MissingDependencyError
        The package ``distributed`` is not installed.
    """
    distributed = optional_package("distributed", "computing on a cluster", "naibu[cluster]")
    try:
        client = distributed.Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        told = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"`cluster` {address!r}: no Dask scheduler answers there ({told[:200]}); start one with `dask scheduler`"
        ) from error
    messages: SimpleQueue[Any] = SimpleQueue()
    with client:
        futures = [client.submit(_called, task.function, dict(task.arguments), pure=False) for task in tasks]
        for index, future in enumerate(futures):
            future.add_done_callback(_teller(index, tasks[index].name, messages))
        try:
            yield Submitted(messages, lambda: _hindrance(client, address))
        finally:
            client.cancel(futures)


def _hindrance(client: Any, address: str) -> str | None:
    """Say that the scheduler has no worker, for which Dask waits without an end: one may yet come, from the queue of a batch system."""
    return None if client.scheduler_info()["workers"] else f"waiting, since {address} has no worker: start `dask worker {address}`"


def _called(function: Callable[..., Any], arguments: Mapping[str, Any]) -> Any:
    return function(**arguments, progress=None)


def _teller(index: int, name: str, messages: SimpleQueue[Any]) -> Callable[[Any], None]:
    def tell(future: Any) -> None:
        if future.status == "finished":
            try:
                messages.put((index, Outcome(future.result())))
            except Exception as error:  # lost on the way
                messages.put((index, Outcome(error=error)))
        elif future.status == "error":
            raised = future.exception()
            lost = type(raised).__name__ == "KilledWorker"
            messages.put((index, Outcome(error=WorkerLostError.of(name, "of the cluster") if lost else raised)))
        else:
            messages.put((index, Outcome(error=WorkerLostError.of(name, f"the cluster says: {future.status}"))))

    return tell
