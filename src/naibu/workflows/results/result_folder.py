"""Result folders: files are written whole, in an order that loses nothing, and read back with clear errors where they are damaged."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from naibu.core.errors import InputError
from naibu.core.parameters import Parameter
from naibu.identification.from_fields.identified.identified_body import FORMAT as FORMAT_OF_FIELDS
from naibu.identification.from_fields.identified.identified_body import IdentifiedBody
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings, Specimen
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.prediction.cross_validation import LeftOut, ModelRow
from naibu.identification.prediction.interval import per_axis
from naibu.identification.prediction.prediction import Prediction, rms
from naibu.identification.verdict import Verdict
from naibu.io.files.atomic import write_atomically
from naibu.io.files.parsing import read_json
from naibu.io.files.reading import guarded_reading, read_bytes
from naibu.io.vtk_files import write_vtkhdf_series, write_vtu
from naibu.mechanics.finite_strain.statics import Solution
from naibu.viewer.json_values import jsonable
from naibu.viewer.result_page.page import report_html
from naibu.viewer.result_page.payload import Report, report_json
from naibu.viewer.result_page.reading import report_from_json
from naibu.workflows.joint_model import FORMAT as FORMAT_OF_BOTH
from naibu.workflows.joint_model import JointModel
from naibu.workflows.results.report_content import Accuracy, accuracy, build_report, prediction_report, search_sentence
from naibu.workflows.results.search_checkpoint import CHECKPOINT_FILE

MODEL_FILE, RESIDUALS_FILE = "model.json", "residuals.csv"
IDENTIFICATION_FILE, COMPARISON_FILE, REPORT_STEM = "identification.json", "comparison.json", "report"
# a prediction may share the folder of the model it was made with, so nothing but its own files bears these names
PREDICTED_FILE, SUMMARY_FILE, PREDICTED_STEM = "predicted.csv", "summary.json", "predicted"
IDENTIFICATION_FILES = (MODEL_FILE, RESIDUALS_FILE, IDENTIFICATION_FILE, f"{REPORT_STEM}.json", f"{REPORT_STEM}.html", CHECKPOINT_FILE)
PREDICTION_FILES = (PREDICTED_FILE, SUMMARY_FILE, *(f"{PREDICTED_STEM}.{ending}" for ending in ("json", "html", "vtu", "vtkhdf")))
Baselines = Mapping[str, Mapping[str, float]]


def read_model(path: str | os.PathLike[str]) -> CalibratedModel:
    """Read a ``model.json`` of markers, also of markers with displacement fields, or the one in a folder.

    Raises
    ------
    InputError
        No such file, or not a model of markers.
    """
    found = read_any_model(path)
    if isinstance(found, IdentifiedBody):
        raise InputError(f"{path}: was identified from displacement fields; this takes a model identified from markers")
    return found.markers if isinstance(found, JointModel) else found


def read_identified_body(path: str | os.PathLike[str]) -> IdentifiedBody:
    """Read a ``model.json`` of displacement fields, also of markers with them, or the one in a folder.

    Raises
    ------
    InputError
        No such file, or not a model of displacement fields.
    """
    found = read_any_model(path)
    if isinstance(found, CalibratedModel):
        raise InputError(f"{path}: was identified from markers; `held` and `moved` go with models of displacement fields")
    return found.fields if isinstance(found, JointModel) else found


def read_any_model(path: str | os.PathLike[str]) -> CalibratedModel | IdentifiedBody | JointModel:
    """Read a ``model.json`` of markers, of displacement fields or of both, or the one in a folder.

    Raises
    ------
    InputError
        No such file, or not a model.
    """
    file = Path(path)
    file = file / MODEL_FILE if file.is_dir() else file
    mend = f"name the {MODEL_FILE} that 'naibu identify' wrote, or its folder"
    try:
        data = read_json(file)
    except InputError as error:
        raise InputError(f"{error}; {mend}") from error
    if not isinstance(data, dict):
        raise InputError(f"{file}: holds a {type(data).__name__}, not a model; {mend}")
    kinds: dict[Any, type[IdentifiedBody | JointModel]] = {FORMAT_OF_FIELDS: IdentifiedBody, FORMAT_OF_BOTH: JointModel}
    named = data.get("format") if isinstance(data.get("format"), str) else None
    try:
        with guarded_reading(file, "a model"):
            return kinds.get(named, CalibratedModel).from_dict(data)
    except InputError as error:
        raise InputError(f"{file}: {str(error).removeprefix(f'{file}: ')}; {mend}") from error


def write_joint_model(folder: Path, model: JointModel) -> Path:
    """Write the ``model.json`` of markers and displacement fields."""
    return write_atomically(folder / MODEL_FILE, _text(model.to_dict()))


def read_comparison(folder: Path, provenance: Mapping[str, Any]) -> ModelRow | None:
    """Return what a folder holds of a candidate model with the same inputs and settings, if there is anything."""
    for entry in _compared(folder):
        if entry["provenance"] == json.loads(json.dumps(provenance)):
            figures: dict[str, Any] = {name: math.nan if value is None else value for name, value in entry["result"].items()}
            return ModelRow(ModelSettings(**entry["provenance"]["settings"]), **figures)
    return None


def write_comparison(folder: Path, provenance: Mapping[str, Any], row: ModelRow) -> None:
    """Add a candidate model to the folder's comparison."""
    figures = {k: v for k, v in asdict(row).items() if k != "settings"}
    entry = {"provenance": provenance, "result": {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in figures.items()}}
    write_atomically(folder / COMPARISON_FILE, _text([*_compared(folder), entry]))


def _compared(folder: Path) -> list[dict[str, Any]]:
    """Entries of the folder's comparison, none where there is no file."""
    file = folder / COMPARISON_FILE
    if not file.exists():
        return []
    try:
        data = read_json(file)
    except InputError as error:
        raise InputError(f"{error}; delete it, or choose another folder as `out`") from error
    if not isinstance(data, list) or not all(isinstance(entry, dict) and {"provenance", "result"} <= entry.keys() for entry in data):
        raise InputError(f"{file} is not a comparison of models; delete it, or choose another folder as `out`")
    return data


def series_file(load_case: str) -> str:
    """Return the name of the file for ParaView of ``experiment/state``."""
    return f"{load_case.replace('/', '_')}.vtkhdf"


def write_identification(
    folder: Path,
    calibration: Calibration,
    model: CalibratedModel,
    verdict: Verdict,
    baselines: Baselines,
    left_out: Sequence[LeftOut],
) -> None:
    """Write model, summary, residuals, report and one file for ParaView for each state, the model first."""
    write_atomically(folder / MODEL_FILE, _text(model.to_dict()))
    write_atomically(folder / RESIDUALS_FILE, _residual_csv(calibration))
    write_atomically(folder / IDENTIFICATION_FILE, _text(_identification_summary(calibration, model, verdict, baselines, left_out)))
    values = model.parameters.values()
    for load_case, fit in zip(calibration.load_cases, calibration.match.fits, strict=True):
        series = folder / series_file(load_case.name)
        states = fit.solution.states
        body = load_case.specimen.reshaped(values).whole
        write_vtkhdf_series(
            series, body.mesh, [s.load for s in states], {"displacement_mm": [body.field(fit.since_scan(s.displacement)) for s in states]}
        )
    _write_report(folder, REPORT_STEM, build_report(calibration, model, verdict, baselines, left_out))


def _identification_summary(
    calibration: Calibration, model: CalibratedModel, verdict: Verdict, baselines: Baselines, left_out: Sequence[LeftOut]
) -> dict[str, Any]:
    load_cases = {}
    for load_case, fit in zip(calibration.load_cases, calibration.match.fits, strict=True):
        load_cases[load_case.name] = (
            _figures(accuracy(load_case.specimen, fit))
            | {
                "baselines_rms_3d_mm": dict(baselines.get(load_case.name, {})),
                "linear_solver": fit.solution.linear_solver,
            }
            | _reactions(model, load_case.specimen, fit.solution)
        )
    rows = {f"{r.experiment}/{r.state}": {"rms_3d_mm": r.rms_mm, "markers": r.marker_count} for r in left_out}
    found = {p.name: _estimate(model, p) for p in model.parameters}
    return {
        "verdict": verdict.to_dict() | {"left_out_markers": list(verdict.outliers)},
        "status": calibration.match.status.name,
        "message": search_sentence(calibration.match.status),
        "noise_factor": model.noise_factor,
        "load_cases": load_cases,
        "left_out": rows,
        "parameters_95": found,
        "provenance": dict(model.provenance),
    }


def _estimate(model: CalibratedModel, p: Parameter) -> dict[str, Any]:
    (low, high), (factor, unit) = model.interval(p.name), model.shown(p)
    told = {"estimate": factor * p.value, "from": factor * low, "to": factor * high, "unit": unit}
    if model.law_covariance is None:
        return told
    low, high = model.interval(p.name, law_exact=True)
    return told | {"from_if_law_exact": factor * low, "to_if_law_exact": factor * high}


def _figures(a: Accuracy) -> dict[str, float | int]:
    return {
        "markers": a.markers,
        "rms_x_mm": a.x,
        "rms_y_mm": a.y,
        "rms_z_mm": a.z,
        "rms_3d_mm": a.total,
        "rms_noise_units": a.noise_units,
    }


def _reactions(model: CalibratedModel, body: Specimen, solution: Solution) -> dict[str, Any]:
    """Forces of the rigid bodies on the object, which ratios of moduli, or lower bounds of them, do not tell."""
    if model.reference is not None or model.is_weighed:
        return {}
    return {"reactions_mN": {name: np.asarray(force).tolist() for name, force in body.reactions(solution).items()}}


def _text(data: object) -> str:
    """JSON of numbers at full precision, with null for what is not finite."""
    return json.dumps(jsonable(data, 17), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _residual_csv(calibration: Calibration) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    axes = [f"residual_{a}_mm" for a in "xyz"] + [f"sd_{a}_mm" for a in "xyz"]
    writer.writerow(["experiment", "state", "marker", *axes, "initial_completed"])
    for load_case, fit in zip(calibration.load_cases, calibration.match.fits, strict=True):
        for i, marker in enumerate(load_case.specimen.marker_ids):
            # a file, like the page, states predicted minus measured
            numbers = [_number(v, 4) for v in (*-fit.residual[i], *fit.sd[i])]
            writer.writerow(
                [load_case.specimen.experiment.name, load_case.state, int(marker), *numbers, int(load_case.specimen.marker_filled[i].any())]
            )
    return text.getvalue()


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "NaN"


def write_prediction(folder: Path, model: CalibratedModel, prediction: Prediction) -> None:
    """Write predicted positions, summary, report and files for ParaView."""
    p = prediction
    write_atomically(folder / PREDICTED_FILE, _predicted_csv(p))
    summary = {
        "experiment": p.specimen.experiment.name,
        "state": p.state,
        "used_to_identify": f"{p.specimen.experiment.name}/{p.state}" in model.load_cases,
        "platen_position_mm": p.platen_position_mm,
        "registered_to_measured": p.registered,
        **_figures(accuracy(p.specimen, p.fit, p.residual)),
        "rms_3d_mm_with_completed": rms(p.residual) if p.registered else None,
        "median_sd_model_mm": float(np.median(per_axis(p.sd_model_mm))),
        "median_sd_mm": float(np.median(per_axis(p.sd_mm))),
        "strain_ratio_to_calibration": p.strain_ratio,
        "interval": p.interval,
        "notes": [*p.specimen.experiment.loading.assumed, *p.notes],
        "linear_solver": p.fit.solution.linear_solver,
        **_reactions(model, p.specimen, p.fit.solution),
        "inputs": {p.specimen.experiment.name: dict(p.specimen.experiment.input_hashes)},
        "provenance": dict(model.provenance),
    }
    write_atomically(folder / SUMMARY_FILE, _text(summary))
    states, body = p.fit.solution.states, p.specimen.reshaped(p.values).whole
    write_vtu(folder / f"{PREDICTED_STEM}.vtu", body.mesh, {"displacement_mm": body.field(p.fit.since_scan(states[-1].displacement))}, {})
    path = folder / f"{PREDICTED_STEM}.vtkhdf"
    write_vtkhdf_series(
        path, body.mesh, [s.load for s in states], {"displacement_mm": [body.field(p.fit.since_scan(s.displacement)) for s in states]}
    )
    _write_report(folder, PREDICTED_STEM, prediction_report(model, p))


def _predicted_csv(p: Prediction) -> str:
    """A row for every marker of the reference configuration; NaN where its position there is not known, or not trusted."""
    columns = np.column_stack([p.points, per_axis(p.sd_model_mm), per_axis(p.sd_mm), p.sd_mm])
    rows = dict(zip(p.specimen.marker_ids.tolist(), columns, strict=True))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["marker", "x_mm", "y_mm", "z_mm", "sd_model_mm", "sd_mm", "sd_x_mm", "sd_y_mm", "sd_z_mm"])
    for marker in p.specimen.experiment.initial.ids:
        writer.writerow([int(marker), *(_number(v, 3) for v in rows.get(int(marker), np.full(8, np.nan)))])
    return text.getvalue()


def _write_report(folder: Path, stem: str, report: Report) -> None:
    """Store what the page shows, and write the page from that, so that it can be written again alike."""
    text = report_json(report)
    write_atomically(folder / f"{stem}.json", text)
    write_atomically(folder / f"{stem}.html", report_html(report_from_json(text)))


def rewrite_reports(folder: Path) -> list[Path]:
    """Write the pages of the results in a folder anew from what was stored, and return their paths.

    Raises
    ------
    InputError
        No stored report, or a damaged one.
    """
    pages = []
    for stored in (folder / f"{stem}.json" for stem in (REPORT_STEM, PREDICTED_STEM)):
        if not stored.is_file():
            continue
        try:
            with guarded_reading(stored, "a report"):
                page = report_html(report_from_json(read_bytes(stored).decode()))
        except InputError as error:
            raise InputError(f"{stored}: {str(error).removeprefix(f'{stored}: ')}; run the command that made it again") from error
        pages.append(write_atomically(stored.with_suffix(".html"), page))
    if not folder.is_dir():
        what = "a file" if folder.is_file() else "not there"
        raise InputError(f"{folder}: holds no results, for it is {what}; give the folder of results")
    if not pages:
        stored_as = f"{REPORT_STEM}.json or {PREDICTED_STEM}.json"
        raise InputError(
            f"{folder}: holds no results of markers ({stored_as}); name a folder that 'naibu identify' or 'naibu predict' wrote of them. "
            "Pages of displacement fields are written with their results only"
        )
    return pages
