"""Writing of HDF5 files that survives a full disk.

The HDF5 library cannot close a file whose last blocks cannot be written: it keeps the file open, and crashes the interpreter when it tries
again at exit. Here HDF5 writes through a Python stream that remembers the first failure and accepts everything that follows, so that the
file closes; the caller asks for the failure and discards the file.
"""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import h5py

from naibu.io.files.rollback_journal import RollbackJournal


class ForgivingStream(io.RawIOBase):
    """A file stream whose writes never raise; `failure` is the first error, after which the file is invalid.

    Parameters
    ----------
    path : Path
        An existing file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._raw = path.open("r+b", buffering=0)
        self._journal: RollbackJournal | None = None
        self.failure: OSError | None = None

    def checkpoint(self, journal: Path) -> None:
        """Keep what is overwritten from now on in a journal; see `naibu.io.files.rollback_journal`.

        Raises
        ------
        InputError
            The journal cannot be written.
        """
        size = os.fstat(self._raw.fileno()).st_size
        before, self._journal = self._journal, RollbackJournal(journal, size)
        if before is not None:
            before.close()

    def readable(self) -> bool:
        """Whether it can be read: always."""
        return True

    def writable(self) -> bool:
        """Whether it can be written: always."""
        return True

    def seekable(self) -> bool:
        """Whether it has positions: always."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Move to a position."""
        return self._raw.seek(offset, whence)

    def tell(self) -> int:
        """Return the position."""
        return self._raw.tell()

    def readinto(self, buffer: Any, /) -> int:
        """Read into a buffer; beyond the end of what could be written there are zeros."""
        view = memoryview(buffer).cast("B")
        count = self._raw.readinto(view)
        if self.failure is not None and count < len(view):
            view[count:] = bytes(len(view) - count)
            return len(view)
        return count

    def write(self, data: Any, /) -> int:
        """Write all bytes, or remember why not."""
        view = memoryview(data).cast("B")
        written, place = 0, self._raw.tell()
        self._keep(place, place + len(view))
        while written < len(view) and self.failure is None:
            try:
                written += self._raw.write(view[written:]) or 0
            except OSError as error:
                self.failure = error
        return len(view)

    def truncate(self, size: int | None = None, /) -> int:
        """Set the size, or remember why not."""
        length = self._raw.tell() if size is None else size
        self._keep(length, os.fstat(self._raw.fileno()).st_size)
        if self.failure is not None:
            return length
        try:
            return self._raw.truncate(length)
        except OSError as error:
            self.failure = error
            return length

    def _keep(self, start: int, stop: int) -> None:
        """Keep bytes in the journal before they are changed; what cannot be kept is not changed."""
        if self._journal is None or self.failure is not None:
            return
        try:
            self._journal.keep(self._raw, start, stop)
        except OSError as error:
            self.failure = error

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def close(self) -> None:
        """Close the file."""
        if not self.closed:
            try:
                self._raw.close()
            except OSError as error:
                self.failure = self.failure or error
            if self._journal is not None:
                self._journal.close()
        super().close()


class Hdf5File:
    """An HDF5 file that is being written.

    Attributes
    ----------
    file : h5py.File
        The open file.
    """

    def __init__(self, path: Path, *, keep: bool = False) -> None:
        self._stream = ForgivingStream(path)
        self.file = h5py.File(self._stream, "r+" if keep else "w")

    def checkpoint(self, journal: Path) -> None:
        """Write everything out, so that `naibu.io.files.rollback_journal.roll_back` can restore this moment.

        Raises
        ------
        OSError, InputError
            The disk is full.
        """
        self.file.flush()
        self.require_written()
        self._stream.checkpoint(journal)

    def require_written(self) -> None:
        """Raise what the disk refused.

        Raises
        ------
        OSError
            Something could not be written; the file is useless.
        """
        if self._stream.failure is not None:
            raise self._stream.failure

    def close(self) -> None:
        """Close the file; nothing is raised."""
        if self.file:
            self.file.close()
        self._stream.close()
