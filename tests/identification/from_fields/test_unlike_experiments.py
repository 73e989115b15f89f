"""Two experiments with a body that other code solves, one half of which may have another stiffness in the second."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.assumptions.unlike_experiments import UNLIKE, Difference, judged_difference
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.verdict import Explanation, Verdict
from naibu.validation.specimens.quadratic_body import UNKNOWN, QuadraticBody

NOISE_MM = 0.01


@cache
def identified(relaxed: float) -> FieldEstimate:
    """Return what is found of the lower half, the modulus of which is `relaxed` times as large in the second experiment."""
    cases, rng = [], np.random.default_rng(0)
    for name, part, push in (("first", 1.0, (1.0, 0.0, -1.5)), ("second", relaxed, (0.0, 1.0, -1.5))):
        body = QuadraticBody("cube", unknown=(part * UNKNOWN[0], UNKNOWN[1]))
        mesh, loaded = body.model(6, "hexahedron")
        points, u = body.solved(push, divisions=4).at(rng.uniform(0.01, 0.99, (600, 3)))
        field = DisplacementField.from_arrays(points, u + NOISE_MM * rng.standard_normal(u.shape), sd_mm=NOISE_MM)
        cases.append(FieldLoadCase.of(name, field, mesh, loaded=loaded))
    return identify_field(mesh, cases, Zones.of(mesh, known={"known": body.known}))


def test_a_zone_that_relaxes_between_two_experiments_is_named_and_its_interval_holds_both_moduli() -> None:
    found = identified(0.6)
    assert found.verdict is not None and found.verdict.explanation is not Explanation.EXPLAINED
    told = found.verdict.reasons[0]
    assert told.startswith(f"{UNLIKE}: in first, unknown is") and "stiffer than in second" in told
    assert float(told.split("unknown is ")[1].split(" %")[0]) == pytest.approx(100.0 * (1.0 / 0.6 - 1.0), rel=0.2)
    low, high = found.intervals()[0][0]
    assert low < 0.6 * UNKNOWN[0] < UNKNOWN[0] < high


def test_experiments_with_the_same_moduli_do_not_contradict_each_other() -> None:
    found = identified(1.0)
    assert found.verdict is not None and found.verdict.explanation is Explanation.EXPLAINED and UNLIKE not in found.verdict.sentence


def test_a_difference_is_told_where_it_is_large_and_first_where_it_explains_most() -> None:
    mesh = QuadraticBody("cube").model(2, "hexahedron")[0]
    zones = Zones.of(mesh, known={"known": (10.0, 0.4)})
    plain = Verdict(Explanation.IN_PART, ("another reason",), "lead", 2.0, 0.1, 0.5)
    much, little = (Difference("third", "the others", 0, change, 100.0, np.zeros(2)) for change in (np.log(0.7), 0.05))
    assert judged_difference(plain, None, zones, 50.0) is plain and judged_difference(plain, little, zones, 50.0) is plain
    first = judged_difference(plain, much, zones, 50.0).reasons
    assert "in third, unknown is 30 % softer than in the others" in first[0] and first[1] == "another reason"
    assert judged_difference(plain, much, zones, 200.0).reasons[0] == "another reason"
