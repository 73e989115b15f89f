"""Checkpoints of a file that is changed in place: what is overwritten later is kept in a journal, so that the file can be put back.

A process that is killed leaves the file half-changed; with the journal it is restored to its last checkpoint. The order of writes suffices
for the end of a process; a failure of power may lose what the system had not yet written to the disk.
"""

from __future__ import annotations

import io
import os
from pathlib import Path

from naibu.core.errors import InputError
from naibu.io.files.atomic import write_atomically

PAGE = 4096
_HEAD = b"naibu rollback 1"
_NUMBER = 8  # bytes of a size or of the number of a page


class RollbackJournal:
    """The pages of a file as they were at its last checkpoint, as far as they were overwritten since.

    Parameters
    ----------
    path : Path
        The journal's own file.
    size : int
        Size of the file at the checkpoint, bytes.
    """

    def __init__(self, path: Path, size: int) -> None:
        write_atomically(path, _HEAD + size.to_bytes(_NUMBER, "little"))
        self._out = path.open("ab", buffering=0)
        self._size = size
        self._kept: set[int] = set()

    def keep(self, file: io.FileIO, start: int, stop: int) -> None:
        """Keep the pages that hold the bytes from `start` to `stop`, before these are changed; the file's position stays.

        Raises
        ------
        OSError
            The journal cannot be written; the bytes must not be changed.
        """
        stop = min(stop, self._size)
        pages = [p for p in range(start // PAGE, -(-stop // PAGE)) if p not in self._kept]
        if start >= stop or not pages:
            return
        place = file.tell()
        try:
            for page in pages:
                file.seek(page * PAGE)
                record = page.to_bytes(_NUMBER, "little") + (file.read(PAGE) or b"").ljust(PAGE, b"\0")
                while record:
                    record = record[self._out.write(record) :]
                self._kept.add(page)
        finally:
            file.seek(place)

    def close(self) -> None:
        """Close the journal's file; it stays."""
        self._out.close()


def roll_back(file: Path, journal: Path) -> None:
    """Restore a file to the checkpoint that a journal belongs to.

    Raises
    ------
    InputError
        The journal is damaged, or one of the two cannot be read or written.
    """
    try:
        data = journal.read_bytes()
        head, records = data[: len(_HEAD) + _NUMBER], data[len(_HEAD) + _NUMBER :]
        if len(head) < len(_HEAD) + _NUMBER or not head.startswith(_HEAD):
            raise InputError(f"{journal}: is no journal of a file; begin anew")
        with file.open("r+b") as stream:
            step = _NUMBER + PAGE
            # a record that was cut off belongs to a page that was not changed any more
            for at in range(0, len(records) - step + 1, step):
                stream.seek(int.from_bytes(records[at : at + _NUMBER], "little") * PAGE)
                stream.write(records[at + _NUMBER : at + step])
            stream.truncate(int.from_bytes(head[len(_HEAD) :], "little"))
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as error:
        raise InputError(f"{file}: cannot be restored to its last checkpoint ({error.strerror or error}); begin anew") from error
