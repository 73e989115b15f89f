"""Parameter sweeps of lattice studies: many runs on workers, one table, and a page that shows what depends on what."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from naibu._version import __version__
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.progress import Progress
from naibu.io.files.atomic import write_atomically
from naibu.io.files.parsing import parsed_toml
from naibu.io.files.reading import file_beside, read_bytes
from naibu.io.study_schemas.lattice_study_schema import checked_study
from naibu.io.study_schemas.sweep_schema import SweepFile, load_sweep
from naibu.workflows.parallel.run_tasks import run_tasks
from naibu.workflows.parallel.task import Outcome, Task
from naibu.workflows.parallel.worker_count import Workers
from naibu.workflows.results.output_folder import no_empty_folders, output_folder
from naibu.workflows.studies.checkpoint_file import CheckpointFile
from naibu.workflows.studies.lattice_study import NAMED, prepared_document, study_tables
from naibu.workflows.studies.simulate_lattice import SimulationRun
from naibu.workflows.studies.sweeps.sweep_design import design
from naibu.workflows.studies.sweeps.sweep_page import SweepRows, sweep_html
from naibu.workflows.studies.sweeps.sweep_run import quantities_of, run_of_sweep, with_values

SWEEP = "sweep"
MEMORY_MB = 500.0  # of a lattice of some thousand nodes with the libraries


@dataclass(frozen=True, slots=True, eq=False)
class PreparedSweep:
    """A checked sweep: the tables of every run, and the names of what is varied and found."""

    name: str
    path: Path
    settings: SweepFile
    study: str
    values: FloatArray
    documents: tuple[dict[str, Any], ...]
    quantities: tuple[str, ...]
    fingerprint: str

    @property
    def keys(self) -> tuple[str, ...]:
        """What is varied."""
        return tuple(table.key for table in self.settings.parameter)


def describes_sweep(source: str | os.PathLike[str]) -> bool:
    """Whether a study is a sweep: a file that has a table ``[sweep]``."""
    try:
        return SWEEP in parsed_toml(source, read_bytes(Path(source)))
    except InputError:  # told by whoever reads it
        return False


def sweep_text() -> str:
    """Return the file of a sweep as a template."""
    return (files("naibu") / "datasets" / "studies" / "sweep.toml").read_text(encoding="utf-8")


def prepared_sweep(source: str | os.PathLike[str]) -> PreparedSweep:
    """Read and check a sweep, its study, and the tables of all its runs.

    Raises
    ------
    InputError
        A file or a key that cannot be used, or values that the study refuses.
    """
    path = Path(source)
    settings = load_sweep(path, read_bytes(path))
    named = settings.sweep.study in NAMED
    study = settings.sweep.study if named else str(file_beside(path, settings.sweep.study))
    tables = study_tables(study)
    first = prepared_document(study, tables)
    values = design(settings)
    keys = [table.key for table in settings.parameter]
    documents = tuple(with_values(tables, dict(zip(keys, map(float, row), strict=True)), str(path)) for row in values)
    for number, document in enumerate(documents):
        try:
            checked_study(study, document)
        except InputError as error:
            told = ", ".join(f"{key} = {value:g}" for key, value in zip(keys, values[number], strict=True))
            raise InputError(f"{path}: run {number + 1}, {told}: {error}") from error
    said = json.dumps([settings.model_dump(mode="json"), first.fingerprint, first.inputs, __version__], sort_keys=True)
    names = [body.name for body in first.study.bodies]
    fingerprint = hashlib.sha256(said.encode()).hexdigest()
    return PreparedSweep(path.stem, path, settings, study, values, documents, quantities_of(names), fingerprint)


@no_empty_folders()
def simulate_sweep(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    resume: bool = False,
    overwrite: bool = False,
    workers: int = 1,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> SimulationRun:
    """Compute all runs of a sweep, and write ``NAME.html``, ``NAME.csv`` and ``NAME.json``, one row a run.

    A run that cannot be computed gets a row that says why. Ctrl-C, or a killed process, keeps the runs that were finished.

    Parameters
    ----------
    source : path-like
        File of the sweep.
    out : path-like
        Folder for the files.
    resume : bool
        Whether a sweep that was interrupted goes on.
    overwrite : bool
        Whether results that the folder holds are replaced.
    workers, cluster
        Where runs are computed, one a task (`naibu.workflows.parallel.worker_count.Workers`).
    progress : callable, optional
        Called with the progress over all runs.

    Raises
    ------
    InputError
        A sweep that cannot be used, a folder that cannot be written to or holds results, or nothing to resume.
    """
    where = Workers(workers, cluster)
    sweep = prepared_sweep(source)
    kept = _KeptRuns(CheckpointFile(Path(out) / f"{sweep.name}.runs.jsonl", str(source), sweep.fingerprint))
    if resume:
        rows = kept.read()
    elif not overwrite and kept.file.path.exists():
        raise InputError(
            f"{kept.file.path}: is what an interrupted sweep can be resumed from; continue it with `resume`, begin anew with `overwrite`, "
            "or choose another folder as `out`"
        )
    else:
        rows = {}
    names = () if resume else [f"{sweep.name}.{ending}" for ending in ("html", "csv", "json")]
    folder = output_folder(out, names, overwrite=overwrite)
    kept.begin(rows)
    left = [number for number in range(len(sweep.documents)) if number not in rows]

    def keep(index: int, outcome: Outcome) -> None:
        figures, problem = outcome.result if outcome.error is None else ({}, " ".join(str(outcome.error).split()))
        rows[left[index]] = (figures, problem)
        kept.append(left[index], figures, problem)

    tasks = [Task(f"run {k + 1}", run_of_sweep, {"source": sweep.study, "document": sweep.documents[k]}, measured=True) for k in left]
    stopped = False
    try:
        run_tasks(tasks, workers=where, memory_mb=MEMORY_MB, stage=f"sweep {sweep.name}", finished=keep, progress=progress)
    except BaseException as error:
        if not rows:
            kept.file.remove()  # nothing to go on from
        if not rows or not isinstance(error, KeyboardInterrupt):
            raise
        stopped = True
    written = _written(sweep, rows, folder)
    if stopped:
        written = (*written, kept.file.path)
    else:
        kept.file.remove()
    return SimulationRun(written, len(rows), len(sweep.documents), "runs")


class _KeptRuns:
    """The finished runs of an unfinished sweep: a file of JSON lines, the first of which tells of which sweep they are."""

    def __init__(self, file: CheckpointFile) -> None:
        self.file = file

    def read(self) -> dict[int, tuple[dict[str, float], str]]:
        """Return figures and problem by the number of the run; a line that was cut off is left out."""
        self.file.require_present()
        lines = self.file.path.read_text(encoding="utf-8", errors="replace").splitlines()
        try:
            self.file.require_same(str(json.loads(lines[0])["fingerprint"]))
            found = [json.loads(line) for line in lines[1:] if line.endswith("}")]
            return {int(row["run"]): (dict(row["figures"]), str(row["problem"])) for row in found}
        except (ValueError, KeyError, TypeError, IndexError) as error:
            if isinstance(error, InputError):
                raise
            raise self.file.damaged(error) from error

    def begin(self, rows: dict[int, tuple[dict[str, float], str]]) -> None:
        """Write the first line, and the runs so far."""
        head = json.dumps({"fingerprint": self.file.fingerprint, "naibu": __version__})
        write_atomically(self.file.path, "\n".join([head, *(_line(k, *row) for k, row in rows.items())]) + "\n")

    def append(self, number: int, figures: dict[str, float], problem: str) -> None:
        """Add a run."""
        with open(self.file.path, "a", encoding="utf-8") as stream:
            stream.write(_line(number, figures, problem) + "\n")


def _line(number: int, figures: dict[str, float], problem: str) -> str:
    return json.dumps({"run": number, "figures": figures, "problem": problem})


def _written(sweep: PreparedSweep, rows: dict[int, tuple[dict[str, float], str]], folder: Path) -> tuple[Path, ...]:
    numbers = sorted(rows)
    found = np.array([[rows[k][0].get(name, np.nan) for name in sweep.quantities] for k in numbers]).reshape(len(numbers), -1)
    problems = tuple(rows[k][1] for k in numbers)
    table = SweepRows(tuple(k + 1 for k in numbers), sweep.keys, sweep.values[numbers], sweep.quantities, found, problems)
    title = sweep.settings.title or sweep.name.replace("-", " ").replace("_", " ").capitalize()
    settings = sweep.settings.model_dump(mode="json", exclude_none=True)
    page = write_atomically(folder / f"{sweep.name}.html", sweep_html(title, table, len(sweep.documents), settings))
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["run", *table.keys, *table.quantities, "problem"])
    for number, values, figures, problem in zip(table.numbers, table.values, table.figures, problems, strict=True):
        writer.writerow([number, *map(float, values), *("" if np.isnan(f) else float(f) for f in figures), problem])
    numbers_file = {
        "sweep": title,
        "naibu": __version__,
        "source": str(sweep.path),
        "study": sweep.settings.sweep.study,
        "fingerprint": sweep.fingerprint,
        "settings": settings,
        "units": "mm, kg, s, mN, mN mm",
        "of": len(sweep.documents),
        "rows": [
            {
                "run": n,
                "values": dict(zip(table.keys, map(float, v), strict=True)),
                "figures": dict(zip(table.quantities, (None if np.isnan(x) else float(x) for x in f), strict=True)),
                "problem": p,
            }
            for n, v, f, p in zip(table.numbers, table.values, table.figures, problems, strict=True)
        ],
    }
    told = write_atomically(folder / f"{sweep.name}.json", json.dumps(numbers_file, indent=1) + "\n")
    return page, write_atomically(folder / f"{sweep.name}.csv", stream.getvalue()), told
