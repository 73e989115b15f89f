"""Names of parameters as readers of a report see them, and sentences that do not contradict the numbers."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from naibu.core.parameters import Parameter, ParameterSet
from naibu.core.status import Status
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import NoiseModel
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.workflows.results.report_content import parameter_label, parameter_rows, search_sentence, undetermined


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("hardness 0: young_modulus", "hardness 0: Young's modulus"),
        ("soft: poisson_ratio", "soft: Poisson's ratio"),
        ("soft on table: friction", "soft on table: friction"),
        ("cube/deformed: height", "cube/deformed: height"),
        ("my_gel: c01_fraction", "my_gel: C01 / (C10 + C01)"),
        ("my_gel: c20_ratio", "my_gel: C20 / C10"),
        ("young_modulus", "Young's modulus"),
    ],
)
def test_labels_are_the_terms_of_the_field(name: str, label: str) -> None:
    assert parameter_label(name) == label


def model_of(parameter: Parameter, sd: float) -> CalibratedModel:
    known = KnownMaterials({"other": 1.0})
    return CalibratedModel(ModelSettings(), ParameterSet.of([parameter]), np.array([[sd**2]]), NoiseModel(), 1.0, known, ())


MODULUS = Parameter("gel: young_modulus", 12.6, "kPa", "log", prior_sd=2.0)
RATIO = Parameter("gel: poisson_ratio", 0.48, "", "incompressibility", prior_sd=1.0)
FRICTION = Parameter("gel on table: friction", 0.4, "", "log", prior_sd=10.0)


@pytest.mark.parametrize(
    ("parameter", "sd", "told"),
    [
        (MODULUS, 1.5, "the data hardly determine it; 12.6 kPa was found; 200 kPa was assumed beforehand."),
        (MODULUS, 0.1, ""),
        (RATIO, 0.5, ""),
        (RATIO, 1.6, "the data hardly determine it; 0.48 was found."),
        (RATIO, 1.9, "the data leave it open between -0.31 and 0.5."),
        (RATIO, 70.0, "the data leave it open between -1.00 and 0.5."),
        (FRICTION, 1.0, "known only to lie between 0.056 and 2.8"),
        (FRICTION, 0.5, ""),
    ],
)
def test_what_is_said_of_a_parameter_agrees_with_its_interval(parameter: Parameter, sd: float, told: str) -> None:
    priors = ParameterSet.of([Parameter(MODULUS.name, 200.0, "kPa", "log", prior_sd=2.0)])
    model = model_of(parameter, sd)
    said = undetermined(model, [parameter.name], priors)
    assert ("".join(said).find(told) >= 0) and bool(said) == bool(told), said
    low, high = model.interval(parameter.name)
    assert low <= parameter.value <= high


def test_a_modulus_that_hangs_on_the_law_has_the_interval_that_does_not_and_the_other_beside() -> None:
    sure = model_of(MODULUS, 0.08)
    for by_law, told in ((0.29, True), (0.05, False), (None, False)):
        law = None if by_law is None else np.array([[by_law**2]])
        model = replace(sure, covariance=sure.covariance + (0.0 if law is None else law), law_covariance=law)
        (row,) = parameter_rows(model, [MODULUS.name])
        said = "".join(undetermined(model, [MODULUS.name]))
        half = 1.959964 * np.hypot(0.08, by_law or 0.0)
        assert (row.lower, row.upper) == pytest.approx((12.6 * np.exp(-half), 12.6 * np.exp(half)))
        assert bool(row.beside) == ("model-form uncertainty" in said) == told
        if told:
            assert row.beside == "10.8 to 14.7 if the law is exactly neo_hookean"  # 12.6 exp(-+ 1.96 0.08)
        assert model.interval(MODULUS.name, law_exact=True) == pytest.approx(sure.interval(MODULUS.name))
        again = CalibratedModel.from_dict(json.loads(json.dumps(model.to_dict())))
        assert again.interval(MODULUS.name, law_exact=True) == model.interval(MODULUS.name, law_exact=True)


def test_moduli_are_multiples_where_none_is_known() -> None:
    stiff = Parameter("stiff: young_modulus", 200.0, "kPa", fixed=True)
    soft, spring = Parameter("soft: young_modulus", 50.0, "kPa", "log"), Parameter("soft on table: friction", 10.0, "kPa/mm", "log")
    parameters, covariance = ParameterSet.of([soft, spring, stiff]), np.diag([0.01, 0.01])
    names = [soft.name, spring.name]
    for absolute, factor, unit in ((True, 1.0, "kPa"), (False, 1.0 / 200.0, "× stiff")):
        known = KnownMaterials({"stiff": 200.0}, absolute)
        model = CalibratedModel(ModelSettings(), parameters, covariance, NoiseModel(), 1.0, known, ())
        found = {row.name: row for row in parameter_rows(model, names)}
        assert [found[p.name].unit for p in (soft, spring, stiff)] == [unit, f"{unit}/mm", unit]
        assert [found[p.name].estimate for p in (soft, spring, stiff)] == [factor * p.value for p in (soft, spring, stiff)]
        assert found[soft.name].lower == pytest.approx(factor * 50.0 * np.exp(-0.1959964))


def test_bounds_are_physical_however_little_is_known() -> None:
    for sd in (5.0, 70.0, 1e6):
        low, high = model_of(RATIO, sd).interval(RATIO.name)
        assert low == -1.0 and 0.499 < high <= 0.4995
        assert model_of(MODULUS, sd).interval(MODULUS.name) == (0.0, np.inf)
        (row,) = parameter_rows(model_of(MODULUS, sd), [MODULUS.name])
        assert row.estimate == 12.6 and row.lower == -np.inf and row.upper == np.inf  # the page and the terminal show no bound
    low, high = model_of(MODULUS, 1.0).interval(MODULUS.name)
    assert (low, high) == pytest.approx((12.6 * np.exp(-1.959964), 12.6 * np.exp(1.959964)))


def test_an_early_end_is_not_called_a_result() -> None:
    assert search_sentence(Status.CONVERGED) == "The search converged."
    assert "may be used" not in search_sentence(Status.ITERATION_LIMIT)
