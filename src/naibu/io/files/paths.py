"""Paths that every part of naibu can store, print and open: refused before the work otherwise, not after it."""

from __future__ import annotations

import os
from pathlib import Path

from naibu.core.errors import InputError

LONGEST_NAME, LONGEST_PATH = 255, 4095  # bytes; limits of Linux, of other systems too for names
ROOM_NAME, ROOM_PATH = 24, 200  # bytes that temporary files beside a result, and the names of results in a folder, need


def require_usable_path(path: str | os.PathLike[str], *, written: bool = False) -> Path:
    """Return a path, or refuse one that cannot be stored in UTF-8 files and messages, or is longer than systems allow.

    Parameters
    ----------
    path : path-like
        File or folder, which need not exist.
    written : bool
        Whether files will be written to it or below it: leaves room for their names.

    Raises
    ------
    InputError
        Bytes that are not UTF-8 text, a zero byte, or a name or path that is too long.
    """
    text = os.fspath(path)
    shown = text.encode("utf-8", "replace").decode("utf-8")
    shown = shown if len(shown) <= 80 else f"{shown[:40]}...{shown[-30:]}"
    try:
        whole = os.path.abspath(text).encode("utf-8")
    except UnicodeEncodeError as error:
        raise InputError(f"the path {shown!r} holds bytes that are not UTF-8 text; rename the file or folder") from error
    except (OSError, ValueError) as error:
        raise InputError(f"the path {shown!r} cannot be ({error}); give another") from error
    if b"\0" in whole:
        raise InputError(f"the path {shown!r} holds a zero byte; give another")
    longest = max(len(part) for part in whole.split(b"/"))
    name, most = (LONGEST_NAME - ROOM_NAME, LONGEST_PATH - ROOM_PATH) if written else (LONGEST_NAME, LONGEST_PATH)
    if longest > name:
        raise InputError(f"the path {shown!r} has a name of {longest} bytes, {name} are possible; choose a shorter one")
    if len(whole) > most:
        raise InputError(f"the path {shown!r} has {len(whole)} bytes, {most} are possible; choose a shorter one")
    return Path(path)
