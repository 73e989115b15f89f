"""Model selection: leave-one-out cross-validation (:cite:p:`stone1974`) and comparison of models by BIC (:cite:p:`schwarz1978`)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.cores import usable_cores
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.experiment import Experiment
from naibu.core.progress import Progress, ProgressReport
from naibu.core.status import Status
from naibu.identification.from_markers.calibration import Calibration, calibrate
from naibu.identification.from_markers.gauss_newton import MatchingSettings
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import NoiseModel, SolvedLoadCase
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.prediction.prediction import Prediction, predict_state, rms
from naibu.mechanics.linear_algebra.direct import use_one_thread


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """A state predicted by a model that has not seen its experiment.

    Attributes
    ----------
    experiment, state : str
        Names.
    rms_mm : float
        Root mean square distance over the complete markers, mm.
    rms_xyz : tuple of float
        The same along x, y and z.
    marker_count : int
        Number of complete markers.
    prediction : Prediction
        Positions, uncertainty and assumptions.
    model : CalibratedModel
        The model that predicted them.
    """

    experiment: str
    state: str
    rms_mm: float
    rms_xyz: tuple[float, float, float]
    marker_count: int
    prediction: Prediction
    model: CalibratedModel


@dataclass(frozen=True, slots=True, eq=False)
class ModelRow:
    """One candidate model.

    Attributes
    ----------
    settings : ModelSettings
        Law, contact, joints.
    noise_factor, chi_squared : float
        Misfit in units of the noise; its noise-normalised sum of squares. NaN where the model failed.
    parameter_count : int
        Free parameters, poses included.
    bic : float
        Bayesian information criterion ``n ln(chi_squared / n) + k ln n`` (:cite:p:`schwarz1978`), the noise level estimated; less is
        better.
    left_out_mm : float
        Root mean square distance over all markers of the experiments left out one by one, mm; NaN where there is but one experiment.
    problem : str
        Why there is no result, or why to take it with care; empty when all went well.
    """

    settings: ModelSettings
    noise_factor: float
    chi_squared: float
    parameter_count: int
    bic: float
    left_out_mm: float
    problem: str


def leave_one_out(
    experiments: Sequence[Experiment],
    *,
    known_materials: KnownMaterials | None = None,
    settings: ModelSettings | None = None,
    noise: NoiseModel | None = None,
    search: MatchingSettings | None = None,
    reference: Calibration | None = None,
    models: Mapping[str, CalibratedModel] | None = None,
    finished: Callable[[Sequence[LeftOut]], None] | None = None,
    progress: Progress | None = None,
) -> list[LeftOut]:
    """Predict all loaded states of every experiment with a model calibrated on the others.

    Of the predicted state only the heights of its lowest and highest marker layers are used, and the rigid pose of its scan.

    Parameters
    ----------
    experiments : sequence of Experiment
        Two at least.
    known_materials, settings, noise, search : optional
        As for `calibrate`.
    reference : Calibration, optional
        The calibration on all experiments: the others start from its solutions, which saves time.
    models : mapping of str to CalibratedModel, optional
        Models of an earlier call, by the experiment that they have not seen; they are not calibrated again.
    finished : callable, optional
        Called in this thread with the states of every experiment, when they are predicted.
    progress : callable, optional
        Gets a report after every step of a calibration, its stage "without EXPERIMENT"; it is called from several threads.

    Raises
    ------
    InputError
        Fewer than two experiments, or others that do not contain a material which the one left out needs.
    ConvergenceError
        A load case cannot be solved.
    KeyboardInterrupt
        The user stopped one of the calibrations.
    """
    if len(experiments) < 2:
        raise InputError(f"leaving one out needs at least 2 experiments, not {len(experiments)}")
    start = None if reference is None else reference.match.parameters.values()
    warm_starts = {} if reference is None else reference.warm_starts
    stop = threading.Event()

    def without(left: Experiment) -> list[LeftOut]:
        return predicted_from_others(
            experiments,
            left.name,
            known_materials=known_materials,
            settings=settings,
            noise=noise,
            search=search,
            start=start,
            warm_starts=warm_starts,
            model=(models or {}).get(left.name),
            progress=_until(progress, stop),
        )

    with ThreadPoolExecutor(min(len(experiments), usable_cores()), initializer=use_one_thread) as pool:
        turns = [pool.submit(without, left) for left in experiments]
        try:
            for turn in as_completed(turns):
                rows = turn.result()
                if finished is not None:
                    finished(rows)
            return [row for turn in turns for row in turn.result()]
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def predicted_from_others(
    experiments: Sequence[Experiment],
    left_out: str,
    *,
    known_materials: KnownMaterials | None = None,
    settings: ModelSettings | None = None,
    noise: NoiseModel | None = None,
    search: MatchingSettings | None = None,
    start: Mapping[str, float] | None = None,
    warm_starts: Mapping[str, SolvedLoadCase] | None = None,
    model: CalibratedModel | None = None,
    progress: Progress | None = None,
) -> list[LeftOut]:
    """Predict all loaded states of one experiment with a model calibrated on the others: a part of `leave_one_out`.

    Parameters
    ----------
    experiments : sequence of Experiment
        Two at least.
    left_out : str
        Name of the one that is predicted.
    known_materials, settings, noise, search, start, warm_starts : optional
        As for `calibrate`.
    model : CalibratedModel, optional
        A model calibrated on the others before.
    progress : callable, optional
        Gets a report after every step of the calibration, its stage "without EXPERIMENT".

    Raises
    ------
    InputError
        The others do not contain a material which the one left out needs.
    ConvergenceError
        A load case cannot be solved.
    KeyboardInterrupt
        The user stopped the calibration.
    """
    left = next(e for e in experiments if e.name == left_out)
    others = [e for e in experiments if e is not left]
    near = {} if warm_starts is None else warm_starts
    if model is None:
        found = calibrate(
            others,
            known_materials=_applicable(known_materials, others),
            settings=settings,
            noise=noise,
            search=search,
            start=start,
            warm_starts=near,
            progress=_under_stage(progress, f"without {left.name}"),
        )
        if found.match.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        model = CalibratedModel.of(found)
    labels = {state.name: f"{left.name}/{state.name}" for state in left.loaded_states}
    return [
        _left_out(predict_state(model, left, name, heights_from_markers=True, warm_start=near.get(label)), model)
        for name, label in labels.items()
    ]


def _applicable(known_materials: KnownMaterials | None, experiments: Sequence[Experiment]) -> KnownMaterials | None:
    """What is known of materials that the experiments contain; None where nothing is."""
    if known_materials is None:
        return None
    materials = {m for e in experiments for m in e.materials}
    known = {m: e for m, e in known_materials.young_moduli.items() if m in materials}
    return KnownMaterials(known, known_materials.scale_is_absolute) if known else None


def _under_stage(progress: Progress | None, stage: str) -> Progress | None:
    """Report the steps of a calibration as a stage of another name."""
    return None if progress is None else lambda report: progress(replace(report, stage=stage))


def _until(progress: Progress | None, stop: threading.Event) -> Progress:
    """Pass reports on, and end the calibration where it was stopped from another thread."""

    def passed_on(report: ProgressReport) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        if progress is not None:
            progress(report)

    return passed_on


def _left_out(p: Prediction, model: CalibratedModel) -> LeftOut:
    x, y, z = (rms(p.residual, [axis]) for axis in range(3))
    count = int(np.isfinite(p.residual).all(axis=1).sum())
    return LeftOut(p.specimen.experiment.name, p.state, rms(p.residual), (x, y, z), count, p, model)


def pooled_rms(rows: Sequence[LeftOut]) -> float:
    """Return the root mean square distance over the markers of several states, mm."""
    counts = np.array([r.marker_count for r in rows], dtype=float)
    return float(np.sqrt((counts * np.array([r.rms_mm for r in rows]) ** 2).sum() / counts.sum()))


def compare_models(
    experiments: Sequence[Experiment],
    candidates: Sequence[ModelSettings],
    *,
    known_materials: KnownMaterials | None = None,
    noise: NoiseModel | None = None,
    search: MatchingSettings | None = None,
    progress: Progress | None = None,
) -> list[ModelRow]:
    """Calibrate every candidate on all experiments, and predict each experiment from the others; one row a candidate, in their order.

    A candidate that cannot be solved gets a row that says so.

    Raises
    ------
    InputError
        Experiments that cannot be used.
    KeyboardInterrupt
        The user stopped one of the calibrations.
    """
    rows = []
    for settings in candidates:
        try:
            found = calibrate(
                experiments, known_materials=known_materials, settings=settings, noise=noise, search=search,
                with_mesh_error=False, progress=progress,
            )  # fmt: skip
        except ConvergenceError as error:
            rows.append(ModelRow(settings, np.nan, np.nan, 0, np.nan, np.nan, str(error)))
            continue
        if found.match.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        left_out, problem = np.nan, "" if found.match.status.ok else found.match.status.value
        if len(experiments) > 1:
            try:
                left_out = pooled_rms(
                    leave_one_out(
                        experiments,
                        known_materials=known_materials,
                        settings=settings,
                        noise=noise,
                        search=search,
                        reference=found,
                        progress=progress,
                    )
                )
            except ConvergenceError as error:
                problem = f"with an experiment left out: {error}"
        rows.append(_row(settings, found, left_out, problem))
    return rows


def _row(settings: ModelSettings, found: Calibration, left_out: float, problem: str) -> ModelRow:
    match = found.match
    n = sum(int(np.isfinite(f.residual).sum()) for f in match.fits)
    k = len(match.parameters.free) + 6 * len(match.fits)
    bic = n * float(np.log(match.chi_squared / n)) + k * float(np.log(n))
    return ModelRow(settings, match.noise_factor, match.chi_squared, k, bic, left_out, problem)
