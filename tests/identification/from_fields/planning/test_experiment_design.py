"""The expected accuracy against a closed form and against repeated identifications."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.identification.from_fields.forward.sensitivities import FieldModel, logarithms, young_and_poisson
from naibu.identification.from_fields.inversion.gauss_newton import Objective, first_point, search
from naibu.identification.from_fields.planning.experiment_design import expected_accuracy
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.reproduction.chapter3.bodies import cube

SD_MM = 0.05

expect = partial(expected_accuracy, elements="as_given")  # of data that were computed with these very elements


def plan(sd_mm: float, noise: np.ndarray | float = 0.0):
    body = cube({"below": (0.25, 0.4)}, known=(0.3, 0.4), divisions=4)
    u = body.displacement((0.0, 0.0, -10.0)) + noise
    return body, [
        FieldLoadCase.of("push", DisplacementField.from_arrays(body.mesh.points, u, sd_mm=sd_mm), body.mesh, loaded=body.constrained)
    ]


def expected(sd_mm: float):
    body, trials = plan(sd_mm)
    return expect(body.mesh, trials, body.zones(), young_modulus=[0.25], poisson_ratio=[0.4])


def test_accuracy_is_proportional_to_noise_and_the_same_mesh_has_no_error_of_its_own() -> None:
    small, large = expected(SD_MM), expected(3.0 * SD_MM)
    np.testing.assert_allclose(large.young_modulus_sd, 3.0 * small.young_modulus_sd, rtol=1e-3)
    assert np.abs(small.young_modulus_bias).max() < 1e-3 * small.young_modulus_sd.min()


def test_two_trials_halve_the_variance() -> None:
    body, trials = plan(SD_MM)
    twice = expect(body.mesh, [*trials, *trials], body.zones(), young_modulus=[0.25], poisson_ratio=[0.4])
    np.testing.assert_allclose(twice.young_modulus_sd, np.sqrt(0.5) * expected(SD_MM).young_modulus_sd, rtol=1e-3)
    np.testing.assert_allclose(twice.poisson_ratio_sd, np.sqrt(0.5) * expected(SD_MM).poisson_ratio_sd, rtol=1e-3)


def test_repeated_identifications_scatter_as_expected() -> None:
    lame, shear = (np.array([v]) for v in lame_parameters(0.25, 0.4))
    rng, errors = np.random.default_rng(3), []
    for _ in range(40):
        body, trials = plan(SD_MM, SD_MM * rng.standard_normal((125, 3)))
        model = FieldModel(body.mesh, trials, body.zones(), elements="as_given")
        e, nu = young_and_poisson(search(model, first_point(model, logarithms(lame, shear)), Objective()).point.theta)
        errors.append([np.log(e[0] / 0.25), nu[0] - 0.4])
    a = expected(SD_MM)
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / [a.young_modulus_sd[0], a.poisson_ratio_sd[0]]
    assert ((ratio > 0.7) & (ratio < 1.3)).all(), ratio  # 40 draws: 11 % standard deviation


def test_bad_plans_are_told() -> None:
    body, trials = plan(0.0)
    with pytest.raises(InputError, match="sd_mm > 0"):
        expect(body.mesh, trials, body.zones(), young_modulus=[0.25], poisson_ratio=[0.4])
    with pytest.raises(InputError, match="1 zones"):
        expect(body.mesh, trials, body.zones(), young_modulus=[0.25, 1.0], poisson_ratio=[0.4, 0.4])
