"""Indenters stand where the parameters of a state put them; side plates that lean are recovered, and predict better than upright ones."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from naibu import datasets
from naibu.core.experiment import Experiment, Loading
from naibu.identification.from_markers.calibration import calibrate, initial_parameters
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import LoadCaseFit, NoiseModel
from naibu.identification.from_markers.specimen.indenter_path import state_parameters
from naibu.identification.from_markers.specimen.parameter_names import (
    friction,
    platen_position,
    poisson_ratio,
    side_plate_tilt,
    young_modulus,
)
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings, specimen
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.prediction.prediction import predict_state, rms
from naibu.mechanics.finite_strain.problem import SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.validation.specimens.marker_phantoms import Scanner, box_experiment, virtual_specimen
from naibu.workflows.results.report_content import scene

SIZE, WIDTH_MM, FURTHER_MM, TILT = (40.0, 70.0, 40.0), 58.0, 50.0, 0.03
COARSE = ModelSettings(element_size_mm=10.0)
KNOWN = KnownMaterials({"gel": 200.0})
TRUTH = {young_modulus("gel"): 200.0, poisson_ratio("gel"): 0.48, friction("gel", "table"): 0.2, friction("gel", "acrylic"): 0.3}


def between_plates(axis: Literal["x", "y"] = "y") -> Experiment:
    """A box of gel between side plates, without markers in its loaded states."""
    loading, positions = Loading("side_plates", bar_axis=axis), {"pressed": WIDTH_MM, "further": FURTHER_MM}
    return box_experiment("pair", SIZE if axis == "y" else (70.0, 40.0, 40.0), [("gel", 40.0)], loading, positions, margin_mm=5.0)


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("whole", [False, True])
def test_leaning_side_plates_are_closer_above_by_their_angle(axis: Literal["x", "y"], whole: bool) -> None:
    experiment = datasets.load("ct_half_ellipsoid")
    experiment = replace(experiment, loading=replace(experiment.loading, bar_axis=axis))
    body = specimen(experiment, ModelSettings(element_size_mm=20.0), whole=whole)
    values = {platen_position(experiment, "width_100"): 90.0, side_plate_tilt(experiment, "width_100"): TILT}
    along, height = "xyz".index(axis), experiment.height_mm
    for plate in body.moved_indenters(values, "width_100"):
        normal, position = plate.orientation(1.0) @ plate.surface.normal, plate.position(1.0)
        # where the plate's face meets vertical lines: n . (x - p) = 0
        places = [position[along] - normal[2] / normal[along] * (z - position[2]) for z in (0.0, 0.5 * height, height)]
        assert abs(places[1]) == pytest.approx(45.0)  # half of the distance, at half of the height
        lower, upper = np.abs(places[0]), np.abs(places[2])
        assert lower - upper == pytest.approx(height * np.tan(TILT))


def test_a_bar_and_a_plate_keep_their_own_parameters() -> None:
    kinds = {}
    for name, state in (("ct_cube_bar", "height_45"), ("ct_cube_plate", "height_45"), ("ct_half_ellipsoid", "width_100")):
        experiment = datasets.load(name)
        kinds[name] = [p.name.rpartition(": ")[2] for p in state_parameters(experiment, experiment.state(state))]
    assert kinds["ct_cube_bar"] == ["height", "tilt_x", "tilt_y", "bar_offset", "bar_yaw"]
    assert kinds["ct_cube_plate"] == ["height", "tilt_x", "tilt_y"]
    assert kinds["ct_half_ellipsoid"] == ["width", "tilt"]


def test_side_plates_that_lean_are_recovered_and_predict() -> None:
    """A gel computed whole on elements of its own; the same markers with plates taken for upright are the control."""
    template = between_plates()
    truth = TRUTH | {side_plate_tilt(template, state): TILT for state in ("pressed", "further")}
    virtual = virtual_specimen(template, truth, settings=ModelSettings(element_size_mm=7.0))
    seen = virtual.scanned(seed=3, scanner=Scanner(placing_mm=0.1, xy_step_mm=0.0, z_step_mm=0.0)).experiment
    model = CalibratedModel.of(
        calibrate([seen], states={seen.name: ["pressed"]}, known_materials=KNOWN, settings=COARSE, noise=NoiseModel(0.1))
    )
    angle = side_plate_tilt(seen, "pressed")
    low, high = model.interval(angle)
    assert low < TILT < high and high - low < 0.02
    upright = model.parameters.with_values({angle: 0.0}, fixed=True)
    kept = [i for i, p in enumerate(model.parameters.free) if p.name != angle]
    without = replace(model, parameters=upright, covariance=model.covariance[np.ix_(kept, kept)])
    found, control = (predict_state(m, seen, "further", heights_from_markers=True) for m in (model, without))
    assert rms(found.residual) < 0.8 * rms(control.residual)
    assert np.mean(np.abs(found.residual) < 1.96 * found.sd_mm) > 0.9


def test_an_angle_known_from_another_state_is_as_uncertain_as_there() -> None:
    experiment = between_plates()
    markers = virtual_specimen(experiment, TRUTH, settings=ModelSettings(element_size_mm=14.0)).scanned(seed=1).experiment
    body = specimen(markers, ModelSettings(element_size_mm=14.0))
    parameters = initial_parameters([body], {markers.name: ["pressed"]}, KNOWN)
    angle, sd = side_plate_tilt(markers, "pressed"), 0.02
    parameters = parameters.with_values({angle: 0.015})
    variances = np.diag([sd**2 if p.name == angle else 1e-6 for p in parameters.free])
    model = CalibratedModel(body.settings, parameters, variances, NoiseModel(), 1.0, KNOWN, ("pair/pressed",))
    solved = predict_state(model, markers, "further")
    assert solved.values[side_plate_tilt(markers, "further")] == pytest.approx(0.015)
    certain = replace(model, covariance=np.where(np.eye(len(variances), dtype=bool), 1e-6, 0.0))
    turned = replace(model, parameters=parameters.with_values({angle: 0.015 + sd}))
    known, leaning = (predict_state(m, markers, "further") for m in (certain, turned))
    # the angle is not better known than where it was found: its standard deviation moves markers as far as turning the plates by it does
    moved = np.abs(leaning.residual - solved.residual)[:, 1]
    added = np.sqrt(np.maximum(solved.sd_model_mm**2 - known.sd_model_mm**2, 0.0))[:, 1]
    assert np.median(added) == pytest.approx(np.median(moved), rel=0.05)


@pytest.mark.parametrize("kind", ["side_plates", "plate", "bar"])
def test_indenters_are_drawn_where_they_touch(kind: Literal["side_plates", "plate", "bar"]) -> None:
    """The face of the box that is drawn lies in the plane of contact, and all of the box behind it."""
    loading = Loading(kind, bar_width_mm=15.0 if kind == "bar" else None)
    template = box_experiment("drawn", (40.0, 40.0, 40.0), [("gel", 40.0)], loading, {"pressed": 36.0}, margin_mm=5.0)
    experiment = virtual_specimen(template, TRUTH, settings=ModelSettings(element_size_mm=20.0)).scanned(seed=1).experiment
    body = specimen(experiment, ModelSettings(element_size_mm=20.0))
    names = [p.name for p in state_parameters(experiment, experiment.state("pressed")) if "tilt" in p.name or "yaw" in p.name]
    values = initial_parameters([body], {"drawn": ["pressed"]}, KNOWN).values() | dict.fromkeys(names, TILT)
    solution = solve(body.problem(values, "pressed"), settings=SolverSettings(first_step=0.25, largest_step=0.5))
    nothing = np.full((len(body.marker_points), 3), np.nan)
    no = np.zeros((*nothing.shape, 0))
    fit = LoadCaseFit(solution, body.placement.pose, nothing, nothing, np.ones_like(nothing), no, no, ())
    drawn = scene(body, "pressed", fit, nothing, values, "fitted").steps
    for state, step in zip(solution.states, drawn, strict=True):
        for plate, box in zip(body.moved_indenters(values, "pressed"), step.indenters, strict=True):
            x, y, z, w = box.turned
            matrix = np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
                ]
            )
            signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
            corners = np.array(box.centre_mm) + (signs * box.half_size_mm) @ matrix.T
            normal = plate.orientation(state.load) @ plate.surface.normal
            ahead = np.sort((corners - plate.position(state.load)) @ normal)
            np.testing.assert_allclose(ahead[4:], 0.0, atol=1e-9)
            assert ahead[:4].max() < -3.0
