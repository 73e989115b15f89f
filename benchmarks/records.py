"""Records of benchmarks: what a program measured, with which command, when, and on what, in ``benchmarks/results/NAME.json``.

``docs/accuracy.rst`` is made from them when the pages are built. A program writes its record if it is called with ``--record``.
"""

from __future__ import annotations

import datetime
import json
import os
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from naibu.cli.shell.version import version_text
from naibu.io.files.atomic import write_atomically

FOLDER = Path(__file__).resolve().parent / "results"
Cell = str | float | int


@dataclass(frozen=True, slots=True)
class ResultTable:
    """A table of measured figures; units stand in the names of the columns.

    Attributes
    ----------
    name : str
        Name by which a page shows it.
    columns : tuple of str
        Headers.
    rows : tuple of tuple
        One cell a column.
    """

    name: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


def write_record(name: str, tables: Sequence[ResultTable]) -> Path:
    """Write the record of this run: its tables, command, date, version and machine."""
    program = Path(sys.argv[0]).name
    options = " ".join(word for word in sys.argv[1:] if word != "--record")
    record = {
        "command": f"python benchmarks/{program} {options}".rstrip(),
        "date": datetime.date.today().isoformat(),
        "version": version_text(),
        "machine": machine(),
        "tables": [asdict(table) for table in tables],
    }
    FOLDER.mkdir(exist_ok=True)
    path = write_atomically(FOLDER / f"{name}.json", json.dumps(record, indent=1, ensure_ascii=False, default=float) + "\n")
    print(f"record: {path}")
    return path


def machine() -> str:
    """Return what the times of a record depend on, in words."""
    busy = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores{busy}, Python {platform.python_version()}"
