"""Verbs for simulations and for the 2008 report: ``reproduce``, ``simulate``."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from naibu.cli.shell.console import INTERRUPTED, WARNING, errors, print_table, progress_display, say
from naibu.cli.shell.described import Flag, Out, Overwrite, Whole, WorkerOptions
from naibu.cli.shell.run_record import wrote
from naibu.cli.shell.verbs import REPRODUCE, SIMULATE, verb
from naibu.core.errors import InputError
from naibu.core.progress import ProgressReport

ChapterName = Literal["ch1", "ch2", "ch3", "ch4-adaptive", "ch4-cut", "ch4-lattice", "ch4-cube", "ch4-octree", "ch5", "ch6", "all"]


@verb(REPRODUCE, "reproduce ch3 --open", "reproduce all -o report --workers 0   # every chapter that the folder does not hold yet")
def reproduce(
    chapter: ChapterName,
    *,
    out: Out = Path("naibu-reproduction"),
    seed: Whole = 0,
    overwrite: Overwrite = False,
    where: WorkerOptions | None = None,
) -> None:
    """Recompute the tables and figures of a chapter of the 2008 report, and compare them with the printed ones.

    With all, every chapter is computed that the folder does not hold yet, and an index page is written over them.

    Parameters
    ----------
    chapter
        Chapter of the report, or all.
    out
        Folder for the page (ch3.html) and the numbers (ch3.json).
    seed
        Seed of the random numbers.
    overwrite
        Replace results, or files of your own, that the folder already holds.
    """
    from naibu.reproduction.chapters import CHAPTERS
    from naibu.workflows.parallel.worker_count import Workers
    from naibu.workflows.reproduce import missing_chapters, processor_seconds, reproduce_all
    from naibu.workflows.reproduce import reproduce as reproduced

    began = time.perf_counter()
    if chapter != "all" and where is not None:
        raise InputError(f"`workers` and `cluster` share out the chapters of `reproduce all`; {chapter} is one: leave them out")
    if chapter == "all":
        Workers(**(where or WorkerOptions()).arguments)  # what cannot be is refused before anything is said
        left = tuple(CHAPTERS) if overwrite else missing_chapters(out, seed)
        if left:
            seconds = processor_seconds(left)
            told = f"{seconds / 60.0:.0f} minutes" if seconds >= 90.0 else f"{seconds:.0f} s"
            of = "1 chapter is" if len(left) == 1 else f"{len(left)} chapters are"
            errors.print(f"{of} to be computed: about {told} of one common core. Ctrl-C keeps those that are done.", soft_wrap=True)
        try:
            with progress_display() as progress:
                index, _ = reproduce_all(out, seed=seed, overwrite=overwrite, progress=progress, **(where or WorkerOptions()).arguments)
        except KeyboardInterrupt:
            kept = len(CHAPTERS) - len(missing_chapters(out, seed))
            errors.print(f"Interrupted: {kept} of {len(CHAPTERS)} chapters are kept. The same command goes on.", soft_wrap=True)
            sys.exit(INTERRUPTED)
        wrote(index)
        say(f"{time.perf_counter() - began:.0f} s. Index: {index}")
        return
    with errors.status("starting"):
        done, page, numbers = reproduced(chapter, out=out, seed=seed, overwrite=overwrite)
    for section in done.sections:
        for table in section.tables:
            print_table(f"{table.title}: {table.caption}", table.columns, table.rows)
            if table.note:
                say(table.note, "dim")
    wrote(page, numbers)
    say(f"{time.perf_counter() - began:.0f} s. Page: {page}   numbers: {numbers}")


@verb(
    SIMULATE,
    "simulate                        # lists the studies that come with naibu",
    "simulate dough-pressed-by-sphere --open",
    "simulate --example > my_study.toml && naibu simulate my_study.toml",
    "simulate sweep --example > my_sweep.toml && naibu simulate my_sweep.toml --workers 0",
)
def simulate(
    study: str = "",
    *,
    out: Out = Path("naibu-simulation"),
    resume: Flag = False,
    overwrite: Overwrite = False,
    checkpoint_every: Whole = 10,
    device: str = "cpu",
    example: Flag = False,
    where: WorkerOptions | None = None,
) -> None:
    """Simulate a study, and write its motion for ParaView, an animated page and the numbers; or all runs of a sweep, and one table.

    Without STUDY, the studies that come with naibu are listed. Ctrl-C keeps what has been computed.

    Parameters
    ----------
    study
        Name of a study, or your own file STUDY.toml of a mass-spring-dashpot lattice, an indentation (adaptive finite
        elements), a sensing chip, a fingertip, layered skin, or a sweep: many runs of a lattice's study with some numbers changed.
    out
        Folder for the files.
    resume
        Resume an interrupted or killed run of a lattice, fingertip or sweep.
    overwrite
        Replace results, or files of your own, that the folder already holds.
    checkpoint_every
        Number of frames of a lattice between checkpoints: a run that is killed loses at most so many.
    device
        Where a lattice is computed: cpu, cuda (an NVIDIA GPU; needs naibu[gpu]), or warp-cpu (the GPU's kernels on the CPU, for tests).
    example
        Print the file of a study as a template for your own: naibu simulate --example > my_study.toml, or, of a sensing chip,
        naibu simulate chip --example > my_chip.toml; the same for indentation, fingertip, ischemia and sweep.
    """
    from naibu.workflows.studies.simulate import example_text, named_studies
    from naibu.workflows.studies.simulate import simulate as simulated

    if example:
        sys.stdout.write(example_text(study))
        return
    if not study:
        print_table("Studies", ("name", "model", "title"), [(s.name, s.model, s.title) for s in named_studies()], left=True)
        return
    began = time.perf_counter()
    with stopped_gently() as stopping, progress_display() as display:

        def progress(report: ProgressReport) -> None:
            display(report)
            if stopping():
                raise KeyboardInterrupt

        run = simulated(
            study, out=out, resume=resume, overwrite=overwrite, checkpoint_every=checkpoint_every, device=device, progress=progress,
            **(where or WorkerOptions()).arguments,
        )  # fmt: skip
    wrote(*run.files)
    say(f"{time.perf_counter() - began:.0f} s. {', '.join(str(path) for path in run.files)}")
    for warning in run.warnings:
        say(warning, WARNING)
    if not run.finished:
        errors.print(f"Interrupted: {run.frames} of {run.of} {run.parts} are kept. The same command with --resume goes on.", soft_wrap=True)
        sys.exit(INTERRUPTED)


@contextmanager
def stopped_gently(part: str = "frame") -> Iterator[Callable[[], bool]]:
    """Yield whether Ctrl-C, or the end of a cluster job (SIGTERM), requested a stop after the current part; a second one stops at once."""
    asked: list[int] = []

    def stop(number: int, frame: object) -> None:
        # the first one raises nothing: Python drops exceptions raised while objects are deleted
        if asked:
            raise KeyboardInterrupt
        asked.append(number)
        errors.print(f"Stopping after this {part}; press again to stop at once.")

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
