"""Independent tasks, computed here, by several processes, or by a Dask cluster, with the same results."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from queue import Empty, SimpleQueue
from threading import Thread

from naibu.core.errors import WorkerLostError
from naibu.core.progress import Progress, ProgressReport, report_progress
from naibu.workflows.parallel.cluster import submitted
from naibu.workflows.parallel.local_worker import LocalWorker, WorkerDiedError
from naibu.workflows.parallel.task import Outcome, Task
from naibu.workflows.parallel.worker_count import HERE, Workers
from naibu.workflows.parallel.worker_pool import WorkerPool

ATTEMPTS = 2  # at a task whose worker dies
_REPEAT_S = 1.0  # between reports of progress where nothing happens, so that a stop is noticed
Message = tuple[int, Outcome | ProgressReport]


def run_tasks(
    tasks: Sequence[Task],
    *,
    workers: Workers = HERE,
    memory_mb: float = 600.0,
    stage: str = "tasks",
    finished: Callable[[int, Outcome], None] | None = None,
    progress: Progress | None = None,
) -> list[Outcome]:
    """Compute tasks, and return what became of each, in their order.

    A task that fails does not stop the others. A worker process that dies costs its task only: the process is replaced, and the task begun
    again once. Ctrl-C (KeyboardInterrupt) ends all workers; what was finished has been given to `finished`.

    Parameters
    ----------
    tasks : sequence of Task
        They may run in any order, and at the same time.
    workers : Workers
        Where they run.
    memory_mb : float
        Memory that one task takes, MB, for the number of processes where `workers` leaves it open.
    stage : str
        What is computed, for the reports of progress.
    finished : callable, optional
        Called in this thread with the index and the outcome of every task, when it is finished.
    progress : callable, optional
        Called in this thread with the progress over all tasks (`naibu.core.progress`).

    Raises
    ------
    InputError
        There is no such cluster.
    MissingDependencyError
        A cluster without the package ``distributed``.
    """
    return list(outcomes_in_order(tasks, workers, memory_mb=memory_mb, stage=stage, finished=finished, progress=progress))


def outcomes_in_order(
    tasks: Sequence[Task],
    workers: Workers,
    *,
    memory_mb: float,
    stage: str,
    finished: Callable[[int, Outcome], None] | None = None,
    progress: Progress | None = None,
    pool: WorkerPool | None = None,
) -> Generator[Outcome, None, None]:
    """Yield what became of each task, in their order: what is done with it is done while workers compute the next ones.

    Parameters
    ----------
    tasks, workers, memory_mb, stage, finished, progress
        As of `run_tasks`, which tells also what is raised.
    pool : WorkerPool, optional
        Whose processes compute the tasks, and stay for later ones; by default processes of their own. Closing the iterator before its end
        ends them.
    """
    overall = _Overall(tasks, stage, finished, progress)
    overall.report()
    if not tasks:
        return
    if workers.cluster is not None:
        with submitted(tasks, workers.cluster) as cluster:
            yield from overall.follow(cluster.messages, cluster.hindrance)
    elif workers.elsewhere:
        count = workers.processes(len(tasks), memory_mb)
        if pool is not None:
            yield from _run_here(tasks, count, overall, pool)
        else:
            with WorkerPool() as own:
                yield from _run_here(tasks, count, overall, own)
    else:
        for index, task in enumerate(tasks):
            overall.take(index, _attempted(task, overall.reporter(index)))
            yield overall.outcomes[index]


class _Overall:
    """Outcomes so far, and the progress over all tasks."""

    def __init__(
        self, tasks: Sequence[Task], stage: str, finished: Callable[[int, Outcome], None] | None, progress: Progress | None
    ) -> None:
        self._tasks, self._stage, self._finished, self._progress = tasks, stage, finished, progress
        self._shares: dict[int, float] = {}
        self.outcomes: dict[int, Outcome] = {}

    def reporter(self, index: int) -> Progress:
        """Return what takes the reports of a task that is computed in this thread."""
        return lambda report: self.take(index, report)

    def take(self, index: int, content: Outcome | ProgressReport) -> None:
        """Take a report or the outcome of a task."""
        if isinstance(content, Outcome):
            self._shares.pop(index, None)
            self.outcomes[index] = content
            if self._finished is not None:
                self._finished(index, content)
        elif self._tasks[index].measured and content.fraction is not None:
            self._shares[index] = min(content.fraction, 0.99)
        self.report()

    def report(self, stage: str | None = None) -> None:
        """Report how many tasks are done, with the shares of those that are computed; `stage` stands for what is computed."""
        done = round(len(self.outcomes) + sum(self._shares.values()), 2)
        lengths = [task.length for task in self._tasks]
        gone = sum(lengths[i] for i in self.outcomes) + sum(lengths[i] * share for i, share in self._shares.items())
        share = gone / sum(lengths) if len(set(lengths)) > 1 else None
        report_progress(self._progress, stage or self._stage, done=done, total=len(self._tasks), share=share)

    def follow(self, messages: SimpleQueue[Message], hindrance: Callable[[], str | None] = lambda: None) -> Generator[Outcome, None, None]:
        """Take messages until all tasks are finished; yield the outcomes in their order. What is a hindrance is told meanwhile."""
        for index in range(len(self._tasks)):
            while index not in self.outcomes:
                try:
                    self.take(*messages.get(timeout=_REPEAT_S))
                except Empty:
                    self.report(hindrance())
            yield self.outcomes[index]


def _run_here(tasks: Sequence[Task], count: int, overall: _Overall, pool: WorkerPool) -> Generator[Outcome, None, None]:
    """Let processes of this computer compute the tasks, each served by a thread."""
    waiting: SimpleQueue[int] = SimpleQueue()
    for index in range(len(tasks)):
        waiting.put(index)
    messages: SimpleQueue[Message] = SimpleQueue()
    with pool.lent(count) as lent:
        for worker in lent:
            Thread(target=_serve, args=(worker, tasks, waiting, messages), daemon=True).start()
        yield from overall.follow(messages)


def _serve(worker: LocalWorker, tasks: Sequence[Task], waiting: SimpleQueue[int], messages: SimpleQueue[Message]) -> None:
    while True:
        try:
            index = waiting.get_nowait()
        except Empty:
            return
        messages.put((index, _on_worker(worker, tasks[index], index, messages)))


def _on_worker(worker: LocalWorker, task: Task, index: int, messages: SimpleQueue[Message]) -> Outcome:
    how = ""
    for attempt in range(1, ATTEMPTS + 1):
        try:
            return Outcome(worker.call(task, lambda report: messages.put((index, report))), attempts=attempt)
        except WorkerDiedError as error:
            how = str(error)
        except Exception as error:
            return Outcome(error=error, attempts=attempt)
    return Outcome(error=WorkerLostError.of(task.name, how), attempts=ATTEMPTS)


def _attempted(task: Task, progress: Progress) -> Outcome:
    try:
        return Outcome(task.function(**task.arguments, progress=progress))
    except Exception as error:
        return Outcome(error=error)
