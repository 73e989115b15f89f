"""Reproduce the chapters of the 2008 report :cite:p:`hirai2008`: pages of tables and figures, and an index over all of them."""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from naibu._version import __version__
from naibu.core.arrays import require_count
from naibu.core.errors import InputError
from naibu.core.progress import Progress
from naibu.io.files.atomic import write_atomically
from naibu.reproduction.chapters import CHAPTERS, PROCESSOR_S
from naibu.viewer.cards import cards_html
from naibu.viewer.chapters.chapter import Chapter
from naibu.viewer.chapters.chapter_page import chapter_html, chapter_numbers_text, write_chapter
from naibu.viewer.chapters.comparisons import Comparison, comparison_cards, comparison_table
from naibu.viewer.page_frame import page_html
from naibu.viewer.tables import scrollable, table_html
from naibu.workflows.parallel.run_tasks import run_tasks
from naibu.workflows.parallel.task import Outcome, Task
from naibu.workflows.parallel.worker_count import Workers
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

MEMORY_MB = 1500.0  # of the largest chapter


@dataclass(frozen=True, slots=True)
class ReproducedChapter:
    """A chapter whose page is written.

    Attributes
    ----------
    name, title : str
        Of the chapter.
    page, numbers : Path
        Its files.
    resumed : bool
        Whether they were there already, of the same version and seed.
    seconds : float
        What computing them took; NaN where they were there.
    """

    name: str
    title: str
    page: Path
    numbers: Path
    resumed: bool
    seconds: float


@no_empty_folders()
def reproduce(chapter: str, *, out: str | os.PathLike[str], seed: int = 0, overwrite: bool = False) -> tuple[Chapter, Path, Path]:
    """Recompute the tables and figures of a chapter; write ``CHAPTER.html`` and ``CHAPTER.json``.

    Parameters
    ----------
    chapter : str
        One of `naibu.reproduction.chapters.CHAPTERS`.
    out : path-like
        Folder of the files.
    seed : int
        Seed of the random numbers.
    overwrite : bool
        Whether results that the folder holds are replaced.

    Returns
    -------
    tuple of Chapter, Path, Path
        The content, the page and the numbers.

    Raises
    ------
    InputError
        No such chapter, a negative seed, or a folder that cannot be written to or holds results.
    """
    require_count("seed", seed, 0)
    if chapter not in CHAPTERS:
        raise InputError(f"chapter {chapter!r} is not known; use one of {', '.join(CHAPTERS)}")
    folder = output_folder(out, (f"{chapter}.html", f"{chapter}.json"), overwrite=overwrite)
    content = CHAPTERS[chapter](seed)
    return content, *write_chapter(content, folder)


def missing_chapters(out: str | os.PathLike[str], seed: int = 0) -> tuple[str, ...]:
    """Return the chapters that the folder does not hold yet, of this version of naibu and this seed.

    Raises
    ------
    InputError
        A negative seed.
    """
    require_count("seed", seed, 0)
    return tuple(name for name in CHAPTERS if _finished(Path(out), name, seed) is None)


def processor_seconds(chapters: tuple[str, ...]) -> float:
    """Return about how long chapters take on one core of a common processor, s."""
    return sum(PROCESSOR_S[name] for name in chapters)


@no_empty_folders()
def reproduce_all(
    out: str | os.PathLike[str],
    *,
    seed: int = 0,
    overwrite: bool = False,
    workers: int = 1,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> tuple[Path, tuple[ReproducedChapter, ...]]:
    """Recompute all chapters, and write ``index.html`` over them: what each has, and what its notes say of agreement and misprints.

    Chapters that the folder holds, of the same version of naibu and the same seed, are kept: an interrupted run goes on.

    Parameters
    ----------
    out : path-like
        Folder of the pages.
    seed : int
        Seed of the random numbers.
    overwrite : bool
        Whether all chapters are computed again.
    workers, cluster
        Where chapters are computed, one a task (`naibu.workflows.parallel.worker_count.Workers`); the folder is written here.
    progress : callable, optional
        Called with a `ProgressReport` after every chapter.

    Returns
    -------
    tuple of Path and tuple of ReproducedChapter
        The index, and the chapters.

    Raises
    ------
    InputError
        A negative seed, a folder that cannot be written to, or one that holds other results, as of another seed.
    WorkerLostError
        The worker of a chapter died twice; the other chapters have been written.
    """
    where = Workers(workers, cluster)
    require_count("seed", seed, 0)
    folder = Path(out)
    left = tuple(CHAPTERS) if overwrite else missing_chapters(folder, seed)
    # the page of a chapter is written before its numbers: a run that was killed between them is resumed
    written = [f"{name}.json" for name in left]
    if overwrite or len(left) == len(CHAPTERS):  # else the index is that of an earlier run
        written.append("index.html")
    output_folder(folder, written, overwrite=overwrite)
    seconds: dict[str, float] = {}

    def write(index: int, outcome: Outcome) -> None:
        if outcome.error is None:
            page, numbers, seconds[left[index]] = outcome.result
            write_atomically(folder / f"{left[index]}.html", page)
            write_atomically(folder / f"{left[index]}.json", numbers)

    tasks = [Task(f"chapter {name}", _computed, {"name": name, "seed": seed}, length=PROCESSOR_S[name]) for name in left]
    outcomes = run_tasks(tasks, workers=where, memory_mb=MEMORY_MB, stage="chapters", finished=write, progress=progress)
    for outcome in outcomes:
        outcome.value()
    done = []
    for name in CHAPTERS:
        files = folder / f"{name}.html", folder / f"{name}.json"
        title = str(json.loads(files[1].read_text(encoding="utf-8"))["title"])
        done.append(ReproducedChapter(name, title, *files, name not in seconds, seconds.get(name, float("nan"))))
    return write_atomically(folder / "index.html", _index(done, seed)), tuple(done)


def _computed(name: str, seed: int, progress: Progress | None) -> tuple[str, str, float]:
    """Return page and numbers of a chapter as texts, which any worker can send, and how long that took, s."""
    began = time.perf_counter()
    content = CHAPTERS[name](seed)
    return chapter_html(content), chapter_numbers_text(content), time.perf_counter() - began


def _finished(folder: Path, name: str, seed: int) -> dict[str, Any] | None:
    """Return the numbers of a chapter whose page is there, of this version and seed."""
    try:
        found = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(found, dict) or not (folder / f"{name}.html").is_file() or not isinstance(found.get("settings"), dict):
        return None
    return found if found.get("naibu") == __version__ and found["settings"].get("seed") == seed else None


def _index(done: list[ReproducedChapter], seed: int) -> str:
    numbers = {c.name: json.loads(c.numbers.read_text(encoding="utf-8")) for c in done}
    found = {name: tuple(Comparison(**each) for each in content.get("comparisons", ())) for name, content in numbers.items()}
    cards = cards_html(comparison_cards([each for comparisons in found.values() for each in comparisons]))
    links = "".join(f'<li><a href="#{c.name}">{escape(c.title)}</a></li>' for c in done)
    sections = "\n".join(_entry(c, found[c.name], numbers[c.name]["tables"]) for c in done)
    contents = f'<nav aria-label="Contents"><ul>{links}</ul></nav>'
    return page_html("The 2008 report, reproduced", cards + contents, sections, f"naibu {__version__}, seed {seed}.")


def _entry(chapter: ReproducedChapter, comparisons: tuple[Comparison, ...], tables: list[dict[str, Any]]) -> str:
    """Return the section of a chapter: its link, what agrees, and its tables with the notes that tell of assumptions and misprints."""
    rows = "".join(
        f"<tr><td>{escape(t['section'])}</td><td>{escape(t['title'])}</td><td>{escape(t['note'] or t['caption'])}</td></tr>" for t in tables
    )
    head = "<thead><tr><th>section</th><th>table</th><th>what to know</th></tr></thead>"
    return (
        f'<section id="{chapter.name}" class="long" aria-labelledby="h-{chapter.name}">'
        f'<h2 id="h-{chapter.name}">{escape(chapter.title)}</h2>'
        f'<p><a href="{chapter.page.name}">Page with all tables and figures</a>, <a href="{chapter.numbers.name}">numbers</a></p>'
        + (table_html(comparison_table(comparisons)) if comparisons else "")
        + f"<details><summary>All {len(tables)} tables</summary>"
        + f"{scrollable('Tables of ' + chapter.title, f'<table>{head}<tbody>{rows}</tbody></table>')}</details></section>"
    )
