"""The command-line application, its output and error consoles: lines, tables, progress, failures.

Exit codes: 0 done, 1 failed (a state that cannot be solved, an error of naibu's own, too little memory, lost output, or an unsound
installation that ``doctor`` found), 2 input that cannot be used, 3 data that the model does not explain (results are written, and marked),
130 interrupted, 143 terminated.
"""

from __future__ import annotations

import contextlib
import io
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import IO, Any, NoReturn, cast

from cyclopts import App, Group, Parameter
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

from naibu.cli.shell.run_record import current_run
from naibu.cli.shell.version import version_text
from naibu.core.errors import NaibuWarning
from naibu.core.progress import Progress, ProgressReport

COMMANDS = Group("This program", sort_key=90)
app = App(
    name="naibu",
    help="Identify the mechanical parameters of soft objects from CT, MR or ultrasound images of their inside.",
    help_epilogue="Exit codes: 0 done, 1 failed, 2 bad input, 3 not explained by the model, 130 interrupted. What naibu promises and "
    "refuses: docs/reliability.rst.",
    version=version_text,
    default_parameter=Parameter(negative_iterable=()),
    group_parameters=Group("Parameters", sort_key=1),
    group_commands=COMMANDS,
    help_format="plaintext",
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
WARNING, GRAVE = "yellow", "bold red"  # styles of warnings, which --quiet does not silence
FAILED, BAD_INPUT, NOT_EXPLAINED, INTERRUPTED = 1, 2, 3, 130
QUIET_S, INTERVAL_S = 1.0, 5.0  # plain progress lines: none before the first, then one in the second


class _PlainProgress:
    """Progress as plain lines, where the output is no terminal: for each stage, and then every few seconds."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._began = clock()
        self._run = current_run()  # a computation may report from threads of its own, which know of no run
        self._stage, self._said = "", -INTERVAL_S
        self._left = TimeLeft()

    def __call__(self, report: ProgressReport) -> None:
        now = self._clock() - self._began
        left = self._left.after(report, now)
        # what takes no time, or fails at once, prints nothing
        if now < QUIET_S or (report.stage == self._stage and now - self._said < INTERVAL_S):
            return
        self._stage, self._said = report.stage, now
        line = ", ".join(part for part in (report.stage, _share(report), _objective(report), f"{now:.0f} s", left) if part)
        self._run.logged(line)
        if not self._run.quiet:
            errors.print(line, soft_wrap=True, highlight=False, markup=False)


class TimeLeft:
    """Estimates the time left in a stage from the share done since the stage began."""

    def __init__(self) -> None:
        self._stage, self._began, self._first = "", 0.0, 0.0

    def after(self, report: ProgressReport, now: float) -> str:
        """Return the time left in words, empty where it cannot be told.

        Parameters
        ----------
        report : ProgressReport
            How far the stage has come.
        now : float
            Seconds.
        """
        if report.fraction is None:
            return ""
        if report.stage != self._stage:
            self._stage, self._began, self._first = report.stage, now, report.fraction
        done = report.fraction - self._first
        if done <= 0.0 or now - self._began < QUIET_S:
            return ""
        seconds = (1.0 - report.fraction) * (now - self._began) / done
        return f"about {seconds:.0f} s left" if seconds < 100.0 else f"about {seconds / 60.0:.0f} min left"


@contextlib.contextmanager
def progress_display(clock: Callable[[], float] = time.monotonic) -> Iterator[Progress]:
    """Show progress on stderr: a bar for each stage on a terminal, plain lines elsewhere, nothing with ``--quiet``.

    Parameters
    ----------
    clock : callable
        Seconds from any origin.

    Yields
    ------
    Progress
        The callback to hand to a computation.
    """
    plain = _PlainProgress(clock)
    if not errors.is_terminal or current_run().quiet:
        yield plain
        return
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[found]}"), TimeElapsedColumn())
    with Display(*columns, console=errors, transient=True) as bars:
        tasks: dict[str, TaskID] = {}
        left = TimeLeft()

        def show(report: ProgressReport) -> None:
            if report.stage not in tasks:
                for task in tasks.values():
                    bars.stop_task(task)
                tasks[report.stage] = bars.add_task(escape(report.stage), total=None, found="")
            told = ", ".join(part for part in (_share(report), _objective(report), left.after(report, clock())) if part)
            bars.update(tasks[report.stage], completed=report.done, total=report.total, found=told)

        yield show


def _share(report: ProgressReport) -> str:
    if report.done is None:
        return ""
    if report.fraction is None:
        return f"{report.done:g}"
    share = f"{100.0 * report.fraction:.0f} %"
    return share if report.total == 1 else f"{report.done:g} of {report.total:g}, {share}"


def _objective(report: ProgressReport) -> str:
    return "" if report.objective is None else f"objective {report.objective:.4g}"


def say(text: str, style: str | None = None) -> None:
    """Print a line verbatim and unwrapped, so that paths can be copied.

    With ``--json`` it goes to standard error; with ``--quiet`` only warnings do.

    Parameters
    ----------
    text : str
        The line.
    style : str, optional
        ``WARNING`` or ``GRAVE`` for a warning; ``"dim"`` or ``"bold"``.
    """
    run, warning = current_run(), style in (WARNING, GRAVE)
    run.notes.append({"kind": "warning" if warning else "note", "text": text})
    run.logged(text)
    if run.quiet and not warning:
        return
    target = errors if run.as_json or run.quiet else console
    target.print(escape(text), style=style, soft_wrap=True, highlight=False)


@contextlib.contextmanager
def told_warnings() -> Iterator[None]:
    """Within this context, warnings of naibu are printed as lines of their own, and those of other packages as they are."""
    shown = warnings.showwarning

    def told(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if issubclass(category, NaibuWarning):
            say(str(message), WARNING)
        else:
            shown(message, category, *place, **more)

    warnings.showwarning = told
    try:
        yield
    finally:
        warnings.showwarning = shown


def print_table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[object]], *, left: bool = False, digits: int | None = None
) -> None:
    """Print a table with right-aligned numbers.

    Parameters
    ----------
    title : str
        Above the table.
    columns : sequence of str
        Headers, with units.
    rows : sequence of sequences
        Cells; None, NaN and infinity are shown as a dash.
    left : bool
        Whether all columns are aligned left.
    digits : int, optional
        Significant digits of numbers; by default three decimals.
    """
    run = current_run()
    run.add_table(title, columns, rows)
    texts = [[_cell(value, digits) for value in row] for row in rows]
    run.logged("\n".join([title, *("  ".join(row) for row in ([*columns], *texts))]))
    if run.quiet:
        return
    table = Table(title=title, title_justify="left")
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 or left else "right", overflow="fold")
    for row in texts:
        table.add_row(*(escape(cell) for cell in row))
    (errors if run.as_json else console).print(table)


def _cell(value: object, digits: int | None) -> str:
    if value is None or value != value:
        return "-"
    if not isinstance(value, float):
        return str(value)
    if math.isinf(value):
        return "-"
    return f"{value:.3f}" if digits is None else f"{value:.{digits}g}"


def fail(text: str, code: int) -> NoReturn:
    """Print an error message and exit with a code."""
    current_run().error = text
    current_run().logged(f"error: {text}")
    errors.print(f"[bold red]error:[/bold red] {escape(text)}", soft_wrap=True, highlight=False)
    sys.exit(code)
