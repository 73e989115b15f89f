"""What all readers share: files that are read whole, sizes that are believed only where the file can hold them, and one kind of error.

A parser, of naibu or of a library, may meet anything in a damaged file. Whatever it raises there reaches the caller as an `InputError`
that names the file.
"""

from __future__ import annotations

import bz2
import lzma
import os
import stat
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from naibu.core.errors import InputError, NaibuError

LARGEST_RATIO = 1100  # no deflate stream unpacks to more than 1032 times its length (RFC 1951)


class _Decompressor(Protocol):
    """What the decompressors of zlib, bz2 and lzma have in common."""

    @property
    def eof(self) -> bool: ...

    def decompress(self, data: bytes, max_length: int = ..., /) -> bytes: ...


@contextmanager
def guarded_reading(path: str | os.PathLike[str], kind: str = "") -> Iterator[None]:
    """Turn whatever is raised while a file is read into an `InputError` that names the file.

    Parameters
    ----------
    path : path-like
        The file, as the user knows it.
    kind : str
        What it was read as, ``"MetaImage"``.

    Raises
    ------
    InputError
        The file is damaged, or not what its name says.
    """
    what = f" as {kind}" if kind else ""
    try:
        yield
    except NaibuError:
        raise
    except MemoryError as error:
        raise InputError(f"{path}: announces more data than fits into memory; it is damaged, or too large for this computer") from error
    except RecursionError as error:
        raise InputError(f"{path}: is nested too deeply to be read{what}; it is damaged") from error
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        said = f"{type(error).__name__}: {reason}" if reason else type(error).__name__
        mend = "it is damaged or not what its name says: copy or export it again"
        raise InputError(f"{path}: cannot be read{what} ({said}); {mend}") from error


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Return the content of a regular file.

    Raises
    ------
    InputError
        It is not there, may not be read, or is a device or a pipe, which might never end.
    """
    require_regular(path)
    try:
        return Path(path).read_bytes()
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from error


def require_regular(path: str | os.PathLike[str]) -> None:
    """Refuse what is not a regular file: folders, devices, pipes, and what is not there.

    Raises
    ------
    InputError
        It is not one.
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from error
    if stat.S_ISDIR(mode):
        raise InputError(f"{path}: cannot be read (Is a directory); name a file in it")
    if not stat.S_ISREG(mode):
        raise InputError(f"{path}: is a device or a pipe; copy its content into a file first")


def _unreadable(path: str | os.PathLike[str], error: Exception) -> InputError:
    reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
    return InputError(f"{path}: cannot be read ({reason}); check the path")


def file_beside(header: Path, name: str) -> Path:
    """Return the file with the data of a header, which must lie in the header's folder or below it.

    Raises
    ------
    InputError
        The name leads elsewhere: a header that was sent along must not make naibu read other files.
    """
    folder = header.resolve().parent
    try:
        found = (folder / name).resolve()
    except (OSError, ValueError) as error:
        raise InputError(f"{header.name}: names the file {name!r} for its data, which cannot be ({error})") from error
    if not found.is_relative_to(folder):
        raise InputError(f"{header.name}: its data stand in {name!r}, outside the folder of the header; put both files into one folder")
    return found


def require_plausible(path: str | os.PathLike[str], announced: int, stored: int, *, compressed: bool) -> None:
    """Refuse a header that announces more bytes than the file can hold, before anything of that size is allocated.

    Parameters
    ----------
    path : path-like
        The file.
    announced : int
        Bytes that the header announces.
    stored : int
        Bytes that are there.
    compressed : bool
        Whether those are compressed.

    Raises
    ------
    InputError
        There cannot be so many.
    """
    most = (stored + 1024) * LARGEST_RATIO if compressed else stored
    if announced > most:
        raise InputError(
            f"{path}: announces {announced} bytes of values, but its {stored} {'compressed ' * compressed}bytes cannot hold them: "
            "the file was truncated, or its header is damaged; copy it again"
        )


def inflated(data: bytes, most: int, method: str = "zlib") -> bytes:
    """Decompress data that must not become longer than `most` bytes.

    Parameters
    ----------
    data : bytes
        Compressed data.
    most : int
        Bytes that they may unpack to.
    method : {"zlib", "gzip", "bz2", "lzma"}
        How they were compressed.

    Raises
    ------
    InputError
        They unpack to more, are damaged, or are truncated.
    """
    decompressor: _Decompressor
    match method:
        case "zlib":
            decompressor = zlib.decompressobj()
        case "gzip":
            decompressor = zlib.decompressobj(wbits=31)
        case "bz2":
            decompressor = bz2.BZ2Decompressor()
        case _:
            decompressor = lzma.LZMADecompressor()
    try:
        content = decompressor.decompress(data, most + 1)
    except (zlib.error, lzma.LZMAError, OSError, EOFError) as error:
        raise InputError(f"compressed values are damaged or truncated ({error}); copy the file again") from error
    if len(content) > most:
        raise InputError(f"compressed values unpack to more than the {most} bytes announced; the file is damaged")
    if not decompressor.eof and len(content) < most:
        raise InputError("compressed values are truncated; copy the file again")
    return content
