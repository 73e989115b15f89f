"""Registration of verbs: the task that a verb belongs to, and the examples below its help."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cyclopts import Group

from naibu.cli.shell.console import app
from naibu.cli.shell.help_texts import flowing

START = Group("Start", sort_key=1)
MARKERS = Group("Markers: from positions to a calibrated model", sort_key=2)
SCANS = Group("Scans: displacement inside an object", sort_key=3)
SIMULATE = Group("Simulate", sort_key=4)
TOUCH = Group("Touch and cut", sort_key=5)
REPRODUCE = Group("Reproduce", sort_key=6)


def verb(group: Group, *examples: str, name: str | None = None) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a function as a verb of the command line.

    Parameters
    ----------
    group : Group
        The task under which ``naibu --help`` lists it.
    *examples : str
        Commands that are shown below its help, without the leading ``naibu``; text after ``  #`` says what they do.
    name : str, optional
        Name of the verb, if not that of the function.
    """
    lines = "\n".join(_shown(example) for example in examples)

    def registered(function: Callable[..., Any]) -> Callable[..., Any]:
        app.command(flowing(function), name=name, group=group, help_epilogue=f"Examples:\n\n{lines}" if examples else "")
        return function

    return registered


def _shown(example: str) -> str:
    command, _, what = example.partition("  #")
    told = f"  # {what.strip()}\n" if what else ""
    return f"{told}  naibu {command.rstrip()}"
