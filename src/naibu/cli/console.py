"""The program, its two consoles, and how it speaks: lines, tables, progress, failures.

Exit codes: 0 done, 1 the installation is not sound (``doctor``), 2 input that cannot be used, 3 a solve that failed, 130 interrupted.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NoReturn

from cyclopts import App, Parameter
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from naibu._version import __version__

app = App(
    name="naibu",
    help="Find the mechanical parameters of soft objects from what was measured inside them.",
    version=__version__,
    default_parameter=Parameter(negative_iterable=()),
)
WIDTH_OF_FILES = 160  # where the output is no terminal
console = Console(width=None if sys.stdout.isatty() else WIDTH_OF_FILES)
errors = Console(stderr=True, width=None if sys.stderr.isatty() else WIDTH_OF_FILES)
BAD_INPUT, NO_SOLUTION, INTERRUPTED = 2, 3, 130


@contextmanager
def progress_lines() -> Iterator[Callable[[str, int, float], None]]:
    """A line for each stage that tells iteration and objective."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TextColumn("{task.fields[found]}"), TimeElapsedColumn())
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as bar:
        tasks: dict[str, TaskID] = {"identify": bar.add_task("identify", total=None, found="reading, and solving with the first guess")}

        def tell(stage: str, iteration: int, objective: float) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=None, found="")
            bar.update(tasks[stage], found=f"iteration {iteration + 1}, chi-squared {objective:.0f}")

        yield tell


@contextmanager
def stages() -> Iterator[Callable[[str], None]]:
    """One line that tells the present stage."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as bar:
        task = bar.add_task("reading", total=None)
        yield lambda stage: bar.update(task, description=stage)


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar for a known number of parts."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, of: bar.update(task, completed=done, total=of)


def say(text: str, style: str | None = None) -> None:
    """Print a line as it is, unbroken, so that paths can be copied."""
    console.print(escape(text), style=style, soft_wrap=True, highlight=False)


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[object]], *, left: bool = False) -> None:
    """Print a table with numbers to the right."""
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
    """Say what went wrong and leave with an exit code."""
    errors.print(f"[bold red]error[/bold red] {escape(text)}", soft_wrap=True, highlight=False)
    sys.exit(code)
