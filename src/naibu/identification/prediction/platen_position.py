"""Platen position of a state to predict: given, stated, or from the outermost markers of the measured state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, State
from naibu.core.parameters import ParameterSet
from naibu.identification.from_markers.gauss_newton import Matcher
from naibu.identification.from_markers.observations import LoadCaseFit, SamePath
from naibu.identification.from_markers.specimen.parameter_names import platen_position
from naibu.identification.from_markers.specimen.specimen_model import Specimen
from naibu.identification.prediction.calibrated_model import CalibratedModel

LAYER_GAP = 0.4  # a new marker layer starts where the height jumps by this fraction of the markers' spacing
ENOUGH = 3  # known markers that an outermost layer or column needs; else the next one inwards is taken
LEAST_RATE = 0.1  # change of the distance of the outermost markers for a change of the platen position of 1 mm
ACCURATE = 0.05  # of what noise leaves open of a platen position that markers tell
BACK = 0.03  # of the load, over which at least a path tells how the distance of the outermost markers changes with its end
SD_MM = {"given": 0.5, "same experiment": 1.0, "stated": 1.5, "unknown": 5.0}


@dataclass(frozen=True, slots=True, eq=False)
class Gauge:
    """Distance between two groups of markers, from which a platen position follows.

    Attributes
    ----------
    low, high : ndarray, shape (k,), bool
        The two groups.
    axis : int or None
        Axis along which the groups' means are apart; None for the length of the line between them, which no rigid motion changes.
    measured_mm : float
        The distance in the measured state.
    sd_mm : float
        Its standard deviation from the noise of both states.
    """

    low: BoolArray
    high: BoolArray
    axis: int | None
    measured_mm: float
    sd_mm: float

    def distance(self, points: FloatArray) -> float:
        """Return the distance between the groups of points (k, 3), mm."""
        return _apart(points, self.low, self.high, self.axis)[0]

    def derivatives(self, points: FloatArray, of_points: FloatArray) -> FloatArray:
        """Return the derivatives (p,) of the distance from those (k, 3, p) of the points (k, 3)."""
        direction = _apart(points, self.low, self.high, self.axis)[1]
        return np.asarray(direction @ (of_points[self.high].mean(axis=0) - of_points[self.low].mean(axis=0)))


def _apart(points: FloatArray, low: BoolArray, high: BoolArray, axis: int | None) -> tuple[float, FloatArray]:
    """Distance of the means of two groups, mm, and the direction (3,) along which it is taken."""
    between = points[high].mean(axis=0) - points[low].mean(axis=0)
    direction = between / np.linalg.norm(between) if axis is None else np.eye(3)[axis]
    return float(np.nan_to_num(between) @ np.nan_to_num(direction)), direction


def stated_platen_position(
    model: CalibratedModel, experiment: Experiment, state: State, given: float | None, notes: list[str]
) -> tuple[float, float | None]:
    """Return the height or width to start from, and its standard deviation, mm; None where the model has identified it.

    Raises
    ------
    InputError
        A position out of reach, or none known.
    """
    if given is not None:
        full = experiment.full_platen_position_mm
        if not 0.3 * full < given <= full:
            raise InputError(f"platen_position_mm is {given:g} mm, which is not between 30 % and 100 % of the object's {full:g} mm")
        if state.markers is not None and state.stated_mm is not None and abs(given - state.stated_mm) > 2.0 * SD_MM["stated"]:
            notes.append(
                f"the markers of {state.name} were measured at a stated {state.stated_mm:g} mm, not at {given:g} mm: their distance from "
                "the prediction is that between two loads, not its error"
            )
        return given, SD_MM["given"]
    values = model.parameters.values()
    name = platen_position(experiment, state.name)
    if name in values:
        return values[name], None
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
        return state.stated_mm + shift, SD_MM["same experiment" if shifts else "stated"]
    if state.estimated_mm is not None:
        notes.append(f"the height of {state.estimated_mm:g} mm is the estimate in the file")
        return state.estimated_mm, SD_MM["stated"]
    if state.markers is not None:
        notes.append("the file states no height; the search for it starts at 70 % of the object's")
        return 0.7 * experiment.full_platen_position_mm, SD_MM["unknown"]
    raise InputError(f"{experiment.name}/{state.name} states no height and has no markers; give platen_position_mm")


def marker_layers(heights: FloatArray, spacing: float | None) -> IntArray:
    """Return the index (k,) of the layer of every marker, from their coordinates (k,) across the layers, mm."""
    order = np.argsort(heights)
    gap = LAYER_GAP * (spacing or 10.0)
    index = np.empty(len(heights), dtype=np.int64)
    index[order] = np.concatenate([[0], np.cumsum(np.diff(heights[order]) > gap)])
    return index


def outermost_markers(body: Specimen, state: State, sd_mm: FloatArray) -> Gauge:
    """Return the outermost markers that tell the platen position of a measured state.

    They are the lowest and the highest layer under a plate or bar, whose distance along z counts, and the outermost columns between side
    plates, whose means' distance counts; a layer or column with fewer than `ENOUGH` known markers gives way to the next one inwards.

    Parameters
    ----------
    body : Specimen
        The meshed experiment.
    state : State
        The measured state.
    sd_mm : ndarray, shape (k, 3)
        Standard deviation of a coordinate from noise in both states.

    Raises
    ------
    InputError
        The state has no markers, or there are no two such layers or columns.
    """
    experiment, sides = body.experiment, body.experiment.loading.kind == "side_plates"
    label = f"{experiment.name}/{state.name}"
    if state.markers is None:
        raise InputError(f"{label} has no measured markers to take heights from; give platen_position_mm")
    measured = state.markers.aligned(body.marker_ids) * body.placement.scale
    axis = "xyz".index(experiment.loading.bar_axis) if sides else 2
    known = np.isfinite(measured).all(axis=1) if sides else np.isfinite(measured[:, 2])
    layer = marker_layers(body.marker_points[:, axis], experiment.nominal_spacing_mm)
    counted = [i for i in range(layer.max() + 1) if (known & (layer == i)).sum() >= ENOUGH]
    if len(counted) < 2:
        what = "columns between the side plates" if sides else "layers"
        raise InputError(f"{label}: no two marker {what} have {ENOUGH} known markers each; give platen_position_mm")
    low, high = (known & (layer == i) for i in (counted[0], counted[-1]))
    distance, direction = _apart(measured, low, high, None if sides else axis)
    variance = sum(float(((sd_mm[group] * direction) ** 2).sum()) / group.sum() ** 2 for group in (low, high))
    return Gauge(low, high, None if sides else axis, distance, float(np.sqrt(variance)))


def fitted_platen_position(matcher: Matcher, fit: LoadCaseFit, name: str, gauge: Gauge) -> tuple[ParameterSet, LoadCaseFit]:
    """Choose the platen position `name` with which the two groups of markers of a gauge are as far apart as measured.

    The body moves along one path, whose states are kept: only its end changes, and its last states tell how the distance changes with
    it. Later positions follow from the secant method, until noise leaves far more open.

    Parameters
    ----------
    matcher : Matcher
        Of the state.
    fit : LoadCaseFit
        The solution at the parameters of the matcher.
    name : str
        Of the platen position.
    gauge : Gauge
        The groups.

    Returns
    -------
    parameters : ParameterSet
    fit : LoadCaseFit
        Without derivatives.

    Raises
    ------
    InputError
        The distance of the groups hardly depends on the platen position.
    ConvergenceError
        The state cannot be solved.
    """
    parameters, body = matcher.parameters, matcher.load_cases[0].specimen
    start = body.experiment.full_platen_position_mm
    rate = _rate_along_path(body, fit, parameters.values(), name, gauge)
    for _ in range(8):
        if rate < LEAST_RATE:
            raise InputError("the distance of the outermost markers does not tell the platen position; give platen_position_mm")
        position, distance = parameters.values()[name], gauge.distance(fit.predicted)
        accuracy = ACCURATE * gauge.sd_mm / rate
        change = float(np.clip((gauge.measured_mm - distance) / rate, -5.0, 5.0))
        if abs(change) < accuracy:
            break
        reached = (position - start) / (position + change - start) if position + change < start else 0.0
        near = SamePath(fit, parameters, reached=reached) if reached > 0.0 else None
        parameters = parameters.with_values({name: position + change})
        fit = matcher.evaluate(parameters.values(), [near], [fit.pose], derivatives=False)[0]
        if abs(change) > accuracy:
            rate = (gauge.distance(fit.predicted) - distance) / change
    return parameters, fit


def _rate_along_path(body: Specimen, fit: LoadCaseFit, values: Mapping[str, float], name: str, gauge: Gauge) -> float:
    """Return how the distance of the groups of markers changes with the platen position, by the last states of the path to it."""
    states, shaped = fit.solution.states, body.reshaped(values)
    before = next(s for s in reversed(states) if s.load <= 1.0 - BACK)
    way = (values[name] - body.experiment.full_platen_position_mm) * (1.0 - before.load)
    moved = shaped.marker_points + shaped.at_markers(fit.since_scan(before.displacement))
    then = gauge.distance(fit.pose.applied(moved) / body.enlargement(values))
    return (gauge.distance(fit.predicted) - then) / way if way else np.inf


def source_of_platen_position(gauge: Gauge, position_mm: float) -> str:
    """Return in words where a platen position that markers told comes from."""
    if gauge.axis is None:
        return f"the distance of the side plates of {position_mm:.2f} mm follows from the distance of the outermost marker columns"
    return f"the height of {position_mm:.2f} mm follows from the mean z of the lowest and the highest marker layer"
