"""Tasks on worker processes: results, deaths, failures, interruption."""

import os
import subprocess
import sys
import time
from collections.abc import Generator
from functools import partial
from pathlib import Path

import pytest
import worker_tasks

from naibu.core.cores import usable_cores
from naibu.core.errors import ConvergenceError, InputError, WorkerLostError
from naibu.core.progress import Progress, ProgressReport
from naibu.workflows.parallel.run_tasks import outcomes_in_order, run_tasks
from naibu.workflows.parallel.task import Outcome, Task
from naibu.workflows.parallel.worker_count import Workers
from naibu.workflows.parallel.worker_pool import WorkerPool

TWO = Workers(2)


def squares(count: int) -> list[Task]:
    return [Task(f"square {k}", worker_tasks.square, {"number": float(k)}, measured=True) for k in range(count)]


def note(indices: list[int], index: int, outcome: Outcome) -> None:
    indices.append(index)


def gone(pid: int, within_s: float = 10.0) -> bool:
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def test_results_come_in_order_whatever_the_number_of_workers() -> None:
    expected = [k * k for k in range(7)]
    for workers in (Workers(1), TWO):
        finished: list[int] = []
        reports: list[ProgressReport] = []
        outcomes = run_tasks(squares(7), workers=workers, finished=partial(note, finished), progress=reports.append, stage="squares")
        assert [o.value() for o in outcomes] == expected
        assert sorted(finished) == list(range(7))
        assert reports[0].done == 0 and reports[-1].done == 7
        assert {(r.stage, r.total) for r in reports} == {("squares", 7)}
        assert any(r.done % 1 == 0.5 for r in reports if r.done is not None) or workers is TWO  # workers leave out what comes too often


def test_long_tasks_count_more_in_the_share_that_is_done() -> None:
    tasks = [Task(f"{k}", worker_tasks.square, {"number": float(k)}, length=length) for k, length in enumerate((10.0, 10.0, 380.0))]
    reports: list[ProgressReport] = []
    run_tasks(tasks, workers=Workers(1), progress=reports.append, stage="chapters")
    told = {report.done: report.fraction for report in reports}
    assert told == pytest.approx({0.0: 0.0, 1.0: 0.025, 2.0: 0.05, 3.0: 1.0})
    assert {report.total for report in reports} == {3}


def test_a_killed_worker_costs_its_task_only_which_is_begun_again(tmp_path: Path) -> None:
    once = Task("once", worker_tasks.dying, {"times": 1, "counter": str(tmp_path / "once")})
    always = Task("always", worker_tasks.dying, {"times": 99, "counter": str(tmp_path / "always")})
    outcomes = run_tasks([once, *squares(3), always, *squares(3)], workers=TWO)
    assert outcomes[0].value() == 2 and outcomes[0].attempts == 2
    assert [o.value() for o in outcomes[1:4]] == [o.value() for o in outcomes[5:]] == [0, 1, 4]
    with pytest.raises(WorkerLostError, match=r"always: its worker died twice \(killed by SIGKILL\)"):
        outcomes[4].value()
    assert (tmp_path / "always").read_text() == "xx"


def test_an_exception_is_that_of_its_task_and_is_not_tried_again() -> None:
    for workers in (Workers(1), TWO):
        outcomes = run_tasks([Task("failing", worker_tasks.failing), *squares(2)], workers=workers)
        assert isinstance(outcomes[0].error, ConvergenceError) and outcomes[0].attempts == 1
        assert str(outcomes[0].error) == "cannot be solved"
        assert [o.value() for o in outcomes[1:]] == [0, 1]


def test_workers_share_the_cores() -> None:
    outcomes = run_tasks([Task("threads", worker_tasks.threads_seen)] * 2, workers=TWO)
    each = max(1, usable_cores() // 2)
    assert [o.value() for o in outcomes] == [(each, str(each))] * 2


def pooled(tasks: list[Task], pool: WorkerPool, progress: Progress | None = None) -> Generator[Outcome, None, None]:
    return outcomes_in_order(tasks, TWO, memory_mb=100.0, stage="tasks", progress=progress, pool=pool)


def processes(pool: WorkerPool, count: int) -> list[int]:
    tasks = [Task(f"process {k}", worker_tasks.own_process, {"seconds": 1.0}) for k in range(count)]
    return [outcome.value() for outcome in pooled(tasks, pool)]


def test_processes_of_a_pool_stay_for_the_next_tasks_and_end_with_it() -> None:
    with WorkerPool() as pool:
        first = processes(pool, 4)
        assert len(set(first)) == 2
        assert set(processes(pool, 2)) == set(first)
    assert all(gone(pid) for pid in first)


def test_a_pool_goes_on_after_a_death_and_after_an_interruption(tmp_path: Path) -> None:
    """A process that died is replaced; after an interruption none is left that may still compute."""
    pid_file = tmp_path / "pid"

    def progress(report: ProgressReport) -> None:
        if pid_file.is_file() and pid_file.read_text():
            raise KeyboardInterrupt

    with WorkerPool() as pool:
        dying = Task("dying", worker_tasks.dying, {"times": 1, "counter": str(tmp_path / "begun")})
        outcomes = list(pooled([dying, *squares(2)], pool))
        assert [o.value() for o in outcomes] == [2, 0, 1] and outcomes[0].attempts == 2
        before = processes(pool, 2)
        sleeping = Task("sleeping", worker_tasks.sleeping, {"seconds": 600.0, "pid_file": str(pid_file)})
        with pytest.raises(KeyboardInterrupt):
            list(pooled([sleeping] * 2, pool, progress))
        assert all(gone(pid) for pid in before)
        assert [o.value() for o in pooled(squares(2), pool)] == [0.0, 1.0]


def test_outcomes_can_be_used_while_later_tasks_are_computed(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    sleeping = Task("sleeping", worker_tasks.sleeping, {"seconds": 600.0, "pid_file": str(pid_file)})
    with WorkerPool() as pool:
        outcomes = pooled([*squares(3), sleeping], pool)
        assert [next(outcomes).value() for _ in range(3)] == [0.0, 1.0, 4.0]
        end = time.monotonic() + 60.0
        while not (pid_file.is_file() and pid_file.read_text()) and time.monotonic() < end:
            time.sleep(0.05)
        outcomes.close()  # nobody wants the others
        assert gone(int(pid_file.read_text()))


def test_an_interruption_ends_the_workers_and_keeps_what_is_finished(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    kept: list[int] = []

    def progress(report: ProgressReport) -> None:
        if kept and pid_file.is_file():
            raise KeyboardInterrupt

    tasks = [Task("sleeping", worker_tasks.sleeping, {"seconds": 600.0, "pid_file": str(pid_file)}), *squares(2)]
    with pytest.raises(KeyboardInterrupt):
        run_tasks(tasks, workers=TWO, finished=lambda k, _: kept.append(k), progress=progress)
    assert set(kept) <= {1, 2} and kept
    assert gone(int(pid_file.read_text()))


def test_workers_end_with_the_process_that_wanted_them(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    program = (
        "import worker_tasks; from naibu.workflows.parallel.run_tasks import run_tasks; from naibu.workflows.parallel.task import Task\n"
        "from naibu.workflows.parallel.worker_count import Workers\n"
        f"run_tasks([Task('s', worker_tasks.sleeping, dict(seconds=600.0, pid_file={str(pid_file)!r}))] * 2, workers=Workers(2))"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    parent = subprocess.Popen([sys.executable, "-c", program], env=environment)
    try:
        end = time.monotonic() + 60.0
        while not (pid_file.is_file() and pid_file.read_text()) and time.monotonic() < end:
            time.sleep(0.05)
    finally:
        parent.kill()
        parent.wait()
    assert gone(int(pid_file.read_text()))


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"workers": -1}, "`workers` is -1"),
        ({"workers": 10_000}, "`workers` is 10000"),
        ({"workers": 2, "cluster": "tcp://a:1"}, "one of the two"),
        ({"cluster": "somewhere"}, "address"),
    ],
)
def test_numbers_of_workers_that_cannot_be(given: dict, told: str) -> None:
    with pytest.raises(InputError, match=told):
        Workers(**given)


def test_as_many_workers_as_cores_memory_and_tasks_allow() -> None:
    assert Workers(0).processes(1, 1.0) == 1
    assert Workers(0).processes(1000, 1.0) == usable_cores()
    assert Workers(0).processes(1000, 1e12) == 1
    assert Workers(3).processes(2, 1e12) == 2


def test_a_cluster_computes_the_same_and_an_absent_one_is_told() -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp") as cluster:
        outcomes = run_tasks([Task("failing", worker_tasks.failing), *squares(3)], workers=Workers(cluster=cluster.scheduler_address))
    assert isinstance(outcomes[0].error, ConvergenceError)
    assert [o.value() for o in outcomes[1:]] == [0, 1, 4]


def test_a_cluster_without_workers_is_told_and_computes_once_one_comes() -> None:
    distributed = pytest.importorskip("distributed")
    stages = []
    with distributed.LocalCluster(n_workers=0, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp") as cluster:

        def told(report: ProgressReport) -> None:
            stages.append(report.stage)
            if "has no worker: start `dask worker tcp://" in report.stage:
                cluster.scale(1)

        outcomes = run_tasks(squares(2), workers=Workers(cluster=cluster.scheduler_address), progress=told)
    assert [o.value() for o in outcomes] == [0, 1]
    assert any("has no worker" in stage for stage in stages)


def test_an_absent_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("naibu.workflows.parallel.cluster.ANSWER_S", 0.5)
    with pytest.raises(InputError, match="no Dask scheduler answers there"):
        run_tasks(squares(1), workers=Workers(cluster="tcp://127.0.0.1:9"))
