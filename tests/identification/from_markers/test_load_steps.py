"""Load steps must not tell where a body ends: contact with a bar's edge, whose penalties steps used to raise in another order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from naibu import datasets
from naibu.identification.from_markers.calibration import initial_parameters
from naibu.identification.from_markers.gauss_newton import PATH
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.specimen.parameter_names import friction, platen_position, poisson_ratio, young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings, specimen
from naibu.mechanics.finite_strain.statics import solve

SETTINGS = ModelSettings(element_size_mm=6.75)


def test_gels_under_a_bar_end_where_they_end_with_shorter_steps() -> None:
    experiment = datasets.load("ct_two_material_1")
    body = specimen(experiment, SETTINGS)
    known = KnownMaterials({"hardness 5": 222.0})
    values = dict(initial_parameters([body], {experiment.name: ["deformed"]}, known).values()) | {
        young_modulus("hardness 0"): 70.0, poisson_ratio("hardness 0"): 0.4988, poisson_ratio("hardness 5"): 0.4964,
        friction("hardness 0", "table"): 0.56, friction("hardness 5", "acrylic"): 0.24, platen_position(experiment, "deformed"): 32.8,
    }  # fmt: skip
    problem = body.problem(values, "deformed")
    ends = [solve(problem, settings=replace(PATH, largest_step=step)) for step in (0.15, 0.07, 0.02)]
    for end in ends[1:]:
        for first, later in zip(ends[0].problem.contacts, end.problem.contacts, strict=True):
            np.testing.assert_array_equal(later.normal_stiffness, first.normal_stiffness)
    markers = [body.at_markers(end.displacement) for end in ends]
    apart = [np.linalg.norm(m - markers[2], axis=1).max() for m in markers[:2]]
    assert max(apart) < 0.012, apart
    assert ends[0].relative_penetration < PATH.penetration
