"""A body that changes its volume by itself while it is loaded, as other code solves it."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.assumptions.eigenstrain import (
    BY_ITSELF,
    WHOLE,
    Eigenstrain,
    asked_eigenstrain,
    judged_eigenstrain,
)
from naibu.identification.from_fields.assumptions.scaled_displacements import SCALED
from naibu.identification.from_fields.assumptions.score_test import Asked, ScoreTest
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel
from naibu.identification.from_fields.inversion.gauss_newton import first_point
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


@pytest.mark.parametrize(("poisson", "growth", "confined", "named"), [
    (0.4999, 0.78, True, False), (0.4999, 0.05, False, True), (0.4999, 1e-4, True, True), (0.3, 0.1, True, True),
])  # fmt: skip
def test_a_growth_that_confinement_would_hold_back_is_none(poisson: float, growth: float, confined: bool, named: bool) -> None:
    """Of a nearly incompressible body whose whole surface was prescribed, it was said that it grows by 78 %: what of that is seen is nil.

    The pressure against it is the bulk modulus times the growth, 5000 times the shear modulus at a Poisson's ratio of 0.4999.
    """
    body = QuadraticBody("cube", unknown=(5.0, poisson), known=(10.0, poisson))
    solved, (mesh, plates) = body.solved((1.0, 0.0, -1.5), divisions=2), body.model(4, "hexahedron")
    points, u = solved.at(np.random.default_rng(0).uniform(0.01, 0.99, (300, 3)))
    surface = (np.abs(mesh.points - 0.5 * SIDE_MM) > 0.499 * SIDE_MM).any(axis=1)
    field = DisplacementField.from_arrays(points, u, sd_mm=NOISE_MM)
    case = FieldLoadCase.of("pressed", field, mesh, loaded=surface if confined else plates)
    model = FieldModel(mesh, [case], Zones.of(mesh, known={"known": body.known}))
    shear = body.unknown[0] / (2.0 * (1.0 + poisson))
    ratio = 2.0 * (1.0 + poisson) / (3.0 * (1.0 - 2.0 * poisson))
    at = model.linearised(first_point(model, np.log([shear, ratio])))

    class Asks:
        """A field that asks for this growth of all materials."""

        errors = np.ones(1)

        def __init__(self) -> None:
            self.at = at

        def of_residuals(self, changes: Any) -> Asked:
            """Return how much."""
            assert len(changes) == 1
            return Asked(growth, 1e3 / growth**2, np.zeros(2), 0.0)

    found = asked_eigenstrain(cast(ScoreTest, Asks()), 1.0, np.ones(2))
    assert (found is not None) is named
