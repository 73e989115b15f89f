"""Packages that are loaded only by those who ask for what they do."""

from __future__ import annotations

import importlib
from typing import Any

from naibu.core.errors import MissingDependencyError


def optional_package(name: str, purpose: str, install: str | None = None) -> Any:
    """Import a package, or say what needs it and how to get it.

    Parameters
    ----------
    name : str
        Name under which Python imports it.
    purpose : str
        What needs it, as the subject of a sentence: ``"reading NIfTI files"``.
    install : str, optional
        What pip calls it, or the extra that brings it; by default `name`.

    Raises
    ------
    MissingDependencyError
        It is not installed, or does not load.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingDependencyError(f'{purpose} needs {name} ({error}); run: pip install "{install or name}"') from error
