"""Displacements that grow through a body while it is scanned, of a body that other code solves."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.assumptions.assumed_law import DOES_NOT_FIT
from naibu.identification.from_fields.assumptions.scaled_displacements import SCALED, Scaling, judged_scaling, unless_explained
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.uncertainty import Uncertainty
from naibu.identification.verdict import Explanation, Verdict
from naibu.validation.specimens.quadratic_body import UNKNOWN, QuadraticBody

NOISE_MM = 0.02


def identified(growth: float, axis: int = 2, *, surface: bool = False) -> FieldEstimate:
    """Identify the lower half of a cube from displacements that are scaled along an axis, their mean as it was."""
    body = QuadraticBody("cube")
    mesh, loaded = body.model(6, "hexahedron")
    if surface:
        loaded = ((mesh.points < 1e-9) | (mesh.points > mesh.points.max() - 1e-9)).any(axis=1)
    rng = np.random.default_rng(0)
    parameters = rng.uniform(0.01, 0.99, (1000, 3))
    points, u = body.solved((1.0, 0.0, -2.0), divisions=4).at(parameters)
    measured = u * (1.0 + growth * (parameters[:, axis, None] - 0.5)) + NOISE_MM * rng.standard_normal(u.shape)
    field = DisplacementField.from_arrays(points, measured, sd_mm=NOISE_MM)
    zones = Zones.of(mesh, known={"known": (10.0, 0.4)})
    return identify_field(mesh, [FieldLoadCase.of("pressed", field, mesh, loaded=loaded)], zones)


@pytest.mark.parametrize(("growth", "word"), [(0.12, "grow by 1"), (-0.12, "shrink by 1")])
def test_intervals_hold_the_truth_and_the_verdict_names_the_axis(growth: float, word: str) -> None:
    found = identified(growth)
    (low, high), (least, most) = found.intervals()[0][0], found.intervals()[1][0]
    assert low < UNKNOWN[0] < high and least < UNKNOWN[1] < most
    assert found.verdict is not None and found.verdict.explanation is Explanation.IN_PART
    told = found.verdict.reasons[0]
    assert f"displacements {word}" in told and "along z" in told and SCALED in told


@pytest.mark.parametrize("surface", [False, True])
def test_right_displacements_are_not_said_to_grow(surface: bool) -> None:
    found = identified(0.0, surface=surface)
    assert found.verdict is not None and SCALED not in found.verdict.sentence


def test_a_growth_is_told_last_where_other_assumptions_explain_more() -> None:
    mesh = QuadraticBody("cube").model(2, "hexahedron")[0]
    zones, theta = Zones.of(mesh, known={"known": (10.0, 0.4)}), np.log([5.0, 8.0])
    found, total = Scaling(0, 0.08, 30.0, np.array([0.3, 0.0])), Uncertainty(np.diag([100.0, 100.0]), np.diag([0.01, 0.01]))
    plain = Verdict(Explanation.IN_PART, ("another reason",), "lead", 1.0, 0.0, 0.5)
    for explained, place in ((20.0, 0), (40.0, 1)):
        told = judged_scaling(plain, found, zones, theta, total, explained)
        assert "grow by 8 % along x" in told.reasons[place] and "that of unknown 35 % higher" in told.reasons[place]
    assert judged_scaling(plain, None, zones, theta, total, 0.0) is plain
    assert judged_scaling(plain, found, zones, theta, total, 20.0, coarse=True) is plain  # errors of elements are not known then
    assert judged_scaling(plain, Scaling(0, 0.08, 30.0, np.array([0.01, 0.0])), zones, theta, total, 0.0) is plain


def test_a_growth_that_another_law_explains_is_not_counted() -> None:
    found, plain = Scaling(0, 0.08, 30.0, np.array([0.3, 0.0])), Verdict(Explanation.IN_PART, ("another reason",), "lead", 1.0, 0.0, 0.5)
    of_law = Verdict(Explanation.IN_PART, (DOES_NOT_FIT,), "lead", 1.0, 0.0, 0.5)
    assert unless_explained(found, of_law, 40.0, 0.0) is None and unless_explained(found, of_law, 20.0, 0.0) is found
    assert unless_explained(found, plain, 40.0, 0.0) is found
