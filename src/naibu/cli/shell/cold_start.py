"""The first run of a verb: what is said while kernels are compiled, and how Ctrl-C ends a compilation."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType

from rich.console import Console

from naibu._numba.reports import reported_compilation
from naibu.cli.shell.console import INTERRUPTED

TERMINATED = 143  # exit code after SIGTERM, as shells have it
INTERVAL_S = 5.0  # between lines of progress
DEFAULTS = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}  # handlers that are replaced
PATIENCE_S = 0.7  # after a signal, before a process that is still compiling is ended
# seconds to compile all kernels of a verb, on two cores; what is there already, or shared with other verbs, takes none
SECONDS = {
    "identify": 40, "demo": 40, "predict": 40, "compare": 40, "sense": 20, "compare-methods": 120, "track": 30, "simulate": 35, "live": 100,
}  # fmt: skip
USUAL_S = 40


class CompilationNotice:
    """Says on a console that kernels are compiled, at once and then every few seconds; nothing where none are.

    Parameters
    ----------
    verb : str
        Verb of the command line, for the estimate of the time.
    console : rich.console.Console
        Where to print.
    clock : callable
        Seconds from any origin.
    """

    def __init__(self, verb: str, console: Console, clock: Callable[[], float] = time.monotonic) -> None:
        self._verb, self._console, self._clock = verb, console, clock
        self._began: float | None = None
        self._spoke = 0.0
        self._done = 0
        self.depth = 0

    def __call__(self, kernel: str, done: bool) -> None:
        """Take note of the begin or the end of a compilation."""
        self.depth += -1 if done else 1
        self._done += done
        now = self._clock()
        if self._began is None:
            self._began = self._spoke = now
            seconds = SECONDS.get(self._verb, USUAL_S)
            self._print(f"compiling kernels for the first time, about {seconds} s ('naibu doctor --warm' compiles those of all verbs)")
        elif now - self._spoke > INTERVAL_S:
            self._spoke = now
            self._print(f"compiling kernels, {self._done} done, {now - self._began:.0f} s: {kernel.removeprefix('naibu.')}")

    def _print(self, text: str) -> None:
        self._console.print(text, soft_wrap=True, highlight=False, markup=False)


@contextlib.contextmanager
def first_run(verb: str, console: Console) -> Iterator[None]:
    """Within this context, say that kernels are compiled, and let Ctrl-C and SIGTERM end a compilation.

    Parameters
    ----------
    verb : str
        Verb of the command line.
    console : rich.console.Console
        Where to print.
    """
    notice = CompilationNotice(verb, console)
    with _prompt_end(lambda: notice.depth > 0), reported_compilation(notice):
        yield


@contextlib.contextmanager
def _prompt_end(compiling: Callable[[], bool]) -> Iterator[None]:
    """End the process soon after a signal while LLVM compiles, which keeps Python's handlers waiting.

    LLVM drops what is raised in its callbacks, and may crash for want of what the callback was to do: nothing is raised while a compilation
    is going on. A thread that is woken by the signal itself sends it again once the compilation has ended; where it is still going on after
    `PATIENCE_S`, the process ends at once. Files are written under temporary names until they are complete, so that none is left
    half-written.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    watch = threading.Thread(target=_watch, args=(theirs, compiling), name="signal watch", daemon=True)
    watch.start()
    wakeup = signal.set_wakeup_fd(ours.fileno(), warn_on_full_buffer=False)
    before = {number: signal.getsignal(number) for number in DEFAULTS}
    ending = _ending(compiling)
    for number, default in DEFAULTS.items():
        if before[number] is default:
            signal.signal(number, ending)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(wakeup)
        ours.close()
        watch.join()
        theirs.close()


def _ending(compiling: Callable[[], bool]) -> Callable[[int, FrameType | None], None]:
    """Return a handler of signals that raises where no kernel is being compiled."""

    def handler(number: int, frame: FrameType | None) -> None:
        if not compiling():
            if number == signal.SIGINT:
                raise KeyboardInterrupt
            sys.exit(TERMINATED)

    return handler


def _watch(signals: socket.socket, compiling: Callable[[], bool]) -> None:
    while number := signals.recv(1):
        if number[0] not in (signal.SIGINT, signal.SIGTERM):
            continue
        if not compiling():
            continue
        deadline = time.monotonic() + PATIENCE_S
        while compiling() and time.monotonic() < deadline:
            time.sleep(0.02)
        if not compiling():
            _send_again(number[0])
        else:
            os.write(2, b"Interrupted while kernels were compiled; every file written is complete.\n")
            os._exit(INTERRUPTED if number[0] == signal.SIGINT else TERMINATED)


def _send_again(number: int) -> None:
    """Send a signal to the main thread, so that it ends what this waits for, as a sleep."""
    main = threading.main_thread().ident
    if sys.platform != "win32" and main is not None:
        signal.pthread_kill(main, number)
    else:
        signal.raise_signal(number)
