"""Atomic writing of files: a reader, or a crash, never sees a half-written one."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import platform
import re
import shutil
import tempfile
import time
from collections.abc import Collection
from pathlib import Path

from naibu.core.errors import InputError
from naibu.io.files.paths import require_usable_path

_STEM = 40  # letters of a file's name in that of its temporary file
_PART = re.compile(r"\..*\.(?P<place>[0-9a-f]{8})-(?P<process>\d+)-\w+\.(part|undo)")
_OLD_S = 7 * 86400.0  # what another computer left is removed when nothing was written to it for so long


def write_atomically(path: str | os.PathLike[str], data: str | bytes) -> Path:
    """Write `data` beside `path` and rename it into place, so that `path` is either the old file or the whole new one.

    Parameters
    ----------
    path : path-like
        File to write; its folder is created if needed.
    data : str or bytes
        Content; text is stored as UTF-8 with its line endings unchanged.

    Returns
    -------
    Path
        `path`.

    Raises
    ------
    InputError
        The folder or the file cannot be written.
    """
    target = Path(path)
    content = data.encode("utf-8") if isinstance(data, str) else data
    aside = new_aside(target)
    try:
        with aside.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        return put_in_place(aside, target)
    except OSError as error:
        raise _not_writable(target, error) from error
    finally:
        aside.unlink(missing_ok=True)


def new_aside(path: str | os.PathLike[str]) -> Path:
    """Create an empty temporary file beside `path`, for libraries that write files themselves; `put_in_place` renames it.

    Its name tells which process writes it, so that `remove_orphans` finds what killed ones left.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    target = require_usable_path(path, written=True)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=_prefix(target.name), suffix=".part")
        os.close(handle)
    except OSError as error:
        raise _not_writable(target, error) from error
    return Path(name)


def new_folder_aside(folder: Path) -> Path:
    """Create an empty temporary folder in `folder`, for files that are to take their places together; named as by `new_aside`.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    try:
        return Path(tempfile.mkdtemp(dir=folder, prefix=_prefix("results"), suffix=".part"))
    except OSError as error:
        raise _not_writable(folder, error) from error


def _prefix(name: str) -> str:
    return f".{name[:_STEM]}.{_place()}-{os.getpid()}-"


def put_in_place(aside: Path, path: str | os.PathLike[str]) -> Path:
    """Rename a finished file from `new_aside` to `path`, with the permissions of an ordinary new file.

    Raises
    ------
    InputError
        It cannot be renamed.
    """
    target = Path(path)
    try:
        aside.chmod(0o666 & ~_umask())  # mkstemp makes the file private
        aside.replace(target)
    except OSError as error:
        raise _not_writable(target, error) from error
    return target


def _not_writable(target: Path, error: OSError) -> InputError:
    reason = error.strerror or str(error)
    return InputError(f"{target}: cannot be written ({reason}); choose a folder you may write to, or free some space")


def _umask() -> int:
    # the only way to read the mask is to set it
    mask = os.umask(0)
    os.umask(mask)
    return mask


def remove_orphans(folder: Path, keep: Collection[str] = ()) -> None:
    """Remove the temporary files of processes that were killed from a folder.

    Parameters
    ----------
    folder : Path
        Where files are written; those in folders below stay.
    keep : collection of str
        Names that stay.
    """
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            found = _PART.fullmatch(path.name)
            if found is None or path.name in keep or _in_use(path, found["place"], int(found["process"])):
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()


def writer_of(aside: Path) -> int | None:
    """Return the number of another process that is writing a temporary file, or None."""
    found = _PART.fullmatch(aside.name)
    if found is None or not aside.exists() or int(found["process"]) == os.getpid():
        return None
    return int(found["process"]) if _in_use(aside, found["place"], int(found["process"])) else None


def _in_use(path: Path, place: str, process: int) -> bool:
    if place == _place() and os.name == "posix":
        return _alive(process)
    # nothing can be known about a process elsewhere; a lattice that is computed is written to after every frame
    return time.time() - path.stat().st_mtime < _OLD_S


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


@functools.cache
def _place() -> str:
    """Return a digest of this computer, and of the container on it, within which the number of a process is unique."""
    space = ""
    with contextlib.suppress(OSError):
        space = os.readlink("/proc/self/ns/pid")
    return hashlib.sha256(f"{platform.node()} {space}".encode()).hexdigest()[:8]
