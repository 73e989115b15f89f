"""Verbs that work with what naibu brings along: ``reproduce``, ``simulate``."""

from __future__ import annotations

import signal
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from naibu.cli.console import INTERRUPTED, app, errors, print_table, progress_bar, say
from naibu.core.errors import InputError

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
    from naibu.viewer.chapter_page import write_chapter

    began = time.perf_counter()
    with errors.status("starting"):
        done = CHAPTERS[chapter](seed)
    for section in done.sections:
        for table in section.tables:
            print_table(f"{table.title}: {table.caption}", table.columns, table.rows)
            if table.note:
                say(table.note, "dim")
    page, numbers = write_chapter(done, out)
    say(f"{time.perf_counter() - began:.0f} s. Page: {page}   numbers: {numbers}")


@app.command
def simulate(study: str = "", *, out: Path = Path("naibu-simulation"), resume: bool = False, example: bool = False) -> None:
    """Run a simulation, and write its motion for ParaView, an animated page and the numbers.

    Without STUDY it lists those of the report. Ctrl-C keeps what is computed.

    Parameters
    ----------
    study
        Name of a study, or your own file STUDY.toml of a lattice of springs and dampers.
    out
        Folder for the files.
    resume
        Go on with an interrupted run of a lattice.
    example
        Print the file of a lattice study, to begin your own: naibu simulate --example > my_study.toml
    """
    from naibu.workflows.lattice_study import NAMED, TEMPLATE, study_text
    from naibu.workflows.simulate_study import SLUGS, SQUARES_TOGETHER, simulate_study

    if example:
        sys.stdout.write(study_text(study or TEMPLATE))
        return
    if not study:
        rows = [(name, "finite elements", SLUGS.get(name, "three squares side by side")) for name in (SQUARES_TOGETHER, *SLUGS)]
        lattices = [(name, "springs and dampers", tomllib.loads(study_text(name))["title"]) for name in NAMED]
        print_table("Studies", ("name", "made of", "what"), rows + lattices, left=True)
        return
    began = time.perf_counter()
    if study == SQUARES_TOGETHER or study in SLUGS:
        if resume:
            raise InputError(f"{study} takes seconds and cannot be resumed; run it without --resume")
        with progress_bar(f"computing {study}") as tell:
            files = simulate_study(study, out, tell=tell)
        say(f"{time.perf_counter() - began:.0f} s. {', '.join(str(path) for path in files)}")
        return
    _simulate_lattice(study, out, resume)


def _simulate_lattice(study: str, out: Path, resume: bool) -> None:
    from naibu.workflows.simulate_lattice import simulate_lattice

    began = time.perf_counter()
    with stopped_gently() as stopping, progress_bar(f"computing {study}") as told:

        def tell(done: int, of: int) -> None:
            told(done, of)
            if stopping():
                raise KeyboardInterrupt

        run = simulate_lattice(study, out, resume=resume, tell=tell)
    say(f"{time.perf_counter() - began:.0f} s. {', '.join(str(path) for path in run.files)}")
    if not run.finished:
        errors.print(f"Interrupted: {run.frames} of {run.of} frames are kept. The same command with --resume goes on.", soft_wrap=True)
        sys.exit(INTERRUPTED)


@contextmanager
def stopped_gently() -> Iterator[Callable[[], bool]]:
    """Whether Ctrl-C, or the end of a job on a cluster (SIGTERM), asked to stop; what is at work may end. A second one stops at once."""
    asked: list[int] = []

    def stop(number: int, frame: object) -> None:
        # the first one raises nothing: Python drops what is raised while it clears objects away
        if asked:
            raise KeyboardInterrupt
        asked.append(number)
        errors.print("Stopping behind this frame; once more stops at once.")

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
