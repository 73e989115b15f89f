"""All chapters in one folder: the index, what is kept, and what is refused."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from naibu import cli
from naibu.core.errors import InputError
from naibu.reproduction import chapters
from naibu.viewer.chapters.chapter import Chapter, Section
from naibu.viewer.tables import Table

workflow = importlib.import_module("naibu.workflows.reproduce")  # the package has a function of this name


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replace the chapters by two quick ones; return the names of those that were computed."""
    done: list[str] = []

    def chapter(name: str, seed: int) -> Chapter:
        if name == "ch2" and seed == 13:
            raise KeyboardInterrupt
        done.append(name)
        table = Table("Table 1", ("a", "b"), ((1, 2.5),), note="printed 2.4: a misprint <b>")
        return Chapter(name, f"Title of {name}", (Section("First", (), (table,)),), {"seed": seed})

    quick = {name: (lambda seed, name=name: chapter(name, seed)) for name in ("ch1", "ch2")}
    monkeypatch.setattr(workflow, "CHAPTERS", quick)
    return done


def test_all_chapters_get_an_index_that_quotes_their_notes(computed: list[str], tmp_path: Path) -> None:
    index, done = workflow.reproduce_all(tmp_path / "out")
    text = index.read_text(encoding="utf-8")
    assert computed == ["ch1", "ch2"] and [c.resumed for c in done] == [False, False]
    assert 'href="ch1.html"' in text and "Title of ch2" in text and "printed 2.4: a misprint &lt;b&gt;" in text
    assert all(c.page.is_file() and c.numbers.is_file() for c in done)


def test_finished_chapters_are_kept_and_others_computed(computed: list[str], tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        workflow.reproduce_all(tmp_path, seed=13)
    assert workflow.missing_chapters(tmp_path, 13) == ("ch2",) and not (tmp_path / "index.html").exists()
    computed.clear()
    (tmp_path / "ch2.json").write_text('{"cut": ', encoding="utf-8")
    assert workflow.missing_chapters(tmp_path, 13) == ("ch2",)
    (tmp_path / "ch2.json").unlink()
    (tmp_path / "ch2.html").write_text("killed before its numbers", encoding="utf-8")
    workflow.reproduce("ch1", out=tmp_path, seed=1, overwrite=True)
    assert workflow.missing_chapters(tmp_path, 1) == ("ch2",)
    _, done = workflow.reproduce_all(tmp_path, seed=1)
    assert computed == ["ch1", "ch2"] and [c.resumed for c in done] == [True, False]
    workflow.reproduce_all(tmp_path, seed=1)
    assert computed == ["ch1", "ch2"]
    workflow.reproduce_all(tmp_path, seed=1, overwrite=True)
    assert computed == ["ch1", "ch2", "ch1", "ch2"]


def test_files_of_others_and_of_another_seed_are_not_replaced(computed: list[str], tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match=r"index\.html"):
        workflow.reproduce_all(tmp_path)
    assert computed == [] and (tmp_path / "index.html").read_text(encoding="utf-8") == "mine"
    workflow.reproduce_all(tmp_path / "results")
    with pytest.raises(InputError, match="ch1"):
        workflow.reproduce_all(tmp_path / "results", seed=5)


def test_unknown_chapters_and_seeds_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'ch9' is not known; use one of ch1, ch2"):
        workflow.reproduce("ch9", out=tmp_path)
    with pytest.raises(InputError, match="seed"):
        workflow.reproduce_all(tmp_path, seed=-1)


def test_the_time_of_several_chapters_is_that_of_each() -> None:
    each = [workflow.processor_seconds((name,)) for name in chapters.CHAPTERS]
    assert min(each) > 0.0
    assert workflow.processor_seconds(tuple(chapters.CHAPTERS)) == pytest.approx(sum(each))


def test_an_interrupted_run_says_what_is_kept_and_how_it_goes_on(
    computed: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["naibu", "reproduce", "all", "--seed", "13", "--out", str(tmp_path)])
    with pytest.raises(SystemExit, match="130"):
        cli.main()
    told = capsys.readouterr().err
    assert "chapters are to be computed: about" in told and "chapters are kept. The same command goes on" in told
    assert computed == ["ch1"] and (tmp_path / "ch1.json").is_file()
