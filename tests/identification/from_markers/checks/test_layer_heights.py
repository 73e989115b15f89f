"""Stated heights of layers that the markers contradict are told, and right ones are not, on a virtual gel."""

from __future__ import annotations

import pytest
from pressed_gels import identified

from naibu.identification.from_markers.checks.layer_heights import contradicted_layers
from naibu.identification.from_markers.checks.verdict import verdict_of
from naibu.identification.verdict import Explanation


def test_right_heights_are_not_doubted() -> None:
    assert contradicted_layers(identified(10.0)) == ()
    assert verdict_of(identified(10.0)).explanation is Explanation.EXPLAINED


@pytest.mark.parametrize(("stated", "least", "most"), [(20.0, 22.0, 33.0), (38.0, 27.0, 33.0)])
def test_wrong_heights_are_told_with_what_the_markers_say(stated: float, least: float, most: float) -> None:
    found = identified(10.0, stated_mm=stated)
    (doubt,) = contradicted_layers(found)
    assert f"stated to meet {stated:g} mm above its base" in doubt.text and not doubt.grave
    told = float(doubt.text.split("the markers say ")[1].split(" mm")[0])
    assert least <= told <= most
    judged = verdict_of(found)
    assert judged.explanation is Explanation.IN_PART and doubt.text in judged.reasons
