"""Safe reading of files: regular files only, announced sizes checked against the file, every failure an `InputError`.

A parser, of naibu or of a library, may raise any exception on a damaged file. It reaches the caller as an `InputError` that names the file.
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
from naibu.io.files.paths import require_usable_path

LARGEST_RATIO = 1100  # no deflate stream unpacks to more than 1032 times its length (RFC 1951)


class _Decompressor(Protocol):
    """Common interface of the decompressors of zlib, bz2 and lzma."""

    @property
    def eof(self) -> bool: ...

    def decompress(self, data: bytes, max_length: int = ..., /) -> bytes: ...


@contextmanager
def guarded_reading(path: str | os.PathLike[str], kind: str = "") -> Iterator[None]:
    """Convert any exception raised while a file is read into an `InputError` that names the file.

    Parameters
    ----------
    path : path-like
        File, as named by the user.
    kind : str
        Format that was expected, such as ``"MetaImage"``.

    Raises
    ------
    InputError
        The file is damaged, or not of the expected format.
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
        mend = "it is damaged or of another format: copy or export it again"
        raise InputError(f"{path}: cannot be read{what} ({said}); {mend}") from error


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Return the content of a regular file.

    Raises
    ------
    InputError
        The file does not exist, cannot be read, or is a device or a pipe, which might never end.
    """
    require_regular(path)
    try:
        return Path(path).read_bytes()
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from error


def require_regular(path: str | os.PathLike[str]) -> None:
    """Raise an error unless the path is a regular file: for folders, devices, pipes, and missing files.

    Raises
    ------
    InputError
        It is not a regular file.
    """
    require_usable_path(path)
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
    """Return the data file of a header, which must be in the folder of the header or below it.

    Raises
    ------
    InputError
        The name leads elsewhere: a header from another source must not make naibu read other files.
    """
    folder = header.resolve().parent
    try:
        found = (folder / name).resolve()
    except (OSError, ValueError) as error:
        raise InputError(f"{header}: names the file {name!r} for its data, which cannot be ({error})") from error
    if not found.is_relative_to(folder):
        raise InputError(f"{header}: its data file {name!r} is outside the folder of the header; put both files into one folder")
    return found


def require_plausible(path: str | os.PathLike[str], announced: int, stored: int, *, compressed: bool) -> None:
    """Raise an error if a header announces more bytes than the file can contain, before memory of that size is allocated.

    Parameters
    ----------
    path : path-like
        The file.
    announced : int
        Bytes that the header announces.
    stored : int
        Bytes in the file.
    compressed : bool
        Whether these are compressed.

    Raises
    ------
    InputError
        The file cannot contain so many.
    """
    most = (stored + 1024) * LARGEST_RATIO if compressed else stored
    if announced > most:
        raise InputError(
            f"{path}: announces {announced} bytes of values, but its {stored} {'compressed ' * compressed}bytes cannot hold them: "
            "the file was truncated, or its header is damaged; copy it again"
        )


def inflated(data: bytes, most: int, method: str = "zlib") -> bytes:
    """Decompress data to at most `most` bytes.

    Parameters
    ----------
    data : bytes
        Compressed data.
    most : int
        Largest size of the decompressed data, bytes.
    method : {"zlib", "gzip", "bz2", "lzma"}
        Compression method.

    Raises
    ------
    InputError
        The decompressed data are larger, or the data are damaged or truncated.
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
