"""The pipeline identify -> predict -> report on folders of measurements; each verb is a function here and a command in `naibu.cli`."""

from __future__ import annotations

import difflib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from naibu import datasets
from naibu._version import __version__
from naibu.core.errors import ConvergenceError, InputError, NaibuError
from naibu.core.experiment import Experiment
from naibu.core.rigid_transform import registration
from naibu.core.status import Status
from naibu.core.units import kilopascals
from naibu.identification.from_markers.calibration import Calibration, calibrate
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import Trial
from naibu.identification.from_markers.parameter_names import platen_position
from naibu.identification.from_markers.specimen_model import ModelSettings
from naibu.identification.prediction.baselines import affine, balanced, baselines
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.prediction.cross_validation import LeftOut, ModelRow, compare_models, leave_one_out
from naibu.identification.prediction.prediction import Prediction, rms
from naibu.identification.prediction.prediction import predict as predict_state
from naibu.io.experiment_folder.reader import META_FILE, read_experiment
from naibu.workflows.result_folder import (
    CHECKPOINT_FILE,
    read_checkpoint,
    read_comparison,
    read_model,
    result_folder,
    rewrite_reports,
    write_checkpoint,
    write_comparison,
    write_identification,
    write_prediction,
)

__all__ = ["Identification", "compare", "identify", "load_experiment", "parse_known", "predict", "read_model", "report"]

Source = str | os.PathLike[str] | Experiment
Progress = Callable[[str, int, float], None]
MOST_ELEMENTS = 100_000
RATIO_REFERENCE_KPA = 200.0  # stands for 1 where only ratios of moduli are sought


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
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
    """

    model: CalibratedModel
    calibration: Calibration
    baselines: Mapping[str, Mapping[str, float]]
    left_out: tuple[LeftOut, ...]
    interrupted: bool


def load_experiment(source: Source) -> Experiment:
    """Return an experiment from a folder, or a bundled one by its name.

    Raises
    ------
    InputError
        Neither a folder with a ``meta.toml`` nor the name of a bundled dataset, or a folder that cannot be used.
    """
    if isinstance(source, Experiment):
        return source
    path, name = Path(source), str(source)
    if path.exists():
        return read_experiment(path)
    if name in datasets.names():
        return datasets.load(name)
    close = difflib.get_close_matches(name, datasets.names(), n=1)
    hint = f"Did you mean {close[0]!r}? " if close else ""
    raise InputError(
        f"{name!r} is neither a folder with a {META_FILE} nor a bundled dataset. {hint}Bundled are {', '.join(datasets.names())}"
    )


def parse_known(known: Sequence[str]) -> KnownMaterials | None:
    """Read ``"hardness 5=222 kPa"`` (absolute) or ``"hardness 5"`` (sets the scale of ratios).

    Raises
    ------
    InputError
        A value that is not a modulus, a material given twice, or materials with and without a value mixed.
    """
    if not known:
        return None
    pairs = [(name.strip(), value.strip()) for name, _, value in (text.partition("=") for text in known)]
    names = [name for name, _ in pairs]
    for name in names:
        if not name or names.count(name) > 1:
            raise InputError(f"--known names {name!r} {names.count(name)} times; write each material once, such as 'hardness 5=222 kPa'")
    without = [text for text in known if "=" not in text]
    if without and len(without) < len(known):
        raise InputError(f"--known gives a modulus for some materials but none for {', '.join(without)}; give one for each")
    if len(without) > 1:
        raise InputError("without moduli only one material can set the scale; write for instance --known 'hardness 5=222 kPa'")
    if without:
        return KnownMaterials({names[0]: RATIO_REFERENCE_KPA}, scale_is_absolute=False)
    try:
        return KnownMaterials({name: kilopascals(value) for name, value in pairs})
    except InputError as error:
        raise InputError(f"--known {', '.join(repr(text) for text in known)}: {error}") from error


def identify(
    experiments: Sequence[Source] | Source,
    *,
    known: Sequence[str] = (),
    states: Mapping[str, Sequence[str]] | None = None,
    settings: ModelSettings | None = None,
    out: str | os.PathLike[str] | None = None,
    cross_validate: bool = False,
    resume: bool = True,
    progress: Progress | None = None,
) -> Identification:
    """Identify materials, friction and boundary conditions from experiments, and write model, tables and report.

    Ctrl-C (KeyboardInterrupt) ends the search: what is returned and written is the best so far, and the same call goes on from it.

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
    progress : callable, optional
        ``progress(stage, iteration, objective)``.

    Returns
    -------
    Identification
        Model, search, and what it is compared with.

    Raises
    ------
    InputError
        Unusable input.
    ConvergenceError
        A state cannot be solved at the starting values, or, with `cross_validate`, with an experiment left out; in the latter case the
        model has been written.
    """
    loaded = _loaded(experiments)
    known_materials, chosen = parse_known(known), settings or ModelSettings()
    _check_size(loaded, chosen.element_size_mm)
    _check_states(loaded, states or {})
    folder = None if out is None else result_folder(out)
    provenance = _provenance(loaded, known, states or {}, chosen)

    def each(iteration: int, objective: float, values: Mapping[str, float]) -> None:
        if folder is not None:
            write_checkpoint(folder, provenance, values)
        if progress is not None:
            progress("identify", iteration, objective)

    start = read_checkpoint(folder, provenance) if folder is not None and resume else None
    try:
        calibration = calibrate(loaded, known_materials=known_materials, states=states, settings=chosen, start=start, callback=each)
    except ConvergenceError as error:
        labels = [f"{e.name}/{s.name}" for e in loaded for s in _with_states(e, states or {}).loaded_states]
        one_of = "one of " * (len(labels) > 1) + ", ".join(labels)
        raise ConvergenceError(f"{one_of} cannot be solved with the starting values: {error}") from error
    model = CalibratedModel.of(calibration, provenance)
    left_in_turn = [_with_states(e, states or {}) for e in loaded] if cross_validate else []
    result, trouble = _compared(calibration, model, left_in_turn, progress)
    if folder is not None:
        write_identification(folder, calibration, model, result.baselines, result.left_out)
        if result.interrupted:
            write_checkpoint(folder, provenance, model.parameters.values())
        else:
            (folder / CHECKPOINT_FILE).unlink(missing_ok=True)
    if trouble is not None:
        raise trouble
    return result


def _loaded(experiments: Sequence[Source] | Source) -> list[Experiment]:
    sources = [experiments] if isinstance(experiments, str | os.PathLike | Experiment) else list(experiments)
    loaded = [load_experiment(e) for e in sources]
    names = [e.name for e in loaded]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{names.count(name)} experiments are called {name!r}; give each once, or rename a folder")
    return loaded


def _check_size(loaded: Sequence[Experiment], edge_mm: float) -> None:
    """Refuse elements of no size, and so many that no memory holds them."""
    if not (math.isfinite(edge_mm) and edge_mm >= 0.0):
        raise InputError(f"an element size of {edge_mm:g} mm cannot be; give a positive length, or 0 for an eighth of the object's height")
    for e in loaded:
        count = math.prod(e.shape.size_mm) / edge_mm**3 if edge_mm > 0.0 else 0.0
        if count > MOST_ELEMENTS:
            raise InputError(
                f"an element size of {edge_mm:g} mm makes {count:.3g} elements of {e.name}, at most {MOST_ELEMENTS} are solved"
            )


def _check_states(loaded: Sequence[Experiment], states: Mapping[str, Sequence[str]]) -> None:
    """Refuse states that no experiment has, or that show no load."""
    by_name = {e.name: e for e in loaded}
    for name, chosen in states.items():
        if name not in by_name:
            raise InputError(f"states of {name!r} are chosen, but the experiments are {', '.join(by_name)}")
        for state in chosen:
            _require_loaded(by_name[name], state)


def _require_loaded(experiment: Experiment, state: str) -> None:
    if not experiment.state(state).loaded:
        raise InputError(f"{experiment.name}/{state} is not loaded; loaded are {_names(experiment)}")


def _names(experiment: Experiment) -> str:
    return ", ".join(s.name for s in experiment.states[1:] if s.loaded) or "none"


def _with_states(experiment: Experiment, states: Mapping[str, Sequence[str]]) -> Experiment:
    """Return the experiment without the loaded states that were not chosen."""
    chosen = states.get(experiment.name)
    if chosen is None:
        return experiment
    return replace(experiment, states=(experiment.states[0], *(s for s in experiment.states[1:] if s.name in chosen)))


def _compared(
    calibration: Calibration, model: CalibratedModel, left_in_turn: Sequence[Experiment], progress: Progress | None
) -> tuple[Identification, NaibuError | None]:
    """Compute what the calibration is compared with; what goes wrong here is returned, so that the model is written first."""
    compared: dict[str, dict[str, float]] = {}
    left_out: tuple[LeftOut, ...] = ()
    interrupted, trouble = calibration.match.status is Status.INTERRUPTED, None
    values = model.parameters.values()

    def each(left: str, iteration: int, objective: float) -> None:
        if progress is not None:
            progress(f"without {left}", iteration, objective)

    try:
        if not interrupted:
            compared = {t.label: _baselines(t, values[platen_position(t.specimen.experiment, t.state)]) for t in calibration.trials}
            for label, distance in balanced(calibration).items():
                compared[label]["force balance"] = distance
        if not interrupted and left_in_turn:
            found = leave_one_out(
                left_in_turn,
                known_materials=calibration.known_materials,
                settings=calibration.settings,
                reference=calibration,
                callback=each,
            )
            left_out = tuple(found)
    except KeyboardInterrupt:
        interrupted = True
    except NaibuError as error:
        trouble = error
    return Identification(model, calibration, compared, left_out, interrupted), trouble


def _baselines(trial: Trial, platen_position_mm: float) -> dict[str, float]:
    """Simple descriptions of a state; without the linear one where it does not apply."""
    try:
        return baselines(trial, platen_position_mm)
    except NaibuError:
        free, measured = trial.specimen.marker_points, trial.measured
        return {"rigid": rms(measured - registration(free, measured).applied(free)), "affine": rms(measured - affine(free, measured))}


def _provenance(
    experiments: Sequence[Experiment], known: Sequence[str], states: Mapping[str, Sequence[str]], settings: ModelSettings
) -> dict[str, Any]:
    return {
        "naibu": __version__,
        "known": list(known),
        "states": {name: list(chosen) for name, chosen in states.items()},
        "settings": asdict(settings),
        "inputs": {e.name: dict(e.input_hashes) for e in experiments},
        "seed": "none: the search is deterministic",
    }


def predict(
    model: CalibratedModel | str | os.PathLike[str],
    experiment: Source,
    *,
    state: str | None = None,
    height_mm: float | None = None,
    heights_from_markers: bool = False,
    out: str | os.PathLike[str] | None = None,
) -> Prediction:
    """Predict the markers of one state with a calibrated model, and write them.

    Parameters
    ----------
    model : CalibratedModel or path
        A model, or its ``model.json``.
    experiment : path, str or Experiment
        Folder, bundled dataset, or object.
    state : str, optional
        Name of the state; may be left out where there is only one loaded state.
    height_mm : float, optional
        Height of the plate or bar, or distance of the side plates, mm.
    heights_from_markers : bool
        Take the height from the lowest and highest marker layer of the measured state.
    out : path, optional
        Folder for ``predicted.csv``, ``summary.json``, ``predicted.html`` with ``predicted.json`` behind it, and ``predicted.vtu`` and
        ``predicted.vtkhdf`` for ParaView.

    Returns
    -------
    Prediction
        Positions, uncertainty and assumptions.

    Raises
    ------
    InputError
        Unusable input; see `naibu.identification.prediction.prediction.predict`.
    ConvergenceError
        The state cannot be solved.
    """
    calibrated = model if isinstance(model, CalibratedModel) else read_model(model)
    loaded = load_experiment(experiment)
    name = state or _only_state(loaded)
    _require_loaded(loaded, name)
    if height_mm is not None and heights_from_markers:
        raise InputError("--height-mm and --heights-from-markers exclude each other; give one of them")
    folder = None if out is None else result_folder(out)
    try:
        prediction = predict_state(calibrated, loaded, name, platen_position_mm=height_mm, heights_from_markers=heights_from_markers)
    except ConvergenceError as error:
        raise ConvergenceError(f"{loaded.name}/{name} cannot be solved: {error}") from error
    if folder is not None:
        write_prediction(folder, calibrated, prediction)
    return prediction


def _only_state(experiment: Experiment) -> str:
    loaded = [s.name for s in experiment.states[1:] if s.loaded]
    if len(loaded) != 1:
        raise InputError(f"{experiment.name} has {len(loaded)} loaded states ({_names(experiment)}); choose one with --state")
    return loaded[0]


def compare(
    experiments: Sequence[Source] | Source,
    *,
    candidates: Sequence[ModelSettings],
    known: Sequence[str] = (),
    out: str | os.PathLike[str] | None = None,
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
    progress : callable, optional
        ``progress(stage, iteration, objective)``.

    Returns
    -------
    list of ModelRow
        One for each candidate, in their order.

    Raises
    ------
    InputError
        Unusable input, or no candidate.
    """
    if not candidates:
        raise InputError("no model is given to compare; name at least one law or contact")
    loaded = _loaded(experiments)
    known_materials = parse_known(known)
    folder = None if out is None else result_folder(out)
    rows: list[ModelRow] = []
    for settings in candidates:
        provenance = _provenance(loaded, known, {}, settings)
        row = read_comparison(folder, provenance) if folder is not None else None
        if row is None:
            told = _stage(progress, settings)
            row = compare_models(loaded, [settings], known_materials=known_materials, callback=told)[0]
            if folder is not None:
                write_comparison(folder, provenance, row)
        rows.append(row)
    return rows


def _stage(progress: Progress | None, settings: ModelSettings) -> Callable[[str, int, float], None]:
    """Report the steps of one candidate under its name."""

    def tell(left: str, iteration: int, objective: float) -> None:
        if progress is not None:
            without = "" if left == "none" else f" without {left}"
            progress(f"{settings.law}, {settings.contact}, {settings.joined}{without}", iteration, objective)

    return tell


def report(folder: str | os.PathLike[str]) -> list[Path]:
    """Write the pages of an identification or a prediction anew from what is stored in its folder; nothing is solved.

    Returns
    -------
    list of Path
        ``report.html``, ``predicted.html``, or both, whichever results the folder holds.

    Raises
    ------
    InputError
        No results in the folder, or damaged ones.
    """
    return rewrite_reports(Path(folder))
