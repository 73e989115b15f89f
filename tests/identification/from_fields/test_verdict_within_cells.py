"""Zones that end inside of cells: determined moduli that move with the size of cells are no result, undetermined ones are told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.identification.from_fields.forward.sensitivities import logarithms
from naibu.identification.from_fields.uncertainty import Uncertainty
from naibu.identification.from_fields.verdicts.within_cells import HalfSize, judged_within_cells, told_alike, with_limits
from naibu.identification.verdict import Explanation, Verdict
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters

EXPLAINED = Verdict(Explanation.EXPLAINED, (), "residuals are those of noise", 1.0, 0.01, 0.0)
SHARED = "residuals are 1.4 times the stated noise, and neighbouring points share it: question law, zones and known values"
IN_PART = Verdict(Explanation.IN_PART, (SHARED,), "", 1.4, 0.2, 0.4)
NAMES = ("muscle", "skin")
OPEN = (0.02, 0.15, 0.05, 1.5)  # standard deviations from the measurement: of these numbers only kappa / mu of the skin is not determined


def half(
    young: tuple[float, float], poisson: tuple[float, float], sd: tuple[float, ...] = OPEN, beyond_noise: tuple[float, float] = (0.0, 0.0)
) -> HalfSize:
    """Return what elements of half the size make of a muscle of 11 kPa and a skin of 24 kPa with a ratio of 0.4."""
    fitted, theta = (
        logarithms(*(np.array(v) for v in zip(*(lame_parameters(e, nu) for e, nu in zip(es, nus, strict=True)), strict=True)))
        for es, nus in (((11.0, 24.0), (0.45, 0.40)), (young, poisson))
    )
    return HalfSize(fitted, theta, Uncertainty(np.diag(np.array(sd) ** -2.0), np.diag(np.array(sd) ** 2)), beyond_noise)


def test_a_ratio_that_is_not_determined_is_told_and_does_not_turn_the_verdict() -> None:
    judged = judged_within_cells(EXPLAINED, NAMES, half((10.0, 26.0), (0.45, 0.485)))
    assert judged.explanation is Explanation.EXPLAINED and judged.reasons == ()
    (note,) = judged.notes
    assert note.startswith("skin: the measurement does not determine kappa / mu, hence Poisson's ratio,") and "logarithm 1.5" in note
    kappa_over_mu = [2.0 * (1.0 + nu) / (3.0 * (1.0 - 2.0 * nu)) for nu in (0.485, 0.40)]
    assert f"{kappa_over_mu[0] / kappa_over_mu[1]:.2g} times" in note


@pytest.mark.parametrize(
    ("young", "poisson", "sd"),
    [
        ((10.0, 45.0), (0.45, 0.40), OPEN),  # Young's modulus of the skin
        ((6.0, 26.0), (0.45, 0.485), OPEN),  # of the muscle, whatever the ratio of the skin does
        ((10.0, 26.0), (0.45, 0.485), (0.02, 0.15, 0.05, 0.3)),  # a ratio that is determined
    ],
)
def test_a_determined_modulus_that_moves_never_passes(
    young: tuple[float, float], poisson: tuple[float, float], sd: tuple[float, ...]
) -> None:
    judged = judged_within_cells(EXPLAINED, NAMES, half(young, poisson, sd))
    assert not judged.ok
    assert "use smaller ones" in judged.sentence


def test_smaller_elements_are_no_advice_where_the_measurement_determines_nothing() -> None:
    judged = judged_within_cells(EXPLAINED, NAMES, half((10.0, 26.0), (0.45, 0.485), (80.0, 90.0, 0.8, 1.5)))
    assert not judged.ok
    assert "determines no Young's modulus (standard deviation of the logarithm 80 or more)" in judged.sentence
    assert "smaller" not in judged.sentence and "measure more points" in judged.sentence


def test_a_nearly_incompressible_zone_whose_ratio_moves_passes() -> None:
    """From 0.497 to 0.4995, cells took off most of mu / kappa, which is as little of any modulus as from 0.45 to 0.453."""
    muscle, skin = (11.0, 0.45), (24.0, 0.497)
    fitted, theta = (
        logarithms(*(np.array(v) for v in zip(*(lame_parameters(*one) for one in zones), strict=True)))
        for zones in ((muscle, skin), (muscle, (24.1, 0.4995)))
    )
    sure = np.diag(np.full(4, 0.02))
    moved = HalfSize(fitted, theta, Uncertainty(np.linalg.inv(sure), sure), (0.0, 0.0))
    assert judged_within_cells(EXPLAINED, NAMES, moved) == EXPLAINED


def test_moduli_that_stay_leave_the_verdict_as_it_is() -> None:
    assert judged_within_cells(IN_PART, NAMES, half((10.0, 26.0), (0.46, 0.41))) == IN_PART


def test_the_factor_told_is_that_of_the_moduli_that_are_judged() -> None:
    """The ratio of the skin moves 7 times, which is not determined; Young's modulus of the muscle halves."""
    told = judged_within_cells(EXPLAINED, NAMES, half((5.5, 26.0), (0.45, 0.485))).sentence
    assert "moduli would change 2 times" in told


def test_shared_residuals_that_smaller_elements_leave_come_first() -> None:
    moved = half((5.5, 26.0), (0.45, 0.40), beyond_noise=(4000.0, 3900.0))
    stay = judged_within_cells(IN_PART, NAMES, moved)
    assert not stay.ok and stay.reasons[0] == SHARED
    assert "elements of half the size leave such residuals as well" in stay.reasons[1] and "use smaller ones" not in stay.sentence
    fall = judged_within_cells(IN_PART, NAMES, replace(moved, beyond_noise=(4000.0, 500.0)))
    assert not fall.ok and "use smaller ones" in fall.reasons[0] and fall.reasons[1] == SHARED


@pytest.mark.parametrize("judged", [EXPLAINED, IN_PART])
def test_a_modulus_that_elements_leave_open_is_in_the_first_sentence(judged: Verdict) -> None:
    bounds = np.array([[8.0, 12.5], [8.0, 72.0]])
    told = with_limits(judged, NAMES, np.array([0.1, 0.5]), bounds)
    start, _, end = told.sentence.partition(": ")
    assert start.endswith(", but elements of this size tell Young's modulus only roughly, that of skin within a factor of 3")
    assert "muscle" not in start and end == judged.sentence.partition(": ")[2]
    assert told.reservation == told.sentence and told.ok
    both = with_limits(judged, NAMES, np.array([0.3, 0.5]), bounds).sentence
    assert "that of muscle within a factor of 1.2 and that of skin within a factor of 3: " in both


def test_what_the_measurement_leaves_open_is_in_the_first_sentence() -> None:
    """Whatever the cause: residuals of noise say nothing of a modulus that may be a tenth or ten times as much."""
    bounds = np.array([[8.0, 18.0], [2.0, 160.0]])
    for of_mesh in (np.array([0.05, 0.1]), None, np.array([0.05, 1.1])):
        told = with_limits(EXPLAINED, NAMES, of_mesh, bounds).sentence
        assert told.startswith("Explained, but Young's modulus of skin (95 % from 2 to 160 kPa) is not determined; ")
        assert "the measurement tells Young's modulus only roughly, that of muscle within a factor of 1.5: " in told
    nothing = np.array([[8.0, 12.0], [0.0, np.inf]])
    assert "Young's modulus of skin (on which there is no information) is not determined: " in (
        with_limits(EXPLAINED, NAMES, None, nothing).sentence
    )
    refused = replace(EXPLAINED, explanation=Explanation.NOT_EXPLAINED)
    assert with_limits(refused, NAMES, None, bounds) is refused


def test_a_region_that_may_be_of_the_material_around_it_is_told() -> None:
    """Young's moduli of 10 and 11 kPa with standard errors of a tenth are alike; those of 10 and 20 kPa are not, nor with common errors."""
    theta = logarithms(*np.array([lame_parameters(e, 0.45) for e in (10.0, 11.0, 20.0)]).T)
    names = ("body", "edge", "lump")
    apart = Uncertainty(np.eye(6), np.diag([0.1**2] * 3 + [1e-6] * 3))
    assert told_alike(names, theta, apart, 0) == "Young's modulus of edge may be that of body"
    common = Uncertainty(np.eye(6), np.diag([1e-6] * 6) + 0.1**2 * np.outer([1, 1, 1, 0, 0, 0], [1, 1, 1, 0, 0, 0]))
    assert told_alike(names, theta, common, 0) == ""


def test_moduli_that_elements_determine_leave_the_verdict_as_it_is() -> None:
    bounds = np.array([[10.0, 12.0], [20.0, 30.0]])
    for small in (np.array([0.05, 0.1]), np.full(2, np.nan), None):
        assert with_limits(EXPLAINED, NAMES, small, bounds) is EXPLAINED
    assert EXPLAINED.reservation == ""


THIN = np.array([False, True])


def test_a_thin_zone_that_moves_is_set_apart_and_named_and_the_others_stand() -> None:
    """Young's modulus of the skin changes 1.9 times; that of the muscle, whose interval holds what the skin may be, by a tenth."""
    judged = judged_within_cells(EXPLAINED, NAMES, half((10.0, 45.0), (0.45, 0.40)), THIN)
    assert judged.ok and judged.explanation is Explanation.IN_PART
    assert judged.mesh_dependent == ("skin",) and judged.to_dict()["mesh_dependent"] == ["skin"]
    assert judged.sentence.startswith("Explained in part, but elements of this size do not determine skin (with half their size its moduli")
    assert judged.reservation == judged.sentence and "muscle" not in judged.limits


@pytest.mark.parametrize(
    ("young", "poisson", "sd"),
    [
        ((6.0, 26.0), (0.45, 0.485), OPEN),  # the muscle, which is not thin
        ((6.0, 45.0), (0.45, 0.40), OPEN),  # both
        ((10.0, 45.0), (0.45, 0.40), (0.8, 0.15, 0.8, 1.5)),  # none but that of the skin
    ],
)
def test_nothing_stands_where_another_zone_moves_or_none_is_determined(
    young: tuple[float, float], poisson: tuple[float, float], sd: tuple[float, ...]
) -> None:
    judged = judged_within_cells(EXPLAINED, NAMES, half(young, poisson, sd), THIN)
    assert not judged.ok and judged.mesh_dependent == ()
    assert "use smaller ones" in judged.sentence
