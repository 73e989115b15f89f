"""Platen positions from the outermost markers, on gels whose plates stand elsewhere than stated."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, Loading
from naibu.core.markers import Markers
from naibu.core.parameters import ParameterSet
from naibu.identification.from_markers import gauss_newton
from naibu.identification.from_markers.calibration import initial_parameters
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import NoiseModel, SamePath, SolvedLoadCase
from naibu.identification.from_markers.specimen.parameter_names import friction, poisson_ratio, young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings, specimen
from naibu.identification.prediction import prediction
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.prediction.platen_position import Gauge, outermost_markers
from naibu.identification.prediction.prediction import predict_state
from naibu.mechanics.finite_strain.statics import LoadState
from naibu.validation.specimens.marker_phantoms import Scanner, box_experiment, virtual_specimen

TRUTH = {young_modulus("gel"): 200.0, poisson_ratio("gel"): 0.48, friction("gel", "table"): 0.2, friction("gel", "acrylic"): 0.3}
WIDTH_MM, STATED_MM = 54.0, 52.0
COARSE = ModelSettings(element_size_mm=12.0)


@pytest.fixture(scope="module")
def squeezed() -> Experiment:
    """A gel between side plates, on a mesh of its own, turned and moved in either scan; the stated distance is 2 mm too small."""
    template = box_experiment("pair", (40.0, 70.0, 40.0), [("gel", 40.0)], Loading("side_plates"), {"pressed": WIDTH_MM}, margin_mm=5.0)
    virtual = virtual_specimen(template, TRUTH, settings=ModelSettings(element_size_mm=9.0))
    seen = virtual.scanned(seed=4, scanner=Scanner(placing_mm=0.05, xy_step_mm=0.0, z_step_mm=0.0, turn_deg=8.0)).experiment
    return replace(seen, states=(seen.states[0], replace(seen.states[1], stated_mm=STATED_MM)))


def model_of(experiment: Experiment) -> CalibratedModel:
    """A model that knows the materials exactly, and nothing of this experiment."""
    known = KnownMaterials({"gel": 200.0})
    wanted = initial_parameters([specimen(experiment, COARSE)], {experiment.name: ["pressed"]}, known)
    own = wanted.with_values({name: v for name, v in TRUTH.items() if name in wanted.values()}, fixed=True)
    kept = type(own)(tuple(p for p in own if p.name in TRUTH))
    return CalibratedModel(COARSE, kept, np.zeros((0, 0)), NoiseModel(0.05), 1.0, known, ("other/pressed",))


def test_the_distance_of_side_plates_follows_from_the_outermost_columns(squeezed: Experiment) -> None:
    found = predict_state(model_of(squeezed), squeezed, "pressed", heights_from_markers=True)
    assert found.platen_position_mm == pytest.approx(WIDTH_MM, abs=0.25)  # stated 2 mm off
    assert any("outermost marker columns" in note for note in found.notes)
    stated = predict_state(model_of(squeezed), squeezed, "pressed")
    assert stated.platen_position_mm == STATED_MM
    assert np.nanmean(found.residual**2) < 0.2 * np.nanmean(stated.residual**2)
    # a distance from markers is known better than a stated one, and the error of the stated one is within its interval
    assert np.median(found.sd_model_mm) < 0.5 * np.median(stated.sd_model_mm)
    assert np.nanmean(np.abs(stated.residual) < 1.96 * stated.sd_mm) > 0.95


def test_a_path_to_another_end_is_that_of_a_solution_from_rest(squeezed: Experiment) -> None:
    model = model_of(squeezed)
    found = predict_state(model, squeezed, "pressed", heights_from_markers=True)  # from the path to the stated distance
    given = predict_state(model, squeezed, "pressed", platen_position_mm=found.platen_position_mm)
    np.testing.assert_allclose(found.points, given.points, atol=0.01)


def test_the_path_tells_how_the_distance_changes_and_a_solution_nearby_where_the_plates_stand(
    squeezed: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    solved, differentiated = [], []
    solve_state, sensitivities = prediction.solve_state, gauss_newton.sensitivities
    monkeypatch.setattr(prediction, "solve_state", lambda *a, **k: solved.append(solve_state(*a, **k)) or solved[-1])
    monkeypatch.setattr(gauss_newton, "sensitivities", lambda *a, **k: differentiated.append(a) or sensitivities(*a, **k))
    found = predict_state(model_of(squeezed), squeezed, "pressed", heights_from_markers=True)
    alone = len(differentiated)
    near = SolvedLoadCase(solved[0].fit, solved[0].parameters)
    again = predict_state(model_of(squeezed), squeezed, "pressed", heights_from_markers=True, warm_start=near)
    assert len(differentiated) - alone == alone == 1  # for the uncertainty alone
    assert again.platen_position_mm == pytest.approx(found.platen_position_mm, abs=0.01)
    np.testing.assert_allclose(again.points, found.points, atol=0.01)


def test_states_of_a_path_are_met_where_the_body_was_in_them() -> None:
    rate = np.array([[1.0, 0.0, -2.0]])
    states = tuple(LoadState(x, x * rate, (), (np.full(2, 10.0 * x),)) for x in (0.0, 0.25, 0.5, 0.98, 1.0))
    solution = SimpleNamespace(states=states)
    near = [SamePath(SimpleNamespace(solution=solution), ParameterSet.of([]), reached=x) for x in (0.8, 0.99, 1.25, 1.0)]
    assert [[load for load, _ in n.warm_start({})] for n in near] == [
        pytest.approx([0.2, 0.4, 0.784, 0.8]),  # the rest of the way is not known
        pytest.approx([0.2475, 0.495, 1.0]),
        pytest.approx([0.3125, 0.625, 1.0]),
        pytest.approx([0.25, 0.5, 1.0]),
    ]
    for n in near:
        for load, displacement in n.warm_start({}):
            np.testing.assert_allclose(displacement, load / n.reached * rate)
        assert n.stiffness[1.0] == (pytest.approx(np.full(2, 10.0)),)
        assert n.stiffness[0.25 * n.reached] == (pytest.approx(np.full(2, 2.5)),)


def test_columns_without_known_markers_give_way_to_the_next_ones(squeezed: Experiment) -> None:
    body, state = specimen(squeezed, COARSE), squeezed.states[1]
    assert state.markers is not None
    whole = outermost_markers(body, state, np.full((len(body.marker_ids), 3), 0.1))
    lost = state.markers.points.copy()
    lost[np.flatnonzero(whole.low)[2:]] = np.nan  # two markers of the column are left
    gauge = outermost_markers(body, replace(state, markers=Markers.from_arrays(state.markers.ids, lost)), np.full(lost.shape, 0.1))
    assert body.marker_points[whole.low, 1].mean() == pytest.approx(-30.0, abs=0.5)
    assert body.marker_points[gauge.low, 1].mean() == pytest.approx(-20.0, abs=0.5)
    n = whole.low.sum()
    assert whole.sd_mm == pytest.approx(0.1 * np.sqrt(2.0 / n))
    with pytest.raises(InputError, match="no two marker columns"):
        outermost_markers(body, replace(state, markers=Markers.from_arrays(state.markers.ids[:4], lost[-4:])), np.full(lost.shape, 0.1))
    with pytest.raises(InputError, match="no measured markers"):
        outermost_markers(body, replace(state, markers=None), np.full(lost.shape, 0.1))


@pytest.mark.parametrize("axis", [None, 2])
def test_the_derivative_of_a_distance_is_its_finite_difference(axis: int | None) -> None:
    rng = np.random.default_rng(0)
    points, direction = rng.normal(size=(9, 3)) * 10.0, rng.normal(size=(9, 3))
    gauge = Gauge(np.arange(9) < 3, np.arange(9) > 5, axis, 10.0, 0.1)
    step = 1e-5
    difference = (gauge.distance(points + step * direction) - gauge.distance(points - step * direction)) / (2.0 * step)
    assert gauge.derivatives(points, direction[:, :, None])[0] == pytest.approx(difference, rel=1e-6)


def test_markers_of_another_load_are_said_to_be_no_measure_of_the_error(squeezed: Experiment) -> None:
    model = model_of(squeezed)
    other = predict_state(model, squeezed, "pressed", platen_position_mm=60.0)
    assert any("stated 52 mm, not at 60 mm" in note and "two loads" in note for note in other.notes)
    assert not any("two loads" in note for note in predict_state(model, squeezed, "pressed", platen_position_mm=WIDTH_MM).notes)
