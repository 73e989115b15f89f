"""Intervals that hold the form of the law: fields of gels that another program computed with other laws, identified as neo-Hookean."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.parameters import MAX_POISSON_RATIO
from naibu.identification.from_fields.assumptions.assumed_law import (
    DOES_NOT_FIT,
    HANGS_ON_LAW,
    NOT_SOUGHT,
    equivalent_strain,
    judged,
    told_changes,
    warned,
)
from naibu.identification.from_fields.assumptions.free_law import FreeLaw, _Joint
from naibu.identification.from_fields.assumptions.known_ratios import DOES_NOT_FIT as RATIO_DOES_NOT_FIT
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.load_cases import KNOWN, FieldLoadCase, Zones
from naibu.identification.from_fields.regions.relative_map import relative_to, zones_beside
from naibu.identification.from_fields.uncertainty import LawPart, Uncertainty, by_law, intervals
from naibu.identification.verdict import Explanation, Verdict
from naibu.meshing.primitives import box

SOFT, HARD, POISSON_RATIO = 100.0, 300.0, 0.45
FINE = 8  # elements along an edge, where what is looked for is as small as the error of larger ones
EXPLAINED = Verdict(Explanation.EXPLAINED, (), "small residuals", 1.0, 0.0, 0.0)


@cache
def found(law: str, cells: int = 6) -> FieldEstimate:
    """Identify the harder of two gels in a cube of 60 mm from 400 points of a field with noise of 1 % of its largest vector.

    The cube was compressed by a fifth between rough plates by another program: 250 quadratic hexahedra in a quarter, neo-Hookean with
    ``-mu ln J + lambda (ln J)^2 / 2``, and Yeoh's law of c20 1 and c30 0.5 times c10 with ``kappa (J - 1)^2 / 2``.
    """
    columns = {"neo_hookean": slice(3, 6), "yeoh": slice(6, 9)}
    table = np.loadtxt(Path(__file__).with_name("two_gels.csv"), delimiter=",", skiprows=1)
    return identified(table[:, :3], table[:, columns[law]], cells=cells)


def identified(points: FloatArray, u: FloatArray, seed: int = 1, poisson: float = POISSON_RATIO, cells: int = 6) -> FieldEstimate:
    """Identify the upper half of the cube from displacements (k, 3), mm, at points (k, 3), mm, to which noise is added."""
    mesh = box((60.0,) * 3, (cells,) * 3, layers=[("soft", 30.0), ("hard", 30.0)], centred=True)
    sd = 0.01 * float(np.linalg.norm(u, axis=1).max())
    noisy = u + sd * np.random.default_rng(seed).standard_normal(u.shape)
    field = DisplacementField.from_arrays(points, noisy, sd_mm=sd)
    plates = np.abs(np.abs(mesh.points[:, 2] - mesh.points[:, 2].mean()) - 30.0) < 1e-9
    zones = Zones.of(mesh, known={"soft": (SOFT, poisson)})
    return identify_field(mesh, [FieldLoadCase.of("pressed", field, mesh, loaded=plates)], zones, law="neo_hookean")


def test_a_gel_that_stiffens_is_held_and_the_verdict_says_that_the_law_does_not_fit() -> None:
    estimate = found("yeoh")
    low, high = estimate.intervals()[0][0]
    exact = estimate.intervals(law_exact=True)[0][0]
    assert low < HARD < high and not exact[0] < HARD < exact[1]
    assert low == pytest.approx(exact[0]) and high < 1.25 * HARD  # the data tell how it stiffens: the prior alone says nothing
    assert estimate.intervals()[1][0, 0] < POISSON_RATIO < estimate.intervals()[1][0, 1]
    verdict, free = estimate.verdict, estimate.free_law
    assert verdict is not None and free is not None and free.settled
    assert verdict.explanation is Explanation.IN_PART and verdict.reasons[0].startswith(DOES_NOT_FIT) and "hard" in verdict.reasons[0]
    assert free.probabilities["yeoh"] < 1e-6
    assert abs(free.shapes[0, 1] - 1.0) < 2.0 * free.shapes_sd[0, 1]
    assert any("If the law is exact" in line for line in estimate.identifiability)


def test_a_neo_hookean_gel_is_held_and_known_as_well_as_the_field_tells_its_law() -> None:
    estimate = found("neo_hookean", FINE)
    low, high = estimate.intervals()[0][0]
    exact = estimate.intervals(law_exact=True)[0][0]
    assert low < HARD < high and exact[0] < HARD < exact[1]
    assert high / low < 1.9  # with the prior of the law alone 12 times
    assert estimate.verdict is not None and estimate.verdict.sentence.startswith(f"Explained, but {HANGS_ON_LAW}")


def test_at_one_per_cent_of_strain_the_law_is_no_question() -> None:
    """One gel between smooth plates: its deformation is uniform."""
    points = np.random.default_rng(2).uniform([-29.0, -29.0, 1.0], [29.0, 29.0, 59.0], (400, 3))
    estimate = identified(points, 0.01 * points * [POISSON_RATIO, POISSON_RATIO, -1.0])
    assert estimate.free_law is None
    assert np.array_equal(estimate.intervals()[0], estimate.intervals(law_exact=True)[0])
    assert estimate.intervals()[0][0, 0] < SOFT < estimate.intervals()[0][0, 1]


def test_equivalent_strain_of_a_stretched_and_turned_bar() -> None:
    """An isochoric stretch by e has the equivalent strain e, at small strain; turning adds none."""
    mesh = box((10.0, 10.0, 20.0), (1, 1, 2), centred=False)
    angle = np.deg2rad(30.0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    moved = mesh.points * (1.0 + np.array([-0.5, -0.5, 1.0]) * 1e-4) @ turn.T
    assert equivalent_strain(mesh, moved - mesh.points) == pytest.approx(1e-4, rel=1e-3)


def test_bounds_hold_both_intervals() -> None:
    theta, plain = np.log([100.0, 8.0]), Uncertainty(np.eye(2), np.diag([0.01, 0.01]))
    shift, more = np.array([0.3, 0.0]), np.diag([0.02, 0.0])
    total = plain.with_law(LawPart(shift, more)).with_added(np.diag([0.01, 0.0]))
    own = plain.with_added(np.diag([0.01, 0.0]))
    young = intervals(theta, total)[0][0]
    assert young[0] == pytest.approx(intervals(theta, own)[0][0, 0])
    assert young[1] == pytest.approx(intervals(theta + shift, own.with_added(more))[0][0, 1])
    assert intervals(theta, total.if_law_exact)[0] == pytest.approx(intervals(theta, own)[0])
    assert by_law(total, theta).all() and not by_law(own, theta).any()


def test_where_no_equilibrium_is_found_with_the_law_free_that_is_said() -> None:
    theta, plain = np.log([100.0, 8.0]), Uncertainty(np.eye(2), np.diag([0.01, 0.01]))
    mesh = box((10.0, 10.0, 20.0), (1, 1, 2), layers=[("a", 10.0), ("b", 10.0)], centred=False)
    zones = Zones.of(mesh, known={"a": (10.0, 0.45)})
    assert judged(EXPLAINED, FreeLaw.lost(("a", "b"), 2), zones, theta, plain, elements_known=True) == (EXPLAINED, NOT_SOUGHT)
    assert judged(EXPLAINED, None, zones, theta, plain, elements_known=True) == (EXPLAINED, "")


def test_what_speaks_against_the_law_may_be_elements_where_their_error_is_not_known() -> None:
    """Where cells of half the size fell back to small strain, the law was blamed all the same."""
    theta, plain = np.log([100.0, 8.0]), Uncertainty(np.eye(2), np.diag([0.01, 0.01]))
    mesh = box((10.0, 10.0, 20.0), (1, 1, 2), layers=[("a", 10.0), ("b", 10.0)], centred=False)
    zones, none = Zones.of(mesh, known={"a": (10.0, 0.45)}), np.zeros((2, 4))
    free = FreeLaw(("a", "b"), np.array([0.3, 0.0]), np.zeros((2, 2)), none, none, {"yeoh": 1e-9}, settled=True)
    for known in (True, False):
        told = judged(EXPLAINED, free, zones, theta, plain, elements_known=known)[0].reasons[0]
        assert told.startswith(DOES_NOT_FIT) and ("elements are too large" in told) is not known and "that of b 35 % higher" in told


@pytest.mark.parametrize(("shift", "named"), [((0.5, 0.0), True), ((1.1, 0.0), False), ((-0.2, -58.0), False)])
def test_no_law_is_named_with_which_a_modulus_may_be_anything(shift: tuple[float, float], named: bool) -> None:
    """Where elements were too coarse for a Poisson's ratio of 0.4999, a modulus would be "100 % lower as in a yeoh law"."""
    theta, plain = np.log([100.0, 8.0]), Uncertainty(np.eye(2), np.diag([0.01, 0.01]))
    mesh = box((10.0, 10.0, 20.0), (1, 1, 2), layers=[("a", 10.0), ("b", 10.0)], centred=False)
    zones, none = Zones.of(mesh, known={"a": (10.0, 0.45)}), np.zeros((2, 4))
    free = FreeLaw(("a", "b"), np.array(shift), np.zeros((2, 2)), none, none, {"yeoh": 1e-9}, settled=False)
    found, hangs = judged(EXPLAINED, free, zones, theta, plain, elements_known=True)
    assert found.explanation is Explanation.IN_PART and found.reasons[0].startswith(DOES_NOT_FIT) is named and not hangs
    assert ("yeoh" in found.reasons[0]) is named and ("smaller elements first" in found.reasons[0]) is not named


def test_the_least_probability_of_three_laws_is_corrected_for_three_tries() -> None:
    theta, plain = np.log([100.0, 8.0]), Uncertainty(np.eye(2), np.diag([0.01, 0.01]))
    mesh = box((10.0, 10.0, 20.0), (1, 1, 2), layers=[("a", 10.0), ("b", 10.0)], centred=False)
    zones, none = Zones.of(mesh, known={"a": (10.0, 0.45)}), np.zeros((2, 4))
    for least, blamed in ((5e-4, False), (3e-4, True)):
        of_laws = {"mooney_rivlin": 0.3, "yeoh": least, "neo_hookean_isochoric": 0.6}
        free = FreeLaw(("a", "b"), np.array([0.3, 0.0]), np.zeros((2, 2)), none, none, of_laws, settled=True)
        found = judged(EXPLAINED, free, zones, theta, plain, elements_known=True)[0]
        assert any(reason.startswith(DOES_NOT_FIT) for reason in found.reasons) is blamed


def test_multiples_of_a_cell_change_as_those_of_the_largest_zone() -> None:
    """That the modulus which is 1 by definition would be another one was told of maps."""
    mesh = box((10.0, 10.0, 40.0), (1, 1, 4), centred=False)
    zones = zones_beside(mesh, 1)
    zones = replace(zones, of_cell=np.array([0, KNOWN, 0, 1]), names=("large", "small"))
    assert told_changes(zones, np.log([0.7, 0.7])) == ""
    assert told_changes(zones, np.log([0.5, 1.0])) == "that of small 100 % higher"


def test_a_map_says_first_that_it_takes_the_law_for_right() -> None:
    assert warned(0.01, ("Resolved.", "More.")) == ("Resolved.", "More.")
    first, second = warned(0.2, ("Resolved.", "More."))
    assert first.startswith("Resolved. The map takes the law for right at strains of 20 per cent") and second == "More."


def test_multiples_of_a_modulus_hold_the_form_of_the_law_of_both() -> None:
    theta, rng = np.log([100.0, 200.0, 8.0, 9.0]), np.random.default_rng(0)
    root = rng.standard_normal((4, 4))
    plain = Uncertainty(root @ root.T, np.linalg.inv(root @ root.T))
    law = LawPart(np.array([0.2, 0.2, 0.0, 0.0]), np.diag([0.04, 0.0, 0.0, 0.0]))
    relative, exact = relative_to(plain.with_law(law), theta, 0), relative_to(plain, theta, 0)
    np.testing.assert_allclose(relative.if_law_exact.covariance, exact.covariance, atol=1e-12)
    assert relative.law is not None
    assert relative.law.shift == pytest.approx(np.zeros(4))  # the same change of both moduli
    assert relative.law.covariance[1, 1] == pytest.approx(0.04)
    assert relative.of_young_and_poisson(theta)[0][0] == pytest.approx(0.0, abs=1e-6)


def test_with_the_law_free_no_ratio_leaves_the_range_of_searches() -> None:
    """A cube whose pressing keeps its volume: at the largest ratio of searches kappa / mu changes nothing, and went to any value."""
    points = np.random.default_rng(3).uniform([-29.0, -29.0, 1.0], [29.0, 29.0, 59.0], (400, 3))
    estimate = identified(points, points * ([0.94**-0.5 - 1.0] * 2 + [-0.06]), seed=3)
    free = estimate.free_law
    assert estimate.poisson_ratio[0] == pytest.approx(MAX_POISSON_RATIO) and free is not None and free.settled
    assert free.shift[1] == pytest.approx(0.0, abs=1e-9)


def test_a_wrong_poisson_ratio_of_a_known_gel_is_told_with_what_the_field_asks_for_and_counted() -> None:
    """With 0.49 for 0.45 of the soft gel the hard one would come out a sixth too soft."""
    table = np.loadtxt(Path(__file__).with_name("two_gels.csv"), delimiter=",", skiprows=1)
    wrong, right = identified(table[:, :3], table[:, 3:6], poisson=0.49, cells=FINE), found("neo_hookean", FINE)
    assert wrong.verdict is not None and right.verdict is not None
    assert wrong.verdict.explanation is Explanation.IN_PART
    assert f"{RATIO_DOES_NOT_FIT}: fields ask for some 0.45 instead of 0.49 of 'soft'" in wrong.verdict.sentence
    assert RATIO_DOES_NOT_FIT not in right.verdict.sentence
    low, high = wrong.intervals()[0][0]
    assert low < HARD < high


def test_a_combination_that_data_leave_open_is_no_root_of_less_than_none() -> None:
    """Rounding left its information just below 0, and numpy warned of the root of a negative variance."""
    turned = np.linalg.qr(np.random.default_rng(0).standard_normal((2, 2)))[0]
    quadratic: Any = SimpleNamespace(hessian=turned @ np.diag([1e4, -1e-9]) @ turned.T)
    there: Any = SimpleNamespace(added=np.zeros(1), point=SimpleNamespace(theta=np.zeros(2)))
    search: Any = SimpleNamespace(precision=np.ones(1), centre=np.zeros(1), n_shapes=1)
    moved = 0.02 * turned[:, :1] @ np.array([[1.0, 0.0]])
    joint = _Joint(there, quadratic, moved, [], [], np.eye(2), 1.0)
    with np.errstate(all="raise"):
        settled = joint.step(search).standard_deviations
    assert 0.0 < settled <= 2.0  # a step of two standard deviations of the combination that the data tell
