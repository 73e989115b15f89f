"""Intervals of a model that does not explain the measurements, in bodies that other code solves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.verdicts.discrepancy import PATTERNS, doubt_of_model
from naibu.identification.verdict import Explanation, Verdict
from naibu.meshing.primitives import box
from naibu.validation.specimens.quadratic_body import SIDE_MM, UNKNOWN, QuadraticBody

NOISE_MM = 0.02


@pytest.mark.parametrize(
    ("border_mm", "sliding", "push", "worst"),
    [
        (25.0, False, (1.0, 0.0, -2.0), Explanation.IN_PART),  # labels are off by 5 mm: 3.3 to 4.9 was told of 5
        (20.0, True, (1.2, 0.0, -0.8), Explanation.NOT_EXPLAINED),
    ],
)
def test_intervals_hold_moduli_where_borders_are_wrong_or_slide(
    border_mm: float, sliding: bool, push: tuple[float, float, float], worst: Explanation
) -> None:
    body, rng = QuadraticBody("cube", sliding=sliding), np.random.default_rng(0)
    points, u = body.solved(push, divisions=6).at(rng.uniform(0.02, 0.98, (1000, 3)))
    layers = [("unknown", border_mm), ("known", SIDE_MM - border_mm)]
    mesh = box((SIDE_MM,) * 3, (6, 6, 8), layers=layers, centred=False, cell_type="hexahedron")
    z = mesh.points[:, 2]
    field = DisplacementField.from_arrays(points, u + NOISE_MM * rng.standard_normal(u.shape), sd_mm=NOISE_MM)
    case = FieldLoadCase.of("pressed", field, mesh, loaded=(z < 1e-9) | (z > SIDE_MM - 1e-9))
    found = identify_field(mesh, [case], Zones.of(mesh, known={"known": body.known}))
    assert found.verdict is not None and found.verdict.explanation is worst
    low, high = found.intervals()[0][0]
    assert low < UNKNOWN[0] < high


def test_what_is_left_widens_by_its_part_and_not_where_it_is_explained() -> None:
    information = np.diag([4.0, 0.0])
    explained, part, not_ = (Verdict(how, (), "", 1.0, 0.2, 0.0) for how in Explanation)
    assert not doubt_of_model(explained, information, 1600.0, 0.0).any() and not doubt_of_model(part, information, 100.0, 100.0).any()
    widened = doubt_of_model(part, information, 1600.0, 800.0)
    assert np.diag(widened) == pytest.approx([(0.99 * 1600.0 - 800.0) / 4.0 / PATTERNS, 0.0])  # 2 of 20 % need no explanation
    assert doubt_of_model(not_, information, 1600.0, 800.0)[0, 0] == pytest.approx(0.99 * 1600.0 / 4.0 / PATTERNS)
    assert not doubt_of_model(replace(part, unexplained=0.02), information, 1600.0, 0.0).any()
