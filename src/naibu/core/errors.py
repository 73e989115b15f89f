"""Exceptions; their messages state what is wrong, the value, and what to do about it."""

from __future__ import annotations


class NaibuError(Exception):
    """Base class of the errors that naibu raises deliberately; the command line prints them without a traceback."""


class NaibuWarning(UserWarning):
    """Base class of the warnings that naibu gives; the command line prints them in a line each, without the place in the code."""


class InputError(NaibuError, ValueError):
    """Invalid data, file or argument."""


class MissingDependencyError(NaibuError, ImportError):
    """An optional package is required but not installed."""


class ConvergenceError(NaibuError, RuntimeError):
    """A solver stopped before it reached its tolerance."""


class WorkerLostError(NaibuError, RuntimeError):
    """The process that computed a task died, and so did the one that took the task over."""

    @classmethod
    def of(cls, task: str, how: str) -> WorkerLostError:
        """Return the error of a task, with what is known of the end of its last worker."""
        return cls(f"{task}: its worker died twice ({how}); too little memory is the usual cause: use fewer workers, or a smaller task")
