"""A file that is changed in place can be put back to its last checkpoint, however and whenever the process ended."""

from __future__ import annotations

import errno
import io
from pathlib import Path

import h5py
import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.io.files.hdf5_stream import ForgivingStream, Hdf5File
from naibu.io.files.rollback_journal import PAGE, roll_back


@pytest.mark.parametrize("seed", range(30))
def test_any_changes_are_undone(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    file, journal = tmp_path / "a", tmp_path / "a.undo"
    file.write_bytes(rng.bytes(int(rng.integers(0, 5 * PAGE))))
    stream = ForgivingStream(file)
    for _ in range(int(rng.integers(1, 4))):
        stream.checkpoint(journal)
        before = file.read_bytes()
        for _ in range(int(rng.integers(0, 12))):
            if rng.random() < 0.3:
                stream.truncate(int(rng.integers(0, 7 * PAGE)))
            else:
                stream.seek(int(rng.integers(0, 6 * PAGE)))
                stream.write(rng.bytes(int(rng.integers(1, 2 * PAGE))))
    # nothing is closed: the process was killed here
    roll_back(file, journal)
    assert file.read_bytes() == before
    roll_back(file, journal)  # it was killed while it was put back, too
    assert file.read_bytes() == before


def test_a_record_cut_off_belongs_to_a_page_not_yet_changed(tmp_path: Path) -> None:
    file, journal = tmp_path / "a", tmp_path / "a.undo"
    file.write_bytes(b"1" * 3 * PAGE)
    stream = ForgivingStream(file)
    stream.checkpoint(journal)
    stream.write(b"2")
    with journal.open("ab") as out:
        out.write((1).to_bytes(8, "little") + b"x" * 100)
    roll_back(file, journal)
    assert file.read_bytes() == b"1" * 3 * PAGE


def test_what_cannot_be_kept_is_not_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, journal = tmp_path / "a", tmp_path / "a.undo"
    file.write_bytes(b"1" * PAGE)
    stream = ForgivingStream(file)
    stream.checkpoint(journal)

    def full(self: object, raw: io.FileIO, start: int, stop: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("naibu.io.files.rollback_journal.RollbackJournal.keep", full)
    stream.write(b"2")
    stream.truncate(0)
    assert stream.failure is not None and stream.failure.errno == errno.ENOSPC
    assert file.read_bytes() == b"1" * PAGE


def test_an_hdf5_file_is_whole_after_any_number_of_its_writes(tmp_path: Path) -> None:
    """As if the process was killed after each write that HDF5 made between two checkpoints."""
    path, journal = tmp_path / "a.h5", tmp_path / "a.undo"
    path.touch()
    output = Hdf5File(path)
    rows = output.file.create_dataset("rows", (0, 40), "f8", maxshape=(None, 40), chunks=(8, 40))
    rows.resize(20, axis=0)
    rows[:] = np.arange(20)[:, None]
    output.checkpoint(journal)
    states: list[tuple[bytes, bytes]] = []
    stream = output._stream
    write = stream.write

    def watched(data: bytes) -> int:
        done = write(data)
        states.append((path.read_bytes(), journal.read_bytes()))
        return done

    stream.write = watched  # type: ignore[method-assign]
    for k in range(20, 60):
        rows.resize(k + 1, axis=0)
        rows[k] = k
        output.file.require_group(f"g{k}").attrs["x"] = np.arange(k)
        output.file.flush()
    output.close()
    assert len(states) > 40
    for content, undo in states:
        (tmp_path / "b.h5").write_bytes(content)
        (tmp_path / "b.undo").write_bytes(undo)
        roll_back(tmp_path / "b.h5", tmp_path / "b.undo")
        with h5py.File(tmp_path / "b.h5") as found:
            assert found["rows"].shape == (20, 40) and (found["rows"][:, 7] == np.arange(20)).all() and list(found) == ["rows"]


def test_a_damaged_journal_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"1")
    (tmp_path / "a.undo").write_bytes(b"something else")
    with pytest.raises(InputError, match="no journal"):
        roll_back(tmp_path / "a", tmp_path / "a.undo")
    with pytest.raises(InputError, match="cannot be restored"):
        roll_back(tmp_path / "a", tmp_path / "missing.undo")
