"""Bundled measurements: marker positions inside gels before and after loading, printed in the 2008 report :cite:p:`hirai2008`."""

from __future__ import annotations

import difflib
import json
from pathlib import Path
from typing import Any

from naibu.core.errors import InputError
from naibu.core.experiment import Experiment
from naibu.io.experiment_folder.reader import META_FILE, read_experiment

_DATA = Path(__file__).resolve().parent / "data"
_TEMPLATES = _DATA.parent / "templates"


def names() -> tuple[str, ...]:
    """Return the names of the bundled experiments, in alphabetical order."""
    return tuple(sorted(meta.parent.name for meta in _DATA.glob(f"*/{META_FILE}")))


def path(name: str) -> Path:
    """Return the folder of the bundled experiment `name`.

    Raises
    ------
    InputError
        There is no such experiment; the message lists those that exist.
    """
    known = names()
    if name not in known:
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise InputError(f"no bundled experiment is called {name!r}; {hint}Available are {', '.join(known)}")
    return _DATA / name


def load(name: str) -> Experiment:
    """Return the bundled experiment `name`, positions in mm.

    Raises
    ------
    InputError
        There is no such experiment.
    """
    return read_experiment(path(name))


def experiment_template() -> str:
    """Return a commented ``meta.toml`` to start an experiment folder from; it describes the cube of ``ct_cube_plate`` at 45 mm."""
    return (_TEMPLATES / "experiment.toml").read_text(encoding="utf-8")


def paper_tables() -> dict[str, Any]:
    """Return the small tables of the report: ``source`` and ``tables``, a list of dicts with id, title, units, columns, rows and notes."""
    tables: dict[str, Any] = json.loads((_DATA / "paper_tables.json").read_text(encoding="utf-8"))
    return tables
