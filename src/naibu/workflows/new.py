"""A commented experiment folder, or the file of a study, to start from."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal, get_args

from naibu import datasets
from naibu.core.errors import InputError
from naibu.io.experiment_folder.reader import META_FILE
from naibu.io.files.atomic import write_atomically
from naibu.workflows.results.output_folder import no_empty_folders, output_folder
from naibu.workflows.studies.simulate import example_text

Kind = Literal["experiment", "lattice", "indentation", "chip", "fingertip", "ischemia"]
EXAMPLE = "ct_cube_plate"  # the bundled measurement whose tables the folder starts with
TABLES = {"initial.csv": "initial.csv", "pressed.csv": "height_45.csv"}


@no_empty_folders()
def new(kind: Kind, out: str | os.PathLike[str], *, overwrite: bool = False) -> tuple[Path, ...]:
    """Write what a user starts from: every key with a comment, and data with which it runs as it is.

    Parameters
    ----------
    kind : str
        ``"experiment"``, a folder with ``meta.toml`` and marker tables for `naibu.identify`; or a file for `naibu.simulate` of a
        ``"lattice"``, an ``"indentation"``, a sensing ``"chip"``, a ``"fingertip"`` or layered skin (``"ischemia"``).
    out : path-like
        Folder of the experiment, or file of the study.
    overwrite : bool
        Whether files that are there already are replaced.

    Returns
    -------
    tuple of Path
        The files, the one to edit first.

    Raises
    ------
    InputError
        An unknown kind, or a place that cannot be written to or holds such files already.
    """
    if kind not in get_args(Kind):
        raise InputError(f"kind={kind!r} is not known; choose one of {', '.join(get_args(Kind))}")
    if kind != "experiment":
        file = Path(out)
        folder = output_folder(file.parent, (file.name,), overwrite=overwrite)
        return (write_atomically(folder / file.name, example_text("" if kind == "lattice" else kind)),)
    folder = output_folder(out, (META_FILE, *TABLES), overwrite=overwrite)
    measured = datasets.path(EXAMPLE)
    tables = [write_atomically(folder / name, (measured / source).read_text(encoding="utf-8")) for name, source in TABLES.items()]
    return (write_atomically(folder / META_FILE, datasets.experiment_template()), *tables)
