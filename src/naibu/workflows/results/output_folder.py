"""Folders that verbs write to: checked before anything is computed, and nothing in them is lost unasked."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from naibu.core.errors import InputError
from naibu.io.files.atomic import remove_orphans
from naibu.io.files.paths import require_usable_path

_NAMED = 3  # files that a message names
_MADE: ContextVar[list[Path] | None] = ContextVar("folders that a run has made", default=None)


def output_folder(
    out: str | os.PathLike[str], files: Iterable[str] = (), *, overwrite: bool = False, what: str = "", keep: Collection[str] = ()
) -> Path:
    """Make a folder for results where it is not there, and check that a run may write to it, before anything is computed.

    What killed runs left under temporary names is removed. A run that continues an earlier one, whose files are its own, gives no `files`.

    Parameters
    ----------
    out : path-like
        The folder.
    files : iterable of str
        Names of the files that the run is going to write.
    overwrite : bool
        Whether these may be there already: results of an earlier run, or files that something else wrote.
    what : str
        What such files are, where that is known; by default earlier results, or files of something else.
    keep : collection of str
        Temporary files that are still needed.

    Raises
    ------
    InputError
        It cannot be made, or not be written to, or holds one of the files.
    """
    folder = require_usable_path(out, written=True)
    if (made := _MADE.get()) is not None:
        made += [each for each in (folder, *folder.parents) if not os.path.lexists(each)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        there = [] if overwrite else [name for name in dict.fromkeys(files) if os.path.lexists(folder / name)]
    except (OSError, ValueError) as error:
        blocked = isinstance(error, FileExistsError | NotADirectoryError)
        reason = "a file stands in its way" if blocked else getattr(error, "strerror", None) or error
        raise InputError(f"{folder}: cannot be used as a folder for results ({reason}); choose another as `out`") from error
    if there:
        more = f" and {len(there) - _NAMED} more" if len(there) > _NAMED else ""
        told = f"{', '.join(there[:_NAMED])}{more}"
        raise InputError(
            f"{folder}: already holds {told}, {what or 'an earlier result or a file of your own'}, which would be overwritten; choose "
            "another folder as `out`, or allow it with `overwrite`"
        )
    remove_orphans(folder, keep)
    return folder


@contextmanager
def no_empty_folders() -> Iterator[None]:
    """Take away the folders that `output_folder` made within this context, if an error leaves it before anything was written to them.

    As a decorator, ``@no_empty_folders()``, it is for functions that write results: whoever calls them.
    """
    made: list[Path] = []
    outer = _MADE.set(made)
    try:
        yield
    except BaseException:
        for folder in sorted(made, key=lambda each: len(each.parts), reverse=True):
            with suppress(OSError):  # not empty, or never made
                folder.rmdir()
        raise
    finally:
        _MADE.reset(outer)
    if (around := _MADE.get()) is not None:
        around += made  # what fails later, around this context, leaves none of them empty either
