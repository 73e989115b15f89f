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
from naibu.core.memory import LIBRARIES_MB, require_address_space, reserve_work_space

_LOST = (errno.EPIPE, errno.ENOSPC, errno.EFBIG, errno.EBADF, errno.EIO)

_REMEDIES = {
    **dict.fromkeys(("identify", "predict", "compare"), "larger elements (--element-size-mm) or fewer experiments and states"),
    **dict.fromkeys(("sense", "compare-methods"), "smaller volumes (crop them or take larger voxels), or Zarr (read block by block)"),
    **dict.fromkeys(("track", "track-sequence"), "smaller volumes (crop them or take larger voxels)"),
    **dict.fromkeys(("simulate", "live", "cut"), "a coarser mesh or lattice"),
}


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
    reason = f"{f'naibu {verb}'.rstrip()} ended with an error of its own ({type(error).__name__}: {' '.join(str(error).split())[:200]})"
    log = _kept(text)
    where = f"the details are in {log}" if log is not None else "its details could not be written to a file"
    return f"{reason}; {where}. Please report it with the command that you gave; results that were written are complete"


def require_room(verb: str) -> None:
    """Raise an error unless the libraries of a verb fit into the address space that the process may take, and reserve their work space.

    Raises
    ------
    MemoryError
        They do not; loading them would end in messages that are not naibu's, or never.
    """
    require_address_space(LIBRARIES_MB, f"the libraries of naibu {verb}".rstrip())
    reserve_work_space()


def out_of_memory(error: BaseException, verb: str) -> str:
    """Return the message for an error of too little memory.

    Parameters
    ----------
    error : BaseException
        What was raised.
    verb : str
        The verb that was running.
    """
    reason = " ".join(str(error).split())[:300].rstrip(".") or "no details"
    remedy = _REMEDIES.get(verb, "a coarser mesh or smaller volumes")
    return f"naibu {verb} needs more memory than there is ({reason}); use {remedy}, or a computer with more memory"


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
