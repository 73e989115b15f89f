"""Identify materials, friction and boundary conditions from measured experiments, and write model, tables and report."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from naibu.core.errors import ConvergenceError, InputError, NaibuError
from naibu.core.experiment import Experiment
from naibu.core.progress import Progress
from naibu.core.status import Status
from naibu.identification.from_markers.calibration import Calibration, calibrate
from naibu.identification.from_markers.checks.marker_checks import check_markers
from naibu.identification.from_markers.checks.marker_outliers import Outlier, distrusted, outliers_of_fit, without_outliers
from naibu.identification.from_markers.checks.verdict import verdict_of
from naibu.identification.from_markers.law_uncertainty import law_uncertainty
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.prediction.baselines import baselines_of
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.prediction.cross_validation import LeftOut
from naibu.identification.verdict import Explanation, Verdict
from naibu.mechanics.linear_algebra.direct import use_one_thread
from naibu.viewer.notebook import ShownInNotebook, empty_figure
from naibu.viewer.result_figures import draw_estimates
from naibu.viewer.result_page.page import report_html
from naibu.viewer.result_page.payload import Report
from naibu.workflows.markers.cross_validation import left_out_in_turn
from naibu.workflows.markers.experiments import Source, load_experiments, parse_known, provenance_of, require_element_size, require_loaded
from naibu.workflows.parallel.worker_count import Workers
from naibu.workflows.results.files_together import written_together
from naibu.workflows.results.output_folder import no_empty_folders, output_folder
from naibu.workflows.results.report_content import build_report
from naibu.workflows.results.result_folder import IDENTIFICATION_FILES, series_file, write_identification
from naibu.workflows.results.search_checkpoint import CHECKPOINT_FILE, SearchCheckpoint

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


@dataclass(frozen=True, slots=True, eq=False)
class Identification(ShownInNotebook):
    """What `identify` returns.

    Attributes
    ----------
    model : CalibratedModel
        What predictions need.
    calibration : Calibration
        The search behind it.
    baselines : mapping of str to mapping
        RMS distance (mm) of simple descriptions from the measured markers, by ``experiment/state`` and name.
    left_out : tuple of LeftOut
        Experiments predicted from the others; empty when that was not asked for.
    interrupted : bool
        Whether the user stopped it; the model is then the best so far, and the same call continues from there.
    verdict : Verdict
        Whether the model explains the markers.
    """

    model: CalibratedModel
    calibration: Calibration
    baselines: Mapping[str, Mapping[str, float]]
    left_out: tuple[LeftOut, ...]
    interrupted: bool
    verdict: Verdict

    def page_html(self) -> str:
        """Return the page of the result, a whole HTML document."""
        return report_html(self._report())

    def plot(self) -> Canvas:
        """Return a figure: estimates with 95 % intervals, and the distance of predicted from measured markers in every state."""
        report = self._report()
        canvas = empty_figure(11.0, 1.6 + 0.45 * max(len(report.parameters), len(report.scenes)))
        draw_estimates(canvas, report.parameters, report.scenes)
        return canvas

    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return one row a parameter: name, estimate, 95 % interval (infinite where the data do not bound it), unit, whether given."""
        names = ("parameter", "estimate", "from", "to", "unit", "given")
        return tuple(
            dict(zip(names, (p.name, p.value, *self.model.interval(p.name), p.unit, p.fixed), strict=True)) for p in self.model.parameters
        )

    def _report(self) -> Report:
        return build_report(self.calibration, self.model, self.verdict, self.baselines, self.left_out)


@no_empty_folders()
def identify(
    experiments: Sequence[Source] | Source,
    *,
    known: Sequence[str] = (),
    states: Mapping[str, Sequence[str]] | None = None,
    settings: ModelSettings | None = None,
    out: str | os.PathLike[str] | None = None,
    cross_validate: bool = False,
    resume: bool = True,
    overwrite: bool = False,
    workers: int = 1,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> Identification:
    """Identify materials, friction and boundary conditions from experiments, and write model, tables and report.

    Data that cannot belong together are refused; markers that are grossly misplaced are left out and listed; and whether the model explains
    the rest is said in a verdict (`naibu.identification.Verdict`), at the top of every result.

    Ctrl-C (KeyboardInterrupt) ends the search: what is returned and written is the best so far, and the same call goes on from it, without
    calibrating the models again that have predicted an experiment left out.

    Parameters
    ----------
    experiments : sequence
        Folders, names of bundled datasets, or `Experiment` objects; or one of these.
    known : sequence of str
        ``"hardness 5=222 kPa"`` for materials with a known Young's modulus, or one name that sets the scale of ratios.
    states : mapping, optional
        States to use, by experiment; all measured ones by default.
    settings : ModelSettings, optional
        Law, contact, joints, mesh.
    out : path, optional
        Folder for ``model.json``, ``identification.json`` (figures), ``residuals.csv`` (predicted minus measured), ``report.html`` with
        ``report.json`` behind it, and one ``.vtkhdf`` for each state.
    cross_validate : bool
        Also predict every experiment from the others.
    resume : bool
        Continue from the checkpoint of an interrupted search with the same inputs and settings in `out`.
    overwrite : bool
        Whether results, or other files of these names, that `out` holds already are replaced.
    workers, cluster
        Where experiments are predicted from the others, one a task (`naibu.workflows.parallel.worker_count.Workers`).
    progress : callable, optional
        Gets reports of the stages "calibration on larger elements" (of large meshes), "calibration", "EXPERIMENT alone" of two that seem
        to contradict each other, and, with `cross_validate`, "without EXPERIMENT" (`naibu.core.progress`); "experiments left out" where
        workers compute them.

    Returns
    -------
    Identification
        Model, search, and what it is compared with.

    Raises
    ------
    InputError
        Unusable input, or markers that cannot be those of the object in the states described.
    ConvergenceError
        A state cannot be solved at the starting values, or, with `cross_validate`, with an experiment left out; in the latter case the
        model has been written.
    WorkerLostError
        The worker that predicted an experiment died twice; the model has been written.
    """
    where = Workers(workers, cluster)
    if where.elsewhere and not cross_validate:
        raise InputError(
            "`workers` and `cluster` share out the experiments that `cross_validate` leaves out; ask for that, or leave them out"
        )
    loaded = load_experiments(experiments)
    known_materials, chosen = parse_known(known), settings or ModelSettings()
    require_element_size(loaded, chosen.element_size_mm)
    require_states(loaded, states or {})
    provenance = provenance_of(loaded, known, states or {}, chosen)
    doubts = check_markers(loaded, states)
    loaded, outliers = without_outliers(loaded, states)
    kept = SearchCheckpoint.read(Path(out), provenance) if out is not None and resume else SearchCheckpoint(provenance)
    folder = kept.folder = None if out is None else _folder(out, loaded, states or {}, bool(kept.values), overwrite)
    search = partial(
        calibrate, known_materials=known_materials, states=states, settings=chosen, progress=progress, checkpoint=kept.keep_values
    )
    try:
        calibration = search(loaded, start=kept.values or None)
        if misfits := _outliers(calibration):
            loaded, outliers = distrusted(loaded, misfits), (*outliers, *misfits)
            calibration = search(loaded, start=calibration.match.parameters.values(), warm_starts=calibration.warm_starts)
    except ConvergenceError as error:
        labels = [f"{e.name}/{s.name}" for e in loaded for s in _with_states(e, states or {}).loaded_states]
        one_of = "one of " * (len(labels) > 1) + ", ".join(labels)
        raise ConvergenceError(f"{one_of} cannot be solved with the starting values: {error}") from error
    law = law_uncertainty(calibration)
    verdict = verdict_of(calibration, doubts, outliers, progress, law)
    # predictions count in what hangs on the law: that alone is nothing against the model
    reservation = verdict.reservation if verdict.explanation is not Explanation.EXPLAINED else ""
    model = replace(CalibratedModel.of(calibration, provenance, law), reservation=reservation)
    left_in_turn = [_with_states(e, states or {}) for e in loaded] if cross_validate else []
    result, trouble = _compared(calibration, model, verdict, left_in_turn, where, progress, kept)
    if folder is not None:
        names = [name for name in (*IDENTIFICATION_FILES, *_series(loaded, states or {})) if name != CHECKPOINT_FILE]
        written_together(folder, names, lambda at: write_identification(at, calibration, model, verdict, result.baselines, result.left_out))
        if result.interrupted:
            kept.keep_values(model.parameters.values())
        else:
            kept.remove()
    if trouble is not None:
        raise trouble
    return result


def _folder(
    out: str | os.PathLike[str], loaded: Sequence[Experiment], states: Mapping[str, Sequence[str]], resumes: bool, overwrite: bool
) -> Path:
    """Return the folder of the results, which holds none yet, or those of the search that goes on."""
    kept = "a search with other inputs or settings that can be resumed" if (Path(out) / CHECKPOINT_FILE).is_file() else ""
    return output_folder(out, () if resumes else (*IDENTIFICATION_FILES, *_series(loaded, states)), overwrite=overwrite, what=kept)


def _series(loaded: Sequence[Experiment], states: Mapping[str, Sequence[str]]) -> list[str]:
    return [series_file(f"{e.name}/{s.name}") for e in loaded for s in _with_states(e, states).loaded_states]


def _outliers(calibration: Calibration) -> tuple[Outlier, ...]:
    """Markers that the solved load cases leave far from the model and from their neighbours; none of an interrupted search."""
    if calibration.match.status is Status.INTERRUPTED:
        return ()
    pairs = zip(calibration.load_cases, calibration.match.fits, strict=True)
    return tuple(o for load_case, fit in pairs for o in outliers_of_fit(load_case, fit))


def require_states(loaded: Sequence[Experiment], states: Mapping[str, Sequence[str]]) -> None:
    """Refuse states that no experiment has, or that show no load."""
    by_name = {e.name: e for e in loaded}
    for name, chosen in states.items():
        if name not in by_name:
            raise InputError(f"states names {name!r}, but the experiments are {', '.join(by_name)}")
        for state in chosen:
            require_loaded(by_name[name], state)


def _with_states(experiment: Experiment, states: Mapping[str, Sequence[str]]) -> Experiment:
    """Return the experiment without the loaded states that were not chosen."""
    chosen = states.get(experiment.name)
    if chosen is None:
        return experiment
    return replace(experiment, states=(experiment.states[0], *(s for s in experiment.states[1:] if s.name in chosen)))


def _compared(
    calibration: Calibration,
    model: CalibratedModel,
    verdict: Verdict,
    left_in_turn: Sequence[Experiment],
    where: Workers,
    progress: Progress | None,
    kept: SearchCheckpoint,
) -> tuple[Identification, NaibuError | None]:
    """Compute what the calibration is compared with; what goes wrong here is returned, so that the model is written first."""
    left_out: tuple[LeftOut, ...] = ()
    trouble: NaibuError | None = None
    if calibration.match.status is Status.INTERRUPTED:
        return Identification(model, calibration, {}, left_out, True, verdict), trouble
    compared: dict[str, dict[str, float]] = {t.name: {} for t in calibration.load_cases}
    interrupted = threading.Event()
    with ThreadPoolExecutor(1, initializer=use_one_thread) as pool:  # beside calibrations that wait for one another
        try:
            described = pool.submit(_describe, calibration, compared, interrupted)
            if left_in_turn:
                left_out, trouble = left_out_in_turn(left_in_turn, calibration, where, progress, kept)
            described.result()
        except KeyboardInterrupt:
            interrupted.set()
        except NaibuError as error:
            trouble = trouble or error
    return Identification(model, calibration, compared, left_out, interrupted.is_set(), verdict), trouble


def _describe(calibration: Calibration, compared: dict[str, dict[str, float]], stop: threading.Event) -> None:
    """Fill the distances of simple descriptions in, until there are no more or it shall stop."""
    for label, name, distance in baselines_of(calibration):
        compared[label][name] = distance
        if stop.is_set():
            return
