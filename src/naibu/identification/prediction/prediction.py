"""Predict the markers of a state that was not used, with the uncertainty of everything that is not known about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.experiment import Experiment, State
from naibu.core.parameters import Parameter
from naibu.core.rigid_transform import registration
from naibu.identification.from_markers.consider_parameters import PREDICTED_SHAPES, with_considered
from naibu.identification.from_markers.observations import LoadCaseFit, MarkerLoadCase, SolvedLoadCase
from naibu.identification.from_markers.specimen.marker_grid import FILLED_SD_MM
from naibu.identification.from_markers.specimen.parameter_names import platen_position
from naibu.identification.from_markers.specimen.specimen_model import Specimen, specimen
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.prediction.interval import coordinate_uncertainty
from naibu.identification.prediction.platen_position import source_of_platen_position, stated_platen_position
from naibu.identification.prediction.predictive_uncertainty import strain_at_markers
from naibu.identification.prediction.solved_state import SolvedState, solve_state
from naibu.identification.prediction.target_parameters import target_parameters

FURTHER = 1.15  # times the strain of the calibrating states from which a prediction is called an extrapolation
LOADED_BY = {"plate": "a plate", "bar": "a bar", "side_plates": "side plates", "cylinder": "a cylinder"}


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Predicted markers of one state.

    Attributes
    ----------
    specimen : Specimen
        The meshed experiment.
    state : str
        Name of the state.
    points : ndarray, shape (k, 3)
        Predicted positions of ``specimen.marker_ids``, printed mm, in the frame of the reference scan, or registered to the measured
        markers where the state has some.
    sd_model_mm : ndarray, shape (k, 3)
        Standard deviation of a predicted coordinate along each axis, mm: parameters, friction, law, platen position, model misfit.
    sd_mm : ndarray, shape (k, 3)
        The same with the measurement noise of both scans: of the difference between a measured and a predicted coordinate, mm.
    strain_ratio : float
        Root mean square strain at the markers over that of the most strained calibrating state; NaN where that is not known.
    interval : str
        What the standard deviations hold, in a sentence.
    registered : bool
        Whether the positions were registered to measured ones.
    residual : ndarray, shape (k, 3)
        Measured minus predicted, true mm; NaN where not measured.
    platen_position_mm : float
        Height of the plate or bar, or distance of the side plates, that was used.
    values : mapping
        Physical values of all parameters that were used.
    measured_in_object : ndarray, shape (k, 3)
        Measured markers brought into the object's frame, mm; NaN where not measured.
    fit : LoadCaseFit
        The solution behind it.
    notes : tuple of str
        Every assumption that was made, in words.
    """

    specimen: Specimen
    state: str
    points: FloatArray
    sd_model_mm: FloatArray
    sd_mm: FloatArray
    strain_ratio: float
    interval: str
    registered: bool
    residual: FloatArray
    platen_position_mm: float
    values: Mapping[str, float]
    measured_in_object: FloatArray
    fit: LoadCaseFit
    notes: tuple[str, ...]


def predict_state(
    model: CalibratedModel,
    experiment: Experiment,
    state: str,
    *,
    platen_position_mm: float | None = None,
    heights_from_markers: bool = False,
    warm_start: SolvedLoadCase | None = None,
) -> Prediction:
    """Predict one state of an experiment with a calibrated model.

    Parameters
    ----------
    model : CalibratedModel
        From `calibrate`.
    experiment : Experiment
        The object and its reference configuration; the loaded state may be measured or not.
    state : str
        Name of the loaded state.
    platen_position_mm : float, optional
        Height of the plate or bar above the base, or distance of the side plates. By default what the file states, corrected by what
        other states of the same experiment showed.
    heights_from_markers : bool
        Take the height from the mean z of the lowest and the highest marker layer of the measured state, or the distance of side plates
        from that of its outermost marker columns, and nothing else of it.
    warm_start : SolvedLoadCase, optional
        Solution of the state with similar parameters; it saves time and does not change the result.

    Raises
    ------
    InputError
        The model does not know a material, no height is known, or there are no markers to take it from.
    ConvergenceError
        The state cannot be solved.
    """
    target = experiment.state(state)
    body = specimen(experiment, model.settings)
    notes: list[str] = []
    wanted = target_parameters(model, body, target, notes)
    name = platen_position(experiment, state)
    start, sd = stated_platen_position(model, experiment, target, platen_position_mm, notes)
    wanted = wanted.changed({name: Parameter(name, start, "mm", prior_sd=sd or 1.0)})
    load_case = _unmeasured(body, state, model)
    parameters = with_considered(body, wanted, PREDICTED_SHAPES)
    solved = solve_state(load_case, parameters, name, markers=target if heights_from_markers else None, warm_start=warm_start)
    if solved.gauge is not None:
        notes.append(source_of_platen_position(solved.gauge, solved.parameters.values()[name]))
    return _finished(model, target, solved, name, sd, [p.name for p in wanted], notes)


def _unmeasured(body: Specimen, state: str, model: CalibratedModel) -> MarkerLoadCase:
    """A load case without data: its pose is that of the reference scan."""
    sd = model.noise.of_experiment(body.experiment)
    return MarkerLoadCase(body, state, np.full(body.marker_points.shape, np.nan), sd, np.where(body.marker_filled, FILLED_SD_MM, sd))


def _finished(
    model: CalibratedModel,
    state: State,
    solved: SolvedState,
    platen: str,
    platen_sd_mm: float | None,
    sought: Sequence[str],
    notes: list[str],
) -> Prediction:
    body, parameters, fit = solved.load_case.specimen, solved.parameters, solved.fit
    scale, values = body.placement.scale, {name: parameters.values()[name] for name in sought}
    measured = state.markers.aligned(body.marker_ids) * scale if state.markers is not None else np.full(fit.predicted.shape, np.nan)
    whole: BoolArray = np.asarray(np.isfinite(measured).all(axis=1))
    pose = registration(fit.predicted, measured) if whole.sum() >= 4 else None
    points = pose.applied(fit.predicted) if pose is not None else fit.predicted
    back = (pose.inverse().applied(measured) if pose is not None else measured) * body.enlargement(values)
    ratio = _strain_ratio(model, body, values, fit)
    sd = coordinate_uncertainty(
        model, body, parameters, fit, strain_ratio=ratio, platen=platen, platen_sd_mm=platen_sd_mm, gauge=solved.gauge,
        pose=pose, seen=whole, elements_mm=solved.error_of_elements() if model.uncertainty.mesh_step else None,
    )  # fmt: skip
    notes += _extrapolation(model, body, ratio)
    return Prediction(
        body, state.name, points / scale, sd.model, sd.measured, ratio, sd.sentence(), pose is not None, measured - points,
        values[platen], values, fit.pose.inverse().applied(back), fit, tuple(notes),
    )  # fmt: skip


def _strain_ratio(model: CalibratedModel, body: Specimen, values: Mapping[str, float], fit: LoadCaseFit) -> float:
    known = [s.strain for s in model.uncertainty.states.values()]
    return strain_at_markers(body, values, fit) / max(known) if known and max(known) > 0.0 else np.nan


def _extrapolation(model: CalibratedModel, body: Specimen, ratio: float) -> list[str]:
    """Sentences that say in what the state lies beyond those of the calibration."""
    out = []
    if ratio > FURTHER:
        out.append(f"this is an extrapolation: the state is strained {ratio:.1f} times as much as any state of the calibration")
    kind, known = body.experiment.loading.kind, {s.loading for s in model.uncertainty.states.values()}
    if known and kind not in known:
        others = " and ".join(LOADED_BY[k] for k in LOADED_BY if k in known)
        out.append(f"this is an extrapolation: the calibration knows objects pressed by {others} only, not by {LOADED_BY[kind]}")
    return out


def rms(residual: FloatArray, axes: Sequence[int] = (0, 1, 2)) -> float:
    """Root mean square over complete markers of the distance along `axes`, mm."""
    whole = np.isfinite(residual).all(axis=1)
    return float(np.sqrt((residual[whole][:, list(axes)] ** 2).sum(axis=1).mean()))
