"""A process of this computer that computes one task after another, and is replaced when it dies."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
from threading import Lock
from typing import IO, Any, cast

from naibu.core.progress import Progress
from naibu.workflows.parallel.frames import read_frame, write_frame
from naibu.workflows.parallel.task import Task

_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
_TOLD = 300  # letters of a dead worker's last words


class WorkerDiedError(Exception):
    """The process of a worker ended in the midst of a task; the text says how."""


class LocalWorker:
    """A worker process, started with its first task.

    Parameters
    ----------
    threads : int
        Threads that its libraries may use.
    """

    def __init__(self, threads: int) -> None:
        # the folders of this process, so that what can be imported here can be imported there
        self._environment = os.environ | dict.fromkeys(_THREADS, str(threads)) | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        self._process: subprocess.Popen[bytes] | None = None
        self._messages: IO[bytes] | None = None
        self._stopped = False
        self._lock = Lock()

    def call(self, task: Task, progress: Progress) -> Any:
        """Compute a task and return its result.

        Raises
        ------
        WorkerDiedError
            The process died.
        Exception
            What the task raised.
        """
        process = self._running()
        try:
            write_frame(cast(IO[bytes], process.stdin), (task.function, dict(task.arguments)))
            while True:
                kind, content = pickle.loads(read_frame(cast(IO[bytes], process.stdout)))
                if kind == "progress":
                    progress(content)
                elif kind == "failed":
                    raise content
                else:
                    return content
        except (EOFError, BrokenPipeError, ConnectionResetError) as error:
            if process.poll() is None and not self._stopped and not isinstance(error, EOFError):
                process.kill()
            raise WorkerDiedError(self._last_words(process)) from None

    def stop(self) -> None:
        """End the process; a task that it computes is lost."""
        with self._lock:
            self._stopped = True
            if self._process is not None:
                self._process.kill()
                self._process.wait()

    def _running(self) -> subprocess.Popen[bytes]:
        with self._lock:
            if self._stopped:
                raise WorkerDiedError("stopped")
            if self._process is None or self._process.poll() is not None:
                self._messages = tempfile.TemporaryFile()  # noqa: SIM115  as long as the process
                self._process = subprocess.Popen(
                    [sys.executable, "-m", "naibu.workflows.parallel.worker"],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=self._messages,
                    env=self._environment,
                    start_new_session=True,  # Ctrl-C in the terminal reaches this process alone
                )
            return self._process

    def _last_words(self, process: subprocess.Popen[bytes]) -> str:
        code = process.wait()
        how = f"exit code {code}" if code >= 0 else f"killed by {signal.Signals(-code).name}"
        messages = cast(IO[bytes], self._messages)
        messages.seek(0)
        lines = messages.read().decode(errors="replace").strip().splitlines()
        return f"{how}; its last line was: {lines[-1][:_TOLD]}" if lines else how
