"""The verb ``new``."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import Literal

from naibu.cli.shell.console import say
from naibu.cli.shell.described import Out, Overwrite
from naibu.cli.shell.run_record import wrote
from naibu.cli.shell.verbs import START, verb

KindName = Literal["experiment", "lattice", "indentation", "chip", "fingertip", "ischemia"]


@verb(START, "new -o my_gel && naibu identify my_gel", "new lattice -o my_study.toml && naibu simulate my_study.toml")
def new(kind: KindName = "experiment", *, out: Out | None = None, overwrite: Overwrite = False) -> None:
    """Write a commented experiment folder, or the file of a study, to start from; it runs as it is.

    Parameters
    ----------
    kind
        An experiment with markers, or a study for naibu simulate: a lattice, an indentation, a sensing chip, a
        fingertip, layered skin (ischemia).
    out
        Folder of the experiment (my_experiment), or file of the study (my_study.toml).
    overwrite
        Replace files that are there already.
    """
    from naibu.workflows.new import new as written

    place = out or Path("my_experiment" if kind == "experiment" else "my_study.toml")
    files = written(kind, place, overwrite=overwrite)
    wrote(*files)
    say(f"Wrote {', '.join(str(file) for file in files)}. Edit {files[0]}, and run: naibu {_next(kind)} {quote(str(place))}")


def _next(kind: str) -> str:
    return "identify" if kind == "experiment" else "simulate"
