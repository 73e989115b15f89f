"""A body that changes its volume by itself while it is loaded, as other code solves it."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.assumptions.eigenstrain import BY_ITSELF, WHOLE, Eigenstrain, judged_eigenstrain
from naibu.identification.from_fields.assumptions.scaled_displacements import SCALED
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.verdict import Explanation, Verdict
from naibu.validation.specimens.quadratic_body import SIDE_MM, UNKNOWN, QuadraticBody

NOISE_MM = 0.01


def identified(stretch: float) -> FieldEstimate:
    """Return what is found of the lower half of a cube that is sheared and pressed, and longer by `stretch` in all directions besides."""
    body = QuadraticBody("cube")
    solved, (mesh, loaded) = body.solved((1.0, 0.0, -1.5), divisions=6), body.model(6, "hexahedron")
    rng = np.random.default_rng(0)
    points, u = solved.at(rng.uniform(0.01, 0.99, (1000, 3)))
    u = u + stretch * (points - 0.5 * SIDE_MM) + NOISE_MM * rng.standard_normal(u.shape)
    case = FieldLoadCase.of("warmed", DisplacementField.from_arrays(points, u, sd_mm=NOISE_MM), mesh, loaded=loaded)
    return identify_field(mesh, [case], Zones.of(mesh, known={"known": body.known}))


@pytest.mark.parametrize("stretch", [0.01, -0.01])
def test_a_body_that_grows_or_shrinks_is_named_with_its_change_of_volume(stretch: float) -> None:
    found = identified(stretch)
    assert found.verdict is not None
    told = found.verdict.reasons[0]
    assert told.startswith(f"{WHOLE} {BY_ITSELF}") and SCALED not in found.verdict.sentence
    assert float(told.split("by some ")[1].split(" %")[0]) == pytest.approx(300.0 * stretch, rel=0.2)
    low, high = found.intervals()[0][0]
    assert low < UNKNOWN[0] < high


def test_a_body_that_keeps_its_volume_is_not_said_to_change_it() -> None:
    found = identified(0.0)
    assert found.verdict is not None and BY_ITSELF not in found.verdict.sentence


def test_a_change_of_volume_is_told_where_it_explains_residuals_or_changes_moduli() -> None:
    mesh = QuadraticBody("cube").model(2, "hexahedron")[0]
    zones, theta = Zones.of(mesh, known={"known": (10.0, 0.4)}), np.log([5.0, 8.0])
    plain, right = Verdict(Explanation.IN_PART, ("another reason",), "lead", 2.0, 0.1, 0.5), Verdict(Explanation.EXPLAINED, (), "", 1, 0, 0)
    little, much = (Eigenstrain(WHOLE, 0.03, 100.0, np.array([change, 0.0])) for change in (0.01, -0.3))
    assert "by some +3 %" in judged_eigenstrain(plain, little, zones, theta, 50.0).reasons[0]
    assert judged_eigenstrain(plain, little, zones, theta, 200.0) is plain
    assert judged_eigenstrain(right, little, zones, theta, 50.0) is right
    assert "that of unknown 26 % lower" in judged_eigenstrain(plain, much, zones, theta, 200.0).reasons[1]
    assert judged_eigenstrain(right, None, zones, theta, 0.0) is right
