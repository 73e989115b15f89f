"""Verbs that work with what naibu brings along: ``reproduce``, ``simulate``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Literal

from naibu.cli.console import app, errors, print_table, say

ChapterName = Literal["ch1", "ch2", "ch3", "ch4-lattice", "ch4-cube", "ch4-octree"]


@app.command
def reproduce(chapter: ChapterName, *, out: Path = Path("naibu-reproduction"), seed: int = 0) -> None:
    """Compute the tables and figures of a chapter of the 2008 report anew, and set them beside the printed ones.

    Parameters
    ----------
    chapter
        Chapter of the report.
    out
        Folder for the page (ch3.html) and the numbers (ch3.json).
    seed
        Of all random numbers.
    """
    from naibu.reproduction.chapters import CHAPTERS
    from naibu.reproduction.page import write_chapter

    began = time.perf_counter()
    with errors.status("starting"):
        done = CHAPTERS[chapter](seed)
    for section in done.sections:
        for table in section.tables:
            print_table(f"{table.name}: {table.caption}", table.columns, table.rows)
            if table.note:
                say(table.note, "dim")
    page, numbers = write_chapter(done, out)
    say(f"{time.perf_counter() - began:.0f} s. Page: {page}   numbers: {numbers}")


@app.command
def simulate(study: str, *, out: Path = Path("naibu-simulation")) -> None:
    """Run one of the report's simulations, and write its motion for ParaView, an animated page and the numbers.

    Parameters
    ----------
    study
        squares (all three side by side), elastic-square, viscoplastic-square, rheological-square, agar-block, agar-block-3-d,
        agar-under-a-bar.
    out
        Folder for the files.
    """
    from naibu.study_runs import simulate_study

    began = time.perf_counter()
    with errors.status(f"computing {study}"):
        files = simulate_study(study, out)
    say(f"{time.perf_counter() - began:.0f} s. {', '.join(str(path) for path in files)}")
