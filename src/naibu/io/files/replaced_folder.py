"""Folders written aside and renamed into place: a reader, or a crash, never sees a half-written store."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from naibu.core.errors import InputError
from naibu.io.files.paths import require_usable_path


@contextlib.contextmanager
def replaced_folder(path: Path) -> Iterator[Path]:
    """Within this context a folder is written where no reader looks; at its end it takes the place of another.

    Parameters
    ----------
    path : Path
        The folder to write, or to replace; the one it lies in is created if needed.

    Yields
    ------
    Path
        Where to create it.

    Raises
    ------
    InputError
        It cannot be written.
    """
    require_usable_path(path, written=True)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose a folder you may write to") from error
    try:
        yield aside / "new"
        if path.exists():
            path.rename(aside / "old")
        (aside / "new").rename(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error}); free some space or choose another folder") from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)
