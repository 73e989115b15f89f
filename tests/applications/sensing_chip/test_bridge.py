"""Piezoresistance against published coefficients; bridges, sensitivities, symmetry and linearity of the whole chip; load limits."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from naibu.applications.sensing_chip.bridge import (
    MEASURED,
    closed_form_sensitivities,
    crosstalk,
    decoupled,
    half_bridge,
    sensitivity_by_place,
    sensitivity_matrix,
)
from naibu.applications.sensing_chip.chip_mesh import ChipResolution
from naibu.applications.sensing_chip.design import assumed_chip
from naibu.applications.sensing_chip.finite_elements import ChipResponse, solve_chip
from naibu.applications.sensing_chip.load_envelope import largest_stress, load_envelope, load_limits, require_bearable, surface_stress
from naibu.applications.sensing_chip.piezoresistance import doping_factor, n_type_silicon, p_type_silicon
from naibu.core.errors import InputError
from naibu.mechanics.small_strain.cubic_elasticity import crystal_frame

PER_TPA = 1e-9
PUBLISHED = np.array([0.2, 2.83, 2.83])  # mV/mN and mV/(N um), table 6.1 of the report


@pytest.mark.parametrize(
    ("direction", "normal", "along", "across"),
    [((1, 1, 0), (0, 0, 1), 718.0, -663.0), ((1, 0, 0), (0, 0, 1), 66.0, -11.0), ((1, 1, 1), (1, -1, 0), 935.0, None)],
)
def test_coefficients_of_p_type_silicon_are_the_published_ones(
    direction: tuple[int, int, int], normal: tuple[int, int, int], along: float, across: float | None
) -> None:
    """Kanda (1982), figures 2 to 7, and the closed forms of Pfann and Thurston for <110> and <111>."""
    silicon = p_type_silicon()
    assert silicon.longitudinal(direction) / PER_TPA == pytest.approx(along, abs=1.0)
    if across is not None:
        assert silicon.transverse(direction, normal) / PER_TPA == pytest.approx(across, abs=1.0)


def test_n_type_silicon_is_most_sensitive_along_100() -> None:
    assert n_type_silicon().longitudinal((1, 0, 0)) / PER_TPA == pytest.approx(-1022.0)
    assert n_type_silicon().longitudinal((1, 1, 0)) / PER_TPA == pytest.approx(-312.0, abs=1.0)


def test_the_change_of_resistance_follows_stress_along_and_across_the_current() -> None:
    axes = crystal_frame((1, 1, 0), (0, 0, 1))
    change = p_type_silicon().relative_change(np.diag([1e5, 2e4, 0.0]), (1.0, 0.0, 0.0), axes)
    assert change == pytest.approx((718.0 * 1e5 - 663.0 * 2e4) * PER_TPA)
    # the same stress and current, told in the axes of the crystal
    stress = axes.T @ np.diag([1e5, 2e4, 0.0]) @ axes
    assert p_type_silicon().relative_change(stress, axes[0], np.eye(3)) == pytest.approx(change)


def test_hydrostatic_pressure_acts_alike_on_every_current() -> None:
    changes = p_type_silicon().relative_change(-1e3 * np.eye(3), np.array([[1.0, 0, 0], [0.6, 0.8, 0]]), np.eye(3))
    assert changes == pytest.approx(-1e3 * (66.0 - 22.0) * PER_TPA)


def test_doping_lowers_the_coefficients() -> None:
    assert doping_factor(1e15) == 1.0
    assert doping_factor(5e17) == pytest.approx(0.90, abs=0.01)
    assert doping_factor(1e20) == pytest.approx(0.44, abs=0.01)
    with pytest.raises(InputError, match="doping_per_cm3"):
        doping_factor(5e22)


def test_the_bridge_is_linear_for_opposite_changes_only() -> None:
    assert half_bridge(0.1, -0.1, 5.0) == pytest.approx(0.25)  # (27): half of the change times the supply
    assert half_bridge(0.1, -0.1, 5.0, exact=True) == pytest.approx(0.25)
    first, second = 1.3 * 1000.0, 0.9 * 1000.0
    assert half_bridge(0.3, -0.1, 5.0, exact=True) == pytest.approx(5.0 * (first / (first + second) - 0.5))
    assert half_bridge(0.2, 0.2, 5.0) == 0.0


def test_closed_forms_of_the_assumed_chip_give_the_published_sensitivities() -> None:
    assert closed_form_sensitivities(assumed_chip()) == pytest.approx(PUBLISHED, rel=0.01)


@pytest.fixture(scope="module")
def whole() -> ChipResponse:
    return solve_chip(assumed_chip(), ChipResolution(along=6, across=1, through=2, below=2, frame=3))


@pytest.fixture(scope="module")
def beams_alone() -> ChipResponse:
    return solve_chip(assumed_chip(), ChipResolution(along=8, across=2, through=2), whole=False)


def test_finite_elements_confirm_the_sensitivities(whole: ChipResponse, beams_alone: ChipResponse) -> None:
    """A thick beam on an elastic frame: the force within 3 %, the moments, whose resistors are near the ends, 5 to 20 % less."""
    own = sensitivity_matrix(beams_alone)[[0, 1, 2], MEASURED]
    assert own[0] == pytest.approx(0.2, rel=0.03)
    assert 0.90 < own[1] / 2.83 < 0.96
    complete = sensitivity_matrix(whole)[[0, 1, 2], MEASURED]
    assert complete[0] == pytest.approx(0.2, rel=0.05)
    assert 0.8 < complete[1] / 2.83 < 0.93
    assert complete[1] == pytest.approx(complete[2], rel=1e-6)


def test_symmetry_decouples_the_bridges(whole: ChipResponse) -> None:
    share = crosstalk(sensitivity_matrix(whole), (5000.0, 5000.0, 5000.0, 800.0, 800.0, 800.0))
    assert share[:, 2:5] == pytest.approx(np.eye(3), abs=1e-6)
    assert share[0, [0, 1, 5]] == pytest.approx(0.0, abs=1e-6)
    # lateral forces act above the middle of block and frame, which tilts the block a little
    assert abs(share).max() == pytest.approx(1.0)
    assert abs(share[1:, :2]).max() < 0.03


def test_a_misaligned_mask_couples_them(whole: ChipResponse) -> None:
    full_scale = (5000.0, 5000.0, 5000.0, 800.0, 800.0, 800.0)
    off = [abs(crosstalk(sensitivity_matrix(whole, shift_mm=(s, s)), full_scale)[0, 1]) for s in (0.002, 0.004)]
    assert 1e-3 < off[0] < 1e-2
    assert off[1] == pytest.approx(2.0 * off[0], rel=0.2)


def test_sensitivity_by_place_is_that_of_the_resistors_where_they_are(beams_alone: ChipResponse) -> None:
    design, matrix = beams_alone.design, sensitivity_matrix(beams_alone)
    # over the length of a resistor the stress is nearly linear
    assert sensitivity_by_place(beams_alone, np.array([design.force_resistor_mm]))[0, 0] == pytest.approx(matrix[0, 2], rel=0.02)
    assert sensitivity_by_place(beams_alone, np.array([design.moment_resistor_mm]))[1, 0] == pytest.approx(matrix[2, 4], rel=0.02)
    # between the ends nothing is left of the force, and of the moment what bends both halves alike
    middle = sensitivity_by_place(beams_alone, np.array([0.5 * design.beam_length_mm]))
    assert middle[0, 0] == pytest.approx(0.0, abs=1e-12)


def test_loads_are_read_back_from_the_bridges(whole: ChipResponse) -> None:
    matrix = sensitivity_matrix(whole, shift_mm=(0.003, -0.002))
    loads = np.array([[0.0, 0.0, 3000.0, 100.0, -50.0, 0.0], [0.0, 0.0, 10.0, 0.0, 300.0, 0.0]])
    assert decoupled(loads @ matrix.T, matrix) == pytest.approx(loads[:, 2:5], abs=1e-9)


def test_the_response_is_symmetric_and_its_energy_is_positive(whole: ChipResponse) -> None:
    scale = np.sqrt(np.diag(whole.stiffness))
    relative = whole.stiffness / np.outer(scale, scale)
    assert relative == pytest.approx(relative.T, abs=1e-9)
    assert np.linalg.eigvalsh(relative).min() > 0.0
    assert np.diag(whole.stiffness)[[0, 3]] == pytest.approx(np.diag(whole.stiffness)[[1, 4]], rel=1e-6)
    displacement, stress = whole.of(np.array([0.0, 0.0, 2.0, 0.0, 3.0, 0.0]))
    assert displacement == pytest.approx(2.0 * whole.displacement[2] + 3.0 * whole.displacement[4])
    assert stress == pytest.approx(np.swapaxes(stress, 1, 2))


def test_resonances_are_those_of_a_mass_on_the_beams(beams_alone: ChipResponse) -> None:
    design = beams_alone.design
    moving = design.block_mass_kg + 4 * 13 / 35 * 2.329e-6 * design.beam_length_mm * design.beam_width_mm * design.beam_thickness_mm
    expected = np.sqrt(beams_alone.force_stiffness / moving) / (2 * np.pi)
    assert abs(beams_alone.resonances_hz - expected).min() < 0.01 * expected


def test_a_mesh_that_is_mirrored_is_the_same_mesh(whole: ChipResponse) -> None:
    points = whole.chip.mesh.points
    for mirrored in (points * [-1, 1, 1], points * [1, -1, 1], points[:, [1, 0, 2]]):
        assert np.unique(np.round(np.concatenate([points, mirrored]), 9), axis=0).shape == points.shape


def test_sensitivity_is_proportional_to_supply_and_piezoresistance() -> None:
    design = assumed_chip()
    doubled = dataclasses.replace(design, supply_voltage=10.0)
    assert closed_form_sensitivities(doubled) == pytest.approx(2.0 * closed_form_sensitivities(design))
    doped = dataclasses.replace(design, doping_per_cm3=5e17)
    assert closed_form_sensitivities(doped) == pytest.approx(doping_factor(5e17) * closed_form_sensitivities(design))
    along_100 = dataclasses.replace(design, beam_direction=(1, 0, 0))
    assert closed_form_sensitivities(along_100)[0] == pytest.approx(66.0 / 718.0 * closed_form_sensitivities(design)[0], rel=1e-3)


def test_each_printed_limit_is_borne_and_both_together_are_not() -> None:
    design = assumed_chip()
    assert (load_limits(design) > [5000.0, 800.0, 800.0]).all()
    assert largest_stress(design, 5000.0, 800.0, 0.0) > 1.8 * design.strength_kpa
    assert require_bearable(design, 5000.0, 0.0, 0.0) < 1.0
    with pytest.raises(InputError, match=r"M_y = 800 N um stresses the beams to 3\.\d+ GPa"):
        require_bearable(design, 5000.0, 0.0, 800.0)
    with pytest.raises(InputError, match="stresses"):
        require_bearable(design, np.nan, 0.0, 0.0)


def test_surface_stress_is_nominal_between_rigid_clamps_and_proportional_to_the_load(
    whole: ChipResponse, beams_alone: ChipResponse
) -> None:
    load = (0.0, 0.0, 5000.0, 0.0, 0.0, 0.0)
    upper, lower = surface_stress(beams_alone, load)
    # at a quarter of the thickness from the ends, of which (1) is a linear function
    design = beams_alone.design
    expected = 5000.0 * float(design.closed_forms.force_stress(0.25 * design.beam_thickness_mm))
    assert upper == pytest.approx(expected, rel=0.1)
    assert lower == pytest.approx(upper, rel=0.02)  # without block and frame below, both sides are alike
    upper, lower = surface_stress(whole, load)
    assert lower > upper  # block and frame below the beams make sharp corners there
    assert surface_stress(whole, 2.0 * np.array(load)) == pytest.approx(2.0 * np.array([upper, lower]))


def test_the_envelope_lies_where_the_stress_reaches_the_strength() -> None:
    design = assumed_chip()
    force, moment = load_envelope(design).T
    assert largest_stress(design, force, moment, 0.0) == pytest.approx(design.strength_kpa)
    # bending stresses add up: a straight line between the limits
    assert force / load_limits(design)[0] + moment / load_limits(design)[1] == pytest.approx(1.0, abs=2e-3)
    halved = load_envelope(dataclasses.replace(design, strength_kpa=0.5 * design.strength_kpa))
    assert halved == pytest.approx(0.5 * load_envelope(design))
    # a moment about a diagonal bends all beams, each less
    assert load_envelope(design, azimuth_deg=45.0)[-1, 1] > load_envelope(design)[-1, 1]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"beam_length_mm": -0.3}, "beam_length_mm must be positive"),
        ({"beam_width_mm": 0.0}, "beam_width_mm must be positive"),
        ({"beam_thickness_mm": np.nan}, "beam_thickness_mm must be positive"),
        ({"beam_length_mm": 325.0}, "give millimetres"),
        ({"beam_width_mm": 0.5}, "make the beams narrower"),
        ({"beam_thickness_mm": 0.5}, "block_height_mm"),
        ({"pillar_width_mm": 0.5}, "pillar_width_mm"),
        ({"force_resistor_mm": 0.2}, "resistors of 0.02 mm fit"),
        ({"beam_direction": (1, 1, 1)}, "not perpendicular"),
        ({"beam_direction": (0, 0, 0)}, "no crystal direction"),
        ({"strength_kpa": np.inf}, "strength_kpa must be positive"),
    ],
)
def test_designs_that_cannot_be_are_refused(changes: dict[str, object], told: str) -> None:
    with pytest.raises(InputError, match=told):
        dataclasses.replace(assumed_chip(), **changes)


def test_a_mesh_without_cells_is_refused() -> None:
    with pytest.raises(InputError, match="at least 1"):
        ChipResolution(along=0)
