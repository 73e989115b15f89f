"""What a run of the command line has told: for ``--json``, ``--log`` and ``--open``."""

from __future__ import annotations

import contextlib
import json
import math
import os
import time
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from naibu._version import __version__
from naibu.core.errors import InputError


@dataclass(slots=True)
class RunRecord:
    """Options of the output of one run, and what was told.

    Attributes
    ----------
    quiet : bool
        Whether only warnings and errors are shown.
    as_json : bool
        Whether standard output gets one JSON document, and everything else goes to standard error.
    log : file, optional
        Where every line goes too, with its time.
    command : tuple of str
        Arguments of the command line.
    verb : tuple of str
        The same without the options of the output.
    notes, tables, files, results
        Sentences with their kind; tables as lists of rows; files that were written; named results.
    error : str
        Message of the error that ended the run.
    """

    quiet: bool = False
    as_json: bool = False
    log: IO[str] | None = None
    command: tuple[str, ...] = ()
    verb: tuple[str, ...] = ()
    notes: list[dict[str, str]] = field(default_factory=list)
    tables: list[dict[str, Any]] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    results: dict[str, Any] = field(default_factory=dict)
    error: str = ""
    began: float = field(default_factory=time.monotonic)

    def log_to(self, file: Path) -> None:
        """Open a log file, to which is appended.

        Raises
        ------
        InputError
            It cannot be written.
        """
        try:
            self.log = open(file, "a", encoding="utf-8", errors="replace")  # noqa: SIM115  closed by `recorded_run`
        except OSError as error:
            raise InputError(f"--log {file}: cannot be written ({error.strerror}); choose another file") from error
        self.logged(f"naibu {__version__}: naibu {' '.join(self.command)}")

    def logged(self, text: str) -> None:
        """Append text to the log file, where there is one; a full disk must not end a computation."""
        if self.log is None:
            return
        stamp = time.strftime("%Y-%m-%d %H:%M:%S")
        with contextlib.suppress(OSError, ValueError):
            self.log.writelines(f"{stamp}  {line}\n" for line in text.splitlines())
            self.log.flush()

    def add_table(self, title: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """Keep a table."""
        self.tables.append({"title": title, "rows": [dict(zip(columns, map(_plain, row), strict=True)) for row in rows]})

    def page(self) -> Path | None:
        """Return the first page among the files."""
        return next((file for file in self.files if file.suffix == ".html"), None)

    def summary(self, code: int) -> str:
        """Return the JSON document of a run that ends with an exit code."""
        told = {
            "naibu": __version__,
            "command": list(self.command),
            "exit_code": code,
            "seconds": round(time.monotonic() - self.began, 2),
            "results": {name: _plain(value) for name, value in self.results.items()},
            "tables": self.tables,
            "notes": self.notes,
            "files": [os.fspath(file) for file in self.files],
            "error": self.error or None,
        }
        return json.dumps(told, indent=1, ensure_ascii=False) + "\n"


_CURRENT: ContextVar[RunRecord | None] = ContextVar("run record", default=None)


def current_run() -> RunRecord:
    """Return the record of the run that is going on; outside of a run, one that nobody reads."""
    return _CURRENT.get() or RunRecord()


@contextlib.contextmanager
def recorded_run(command: Sequence[str]) -> Iterator[RunRecord]:
    """Within this context, what is told is recorded.

    Parameters
    ----------
    command : sequence of str
        Arguments of the command line.
    """
    record = RunRecord(command=tuple(command), verb=tuple(command))
    before = _CURRENT.set(record)
    try:
        yield record
    finally:
        _CURRENT.reset(before)
        if record.log is not None:
            with contextlib.suppress(OSError):
                record.log.close()


def wrote(*files: str | os.PathLike[str]) -> None:
    """Note files that a verb has written, its page first."""
    current_run().files += [Path(file) for file in files]


def found(**results: object) -> None:
    """Note named results of a verb, for ``--json``."""
    current_run().results.update(results)


def _plain(value: Any) -> Any:
    """Return a value as JSON has it: no NaN, no infinity, no types of NumPy."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
