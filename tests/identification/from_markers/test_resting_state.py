"""The reference scan saw the object bent by its weight, which tells how stiff it is."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from naibu import datasets
from naibu.core.experiment import Experiment, Loading
from naibu.identification.from_markers.calibration import calibrate, initial_parameters
from naibu.identification.from_markers.consider_parameters import with_considered
from naibu.identification.from_markers.gauss_newton import Matcher
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import MarkerLoadCase, NoiseModel
from naibu.identification.from_markers.specimen.parameter_names import (
    friction,
    platen_position,
    poisson_ratio,
    straight_base,
    young_modulus,
)
from naibu.identification.from_markers.specimen.resting_state import resting_state
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings, specimen
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.mechanics.finite_strain.statics import solve
from naibu.validation.specimens.marker_phantoms import Scanner, box_experiment, virtual_specimen
from naibu.viewer.result_page.estimates import parameter_cards
from naibu.workflows.results.report_content import parameter_rows

SIZE, YOUNG = (40.0, 60.0, 30.0), 8.0
TRUTH = {young_modulus("gel"): YOUNG, poisson_ratio("gel"): 0.48, friction("gel", "table"): 0.2, friction("gel", "acrylic"): 0.2}
EXACT = Scanner(placing_mm=0.05, xy_step_mm=0.0, z_step_mm=0.0)


def squeezed(width_mm: float, *, heavier: float = 1.0) -> Experiment:
    """A very soft block between side plates, computed whole on elements of its own; something holds it down as if it were `heavier`."""
    template = box_experiment("soft", SIZE, [("gel", SIZE[2])], Loading("side_plates"), {"pressed": width_mm}, margin_mm=5.0)
    settings = ModelSettings(element_size_mm=7.0, density=1e-6 * heavier)
    return virtual_specimen(template, TRUTH, settings=settings).scanned(seed=2, scanner=EXACT).experiment


def test_a_block_settles_under_its_weight_as_a_column_does() -> None:
    """The settlement of a column is rho g h^2 / (2 E); its ends bulge freely but for friction on the table."""
    experiment = squeezed(50.0)
    body = specimen(experiment, ModelSettings(element_size_mm=6.0))
    values = {**TRUTH, friction("gel", "table"): 1e-3, platen_position(experiment, "pressed"): 50.0}
    resting = resting_state(solve(body.problem(values, "pressed")))
    assert resting is not None
    top = np.abs(body.mesh.points[:, 2] - SIZE[2]) < 1e-6
    expected = body.settings.density * 9810.0 * SIZE[2] ** 2 / (2.0 * YOUNG)
    assert -resting.displacement[top, 2].mean() == pytest.approx(expected, rel=0.05)
    weight = body.settings.density * 9810.0 * np.prod(SIZE)
    assert body.reactions(resting)["base of table"][2] == pytest.approx(weight, rel=1e-3)


def test_plates_that_do_not_press_leave_the_markers_where_the_reference_scan_saw_them() -> None:
    experiment = squeezed(50.0)
    body = specimen(experiment, ModelSettings(element_size_mm=8.0))
    case = MarkerLoadCase.of(body, "pressed", NoiseModel())
    parameters = initial_parameters([body], {experiment.name: ["pressed"]}, KnownMaterials())
    values = parameters.values() | TRUTH | {platen_position(experiment, "pressed"): experiment.full_platen_position_mm + 6.0}
    fit = Matcher([case], parameters).evaluate(values)[0]
    settled, left = (np.abs(body.at_markers(u)) for u in (fit.solution.displacement, fit.since_scan(fit.solution.displacement)))
    assert settled.max() > 0.2
    assert left.max() < 0.15 * settled.max()  # the plates leave while the sides bulge: friction on the table remembers that


def test_derivatives_count_what_the_reference_scan_has_seen() -> None:
    """By the modulus, which the settlement depends on, against differences of whole solutions."""
    experiment = squeezed(50.0)
    body = specimen(experiment, ModelSettings(element_size_mm=12.0, modulus="weighed"))
    parameters = initial_parameters([body], {experiment.name: ["pressed"]}, KnownMaterials({"gel": YOUNG}, scale_is_absolute=False))
    assert not next(p for p in parameters if p.name == young_modulus("gel")).fixed
    matcher = Matcher([MarkerLoadCase.of(body, "pressed", NoiseModel())], parameters)
    values = parameters.values() | TRUTH
    fit, at = matcher.evaluate(values)[0], [p.name for p in parameters.free].index(young_modulus("gel"))
    # solutions are right to about .001 mm: small steps would compare that
    ends = [matcher.evaluate(values | {young_modulus("gel"): YOUNG * f}, poses=[fit.pose])[0].predicted for f in (1.05, 0.95)]
    difference = (ends[0] - ends[1]) / (0.1 * YOUNG)
    np.testing.assert_allclose(fit.jacobian[:, :, at], difference, atol=0.03 * np.abs(difference).max())


def test_a_modulus_that_nobody_states_is_sought_where_only_the_weight_holds_an_object_of_known_height() -> None:
    known, measured = KnownMaterials(), datasets.load("ct_half_ellipsoid")
    somewhere = replace(measured, shape=replace(measured.shape, straight_base_mm=None))
    gel = young_modulus(measured.materials[0])

    def fixed(experiment: Experiment, known: KnownMaterials = known, **settings: Literal["given", "weighed"]) -> bool:
        body = specimen(experiment, ModelSettings(element_size_mm=20.0, **settings))
        parameters = {p.name: p for p in initial_parameters([body], {experiment.name: ["width_100"]}, known)}
        assert parameters[straight_base(experiment)].fixed == (experiment is measured)
        return parameters[gel].fixed

    assert not fixed(measured) and fixed(somewhere)
    assert not fixed(somewhere, modulus="weighed") and fixed(measured, modulus="given")
    assert fixed(measured, KnownMaterials({measured.materials[0]: 100.0}))


def test_a_stated_height_that_a_modulus_follows_from_is_uncertain_in_predictions() -> None:
    measured = datasets.load("ct_half_ellipsoid")
    body = specimen(measured, ModelSettings(element_size_mm=20.0))
    parameters = with_considered(body, initial_parameters([body], {measured.name: ["width_100"]}, KnownMaterials()))
    (base,) = (p for p in parameters.free if p.name == straight_base(measured))
    assert base.value == 20.0 and base.prior_sd == 1.0


def test_a_modulus_that_follows_from_the_weight_is_a_lower_bound_unless_nothing_else_is_said_to_hold_the_object() -> None:
    """Half of what holds this block down is not its weight, so that it looks half as stiff as it is."""
    experiment, name = squeezed(50.0, heavier=2.0), young_modulus("gel")
    settings = ModelSettings(element_size_mm=9.0)
    found = CalibratedModel.of(calibrate([experiment], settings=settings, with_mesh_error=False))
    low, high = found.interval(name)
    assert found.is_lower_bound(name) and low < YOUNG < high == np.inf
    assert found.interval_of_model(name)[1] < YOUNG  # what the model alone would have said
    assert np.isfinite(found.interval(poisson_ratio("gel"))).all()
    stated = replace(found, settings=replace(settings, modulus="weighed"))
    assert stated.interval(name) == found.interval_of_model(name)
    (row,) = (r for r in parameter_rows(found, [name]) if r.name == name)
    assert (row.lower, row.upper) == (low, np.inf) and "if nothing but its weight holds the object down" in row.remarks
    (card,) = parameter_cards([row])
    assert card.value == f"at least {low:.3g} kPa"
