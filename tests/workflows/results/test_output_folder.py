"""Nothing in a folder for results is lost unasked, and what killed runs left is removed."""

from __future__ import annotations

import importlib
import inspect
import os
import pkgutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import naibu.workflows
from naibu.core.errors import InputError
from naibu.io.files.atomic import new_aside, writer_of
from naibu.workflows.measurement.multiscale_results import folder_for_multiscale
from naibu.workflows.reproduce import missing_chapters
from naibu.workflows.results.output_folder import no_empty_folders, output_folder


def test_a_folder_is_made_and_may_hold_other_files(tmp_path: Path) -> None:
    folder = output_folder(tmp_path / "a" / "b", ["report.html"])
    (folder / "notes.txt").write_text("mine")
    assert output_folder(folder, ["report.html"]) == folder and os.listdir(folder) == ["notes.txt"]


def test_files_of_the_same_name_are_refused_whoever_wrote_them(tmp_path: Path) -> None:
    for name in ("a.html", "b.json", "c.csv", "d.csv"):
        (tmp_path / name).write_text("mine")
    (tmp_path / "e.csv").symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"holds a\.html, b\.json, c\.csv and 1 more.*another folder.*`overwrite`"):
        output_folder(tmp_path, ["a.html", "b.json", "c.csv", "d.csv", "other.csv"])
    with pytest.raises(InputError, match=r"holds e\.csv"):
        output_folder(tmp_path, ["e.csv"])
    output_folder(tmp_path, ["a.html", "e.csv"], overwrite=True)
    assert (tmp_path / "a.html").read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "said"),
    [("a\0b", "holds a zero byte"), ("x" * 300, "a name of 300 bytes"), ("/proc/nowhere/a", "cannot be used as a folder for results")],
)
def test_a_folder_that_cannot_be_is_refused(tmp_path: Path, name: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        output_folder(tmp_path / name)


def test_what_a_killed_run_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    code = "import os, sys; from naibu.io.files.atomic import new_aside; print(new_aside(sys.argv[1]), flush=True); os.kill(os.getpid(), 9)"
    killed = subprocess.run([sys.executable, "-c", code, str(tmp_path / "m.vtkhdf")], capture_output=True, text=True, check=False)
    left = Path(killed.stdout.strip())
    journal = left.with_suffix(".undo")
    journal.write_text("journal")
    assert left.exists() and left.name.startswith(".m.vtkhdf.") and writer_of(left) is None
    mine = new_aside(tmp_path / "m.vtkhdf")  # of a process that lives
    others = [".m.vtkhdf.part", "m.part", ".m.vtkhdf.zz-1-abc.part", ".hidden"]
    for name in others:
        (tmp_path / name).write_text("mine")
    elsewhere = tmp_path / ".m.vtkhdf.00000000-1-abc.part"
    elsewhere.touch()
    assert writer_of(elsewhere) == 1  # a process of another computer: nobody can tell
    output_folder(tmp_path, keep=(left.name, journal.name))
    assert left.exists() and journal.exists()
    output_folder(tmp_path)
    assert sorted(os.listdir(tmp_path)) == sorted([*others, mine.name, elsewhere.name])
    old = time.time() - 8 * 86400
    os.utime(elsewhere, (old, old))
    output_folder(tmp_path)
    assert not elsewhere.exists() and mine.exists()


def test_long_names_have_temporary_files_too(tmp_path: Path) -> None:
    assert new_aside(tmp_path / ("é" * 115)).exists()


def test_a_folder_in_which_a_run_that_failed_wrote_nothing_is_taken_away_again(tmp_path: Path) -> None:
    @no_empty_folders()
    def run(place: Path, name: str = "") -> None:
        folder = output_folder(place, ["report.html"])
        if name:
            (folder / name).write_text("")
        raise InputError("useless")

    def fail(place: Path, name: str = "") -> None:
        with pytest.raises(InputError, match="useless"):
            run(place, name)

    fail(tmp_path / "a" / "b")
    assert not (tmp_path / "a").exists()
    fail(tmp_path / "c" / "d", "log.txt")  # what was written is kept
    assert (tmp_path / "c" / "d" / "log.txt").is_file()
    (tmp_path / "mine").mkdir()
    fail(tmp_path / "mine")  # as is a folder that was there before
    assert (tmp_path / "mine").is_dir()
    (tmp_path / "c" / "d" / "report.html").write_text("")
    with pytest.raises(InputError, match="already holds"):
        run(tmp_path / "c" / "d")
    assert (tmp_path / "c" / "d" / "report.html").is_file()


def test_a_run_within_another_that_fails_later_leaves_no_folder_either(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="useless"), no_empty_folders():
        with no_empty_folders():
            output_folder(tmp_path / "a" / "b")
        assert (tmp_path / "a" / "b").is_dir()
        raise InputError("useless")
    assert not os.listdir(tmp_path)


ASIDE = (folder_for_multiscale, missing_chapters)  # the one makes a folder for its caller, the other only looks into one


def writers() -> Iterator[Callable[..., object]]:
    """Give the public functions of the workflows that write results to a folder `out`."""
    for found in pkgutil.walk_packages(naibu.workflows.__path__, "naibu.workflows."):
        module = importlib.import_module(found.name)
        if hasattr(module, "output_folder") and module is not sys.modules[output_folder.__module__]:
            for name, value in vars(module).items():
                if inspect.isfunction(value) and value.__module__ == found.name and not name.startswith("_"):
                    signature = inspect.signature(value)
                    if "out" in signature.parameters and value not in ASIDE:
                        yield value


def test_no_function_that_writes_results_leaves_an_empty_folder_where_it_fails() -> None:
    wrapped = {function: hasattr(function, "__wrapped__") for function in writers()}
    assert len(wrapped) > 25
    assert [f.__qualname__ for f, as_it_should in wrapped.items() if not as_it_should] == []
