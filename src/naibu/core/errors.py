"""Exceptions; their messages state what is wrong, the value, and what to do about it."""

from __future__ import annotations


class NaibuError(Exception):
    """Base class of the errors that naibu raises deliberately; the command line prints them without a traceback."""


class InputError(NaibuError, ValueError):
    """Invalid data, file or argument."""


class MissingDependencyError(NaibuError, ImportError):
    """An optional package is required but not installed."""


class ConvergenceError(NaibuError, RuntimeError):
    """A solver stopped before it reached its tolerance."""
