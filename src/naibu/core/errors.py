"""Exceptions whose text tells the user what is wrong, with which value, and what to do about it."""

from __future__ import annotations


class NaibuError(Exception):
    """Base of every error that naibu raises on purpose; the command line prints its text without a traceback."""


class InputError(NaibuError, ValueError):
    """The data, a file or an argument cannot be used as given."""


class MissingDependencyError(NaibuError, ImportError):
    """An optional package is needed for what was asked."""


class ConvergenceError(NaibuError, RuntimeError):
    """A solve stopped before it reached its tolerance."""
