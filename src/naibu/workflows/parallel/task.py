"""A task that any process can compute, and what became of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """A call that depends on nothing but its arguments.

    Attributes
    ----------
    name : str
        What it computes, for messages.
    function : callable
        A function of a module, called with `arguments` and ``progress``, a callback as everywhere in naibu (`naibu.core.progress`).
    arguments : mapping
        By name; everything in it can be pickled.
    measured : bool
        Whether its reports tell the share that it has done, so that the progress over all tasks can count it.
    length : float
        About how long it takes, in any unit that all tasks have in common: the time left is told from that.
    """

    name: str
    function: Callable[..., Any]
    arguments: Mapping[str, Any] = field(default_factory=dict)
    measured: bool = False
    length: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What became of a task.

    Attributes
    ----------
    result : Any
        What its function returned; None if it failed.
    error : Exception, optional
        What it raised, or `naibu.core.errors.WorkerLostError`.
    attempts : int
        How often it was begun.
    """

    result: Any = None
    error: Exception | None = None
    attempts: int = 1

    def value(self) -> Any:
        """Return the result, or raise the error."""
        if self.error is not None:
            raise self.error
        return self.result
