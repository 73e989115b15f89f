"""Results of two runs are never mixed in one folder."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from virtual_press import Press

from naibu.core.errors import InputError
from naibu.io.files.atomic import new_folder_aside, write_atomically
from naibu.workflows.predict import predict
from naibu.workflows.results import result_folder
from naibu.workflows.results.files_together import written_together
from naibu.workflows.results.output_folder import output_folder

NAMES = ("table.csv", "page.html")


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


def one_then_a_full_disk(folder: Path) -> None:
    write_atomically(folder / "table.csv", "new")
    raise InputError(f"{folder / 'page.html'}: cannot be written (No space left on device)")


def test_files_are_in_their_places_and_told_in_order(tmp_path: Path) -> None:
    write_atomically(tmp_path / "table.csv", "old")
    found = written_together(tmp_path, NAMES, lambda at: [write_atomically(at / name, "new") for name in NAMES])
    assert found == tuple(tmp_path / name for name in NAMES)
    assert contents(tmp_path) == dict.fromkeys(NAMES, "new")


def test_a_full_disk_keeps_all_earlier_results_or_what_was_finished(tmp_path: Path) -> None:
    write_atomically(tmp_path / "page.html", "old")
    with pytest.raises(InputError, match=r"earlier results .* are as they were") as told:
        written_together(tmp_path, NAMES, one_then_a_full_disk)
    assert str(told.value).startswith(f"{tmp_path / 'page.html'}: cannot be written")
    assert contents(tmp_path) == {"page.html": "old"}
    (tmp_path / "page.html").unlink()
    with pytest.raises(InputError, match=r"No space left on device\)$"):
        written_together(tmp_path, NAMES, one_then_a_full_disk)
    assert contents(tmp_path) == {"table.csv": "new"}


def test_another_failure_keeps_what_was_finished(tmp_path: Path) -> None:
    def fails(folder: Path) -> None:
        write_atomically(folder / "table.csv", "new")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        written_together(tmp_path, NAMES, fails)
    assert contents(tmp_path) == {"table.csv": "new"}


def test_the_folder_that_a_killed_run_left_is_removed(tmp_path: Path) -> None:
    aside = new_folder_aside(tmp_path)
    write_atomically(aside / "table.csv", "of a run that was killed")
    killed = tmp_path / aside.name.replace(f"-{os.getpid()}-", "-999999999-")
    aside.rename(killed)
    mine = new_folder_aside(tmp_path)
    output_folder(tmp_path)
    assert list(tmp_path.iterdir()) == [mine]


def test_a_prediction_that_cannot_write_its_page_leaves_the_earlier_one(
    press: Press, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    predict(press.results, press.folder, state="pressed_more", out=tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(folder: Path, *_: object) -> None:
        raise InputError(f"{folder / 'predicted.html'}: cannot be written (No space left on device)")

    monkeypatch.setattr(result_folder, "_write_report", full)
    with pytest.raises(InputError, match="are as they were"):
        predict(press.results, press.folder, state="pressed_more", height_mm=48.0, out=tmp_path, overwrite=True)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
