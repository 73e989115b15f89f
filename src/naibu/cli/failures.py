"""What ends a verb and is nobody's input: errors of naibu's own, and output that nobody takes."""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import sys
import tempfile
import traceback
from pathlib import Path
from typing import NoReturn

from naibu._version import __version__

_LOST = (errno.EPIPE, errno.ENOSPC, errno.EFBIG, errno.EBADF, errno.EIO)


class OutputLostError(Exception):
    """Standard output is closed or full."""


def unexpected(error: Exception, verb: str) -> str:
    """Return the message for an error of naibu's own, and keep its traceback in a file.

    Parameters
    ----------
    error : Exception
        What was raised.
    verb : str
        The verb that was running.
    """
    head = f"naibu {__version__}, Python {platform.python_version()}, {platform.platform()}\ncommand: {' '.join(sys.argv)}\n\n"
    text = head + "".join(traceback.format_exception(error))
    reason = f"naibu {verb} ended with an error of its own ({type(error).__name__}: {' '.join(str(error).split())[:200]})"
    log = _kept(text)
    where = f"the details are in {log}" if log is not None else "its details could not be written to a file"
    return f"{reason}; {where}. Please report it with the command that you gave; results that were written are complete"


def _kept(text: str) -> Path | None:
    try:
        handle, name = tempfile.mkstemp(prefix="naibu-", suffix=".log")
        with os.fdopen(handle, "w", encoding="utf-8", errors="replace") as stream:
            stream.write(text)
    except OSError:
        return None
    return Path(name)


def occupy_closed_streams() -> None:
    """Open what stands for nothing where a standard stream was closed: a result must not get its number, and with it stray messages."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free


def output_lost(error: Exception) -> bool:
    """Tell whether an error is that of a stream that takes no more output; files are written by functions that raise naibu's errors."""
    return isinstance(error, OSError) and error.filename is None and error.errno in _LOST


def flush_output() -> None:
    """Write out what is buffered.

    Raises
    ------
    OutputLostError
        Standard output is closed or full.
    """
    if sys.stdout is None:
        raise OutputLostError("standard output is closed; results in files are complete")
    try:
        sys.stdout.flush()
    except (OSError, ValueError) as error:
        raise OutputLostError(f"standard output cannot be written ({error}); results in files are complete") from error


def leave_quietly(reason: str) -> NoReturn:
    """End with exit code 1, without the interpreter's second attempt to write what is buffered."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        sys.stderr.write(f"error: {reason}\n")
        sys.stderr.flush()
    os._exit(1)
