"""Names of parameters as readers of a report see them."""

from __future__ import annotations

import pytest

from naibu.workflows.report_content import parameter_label


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("hardness 0: young_modulus", "hardness 0: Young's modulus"),
        ("soft: poisson_ratio", "soft: Poisson's ratio"),
        ("soft on table: friction", "soft on table: friction"),
        ("cube/deformed: height", "cube/deformed: height"),
        ("my_gel: c01_fraction", "my_gel: c01 fraction"),
        ("young_modulus", "Young's modulus"),
    ],
)
def test_labels_are_the_terms_of_the_field(name: str, label: str) -> None:
    assert parameter_label(name) == label
