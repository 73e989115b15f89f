"""Leave-one-out cross-validation of a calibration, in this process or on workers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from naibu.core.errors import NaibuError
from naibu.core.experiment import Experiment
from naibu.core.progress import Progress
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.prediction.cross_validation import LeftOut, leave_one_out, predicted_from_others
from naibu.workflows.parallel.run_tasks import run_tasks
from naibu.workflows.parallel.task import Outcome, Task
from naibu.workflows.parallel.worker_count import Workers
from naibu.workflows.results.search_checkpoint import SearchCheckpoint

MEMORY_MB = 900.0  # of a calibration of one of the bundled experiments with its libraries


def left_out_in_turn(
    experiments: Sequence[Experiment], reference: Calibration, where: Workers, progress: Progress | None, kept: SearchCheckpoint
) -> tuple[tuple[LeftOut, ...], NaibuError | None]:
    """Predict every experiment from the others; return what was found, and the error of an experiment that could not be predicted.

    Parameters
    ----------
    experiments : sequence of Experiment
        Those of the calibration.
    reference : Calibration
        The calibration on all of them, from whose solutions the others start.
    where : Workers
        Where they are computed, one experiment a task.
    progress : callable, optional
        Gets the reports of `leave_one_out`, or of the stage "experiments left out" where workers compute.
    kept : SearchCheckpoint
        Models of an interrupted call, which are not calibrated again; it gets every model as soon as it is found.

    Raises
    ------
    KeyboardInterrupt
        The user stopped it.
    """
    common: dict[str, Any] = {"known_materials": reference.known_materials, "settings": reference.settings}

    def keep(rows: Sequence[LeftOut]) -> None:
        if rows:
            kept.keep_model(rows[0].experiment, rows[0].model)

    def finished(_: int, outcome: Outcome) -> None:
        if outcome.error is None:
            keep(outcome.result)

    if not where.elsewhere or len(experiments) < 2:
        try:
            found = leave_one_out(experiments, **common, reference=reference, models=kept.models, finished=keep, progress=progress)
            return tuple(found), None
        except NaibuError as error:
            return (), error
    given = {"experiments": experiments, **common, "start": reference.match.parameters.values(), "warm_starts": reference.warm_starts}
    tasks = [
        Task(f"without {e.name}", predicted_from_others, {**given, "left_out": e.name, "model": kept.models.get(e.name)})
        for e in experiments
    ]
    outcomes = run_tasks(tasks, workers=where, memory_mb=MEMORY_MB, stage="experiments left out", finished=finished, progress=progress)
    errors = [outcome.error for outcome in outcomes if outcome.error is not None]
    if unexpected := next((error for error in errors if not isinstance(error, NaibuError)), None):
        raise unexpected
    rows = tuple(row for outcome in outcomes if outcome.error is None for row in outcome.result)
    return rows, next((error for error in errors if isinstance(error, NaibuError)), None)
