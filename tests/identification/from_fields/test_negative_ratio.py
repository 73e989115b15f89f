"""A lump that grows in a body that no load deforms, as closed form has it: outside of a sphere the volume stays."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.assumptions.negative_ratio import NEGATIVE, UNTOLD, NegativeRatio, judged_negative_ratio
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.verdict import Explanation, Verdict
from naibu.meshing.primitives import box

SIDE_MM, NOISE_MM, CELLS = 40.0, 0.01, 6


@cache
def identified(growth: float, strain: float = 0.0) -> FieldEstimate:
    """Return what is found of a sphere that grows in radius by `growth` of it in a body as stiff, stretched as well."""
    mesh = box((SIDE_MM,) * 3, (CELLS,) * 3, centred=False)
    middle = mesh.points[mesh.cells].mean(axis=1) - 0.5 * SIDE_MM
    inside = np.linalg.norm(middle, axis=1) < 0.3 * SIDE_MM
    radius = float((inside.sum() * (SIDE_MM / CELLS) ** 3 * 0.75 / np.pi) ** (1.0 / 3.0))
    rng = np.random.default_rng(0)
    points = rng.uniform(0.01, 0.99, (700, 3)) * SIDE_MM
    x = points - 0.5 * SIDE_MM
    u = growth * x * np.minimum(1.0, (radius / np.linalg.norm(x, axis=1)) ** 3)[:, None] + strain * x * [-0.45, -0.45, 1.0]
    field = DisplacementField.from_arrays(points, u + NOISE_MM * rng.standard_normal(u.shape), sd_mm=NOISE_MM)
    surface = (np.abs(mesh.points - 0.5 * SIDE_MM) > 0.499 * SIDE_MM).any(axis=1)
    mesh = Mesh.from_arrays(mesh.points, mesh.cells, mesh.cell_type, regions=inside.astype(int), region_names=("around", "lump"))
    zones = Zones.of(mesh, known={"around": (5.0, 0.45)})
    return identify_field(mesh, [FieldLoadCase.of("unloaded", field, mesh, loaded=surface)], zones)


def test_a_lump_that_grows_is_named_and_no_other_cause_is_blamed() -> None:
    """It had a Poisson's ratio of -0.9 without a word, and at finite strain the advice to reverse the displacements."""
    verdict = identified(0.01, 0.02).verdict
    assert verdict is not None and verdict.explanation is Explanation.NOT_EXPLAINED
    assert verdict.reasons[0].startswith(f"{NEGATIVE}, -0.90 of lump") and "changes its volume by itself" in verdict.reasons[0]
    assert not any("far better with" in reason or "law" in reason.split(":")[0] for reason in verdict.reasons)


def test_where_other_ratios_fit_as_badly_no_cause_is_blamed() -> None:
    """Cells too large for the lump left an eighth of the deformation, and a wrong Poisson's ratio of the known part was blamed."""
    before, found = Verdict(Explanation.IN_PART, ("ratio", "residuals"), "lead", 2, 0, 0), NegativeRatio(("lump",), (-0.9,), True, False)
    assert judged_negative_ratio(before, found, ("residuals",)).reasons == (UNTOLD.format("lump"), "residuals")
    explained = Verdict(Explanation.EXPLAINED, (), "lead", 1.0, 0.0, 0.0)
    assert judged_negative_ratio(explained, found, ()) is explained


def test_a_stretched_body_is_not_said_to_have_a_negative_ratio() -> None:
    verdict = identified(0.0, 0.02).verdict
    assert verdict is not None and verdict.explanation is Explanation.EXPLAINED and NEGATIVE not in verdict.sentence


@pytest.mark.parametrize("at_bound", [True, False])
def test_of_other_reasons_those_of_residuals_remain_at_the_least_ratio(at_bound: bool) -> None:
    before = Verdict(Explanation.IN_PART, ("exchanged scans", "residuals"), "lead", 2.0, 0.1, 0.5)
    after = judged_negative_ratio(before, NegativeRatio(("lump",), (-0.3,), at_bound), ("residuals",))
    assert "-0.30 of lump" in after.reasons[0] and after.reasons[1:] == (("residuals",) if at_bound else before.reasons)
    assert after.ok is not at_bound and judged_negative_ratio(before, None, ()) is before
