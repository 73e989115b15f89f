"""Stated heights of layers that the markers contradict are told, and right ones are not, on a virtual gel."""

from __future__ import annotations

from dataclasses import replace

import pytest
from pressed_gels import identified, scanned

from naibu.identification.from_markers.calibration import calibrate
from naibu.identification.from_markers.checks.layer_heights import contradicted_layers
from naibu.identification.from_markers.checks.verdict import verdict_of
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.verdict import Explanation


def test_right_heights_are_not_doubted() -> None:
    assert contradicted_layers(identified(10.0)) == ()
    assert verdict_of(identified(10.0)).explanation is Explanation.EXPLAINED


@pytest.mark.parametrize(("stated", "least", "most"), [pytest.param(20.0, 22.0, 33.0, marks=pytest.mark.slow), (38.0, 27.0, 33.0)])
def test_wrong_heights_are_told_with_what_the_markers_say(stated: float, least: float, most: float) -> None:
    found = identified(10.0, stated_mm=stated)
    (doubt,) = contradicted_layers(found)
    assert f"stated to meet {stated:g} mm above its base" in doubt.text and not doubt.grave
    told = float(doubt.text.split("the markers say ")[1].split(" mm")[0])
    assert least <= told <= most
    judged = verdict_of(found)
    assert judged.explanation is Explanation.IN_PART and doubt.text in judged.reasons


def test_a_layer_that_no_loaded_state_shows_is_not_doubted() -> None:
    experiment = scanned()[0]
    spare = replace(experiment, name="spare", states=experiment.states[:1])
    found = calibrate([experiment, spare], settings=ModelSettings(element_size_mm=10.0, contact="stick"), with_mesh_error=False)
    assert contradicted_layers(found) == ()
