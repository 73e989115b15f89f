"""Compare laws, contacts and joints: calibrate each candidate model, and predict each experiment from the others."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace

from naibu.core.errors import InputError
from naibu.core.progress import Progress, ProgressReport
from naibu.identification.from_markers.checks.marker_checks import check_markers
from naibu.identification.from_markers.checks.marker_outliers import without_outliers
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.prediction.cross_validation import ModelRow, compare_models
from naibu.workflows.markers.cross_validation import MEMORY_MB
from naibu.workflows.markers.experiments import Source, load_experiments, parse_known, provenance_of, require_element_size
from naibu.workflows.parallel.run_tasks import run_tasks
from naibu.workflows.parallel.task import Outcome, Task
from naibu.workflows.parallel.worker_count import Workers
from naibu.workflows.results.output_folder import no_empty_folders, output_folder
from naibu.workflows.results.result_folder import COMPARISON_FILE, read_comparison, write_comparison


@no_empty_folders()
def compare(
    experiments: Sequence[Source] | Source,
    *,
    candidates: Sequence[ModelSettings],
    known: Sequence[str] = (),
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    workers: int = 1,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> list[ModelRow]:
    """Calibrate several models on the same experiments, and predict each experiment from the others with each of them.

    Parameters
    ----------
    experiments : sequence of path, str or Experiment
        As for `identify`.
    candidates : sequence of ModelSettings
        Laws, contacts and joints to compare.
    known : sequence of str
        As for `identify`.
    out : path, optional
        Folder for ``comparison.json``, written anew after every candidate; candidates that it holds already, of the same inputs, are not
        repeated.
    overwrite : bool
        Whether what `out` holds is discarded and all is computed anew.
    workers, cluster
        Where candidates are computed, one a task (`naibu.workflows.parallel.worker_count.Workers`).
    progress : callable, optional
        Gets reports whose stages name the candidate, and the experiment left out (`naibu.core.progress`); "candidates" where workers
        compute them.

    Returns
    -------
    list of ModelRow
        One for each candidate, in their order.

    Raises
    ------
    InputError
        Unusable input, or no candidate.
    WorkerLostError
        The worker of a candidate died twice; the rows of the others have been written.
    """
    where = Workers(workers, cluster)
    if not candidates:
        raise InputError("candidates is empty; give at least one model to compare")
    loaded = load_experiments(experiments)
    check_markers(loaded)
    loaded = without_outliers(loaded)[0]
    known_materials = parse_known(known)
    for settings in candidates:
        require_element_size(loaded, settings.element_size_mm)
    folder = None if out is None else output_folder(out)
    if folder is not None and overwrite:
        (folder / COMPARISON_FILE).unlink(missing_ok=True)
    provenance = [provenance_of(loaded, known, {}, settings) for settings in candidates]
    rows = [None if folder is None else read_comparison(folder, each) for each in provenance]
    missing = [k for k, row in enumerate(rows) if row is None]

    def keep(index: int, outcome: Outcome) -> None:
        if outcome.error is None:
            rows[missing[index]] = row = outcome.result[0]
            if folder is not None:
                write_comparison(folder, provenance[missing[index]], row)

    if where.elsewhere:
        given = {"experiments": loaded, "known_materials": known_materials}
        tasks = [Task(_named(candidates[k]), compare_models, {**given, "candidates": [candidates[k]]}) for k in missing]
        for outcome in run_tasks(tasks, workers=where, memory_mb=MEMORY_MB, stage="candidates", finished=keep, progress=progress):
            outcome.value()
    else:
        for index, k in enumerate(missing):
            told = _of_candidate(progress, candidates[k])
            keep(index, Outcome(compare_models(loaded, [candidates[k]], known_materials=known_materials, progress=told)))
    return [row for row in rows if row is not None]


def _named(settings: ModelSettings) -> str:
    return f"{settings.law}, {settings.contact}, {settings.joined}"


def _of_candidate(progress: Progress | None, settings: ModelSettings) -> Progress | None:
    """Report the steps of one candidate under its name."""
    if progress is None:
        return None
    name = _named(settings)

    def passed_on(report: ProgressReport) -> None:
        stage = name if report.stage == "calibration" else f"{name} {report.stage}"
        progress(replace(report, stage=stage))

    return passed_on
