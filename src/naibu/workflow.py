"""The pipeline identify -> predict -> report on folders of measurements; each verb is a function here and a command in `naibu.cli`."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import naibu
from naibu import datasets
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment
from naibu.core.solution import Status
from naibu.core.units import kilopascals
from naibu.identification.calibration import Calibration, Knowledge, calibrate
from naibu.identification.comparison import LeftOut, leave_one_out
from naibu.identification.model import CalibratedModel
from naibu.identification.prediction import Prediction, opening, rms
from naibu.identification.prediction import predict as predict_state
from naibu.identification.specimen import ModelSettings
from naibu.io.atomic import write_atomically
from naibu.io.experiments import META_FILE, read_experiment
from naibu.io.results import write_vtu, write_vtkhdf_series
from naibu.presentation import build_report, prediction_report, residual_rows
from naibu.report import report_html
from naibu.validation.baselines import baselines

MODEL_FILE, REPORT_FILE, SUMMARY_FILE, CHECKPOINT_FILE = "model.json", "report.html", "summary.json", "checkpoint.json"
Source = str | os.PathLike[str] | Experiment
Progress = Callable[[str, int, float], None]


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """What `identify` returns: the model, the calibration behind it, and the experiments left out in turn."""

    model: CalibratedModel
    calibration: Calibration
    left_out: tuple[LeftOut, ...]


def load_experiment(source: Source) -> Experiment:
    """Return an experiment from a folder, or a bundled one by its name.

    Raises
    ------
    InputError
        Neither a folder with a ``meta.toml`` nor the name of a bundled dataset, or a folder that cannot be used.
    """
    if isinstance(source, Experiment):
        return source
    path = Path(source)
    if (path / META_FILE).is_file() or path.exists():
        return read_experiment(path)
    if str(source) in datasets.names():
        return datasets.load(str(source))
    raise InputError(f"{str(source)!r} is neither a folder with a {META_FILE} nor a bundled dataset ({', '.join(datasets.names())})")


def parse_known(known: Sequence[str]) -> Knowledge | None:
    """Read ``"hardness 5=222 kPa"`` (absolute) or ``"hardness 5"`` (sets the scale of ratios).

    Raises
    ------
    InputError
        A value that is not a modulus, or materials with and without a value mixed.
    """
    if not known:
        return None
    with_value = {k.split("=", 1)[0].strip(): kilopascals(k.split("=", 1)[1]) for k in known if "=" in k}
    without = [k.strip() for k in known if "=" not in k]
    if with_value and without:
        raise InputError(f"--known gives a modulus for {', '.join(with_value)} but none for {', '.join(without)}; give one for each")
    if len(without) > 1:
        raise InputError("without moduli only one material can set the scale; write for instance --known 'hardness 5=222 kPa'")
    return Knowledge(with_value) if with_value else Knowledge({without[0]: 200.0}, scale_is_absolute=False)


def identify(
    experiments: Sequence[Source],
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

    Parameters
    ----------
    experiments : sequence
        Folders, names of bundled datasets, or `Experiment` objects.
    known : sequence of str
        ``"hardness 5=222 kPa"`` for materials with a known Young's modulus, or one name that sets the scale of ratios.
    states : mapping, optional
        States to use, by experiment; all measured ones by default.
    settings : ModelSettings, optional
        Law, contact, joints, mesh.
    out : path, optional
        Folder for ``model.json``, ``summary.json``, ``residuals.csv``, ``report.html`` and one ``.vtkhdf`` for each state.
    cross_validate : bool
        Also predict every experiment from the others.
    resume : bool
        Continue from the checkpoint of an interrupted search with the same inputs and settings in `out`.
    progress : callable, optional
        ``progress(stage, iteration, objective)``.

    Raises
    ------
    InputError
        Unusable input.
    ConvergenceError
        A state cannot be solved at the starting values.
    """
    loaded = [load_experiment(e) for e in experiments]
    knowledge, chosen = parse_known(known), settings or ModelSettings()
    folder = _folder(out)
    provenance = _provenance(loaded, known, chosen)
    checkpoint = folder / CHECKPOINT_FILE if folder else None

    def each(iteration: int, objective: float, values: Mapping[str, float]) -> None:
        if checkpoint is not None:
            write_atomically(checkpoint, json.dumps({"provenance": provenance, "values": dict(values)}))
        if progress is not None:
            progress("identify", iteration, objective)

    start = _resumed(checkpoint, provenance) if resume else None
    calibration = calibrate(loaded, knowledge=knowledge, states=states, settings=chosen, start=start, callback=each)
    model = CalibratedModel.of(calibration, provenance)
    left_out: tuple[LeftOut, ...] = ()
    if cross_validate and calibration.match.status is not Status.INTERRUPTED and len(loaded) > 1:

        def other(iteration: int, objective: float, values: Mapping[str, float]) -> None:
            if progress is not None:
                progress("leave one out", iteration, objective)

        left_out = tuple(leave_one_out(loaded, knowledge=calibration.knowledge, settings=chosen, start=model.parameters.values(), callback=other))
    if folder:
        _write_identification(folder, calibration, model, left_out)
        if checkpoint is not None and calibration.match.status is not Status.INTERRUPTED:
            checkpoint.unlink(missing_ok=True)
    return Identification(model, calibration, left_out)


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
        Folder for ``predicted.csv``, ``summary.json``, ``report.html``, ``predicted.vtu`` and ``path.vtkhdf``.

    Raises
    ------
    InputError
        Unusable input; see `naibu.identification.prediction.predict`.
    ConvergenceError
        The state cannot be solved.
    """
    calibrated = model if isinstance(model, CalibratedModel) else read_model(model)
    loaded = load_experiment(experiment)
    name = state or _only_state(loaded)
    if height_mm is not None and heights_from_markers:
        raise InputError("give either a height or --heights-from-markers, not both")
    prediction = predict_state(calibrated, loaded, name, opening_mm=height_mm, heights_from_markers=heights_from_markers)
    folder = _folder(out)
    if folder:
        _write_prediction(folder, calibrated, prediction)
    return prediction


def read_model(path: str | os.PathLike[str]) -> CalibratedModel:
    """Read a ``model.json``, or the one in a folder.

    Raises
    ------
    InputError
        No such file, or not a model.
    """
    file = Path(path)
    file = file / MODEL_FILE if file.is_dir() else file
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); name the {MODEL_FILE} that 'naibu identify' wrote") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: is not JSON ({error}); name the {MODEL_FILE} that 'naibu identify' wrote") from error
    if not isinstance(data, dict):
        raise InputError(f"{file}: holds a {type(data).__name__}, not a model")
    return CalibratedModel.from_dict(data)


def _only_state(experiment: Experiment) -> str:
    loaded = [s.name for s in experiment.states[1:] if s.loaded]
    if len(loaded) != 1:
        raise InputError(f"{experiment.name} has the loaded states {', '.join(loaded)}; choose one with --state")
    return loaded[0]


def _folder(out: str | os.PathLike[str] | None) -> Path | None:
    if out is None:
        return None
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made a folder for results ({error.strerror}); choose another with --out") from error
    return folder


def _provenance(experiments: Sequence[Experiment], known: Sequence[str], settings: ModelSettings) -> dict[str, Any]:
    return {
        "naibu": naibu.__version__,
        "known": list(known),
        "settings": asdict(settings),
        "inputs": {e.name: dict(e.input_hashes) for e in experiments},
        "seed": "none: the search is deterministic",
    }


def _resumed(checkpoint: Path | None, provenance: Mapping[str, Any]) -> dict[str, float] | None:
    """Values of an interrupted search with the same inputs and settings, if there are any."""
    if checkpoint is None or not checkpoint.is_file():
        return None
    try:
        data = json.loads(checkpoint.read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError):
        return None
    return dict(data["values"]) if data.get("provenance") == json.loads(json.dumps(provenance)) else None


def _write_identification(folder: Path, calibration: Calibration, model: CalibratedModel, left_out: Sequence[LeftOut]) -> None:
    values = model.parameters.values()
    compared = {}
    if calibration.match.status is not Status.INTERRUPTED:
        compared = {t.label: baselines(t, values[opening(t.specimen.experiment, t.state)]) for t in calibration.trials}
    report = build_report(calibration, model, compared, left_out)
    summary: dict[str, Any] = {"status": calibration.match.status.name, "noise_factor": model.noise_factor, "trials": {}}
    for trial, fit in zip(calibration.trials, calibration.match.fits, strict=True):
        summary["trials"][trial.label] = _rms_summary(fit.residual, fit.sd, ~trial.specimen.marker_filled.any(axis=1)) | {
            "baselines_rms_3d_mm": compared.get(trial.label, {}),
            "linear_solver": fit.solution.linear_solver,
            "reactions_mN": {k: v.tolist() for k, v in fit.solution.reactions.items()},
        }
        name = trial.label.replace("/", "_")
        states = fit.solution.states
        write_vtkhdf_series(folder / f"{name}.vtkhdf", trial.specimen.mesh, [s.load for s in states], [{"displacement_mm": s.displacement} for s in states])
    summary["left_out"] = {f"{r.experiment}/{r.state}": {"rms_3d_mm": r.rms_mm, "markers": r.marker_count} for r in left_out}
    write_atomically(folder / "residuals.csv", _residual_csv(calibration))
    write_atomically(folder / SUMMARY_FILE, json.dumps(summary, indent=1))
    write_atomically(folder / REPORT_FILE, report_html(report))
    write_atomically(folder / MODEL_FILE, json.dumps(model.to_dict(), indent=1))


def _rms_summary(residual: np.ndarray[Any, Any], sd: np.ndarray[Any, Any], exact: np.ndarray[Any, Any]) -> dict[str, float | int | None]:
    names = ("markers", "rms_x_mm", "rms_y_mm", "rms_z_mm", "rms_3d_mm", "rms_noise_units")
    return {k: (v if np.isfinite(v) else None) for k, v in zip(names, residual_rows(residual, sd, exact), strict=True)}


def _residual_csv(calibration: Calibration) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["experiment", "state", "marker", "residual_x_mm", "residual_y_mm", "residual_z_mm", "sd_x_mm", "sd_y_mm", "sd_z_mm", "initial_completed"])
    for trial, fit in zip(calibration.trials, calibration.match.fits, strict=True):
        for i, marker in enumerate(trial.specimen.marker_ids):
            numbers = [f"{v:.4f}" for v in (*fit.residual[i], *fit.sd[i])]
            writer.writerow([trial.specimen.experiment.name, trial.state, int(marker), *numbers, int(trial.specimen.marker_filled[i].any())])
    return text.getvalue()


def _write_prediction(folder: Path, model: CalibratedModel, prediction: Prediction) -> None:
    body = prediction.specimen
    rows = {int(i): (p, sd) for i, p, sd in zip(body.marker_ids, prediction.points, prediction.sd_mm, strict=True)}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["marker", "x_mm", "y_mm", "z_mm", "sd_mm"])
    for marker in body.experiment.initial.ids:
        point, sd = rows.get(int(marker), (np.full(3, np.nan), np.nan))
        writer.writerow([int(marker), *(f"{v:.3f}" if np.isfinite(v) else "NaN" for v in (*point, sd))])
    write_atomically(folder / "predicted.csv", text.getvalue())
    summary = {
        "experiment": body.experiment.name,
        "state": prediction.state,
        "opening_mm": prediction.opening_mm,
        "registered_to_measured": prediction.registered,
        "notes": list(prediction.notes),
        "reactions_mN": {k: v.tolist() for k, v in prediction.fit.solution.reactions.items()},
        "rms": _rms_summary(prediction.residual, prediction.fit.sd, ~body.marker_filled.any(axis=1)) if prediction.registered else None,
        "rms_all_3d_mm": rms(prediction.residual) if prediction.registered else None,
        "provenance": dict(model.provenance),
    }
    write_atomically(folder / SUMMARY_FILE, json.dumps(summary, indent=1))
    states = prediction.fit.solution.states
    write_vtu(folder / "predicted.vtu", body.mesh, {"displacement_mm": states[-1].displacement}, {})
    write_vtkhdf_series(folder / "path.vtkhdf", body.mesh, [s.load for s in states], [{"displacement_mm": s.displacement} for s in states])
    write_atomically(folder / REPORT_FILE, report_html(prediction_report(model, prediction)))


def report(folder: str | os.PathLike[str]) -> Path:
    """Write the report of an identification anew from its folder's ``model.json``, and return its path.

    The experiments must be bundled datasets, or lie where they lay when the model was identified.

    Raises
    ------
    InputError
        No model in the folder, or an experiment that cannot be found or has changed.
    """
    raise NotImplementedError(str(folder))
