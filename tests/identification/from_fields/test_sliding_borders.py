"""A zone that slides along another, in bodies that other code solves."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.assumptions.averaged_displacements import AVERAGES
from naibu.identification.from_fields.assumptions.scaled_displacements import SCALED
from naibu.identification.from_fields.assumptions.sliding_borders import SLIDES, Sliding, judged_sliding
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.verdict import Explanation, Verdict
from naibu.validation.specimens.quadratic_body import UNKNOWN, QuadraticBody

NOISE_MM = 0.01
PUSH = (0.4, 0.0, -1.5)


def identified(shape: str, *, sliding: bool) -> tuple[FieldEstimate, float]:
    """Return what is found of the lower half, and the root mean square jump at the border, mm."""
    body = QuadraticBody(shape, sliding=sliding)
    solved = body.solved(PUSH, divisions=6)
    mesh, loaded = body.model(6, "hexahedron")
    rng = np.random.default_rng(0)
    points, u = solved.at(rng.uniform(0.01, 0.99, (1000, 3)))
    field = DisplacementField.from_arrays(points, u + NOISE_MM * rng.standard_normal(u.shape), sd_mm=NOISE_MM)
    there = np.column_stack([rng.uniform(0.0, 1.0, (500, 2)), np.full(500, 0.5)])
    jump = solved.at(there)[1] - solved.at(there - [0.0, 0.0, 1e-9])[1]
    zones = Zones.of(mesh, known={"known": body.known})
    found = identify_field(mesh, [FieldLoadCase.of("pressed", field, mesh, loaded=loaded)], zones)
    return found, float(np.sqrt((jump**2).sum(axis=1).mean()))


@pytest.mark.parametrize("shape", ["cube", "barrel"])
def test_a_border_that_slides_is_named_with_its_jump_and_no_other_cause(shape: str) -> None:
    found, jump = identified(shape, sliding=True)
    assert found.verdict is not None and found.verdict.explanation is Explanation.IN_PART
    told = found.verdict.reasons[0]
    assert SLIDES in told and "across the border of known and unknown" in told
    assert float(told.split("some ")[1].split(" mm")[0]) == pytest.approx(jump, rel=0.2)
    assert SCALED not in found.verdict.sentence and AVERAGES not in found.verdict.sentence
    low, high = found.intervals()[0][0]
    assert low < UNKNOWN[0] < high


def test_bonded_zones_are_not_said_to_slide() -> None:
    found, jump = identified("tapered", sliding=False)
    assert jump < 1e-6 and found.verdict is not None and SLIDES not in found.verdict.sentence


def test_a_jump_is_told_where_it_explains_residuals_or_changes_moduli() -> None:
    mesh = QuadraticBody("cube").model(2, "hexahedron")[0]
    zones, theta = Zones.of(mesh, known={"known": (10.0, 0.4)}), np.log([5.0, 8.0])
    plain, right = Verdict(Explanation.IN_PART, ("another reason",), "lead", 2.0, 0.1, 0.5), Verdict(Explanation.EXPLAINED, (), "", 1, 0, 0)
    little, much = (Sliding(("known", "unknown"), 0.3, 100.0, np.array([change, 0.0])) for change in (0.01, -0.3))
    assert judged_sliding(plain, little, zones, theta, 50.0).reasons[0].endswith("or a thin soft layer lies between them")
    assert judged_sliding(plain, little, zones, theta, 200.0) is plain and judged_sliding(right, little, zones, theta, 50.0) is right
    assert "that of unknown 26 % lower" in judged_sliding(plain, much, zones, theta, 200.0).reasons[1]
    assert judged_sliding(right, much, zones, theta, 50.0).explanation is Explanation.IN_PART
    assert judged_sliding(plain, None, zones, theta, 0.0) is plain
