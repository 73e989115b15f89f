"""Predict the markers of a state with a calibrated model, and write positions, summary and page."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

from naibu.core.errors import ConvergenceError, InputError
from naibu.core.experiment import Experiment
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.prediction.prediction import Prediction, predict_state
from naibu.viewer.notebook import ShownInNotebook, empty_figure
from naibu.viewer.result_figures import draw_marker_motion
from naibu.viewer.result_page.page import report_html
from naibu.workflows.markers.experiments import Source, load_experiment, loaded_names, require_loaded
from naibu.workflows.results.files_together import written_together
from naibu.workflows.results.output_folder import no_empty_folders, output_folder
from naibu.workflows.results.report_content import prediction_report, prediction_scene
from naibu.workflows.results.result_folder import PREDICTION_FILES, read_model, write_prediction

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


@dataclass(frozen=True, slots=True, eq=False)
class PredictionRun(Prediction, ShownInNotebook):
    """Predicted markers of one state, and the model that predicts them.

    Attributes
    ----------
    model : CalibratedModel
        The model; for the others see `naibu.identification.Prediction`.
    """

    model: CalibratedModel

    def page_html(self) -> str:
        """Return the page of the result, a whole HTML document."""
        return report_html(prediction_report(self.model, self))

    def plot(self) -> Canvas:
        """Return a figure of the predicted displacement of the markers, in the object's frame, seen along y, x and z."""
        scene = prediction_scene(self)
        canvas = empty_figure(10.5, 4.2)
        draw_marker_motion(canvas, scene.initial_markers, scene.steps[-1].markers, ["ok"] * len(scene.marker_ids))
        return canvas

    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return one row a marker: its number, predicted position, standard deviations, and measured minus predicted position, mm."""
        names = ("marker", *(f"{kind}{axis}_mm" for kind in ("", "sd_", "residual_") for axis in "xyz"))
        return tuple(
            dict(zip(names, (int(i), *p.tolist(), *sd.tolist(), *r.tolist()), strict=True))
            for i, p, sd, r in zip(self.specimen.marker_ids, self.points, self.sd_mm, self.residual, strict=True)
        )


@no_empty_folders()
def predict(
    model: CalibratedModel | str | os.PathLike[str],
    experiment: Source,
    *,
    state: str | None = None,
    height_mm: float | None = None,
    heights_from_markers: bool = False,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
) -> PredictionRun:
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
        Take the height from the lowest and highest marker layer of the measured state, or the distance of side plates from its outermost
        marker columns.
    out : path, optional
        Folder for ``predicted.csv``, ``summary.json``, ``predicted.html`` with ``predicted.json`` behind it, and ``predicted.vtu`` and
        ``predicted.vtkhdf`` for ParaView.
    overwrite : bool
        Whether results, or other files of these names, that `out` holds already are replaced.

    Returns
    -------
    PredictionRun
        Positions, uncertainty and assumptions.

    Raises
    ------
    InputError
        Unusable input; see `naibu.identification.prediction.prediction.predict_state`.
    ConvergenceError
        The state cannot be solved.
    """
    calibrated = model if isinstance(model, CalibratedModel) else read_model(model)
    loaded = load_experiment(experiment)
    name = state or _only_state(loaded)
    require_loaded(loaded, name)
    if height_mm is not None and heights_from_markers:
        raise InputError("height_mm and heights_from_markers exclude each other; give one of them")
    folder = None if out is None else output_folder(out, PREDICTION_FILES, overwrite=overwrite)
    try:
        prediction = predict_state(calibrated, loaded, name, platen_position_mm=height_mm, heights_from_markers=heights_from_markers)
    except ConvergenceError as error:
        raise ConvergenceError(f"{loaded.name}/{name} cannot be solved: {error}") from error
    if calibrated.reservation:
        prediction = replace(prediction, notes=(f"The model is doubtful: {calibrated.reservation}", *prediction.notes))
    if folder is not None:
        written_together(folder, PREDICTION_FILES, lambda at: write_prediction(at, calibrated, prediction))
    return PredictionRun(**{f.name: getattr(prediction, f.name) for f in fields(prediction)}, model=calibrated)


def _only_state(experiment: Experiment) -> str:
    loaded = [s.name for s in experiment.states[1:] if s.loaded]
    if len(loaded) != 1:
        raise InputError(f"{experiment.name} has {len(loaded)} loaded states ({loaded_names(experiment)}); choose one with `state`")
    return loaded[0]
