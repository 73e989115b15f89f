"""A mask that ends within the object, whose surface is then not free where the model has it, in bodies that other code solves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.assumptions.assumed_law import DOES_NOT_FIT
from naibu.identification.from_fields.assumptions.averaged_displacements import AVERAGES
from naibu.identification.from_fields.assumptions.free_surface import FREE_SURFACE, SurfacePlace, judged_surface
from naibu.identification.from_fields.assumptions.other_readings import EXCHANGED, PLACED_LATER, REVERSED
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.verdict import Explanation, Verdict
from naibu.validation.specimens.quadratic_body import SIDE_MM, UNKNOWN, QuadraticBody

NOISE_MM = 0.005


def identified(rim_mm: float) -> FieldEstimate:
    """Return what is found of the lower half of a cube on a mesh that leaves out a rim of it."""
    body = QuadraticBody("cube")
    solved, (mesh, loaded) = body.solved((0.4, 0.0, -1.5), divisions=6), body.model(6, "hexahedron")
    kept = np.array([1.0 - 2.0 * rim_mm / SIDE_MM] * 2 + [1.0])
    mesh = replace(mesh, points=0.5 * SIDE_MM + kept * (mesh.points - 0.5 * SIDE_MM))
    rng = np.random.default_rng(0)
    points, u = solved.at(0.5 + kept * (rng.uniform(0.01, 0.99, (1000, 3)) - 0.5))
    field = DisplacementField.from_arrays(points, u + NOISE_MM * rng.standard_normal(u.shape), sd_mm=NOISE_MM)
    case = FieldLoadCase.of("pressed", field, mesh, loaded=loaded)
    return identify_field(mesh, [case], Zones.of(mesh, known={"known": body.known}), law="neo_hookean")


def test_a_rim_that_is_left_out_is_named_with_its_thickness_and_no_other_cause() -> None:
    found = identified(3.0)
    assert found.verdict is not None and found.verdict.explanation is Explanation.IN_PART
    told = found.verdict.reasons[-1]
    assert FREE_SURFACE in told and "outside of where mask or zones have it" in told
    assert float(told.split("some ")[1].split(" mm")[0]) == pytest.approx(3.0, rel=0.5)  # to first order
    assert not any(other in found.verdict.sentence for other in (DOES_NOT_FIT, REVERSED, EXCHANGED, PLACED_LATER, AVERAGES))
    low, high = found.intervals()[0][0]
    assert low < UNKNOWN[0] < high


def test_a_surface_that_is_right_is_not_blamed() -> None:
    found = identified(0.0)
    assert found.verdict is not None and FREE_SURFACE not in found.verdict.sentence


def test_a_surface_takes_the_place_of_another_law_where_it_explains_more() -> None:
    mesh = QuadraticBody("cube").model(2, "hexahedron")[0]
    zones, theta = Zones.of(mesh, known={"known": (10.0, 0.4)}), np.log([5.0, 8.0])
    place = SurfacePlace(-0.4, 100.0, np.array([0.3, 0.0]))
    of_law = Verdict(Explanation.IN_PART, ("the law does not fit: so and so", "another reason"), "lead", 2.0, 0.1, 0.5)
    judged = judged_surface(of_law, place, zones, theta, 50.0, 400.0)
    assert "0.4 mm inside" in judged.reasons[0] and "that of unknown 35 % higher" in judged.reasons[0]
    assert judged.reasons[1:] == ("another reason",)
    assert judged_surface(of_law, place, zones, theta, 150.0, 400.0).reasons[:2] == of_law.reasons
    right = Verdict(Explanation.EXPLAINED, (), "", 1.0, 0.0, 0.0)
    assert judged_surface(right, replace(place, theta=np.zeros(2)), zones, theta, 0.0, 50.0) is right
    in_part = replace(of_law, reasons=("residuals are 2 times the noise",))
    assert FREE_SURFACE in judged_surface(in_part, replace(place, theta=np.zeros(2)), zones, theta, 0.0, 400.0).reasons[1]
    assert judged_surface(in_part, replace(place, theta=np.zeros(2)), zones, theta, 0.0, 4000.0) is in_part
    assert judged_surface(right, None, zones, theta, 0.0, 0.0) is right
