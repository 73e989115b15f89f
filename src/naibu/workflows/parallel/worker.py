"""The program of a worker process, ``python -m naibu.workflows.parallel.worker``: computes tasks that come through standard input."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import time
import traceback
from queue import SimpleQueue
from threading import Thread
from typing import IO

from naibu.core.progress import ProgressReport
from naibu.workflows.parallel.frames import read_frame, write_frame

REPORT_S = 0.1  # between reports of progress


def main() -> None:
    """Compute tasks until standard input ends, which also ends a task that is being computed: whoever wanted it is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that gives the tasks
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print must not come between the replies
    tasks: SimpleQueue[bytes] = SimpleQueue()
    Thread(target=_receive, args=(sys.stdin.buffer, tasks), daemon=True).start()
    while True:
        _compute(tasks.get(), replies)


def _receive(stream: IO[bytes], tasks: SimpleQueue[bytes]) -> None:
    while True:
        try:
            tasks.put(read_frame(stream))
        except (EOFError, OSError):
            os._exit(0)


def _compute(message: bytes, replies: IO[bytes]) -> None:
    said = 0.0

    def progress(report: ProgressReport) -> None:
        nonlocal said
        if time.monotonic() - said >= REPORT_S:
            said = time.monotonic()
            write_frame(replies, ("progress", report))

    try:
        function, arguments = pickle.loads(message)
        reply = ("done", function(**arguments, progress=progress))
    except Exception as error:
        error.add_note("".join(traceback.format_exception(error)))
        reply = ("failed", error)
    try:
        write_frame(replies, reply)
    except OSError:
        os._exit(0)
    except Exception as error:  # neither every result nor every exception can be pickled
        told = "".join(traceback.format_exception(reply[1])) if reply[0] == "failed" else f"a result that cannot be sent ({error})"
        write_frame(replies, ("failed", RuntimeError(told)))


if __name__ == "__main__":
    main()
