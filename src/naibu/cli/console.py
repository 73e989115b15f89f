"""The command-line application, its output and error consoles: lines, tables, progress, failures.

Exit codes: 0 done, 1 failed (a state that cannot be solved, an error of naibu's own, too little memory, lost output, or an unsound
installation that ``doctor`` found), 2 input that cannot be used, 3 data that the model does not explain (results are written, and marked),
130 interrupted, 143 terminated.
"""

from __future__ import annotations

import contextlib
import io
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import IO, NoReturn, cast

from cyclopts import App, Parameter
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.progress import Progress as Display
from rich.table import Table

from naibu._version import __version__
from naibu.core.progress import Progress, ProgressReport

app = App(
    name="naibu",
    help="Identify the mechanical parameters of soft objects from CT, MR or ultrasound images of their inside.",
    help_epilogue="Exit codes: 0 done, 1 failed, 2 bad input, 3 not explained by the model, 130 interrupted. What naibu promises and "
    "refuses: docs/reliability.rst.",
    version=__version__,
    default_parameter=Parameter(negative_iterable=()),
)


class Messages(io.TextIOBase):
    """Standard error, whatever it is at the time; what it does not take is lost, for messages must not end a computation."""

    def write(self, text: str, /) -> int:
        """Write, if possible."""
        with contextlib.suppress(OSError, ValueError, AttributeError):  # full, closed, or None
            sys.stderr.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush, if possible."""
        with contextlib.suppress(OSError, ValueError, AttributeError):
            sys.stderr.flush()

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        return sys.stderr is not None and sys.stderr.isatty()

    def fileno(self) -> int:
        """Return its number, as rich asks for the size of a terminal."""
        if sys.stderr is None:
            raise OSError("standard error is closed")
        return sys.stderr.fileno()


WIDTH_OF_FILES = 160  # where the output is no terminal
# a stream that was closed before the start is None
console = Console(width=None if sys.stdout is not None and sys.stdout.isatty() else WIDTH_OF_FILES)
errors = Console(file=cast(IO[str], Messages()), width=None if sys.stderr is not None and sys.stderr.isatty() else WIDTH_OF_FILES)
FAILED, BAD_INPUT, NOT_EXPLAINED, INTERRUPTED = 1, 2, 3, 130
QUIET_S, INTERVAL_S = 1.0, 5.0  # plain progress lines: none before the first, then one in the second


class _PlainProgress:
    """Progress as plain lines, where the output is no terminal: for each stage, and then every few seconds."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._began = clock()
        self._stage, self._said = "", -INTERVAL_S

    def __call__(self, report: ProgressReport) -> None:
        now = self._clock() - self._began
        # what takes no time, or fails at once, prints nothing
        if now < QUIET_S or (report.stage == self._stage and now - self._said < INTERVAL_S):
            return
        self._stage, self._said = report.stage, now
        percent = "" if report.fraction is None else f"{100.0 * report.fraction:.0f} %"
        parts = (report.stage, _count(report), percent, _objective(report), f"{now:.0f} s")
        errors.print(", ".join(part for part in parts if part), soft_wrap=True, highlight=False, markup=False)


@contextlib.contextmanager
def progress_display(clock: Callable[[], float] = time.monotonic) -> Iterator[Progress]:
    """Show progress on stderr: a bar for each stage on a terminal, plain lines elsewhere.

    Parameters
    ----------
    clock : callable
        Seconds from any origin.

    Yields
    ------
    Progress
        The callback to hand to a computation.
    """
    if not errors.is_terminal:
        yield _PlainProgress(clock)
        return
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[found]}"), TimeElapsedColumn())
    with Display(*columns, console=errors, transient=True) as bars:
        tasks: dict[str, TaskID] = {}

        def show(report: ProgressReport) -> None:
            if report.stage not in tasks:
                for task in tasks.values():
                    bars.stop_task(task)
                tasks[report.stage] = bars.add_task(escape(report.stage), total=None, found="")
            found = ", ".join(part for part in (_count(report), _objective(report)) if part)
            bars.update(tasks[report.stage], completed=report.done, total=report.total, found=found)

        yield show


def _count(report: ProgressReport) -> str:
    if report.done is None:
        return ""
    return f"{report.done:g}" if report.total is None else f"{report.done:g} of {report.total:g}"


def _objective(report: ProgressReport) -> str:
    return "" if report.objective is None else f"objective {report.objective:.4g}"


def say(text: str, style: str | None = None) -> None:
    """Print a line verbatim and unwrapped, so that paths can be copied."""
    console.print(escape(text), style=style, soft_wrap=True, highlight=False)


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[object]], *, left: bool = False) -> None:
    """Print a table with right-aligned numbers."""
    table = Table(title=title, title_justify="left")
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 or left else "right", overflow="fold")
    for row in rows:
        table.add_row(*(_cell(c) for c in row))
    console.print(table)


def _cell(value: object) -> str:
    if value is None or value != value:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else escape(str(value))


def fail(text: str, code: int) -> NoReturn:
    """Print an error message and exit with a code."""
    errors.print(f"[bold red]error:[/bold red] {escape(text)}", soft_wrap=True, highlight=False)
    sys.exit(code)
