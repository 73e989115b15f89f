"""Experiments that contradict each other are told, and others are not: against closed forms, and on virtual gels of known stiffness."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from pressed_gels import identified, identified_together
from scipy.stats import chi2

from naibu.core.parameters import Parameter, ParameterSet
from naibu.core.status import Status
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.from_markers.checks.contradicting_experiments import contradicted_experiments, contradiction, told_alone
from naibu.identification.from_markers.checks.verdict import verdict_of
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import LoadCaseFit
from naibu.identification.joint_estimate import NormalEstimate
from naibu.identification.verdict import Explanation

YOUNG, POISSON = "gel: young_modulus", "gel: poisson_ratio"
STIFFNESS = Parameter(YOUNG, 100.0, "kPa", "log", prior_sd=2.0)
GEL = (STIFFNESS, Parameter(POISSON, 0.48, "", "incompressibility", prior_sd=1.0))


def told(*values: float, sd: float) -> dict[str, NormalEstimate]:
    return {f"e{k}": NormalEstimate((YOUNG,), np.array([np.log(v)]), np.array([[sd**2]])) for k, v in enumerate(values)}


def test_probability_is_that_of_the_difference_of_two_estimates() -> None:
    covariances = [np.array([[0.01, 0.004], [0.004, 0.04]]), np.array([[0.004, -0.003], [-0.003, 0.03]])]
    values = [np.log([100.0, 0.04]), np.log([180.0, 0.05])]
    estimates = {n: NormalEstimate((YOUNG, POISSON), v, c) for n, v, c in zip("ab", values, covariances, strict=True)}
    apart = values[1] - values[0]
    expected = chi2.sf(apart @ np.linalg.inv(sum(covariances)) @ apart, 2)
    found = contradiction(estimates, GEL)
    assert found is not None and found.probability == pytest.approx(expected, rel=1e-6)


def test_of_three_experiments_the_two_that_differ_most_are_named() -> None:
    found = contradiction(told(100.0, 400.0, 120.0, sd=0.1), GEL)
    assert found is not None and found.experiments == ("e0", "e1") and found.values == pytest.approx((100.0, 400.0))
    logs = np.log([100.0, 400.0, 120.0])  # Cochran's Q of equal weights
    assert found.probability == pytest.approx(chi2.sf(((logs - logs.mean()) ** 2).sum() / 0.01, 2), rel=1e-6)


@pytest.mark.parametrize(
    ("values", "sd"),
    [
        ((100.0, 300.0), 0.5),  # as far apart as chance may put them
        ((100.0, 110.0), 0.001),  # certainly different, but hardly
        ((100.0,), 0.1),
    ],
)
def test_what_chance_explains_or_does_not_matter_is_no_contradiction(values: tuple[float, ...], sd: float) -> None:
    assert contradiction(told(*values, sd=sd), GEL) is None


def test_it_is_told_in_the_scale_that_is_known() -> None:
    found = contradiction(told(50.0, 150.0, sd=0.1), GEL)
    assert found is not None
    assert "e0 alone asks for gel: young_modulus of about 50 kPa, e1 alone for about 150 kPa" in found.in_words(
        KnownMaterials({"b": 200.0})
    )
    relative = found.in_words(KnownMaterials({"b": 200.0}, scale_is_absolute=False))
    assert "about 0.25 times that of b, e1 alone for about 0.75 times that of b" in relative
    assert "e0 alone asks for a lower gel: young_modulus than e1" in found.in_words()


def test_experiments_on_different_materials_do_not_contradict_each_other() -> None:
    other = NormalEstimate(("other: young_modulus",), np.log([900.0]), np.array([[0.01]]))
    assert contradiction({**told(100.0, sd=0.1), "b": other}, GEL) is None


def linear_calibration() -> tuple[Calibration, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Return two load cases whose markers depend linearly on ln E, an offset of their own and the pose; and their whitened equations."""
    rng = np.random.default_rng(5)
    priors = ParameterSet.of((STIFFNESS, *(Parameter(f"{n}: base_offset", 0.0, "mm", prior_sd=0.5) for n in ("one", "two"))))
    found = priors.with_values({YOUNG: 80.0, "one: base_offset": 0.2, "two: base_offset": -0.1})
    cases, fits, equations = [], [], {}
    unused = cast("Any", None)
    for k, name in enumerate(("one", "two")):
        slopes, poses, residual = np.zeros((40, 3, 3)), rng.normal(size=(40, 3, 6)), 0.1 * rng.normal(size=(40, 3))
        slopes[:, :, [0, 1 + k]] = rng.normal(size=(40, 3, 2))
        sd = np.full((40, 3), 0.2)
        physical = slopes / np.array([80.0, 1.0, 1.0])
        fits.append(LoadCaseFit(unused, unused, unused, residual, sd, physical, poses, ()))
        cases.append(SimpleNamespace(name=f"{name}/pressed", n_data=120, specimen=SimpleNamespace(experiment=SimpleNamespace(name=name))))
        design = np.concatenate([slopes[:, :, [0, 1 + k]], poses], axis=2).reshape(120, 8) / 0.2
        # the prior of ln E lies about the joint estimate, that of the offset where it was
        held = np.diag([1 / 2.0, 1 / 0.5, 0, 0, 0, 0, 0, 0])[:2]
        aim = np.array([0.0, -(0.2, -0.1)[k] / 0.5])
        equations[name] = np.concatenate([design, held]), np.concatenate([residual.ravel() / 0.2, aim])
    match = SimpleNamespace(parameters=found, fits=tuple(fits), status=Status.CONVERGED)
    return Calibration(tuple(cases), match, unused, unused, unused, priors), equations  # type: ignore[arg-type]


def test_each_experiment_alone_tells_its_own_least_squares_estimate() -> None:
    calibration, equations = linear_calibration()
    alone = told_alone(calibration)
    for name, (design, right) in equations.items():
        step = np.linalg.lstsq(design, right, rcond=None)[0]
        assert alone[name].names == (YOUNG,)
        assert alone[name].value(YOUNG) == pytest.approx(np.log(80.0) + step[0], rel=1e-9)
        assert alone[name].standard_deviation(YOUNG) == pytest.approx(np.sqrt(np.linalg.inv(design.T @ design)[0, 0]), rel=1e-9)


def test_gels_of_other_stiffness_are_told_with_both_values() -> None:
    found = identified_together(0.5)
    stages: list[str] = []
    judged = verdict_of(found, progress=lambda report: stages.append(report.stage))
    assert judged.explanation is Explanation.NOT_EXPLAINED and set(stages) == {"one alone", "two alone"}
    assert judged.sentence.startswith(
        "Not explained, do not use: experiments contradict each other: one alone asks for soft: young_modulus"
    )
    words = judged.reasons[0].split("about ")
    assert float(words[1].split()[0]) == pytest.approx(90.0, rel=0.1) and float(words[2].split()[0]) == pytest.approx(45.0, rel=0.1)
    assert contradicted_experiments(replace(found, match=replace(found.match, status=Status.INTERRUPTED))) == ()


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_gels_of_one_stiffness_do_not_contradict_each_other(seed: int) -> None:
    found = identified_together(1.0, seed=seed)
    assert contradicted_experiments(found) == ()
    told_of = [e.value("soft: young_modulus") for e in told_alone(found).values()]
    np.testing.assert_allclose(np.exp(told_of), 90.0, rtol=0.15)


def test_one_experiment_contradicts_nothing() -> None:
    assert told_alone(identified(10.0)) == {} and contradicted_experiments(identified(10.0)) == ()
