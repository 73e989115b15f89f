"""Tasks that worker processes compute in tests."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from naibu.core.errors import ConvergenceError
from naibu.core.progress import Progress, report_progress


def square(number: float, progress: Progress | None) -> float:
    report_progress(progress, "squaring", done=1, total=2)
    return number * number


def threads_seen(progress: Progress | None) -> tuple[int, str]:
    import numba

    print("noise on standard output")
    return numba.get_num_threads(), os.environ["OMP_NUM_THREADS"]


def failing(progress: Progress | None) -> None:
    raise ConvergenceError("cannot be solved")


def dying(times: int, counter: str, progress: Progress | None) -> int:
    """Kill its own process the first `times` times; return how often it was begun."""
    begun = Path(counter)
    with begun.open("a") as file:
        file.write("x")
    count = len(begun.read_text())
    if count <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return count


def sleeping(seconds: float, pid_file: str, progress: Progress | None) -> None:
    Path(pid_file).write_text(str(os.getpid()))
    time.sleep(seconds)


def killed_at(
    function: Callable[..., Any], victim: tuple[str, Any], times: int, counter: str, progress: Progress | None, **arguments: Any
) -> Any:
    """Call a task's function, but kill the own process the first `times` times that an argument has the value of the `victim`."""
    name, value = victim
    if np.array_equal(arguments[name], value):
        dying(times, counter, progress)
    return function(**arguments, progress=progress)


def own_process(seconds: float, progress: Progress | None) -> int:
    """Return the process's number after a while, in which another process takes the next task."""
    time.sleep(seconds)
    return os.getpid()


def process_of_block(reference: object, deformed: object, mask: object, item: int) -> tuple[int, int]:
    """Return the item, and the process's number after a while, in which another process takes the next block."""
    time.sleep(1.0)
    return item, os.getpid()
