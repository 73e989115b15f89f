"""Layers identified from the motion that another mesh, another element and a time integration produced."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.applications.ischemia.layer_identification import SEARCHED, identify_layers
from naibu.applications.ischemia.layered_response import LayeredModes, simulate_skin
from naibu.applications.ischemia.skin import SkinLayer, SkinPatch, SurfaceLoad, meshed
from naibu.core.errors import InputError
from naibu.mechanics.small_strain.rheology import three_element

LOWER, UPPER = three_element(0.5, 1.0, 30.0, 0.49), three_element(3.8, 0.03, 30.0, 0.49)
LOAD = SurfaceLoad(50.0, 0.47, 0.5)
TIMES = np.concatenate([np.linspace(0.005, 0.47, 60), np.linspace(0.475, 2.0, 60)])


@pytest.fixture(scope="module")
def modes() -> LayeredModes:
    return LayeredModes.of(meshed(SkinPatch((SkinLayer(0.5, LOWER), SkinLayer(0.5, UPPER)), 4.0), 0.5, across=8, upwards=6))


@pytest.fixture(scope="module")
def record() -> np.ndarray:
    """The indentation of a finer mesh."""
    fine = LayeredModes.of(meshed(SkinPatch((SkinLayer(0.5, LOWER), SkinLayer(0.5, UPPER)), 4.0), 0.5, across=18, upwards=14))
    return simulate_skin(fine, (LOWER, UPPER), LOAD, TIMES).indentation


def test_the_layers_are_found_and_what_is_not_determined_is_said(modes: LayeredModes, record: np.ndarray) -> None:
    noise = 0.04
    measured = record + noise * np.random.default_rng(1).standard_normal(len(TIMES))
    start = (three_element(1.0, 0.5, 50.0, 0.49), three_element(2.0, 0.08, 50.0, 0.49))
    found = identify_layers(modes, LOAD, TIMES, measured, noise, start=start)
    assert found.explained and found.residual_mm == pytest.approx(noise, rel=0.2)
    truth = {(i, n): getattr(m, n) for i, m in enumerate((LOWER, UPPER)) for n in ("young_modulus", "voigt_viscosity", "series_viscosity")}
    for p in found.parameters:
        assert p.low < truth[p.layer, p.name] < p.high, p
        assert p.low <= p.value <= p.high
    determined = {(p.layer, p.name) for p in found.parameters if p.determined}
    assert {(1, "young_modulus"), (1, "voigt_viscosity"), (0, "voigt_viscosity")} <= determined
    assert (0, "series_viscosity") not in determined  # the soft layer hardly flows within two seconds


def test_a_record_under_the_load_only_leaves_the_flow_undetermined(modes: LayeredModes, record: np.ndarray) -> None:
    under = TIMES < 0.4
    measured = record[under] + 0.02 * np.random.default_rng(5).standard_normal(int(under.sum()))
    found = identify_layers(modes, LOAD, TIMES[under], measured, 0.02, known=[(0, "voigt_viscosity"), (1, "voigt_viscosity")])
    determined = {(p.layer, p.name): p.determined for p in found.parameters}
    assert determined[1, "young_modulus"]
    assert not determined[0, "series_viscosity"] and not determined[1, "series_viscosity"]
    truth = {(i, n): getattr(m, n) for i, m in enumerate((LOWER, UPPER)) for n in ("young_modulus", "voigt_viscosity", "series_viscosity")}
    assert all(p.low < truth[p.layer, p.name] < p.high for p in found.parameters)


def test_an_end_of_the_range_that_is_searched_determines_nothing(modes: LayeredModes) -> None:
    # skin far stiffer than any that the search tries
    single = LayeredModes.of(meshed(SkinPatch((SkinLayer(1.0, UPPER),), 4.0), 0.5, across=8, upwards=6))
    stiff = replace(UPPER, young_modulus=1e2 * SEARCHED * UPPER.young_modulus)
    measured = simulate_skin(single, (stiff,), LOAD, TIMES).indentation
    (found,) = identify_layers(single, LOAD, TIMES, measured, 1e-4, known=[(0, "voigt_viscosity"), (0, "series_viscosity")]).parameters
    assert found.value == pytest.approx(SEARCHED * UPPER.young_modulus) and found.high < 4.0 * found.low
    assert not found.determined


def test_a_record_of_another_process_is_not_explained(modes: LayeredModes, record: np.ndarray) -> None:
    # a load that fades away slowly, as an air jet whose pressure remains for a while, seen by a precise instrument
    fading = record + 0.4 * np.where(TIMES > 0.47, np.exp(-(TIMES - 0.47) / 0.05), 0.0) * np.sin(30.0 * TIMES)
    known = [(0, n) for n in ("young_modulus", "voigt_viscosity", "series_viscosity")]
    found = identify_layers(modes, LOAD, TIMES, fading, 0.04, known=known)
    assert not found.explained


def test_one_layer_cannot_stand_for_two(modes: LayeredModes, record: np.ndarray) -> None:
    single = LayeredModes.of(meshed(SkinPatch((SkinLayer(1.0, UPPER),), 4.0), 0.5, across=8, upwards=6))
    found = identify_layers(single, LOAD, TIMES, record, 0.02)
    assert not found.explained and len(found.parameters) == 3


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"noise_mm": 0.0}, "noise_mm must be positive"),
        ({"times": TIMES[:5], "indentation_mm": TIMES[:5]}, "5 values for 6 parameters"),
        ({"indentation_mm": np.full_like(TIMES, np.nan)}, "finite numbers"),
        ({"known": [(2, "young_modulus")]}, "layers are 0 to 1"),
        ({"start": (UPPER,)}, "for each of the 2 layers, not 1"),
        ({"indentation_mm": 0.1 * np.random.default_rng(2).standard_normal(len(TIMES))}, "lies within its noise"),
    ],
)
def test_bad_input_is_named(changes: dict[str, object], what: str, modes: LayeredModes) -> None:
    given: dict[str, object] = {"times": TIMES, "indentation_mm": TIMES, "noise_mm": 0.1} | changes
    with pytest.raises(InputError, match=what):
        identify_layers(modes, LOAD, given.pop("times"), given.pop("indentation_mm"), given.pop("noise_mm"), **given)  # type: ignore[arg-type]


def test_materials_without_flow_have_no_flow_to_identify(modes: LayeredModes) -> None:
    solid = replace(LOWER, series_viscosity=np.inf), replace(UPPER, series_viscosity=np.inf)
    measured = simulate_skin(modes, solid, LOAD, TIMES).indentation
    found = identify_layers(modes, LOAD, TIMES, measured, 0.02, start=solid)
    assert {p.name for p in found.parameters} == {"young_modulus", "voigt_viscosity"}
