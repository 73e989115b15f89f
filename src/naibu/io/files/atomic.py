"""Atomic writing of files: a reader, or a crash, never sees a half-written one."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from naibu.core.errors import InputError


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

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
        os.close(handle)
    except OSError as error:
        raise _not_writable(target, error) from error
    return Path(name)


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
