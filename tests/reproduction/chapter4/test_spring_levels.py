"""Springs of bisected cubes: closed forms of the report against meshes."""

from __future__ import annotations

import pytest

from naibu.reproduction.chapter4.adaptive import cuboid
from naibu.reproduction.chapter4.spring_levels import closed_form, measured


@pytest.mark.parametrize("level", range(5))
def test_the_closed_forms_of_a_level_are_those_of_a_mesh_that_is_bisected_everywhere(level: int) -> None:
    length, volume, stiffness = closed_form(level, 50.0, 30.0)
    own, volumes, springs = measured(cuboid(2), level, 30.0)
    assert own == pytest.approx(length, rel=1e-12)
    assert volumes == pytest.approx((volume, volume), rel=1e-12)
    assert springs == pytest.approx((stiffness, stiffness), rel=1e-12)
