"""What predictions are uncertain by: sensitivities against finite differences, statistics against draws, and a gel of another law."""

import json
from dataclasses import replace

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, Loading
from naibu.identification.from_markers.calibration import Calibration, calibrate
from naibu.identification.from_markers.consider_parameters import smooth_variance, with_considered
from naibu.identification.from_markers.gauss_newton import Matcher
from naibu.identification.from_markers.observations import NoiseModel
from naibu.identification.from_markers.specimen.parameter_names import (
    base_offset,
    pixel_scale,
    poisson_ratio,
    shape_parameter,
    young_modulus,
)
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings, specimen
from naibu.identification.prediction import interval
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.prediction.prediction import Prediction, predict_state
from naibu.mechanics.finite_strain.sensitivities import sensitivities
from naibu.mechanics.finite_strain.statics import solve
from naibu.validation.specimens.marker_phantoms import Scanner, box_experiment, virtual_specimen

COARSE = ModelSettings(contact="stick", element_size_mm=10.0)
STIFFENING = shape_parameter("gel", "c20_ratio")
TRUTH = {young_modulus("gel"): 200.0, poisson_ratio("gel"): 0.48, STIFFENING: 0.6}
NOISE_MM = 0.03


@pytest.fixture(scope="module")
def gel() -> Experiment:
    """A gel that stiffens more than a neo-Hookean one, pressed to two heights, on a mesh of its own."""
    heights = {"little": 33.0, "more": 26.0}
    template = box_experiment("gel", (40.0,) * 3, [("gel", 40.0)], Loading("plate"), heights, spacing_mm=6.0, margin_mm=5.0)
    finer = ModelSettings(law="yeoh", contact="stick", element_size_mm=40.0 / 6.0)
    return virtual_specimen(template, TRUTH, settings=finer).scanned(seed=1, scanner=Scanner(NOISE_MM, 0.0, 0.0)).experiment


@pytest.fixture(scope="module")
def found(gel: Experiment) -> Calibration:
    return calibrate([gel], states={"gel": ["little"]}, settings=COARSE, noise=NoiseModel(NOISE_MM), with_mesh_error=False)


@pytest.mark.parametrize(("law", "kind"), [("mooney_rivlin", "c01_fraction"), ("yeoh", "c20_ratio"), ("yeoh", "c30_ratio")])
def test_the_sensitivity_to_another_law_is_its_finite_difference(gel: Experiment, law: str, kind: str) -> None:
    name = shape_parameter("gel", kind)
    values = TRUTH | {"gel/more: height": 30.0, STIFFENING: 0.0, shape_parameter("gel", "c30_ratio"): 0.0, name: 0.0}
    body = specimen(gel, replace(COARSE, law="neo_hookean_isochoric"))
    problem = body.problem(values, "more")
    derivative = sensitivities(problem, solve(problem).states, body.direction(name, values, "more"))[-1][:, :, 0]
    other, step = specimen(gel, replace(COARSE, law=law)), 0.02
    ends = [solve(other.problem(values | {name: sign * step}, "more")).displacement for sign in (1.0, -1.0)]
    difference = (ends[0] - ends[1]) / (2.0 * step)
    assert np.abs(difference).max() > 0.05
    np.testing.assert_allclose(derivative, difference, atol=0.01 * np.abs(difference).max())


def test_a_smooth_misfit_is_told_from_noise(found: Calibration) -> None:
    rng, (load_case,), (fit,) = np.random.default_rng(0), found.load_cases, found.match.fits
    noise = rng.normal(0.0, 0.2, fit.residual.shape)
    smooth = 0.02 * load_case.specimen.marker_points
    assert smooth_variance([load_case], [replace(fit, residual=noise)]) < 0.03 * 0.2**2 + 3.0 * 0.2**2 / np.sqrt(3 * len(noise))
    both = smooth_variance([load_case], [replace(fit, residual=noise + smooth - smooth.mean(axis=0))])
    assert both == pytest.approx(np.var(smooth, axis=0).mean(), rel=0.25)  # neighbours differ a little even in a smooth field


def test_a_fitted_platen_position_errs_with_the_other_parameters() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(3, 3))
    errors = rng.normal(size=(200_000, 3)) @ root.T
    rates, noise = np.array([0.8, -0.3, 0.5]), 0.4
    errors[:, 0] = (noise * rng.normal(size=len(errors)) - errors[:, 1:] @ rates[1:]) / rates[0]  # the distance comes out as measured
    np.testing.assert_allclose(interval._gauged(root @ root.T, rates, 0, noise), np.cov(errors.T), rtol=0.05, atol=0.02)


def test_one_standard_deviation_holds_95_percent_of_three_unequal_coordinates() -> None:
    rng, sd = np.random.default_rng(5), np.array([[0.2, 0.3, 0.9], [0.4, 0.4, 0.4]])
    draws = sd * rng.normal(size=(100_000, 2, 3))
    one = interval.per_axis(sd)
    assert np.mean(np.abs(draws[:, 0]) < 1.96 * one[0]) == pytest.approx(0.95, abs=0.003)
    assert one[1] == pytest.approx(0.4)


def covered(prediction: Prediction) -> float:
    return float(np.mean(np.abs(prediction.residual) < 1.96 * prediction.sd_mm))


def test_a_gel_of_another_law_stays_within_the_intervals(gel: Experiment, found: Calibration) -> None:
    model = CalibratedModel.of(found)
    with_law = predict_state(model, gel, "more", heights_from_markers=True)
    known = model.uncertainty  # and as if the law were right
    sure, size = np.zeros_like(known.covariance), len(found.match.parameters.free)
    sure[:size, :size] = found.covariance
    assert known.names[:size] == tuple(p.name for p in found.match.parameters.free)
    without = predict_state(
        replace(model, predictive=replace(known, covariance=sure, discrepancy_mm=0.0)), gel, "more", heights_from_markers=True
    )
    np.testing.assert_allclose(with_law.points, without.points, atol=1e-6)
    assert covered(with_law) > 0.9
    assert np.sqrt(np.mean(with_law.sd_mm**2)) < 3.0 * np.sqrt(np.nanmean(with_law.residual**2))  # and is of use
    assert covered(without) < covered(with_law) - 0.1
    assert with_law.strain_ratio == pytest.approx(np.log(26.0 / 40.0) / np.log(33.0 / 40.0), rel=0.15)
    assert any("extrapolation: the state is strained 2" in note for note in with_law.notes)
    assert (with_law.sd_mm > with_law.sd_model_mm).all()
    assert f"{np.median(interval.per_axis(with_law.sd_model_mm)):.2f} mm (standard deviation per axis" in with_law.interval


def test_what_coarse_elements_miss_in_a_state_is_in_its_interval() -> None:
    """A neo-Hookean gel made on elements of half the size, so that the law is right and the elements are not."""
    template = box_experiment(
        "gel", (40.0,) * 3, [("gel", 40.0)], Loading("plate"), {"little": 34.0, "more": 26.0}, spacing_mm=10.0, margin_mm=5.0
    )
    made = virtual_specimen(template, {n: TRUTH[n] for n in TRUTH if n != STIFFENING}, settings=replace(COARSE, element_size_mm=5.0))
    seen = made.scanned(seed=1, scanner=Scanner(NOISE_MM, 0.0, 0.0)).experiment
    model = CalibratedModel.of(calibrate([seen], states={"gel": ["little"]}, settings=COARSE, noise=NoiseModel(NOISE_MM)))
    assert model.predictive is not None and any(model.predictive.mesh_step)
    honest = predict_state(model, seen, "more", heights_from_markers=True)
    bold = predict_state(replace(model, predictive=replace(model.predictive, mesh_step=())), seen, "more", heights_from_markers=True)
    np.testing.assert_allclose(honest.points, bold.points, atol=1e-9)
    assert (honest.sd_model_mm >= bold.sd_model_mm).all()
    assert covered(honest) > 0.9
    told = np.sqrt(3.0 * np.mean(honest.sd_mm**2 - bold.sd_mm**2))  # half the width of a rectangular distribution
    assert 0.5 < told / np.sqrt(np.mean(honest.residual**2)) < 2.0


def test_without_measured_markers_positions_stand_in_the_reference_scan(gel: Experiment, found: Calibration) -> None:
    blind = replace(gel, states=tuple(replace(s, markers=None if s.loaded else s.markers) for s in gel.states))
    model = CalibratedModel.of(found)
    higher = replace(model, parameters=model.parameters.with_values({base_offset(gel): model.parameters.values()[base_offset(gel)] + 2.0}))
    one, two = (predict_state(m, blind, "more") for m in (model, higher))
    lowest = blind.initial.points[:, 2] < blind.initial.points[:, 2].min() + 1.0
    # layers 5 mm above the table sink by a third of that at most, wherever the model thinks the table is
    for prediction in (one, two):
        sunk = (blind.initial.points - prediction.points)[lowest, 2]
        assert 0.5 < sunk.mean() < 3.0
    assert not one.registered
    assert np.median(one.sd_model_mm[lowest, 2]) < 1.5


def test_what_is_taken_for_known_is_considered(gel: Experiment, found: Calibration) -> None:
    body = specimen(gel, COARSE)
    names = {p.name for p in with_considered(body, found.match.parameters).free} - {p.name for p in found.match.parameters.free}
    assert names == {shape_parameter("gel", "c01_fraction"), STIFFENING, shape_parameter("gel", "c30_ratio"), pixel_scale(gel)}
    yeoh = specimen(gel, replace(COARSE, law="yeoh"))
    assert STIFFENING not in {p.name for p in with_considered(yeoh, found.match.parameters)} - set(found.match.parameters.values())
    matcher = Matcher(found.load_cases, with_considered(body, found.match.parameters))
    (again,) = matcher.differentiated(found.match.fits, matcher.parameters.values())
    (fit,) = found.match.fits
    shared = [[p.name for p in matcher.parameters.free].index(p.name) for p in found.match.parameters.free]
    np.testing.assert_allclose(again.jacobian[:, :, shared], fit.jacobian, rtol=1e-6, atol=1e-9)


def test_the_uncertainty_is_part_of_the_file(found: Calibration) -> None:
    model = CalibratedModel.of(found)
    stored = json.loads(json.dumps(model.to_dict()))
    again = CalibratedModel.from_dict(stored)
    np.testing.assert_array_equal(again.uncertainty.covariance, model.uncertainty.covariance)
    assert again.uncertainty.states == model.uncertainty.states
    older = {k: v for k, v in stored.items() if k != "predictive"}
    assert CalibratedModel.from_dict(older).uncertainty.names == tuple(p.name for p in model.parameters.free)
    stored["predictive"]["covariance"][0][1] += 1.0
    with pytest.raises(InputError, match="must be symmetric"):
        CalibratedModel.from_dict(stored)
    stored["predictive"] |= {"covariance": model.uncertainty.covariance.tolist(), "discrepancy_mm": -1.0}
    with pytest.raises(InputError, match=r"discrepancy_mm = -1\.0"):
        CalibratedModel.from_dict(stored)
