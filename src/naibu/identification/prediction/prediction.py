"""Predict the markers of a state that was not used, with the uncertainty of everything that is not known about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, State
from naibu.core.parameters import Parameter, ParameterSet
from naibu.core.rigid_transform import registration
from naibu.identification.from_markers.calibration import REFERENCE_MODULUS_KPA, START_FRICTION, START_SPRING, initial_parameters
from naibu.identification.from_markers.gauss_newton import Matcher
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import LoadCaseFit, MarkerLoadCase, SolvedLoadCase
from naibu.identification.from_markers.parameter_names import platen_position
from naibu.identification.from_markers.specimen_model import Specimen, specimen
from naibu.identification.prediction.calibrated_model import CalibratedModel

LAYER_GAP = 0.4  # a new marker layer starts where the height jumps by this fraction of the markers' spacing
UNKNOWN_SD = {"tilt_x": 0.007, "tilt_y": 0.007, "bar_offset": 0.5, "bar_yaw": 0.01, "base_offset": 0.5, "friction": 0.5}
PLATEN_POSITION_SD_MM = {"given": 0.3, "markers": 0.15, "stated": 1.0}


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
    sd_mm : ndarray, shape (k,)
        Standard deviation of a coordinate (root mean square over the three), mm: parameters, boundary conditions and model misfit.
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
    sd_mm: FloatArray
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
        Take the height from the mean z of the lowest and the highest marker layer of the measured state, and from nothing else of it.
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
    parameters = _parameters(model, body, target, notes)
    name = platen_position(experiment, state)
    use_layers = heights_from_markers and experiment.loading.kind != "side_plates"
    if heights_from_markers and not use_layers:
        notes.append("heights of marker layers do not give the distance of side plates; the stated distance is used")
    start, sd = _platen_position(model, experiment, target, platen_position_mm, notes)
    parameters = parameters.changed({name: Parameter(name, start, "mm", prior_sd=PLATEN_POSITION_SD_MM["markers"] if use_layers else sd)})
    load_case = _unmeasured(body, state, model)
    matcher = Matcher([load_case], parameters)
    fit = matcher.evaluate(parameters.values(), [warm_start])[0]
    if use_layers:
        parameters, fit = _fit_height(matcher, fit, name, target, notes)
    return _finished(model, body, target, parameters, fit, name, notes)


def _parameters(model: CalibratedModel, body: Specimen, state: State, notes: list[str]) -> ParameterSet:
    """Take parameters from the model; where it has none, from its nearest relatives, with a wide prior, and say so."""
    experiment = body.experiment
    own = set(experiment.materials)
    known = {m: e for m, e in model.known_materials.young_moduli.items() if m in own}
    wanted = initial_parameters([body], {experiment.name: [state.name]}, KnownMaterials(known, model.known_materials.scale_is_absolute))
    have = {p.name: p for p in model.parameters}
    out = []
    for p in wanted:
        if p.name in have:
            sd = model.standard_deviation(p.name)
            out.append(Parameter(p.name, have[p.name].value, p.unit, p.scale, prior_sd=sd or np.inf, fixed=sd == 0.0))
        else:
            out.append(_relative(p, model, experiment, notes))
    return ParameterSet.of(out)


def _relative(p: Parameter, model: CalibratedModel, experiment: Experiment, notes: list[str]) -> Parameter:
    """A parameter that the model does not have, from those most like it."""
    subject, _, kind = p.name.partition(": ")
    similar = [q for q in model.parameters if q.name.endswith(f": {kind}")]
    if kind == "young_modulus":
        if len(experiment.materials) > 1:
            raise InputError(
                f"the model does not know {subject!r}; it knows {_materials(model)}. Identify it with an experiment that contains it"
            )
        return Parameter(p.name, REFERENCE_MODULUS_KPA, p.unit, p.scale, fixed=True)
    if kind == "friction":
        body = subject.rpartition(" on ")[2]
        material = subject.rpartition(" on ")[0]
        same = (
            [q for q in similar if f" on {body}:" in q.name]  # two gels on one table rub more alike than one gel on two bodies
            or [q for q in similar if q.name.startswith(f"{material} on ")]
            or similar
        )
        default = START_FRICTION if model.settings.contact == "coulomb" else START_SPRING
        value = float(np.exp(np.mean([np.log(q.value) for q in same]))) if same else default
        notes.append(f"friction of {subject} was not identified; {value:.2f} is taken from {_subjects(same) or 'nothing'}")
        return Parameter(p.name, value, p.unit, p.scale, prior_sd=UNKNOWN_SD["friction"])
    if kind in ("poisson_ratio", "c01_fraction", "c20_ratio", "c30_ratio"):
        if not similar:
            return p
        notes.append(f"{kind} of {subject} was not identified; the mean of the model's materials is taken")
        centre = float(np.mean([q.inner(q.value) for q in similar]))
        return Parameter(p.name, p.physical(centre), p.unit, p.scale, prior_sd=0.5 if p.scale == "incompressibility" else 0.1)
    if kind == "stiffness":
        notes.append(f"the relative stiffness of {subject} was not identified; it is taken to be that of the other batches")
        return Parameter(p.name, 1.0, p.unit, p.scale, prior_sd=p.prior_sd)
    sisters = [q for q in similar if q.name.split("/")[0] == experiment.name]
    if kind.startswith("shift_of_layer") and similar:
        sisters = similar
        notes.append(f"{kind.replace('_', ' ')} mm is that of {_subjects(similar)}, whose layers have the same nominal height")
    if sisters and kind not in ("height", "width"):
        return Parameter(p.name, float(np.mean([q.value for q in sisters])), p.unit, p.scale, prior_sd=UNKNOWN_SD.get(kind, p.prior_sd))
    return Parameter(p.name, p.value, p.unit, p.scale, prior_sd=UNKNOWN_SD.get(kind, p.prior_sd))


def _subjects(parameters: Sequence[Parameter]) -> str:
    return ", ".join(p.name.partition(":")[0] for p in parameters)


def _materials(model: CalibratedModel) -> str:
    return ", ".join(p.name.partition(":")[0] for p in model.parameters if p.name.endswith(": young_modulus"))


def _platen_position(
    model: CalibratedModel, experiment: Experiment, state: State, given: float | None, notes: list[str]
) -> tuple[float, float]:
    """Height or width to start from, and its standard deviation, mm."""
    if given is not None:
        full = experiment.full_platen_position_mm
        if not 0.3 * full < given <= full:
            raise InputError(f"platen_position_mm is {given:g} mm, which is not between 30 % and 100 % of the object's {full:g} mm")
        return given, PLATEN_POSITION_SD_MM["given"]
    values = model.parameters.values()
    name = platen_position(experiment, state.name)
    if name in values:
        return values[name], max(model.standard_deviation(name), 1e-3)
    if state.stated_mm is not None:
        shifts = [
            values[n] - s.stated_mm
            for s in experiment.states
            if s.stated_mm is not None and (n := platen_position(experiment, s.name)) in values
        ]
        shift = float(np.mean(shifts)) if shifts else 0.0
        if shifts:
            notes.append(
                f"the stated {state.stated_mm:g} mm is corrected by {shift:+.2f} mm, as found in other states of {experiment.name}"
            )
        else:
            notes.append(f"the stated {state.stated_mm:g} mm is taken as it is; stated heights are nominal")
        return state.stated_mm + shift, 0.5 if shifts else PLATEN_POSITION_SD_MM["stated"]
    if state.estimated_mm is not None:
        notes.append(f"the height of {state.estimated_mm:g} mm is the estimate in the file")
        return state.estimated_mm, PLATEN_POSITION_SD_MM["stated"]
    if state.markers is not None:
        notes.append("the file states no height; the search for it starts at 70 % of the object's")
        return 0.7 * experiment.height_mm, 5.0
    raise InputError(f"{experiment.name}/{state.name} states no height and has no markers; give platen_position_mm")


def _unmeasured(body: Specimen, state: str, model: CalibratedModel) -> MarkerLoadCase:
    """A load case without data: its pose is that of the reference scan."""
    sd = model.noise.standard_deviation(body.experiment.xy_step_mm, body.experiment.z_step_mm)
    return MarkerLoadCase(body, state, np.full(body.marker_points.shape, np.nan), sd, np.broadcast_to(sd, body.marker_points.shape))


def marker_layers(heights: FloatArray, spacing: float | None) -> IntArray:
    """Return the index (k,) of the horizontal layer of every marker, from their heights (k,) in the reference configuration, mm."""
    order = np.argsort(heights)
    gap = LAYER_GAP * (spacing or 10.0)
    index = np.empty(len(heights), dtype=np.int64)
    index[order] = np.concatenate([[0], np.cumsum(np.diff(heights[order]) > gap)])
    return index


def _fit_height(matcher: Matcher, fit: LoadCaseFit, name: str, state: State, notes: list[str]) -> tuple[ParameterSet, LoadCaseFit]:
    """Choose the height so that the distance between the lowest and the highest marker layer is the measured one.

    Raises
    ------
    InputError
        The state has no markers in one of the two layers.
    """
    body = matcher.load_cases[0].specimen
    if state.markers is None:
        raise InputError(f"{body.experiment.name}/{state.name} has no measured markers to take heights from; give platen_position_mm")
    z = state.markers.aligned(body.marker_ids)[:, 2]
    layer = marker_layers(body.marker_points[:, 2], body.experiment.nominal_spacing_mm)
    low, high = (layer == 0) & np.isfinite(z), (layer == layer.max()) & np.isfinite(z)
    if not low.any() or not high.any():
        raise InputError(
            f"{body.experiment.name}/{state.name}: no height is known in the lowest or the highest marker layer; give platen_position_mm"
        )
    wanted = float(z[high].mean() - z[low].mean())
    free = [p.name for p in matcher.parameters.free]
    k = free.index(name)
    parameters = matcher.parameters
    for _ in range(8):
        spread = float(fit.predicted[high, 2].mean() - fit.predicted[low, 2].mean())
        rate = float(fit.jacobian[high, 2, k].mean() - fit.jacobian[low, 2, k].mean())
        change = float(np.clip((wanted - spread) / rate, -5.0, 5.0))
        if abs(change) < 1e-3:
            break
        before, parameters = parameters, parameters.with_values({name: parameters.values()[name] + change})
        fit = matcher.evaluate(parameters.values(), [SolvedLoadCase(fit, before)], [fit.pose])[0]
    notes.append(f"the height of {parameters.values()[name]:.2f} mm follows from the mean z of the lowest and the highest marker layer")
    return parameters, fit


def _finished(
    model: CalibratedModel, body: Specimen, state: State, parameters: ParameterSet, fit: LoadCaseFit, name: str, notes: list[str]
) -> Prediction:
    scale = body.placement.scale
    measured = state.markers.aligned(body.marker_ids) * scale if state.markers is not None else np.full(fit.predicted.shape, np.nan)
    registered = bool(np.isfinite(measured).all(axis=1).sum() >= 4)
    pose = registration(fit.predicted, measured) if registered else None
    points = pose.applied(fit.predicted) if pose is not None else fit.predicted
    back = (pose.inverse().applied(measured) if pose is not None else measured) * body.enlargement(parameters.values())
    return Prediction(
        body, state.name, points / scale, _standard_deviation(model, parameters, fit), registered, measured - points,
        parameters.values()[name], parameters.values(), fit.pose.inverse().applied(back), fit, tuple(notes),
    )  # fmt: skip


def _standard_deviation(model: CalibratedModel, parameters: ParameterSet, fit: LoadCaseFit) -> FloatArray:
    """Standard deviation (k,) of a predicted coordinate, mm: the model's covariance, the priors of the rest, the model's misfit."""
    free = parameters.free
    covariance = np.diag([p.prior_sd**2 if np.isfinite(p.prior_sd) else 0.0 for p in free])
    known = {p.name: i for i, p in enumerate(model.parameters.free)}
    shared = [(i, known[p.name]) for i, p in enumerate(free) if p.name in known]
    for i, a in shared:
        for j, b in shared:
            if i != j:
                covariance[i, j] = model.covariance[a, b]
    slope = np.array([p.slope(p.value) for p in free])
    j = fit.jacobian * slope
    variance = np.einsum("kip,pq,kiq->k", j, covariance, j) / 3.0
    misfit = max(model.noise_factor**2 - 1.0, 0.0) * (fit.sd**2).mean(axis=1)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0) + misfit))


def rms(residual: FloatArray, axes: Sequence[int] = (0, 1, 2)) -> float:
    """Root mean square over complete markers of the distance along `axes`, mm."""
    whole = np.isfinite(residual).all(axis=1)
    return float(np.sqrt((residual[whole][:, list(axes)] ** 2).sum(axis=1).mean()))
