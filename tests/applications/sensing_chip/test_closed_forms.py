"""Equations (1) to (22): algebra, published torsion constants, and the beams of the chip against three-dimensional finite elements."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from naibu.applications.sensing_chip.chip_mesh import ChipResolution
from naibu.applications.sensing_chip.closed_forms import CrossBeam, orthotropic_torsion_stiffness
from naibu.applications.sensing_chip.design import ChipDesign, assumed_chip, beam_points
from naibu.applications.sensing_chip.finite_elements import ChipResponse, solve_chip
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.problem import Problem
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.element_conversion import to_quadratic
from naibu.meshing.primitives import box

BEAM = CrossBeam.of(0.5, 0.1, 0.04, 0.2, 169e6, 50.9e6)


def test_the_deflection_solves_the_beam_equation() -> None:
    x = np.linspace(0.0, 0.5, 2001)
    curvature = np.gradient(np.gradient(BEAM.force_deflection(x), x), x)[3:-3]
    # stress of the lower surface under a force that presses down: E w'' t / 2
    assert 0.5 * 169e6 * 0.04 * curvature == pytest.approx(BEAM.force_stress(x)[3:-3], abs=1e-3 * BEAM.force_stress(0.0))
    assert BEAM.force_deflection(0.5) == pytest.approx(1.0 / BEAM.force_stiffness)


def test_end_loads_give_displacement_and_slope_of_the_block() -> None:
    """Equations (5) to (7) with the sides of the block at +-c."""
    f, m, rigidity = BEAM.end_force, BEAM.end_moment, 169e6 * BEAM.second_moment
    assert f * 0.5**3 / (3 * rigidity) - m * 0.5**2 / (2 * rigidity) == pytest.approx(0.2)
    assert m * 0.5 / rigidity - f * 0.5**2 / (2 * rigidity) == pytest.approx(1.0)


def test_the_stress_vanishes_at_the_stress_free_point_and_has_the_printed_ends() -> None:
    theta = 5e-3
    assert BEAM.stress(BEAM.stress_free_point(theta), theta) == pytest.approx(0.0, abs=1e-9 * BEAM.stress(0.5, theta))
    stretch = 169e6 * 0.2 * theta**2 / (2 * 0.5)
    first = 6 * 169e6 * 0.04 * theta / 0.5**2
    assert BEAM.stress(0.0, theta) == pytest.approx(-first * (0.5 / 6 + 0.1) + stretch)
    assert BEAM.stress(0.5, theta) == pytest.approx(first * (0.5 / 3 + 0.1) + stretch)


# torsion constants of rectangles a x b over a b^3 (Timoshenko and Goodier, table in chapter 10)
@pytest.mark.parametrize(("ratio", "constant"), [(1.0, 0.1406), (1.5, 0.196), (2.0, 0.229), (4.0, 0.281), (10.0, 0.312)])
def test_torsion_constants_are_the_published_ones(ratio: float, constant: float) -> None:
    roark = CrossBeam.of(1.0, ratio, 1.0, 1.0, 1.0, 1.0).torsion_constant / ratio
    assert roark == pytest.approx(constant, rel=5e-3)
    assert orthotropic_torsion_stiffness(ratio, 1.0, 1.0, 1.0) / ratio == pytest.approx(constant, rel=5e-3)
    assert CrossBeam.of(1.0, 1.0, ratio, 1.0, 1.0, 1.0).torsion_constant == pytest.approx(roark * ratio)


def test_orthotropic_torsion_does_not_depend_on_which_side_is_called_the_width() -> None:
    assert orthotropic_torsion_stiffness(0.1, 0.06, 50.9, 79.6) == pytest.approx(
        orthotropic_torsion_stiffness(0.06, 0.1, 79.6, 50.9), rel=1e-6
    )


def stretched_by(theta: float) -> float:
    """Axial force, mN, of a clamped beam (10 x 0.4 x 0.4, E 1e6) whose end turns with a block of half width 5, at finite strain."""
    mesh = to_quadratic(box((10.0, 0.4, 0.4), (24, 1, 2), centred=False, cell_type="tetra"))
    points = mesh.points - [0.0, 0.2, 0.2]
    turn = np.array([[np.cos(theta), 0.0, np.sin(theta)], [0.0, 1.0, 0.0], [-np.sin(theta), 0.0, np.cos(theta)]])
    arm = points - [15.0, 0.0, 0.0]
    end = points[:, 0] == 10.0
    constrained = np.repeat((end | (points[:, 0] == 0.0))[:, None], 3, axis=1)
    prescribed = PrescribedDisplacement(constrained, np.where(end[:, None], arm @ turn.T - arm, 0.0))
    stuff = material("saint_venant_kirchhoff", young_modulus=1e6, poisson_ratio=0.0)
    assembler = Assembler.from_materials(elements(mesh, "standard"), mesh.regions, [stuff])
    found = solve(Problem(mesh.points, assembler, (), prescribed, np.zeros(points.shape)))
    return float(assembler.forces(found.displacement)[1][end, 0].sum())


def test_bent_beams_stretch_by_the_edge_of_the_block_and_by_their_own_shortening() -> None:
    beam = CrossBeam.of(10.0, 0.4, 0.4, 5.0, 1e6, 5e5)
    for theta in (5e-3, 2e-2):
        force = stretched_by(theta)
        assert force == pytest.approx(1e6 * 0.16 * float(beam.axial_strain(theta, bending=True)), rel=0.01)
        # the displacement of the edge alone explains half of it
        assert 1e6 * 0.16 * float(beam.axial_strain(theta)) == pytest.approx(0.484 * force, rel=0.02)


@pytest.fixture(scope="module")
def slender() -> tuple[ChipDesign, ChipResponse]:
    """Beams that are long and wide for their thickness, between a rigid block and rigid clamps, as the closed forms suppose."""
    design = dataclasses.replace(
        assumed_chip(), beam_length_mm=1.2, beam_thickness_mm=0.03, beam_width_mm=0.09, force_resistor_mm=0.3, moment_resistor_mm=0.15
    )
    return design, solve_chip(design, ChipResolution(along=20, across=2, through=2), whole=False)


def test_stiffnesses_of_slender_beams_are_those_of_finite_elements(slender: tuple[ChipDesign, ChipResponse]) -> None:
    design, response = slender
    beams = design.closed_forms
    assert response.force_stiffness == pytest.approx(float(beams.force_stiffness), rel=0.01)  # (4)
    assert response.moment_stiffness == pytest.approx(float(beams.moment_stiffness), rel=0.025)  # (15)


def test_stresses_of_slender_beams_are_those_of_finite_elements(slender: tuple[ChipDesign, ChipResponse]) -> None:
    design, response = slender
    beams, x = design.closed_forms, np.array([0.2, 0.35, 0.8, 1.0])
    stress = response.stress_at(beam_points(design, "A", x))
    assert stress[2, :, 0, 0] == pytest.approx(beams.force_stress(x), rel=0.01, abs=0.01 * beams.force_stress(0.0))  # (1)
    expected = beams.bending_stress(x) / response.moment_stiffness
    assert stress[4, :, 0, 0] == pytest.approx(expected, abs=0.01 * abs(expected).max())  # (16), (17), (19)
    free = np.interp(0.0, stress[4, :, 0, 0], x)
    assert free == pytest.approx(float(beams.stress_free_point()), rel=0.01)  # (22)
    # beam B bears the opposite, beams C and D no stress along their axes
    assert response.stress_at(beam_points(design, "B", x))[4, :, 0, 0] == pytest.approx(-stress[4, :, 0, 0], rel=1e-6)
    along_c = response.stress_at(beam_points(design, "C", x))[4, :, 1, 1]
    assert along_c == pytest.approx(0.0, abs=1e-6 * abs(expected).max())


def test_deflection_of_slender_beams_is_that_of_finite_elements(slender: tuple[ChipDesign, ChipResponse]) -> None:
    design, response = slender
    points = response.chip.mesh.points
    axis = (np.abs(points[:, 1]) < 1e-9) & (np.abs(points[:, 2]) < 1e-9) & (points[:, 0] < 0.0)
    x = design.block_half_width_mm + design.beam_length_mm + points[axis, 0]
    found = -response.displacement[2, axis, 2]
    assert found == pytest.approx(design.closed_forms.force_deflection(x), abs=0.02 * found.max())  # (3)


def test_the_share_of_every_beam_is_that_of_finite_elements(slender: tuple[ChipDesign, ChipResponse]) -> None:
    design, response = slender
    beams = design.closed_forms
    rotation = 1.0 / response.moment_stiffness
    a, d = response.clamp_loads[4, 0], response.clamp_loads[4, 3]
    assert a[2] == pytest.approx(float(beams.end_force) * rotation, rel=0.02)  # (9): downwards on the frame at beam B, upwards at A
    at_clamp = float(beams.end_moment - beams.end_force * beams.length) * rotation  # (10), carried to the outer end
    assert -abs(a[4]) == pytest.approx(at_clamp, rel=0.02)
    twist = orthotropic_torsion_stiffness(0.09, 0.03, *(design.crystal.shear_modulus((1, 1, 0), n) for n in ((1, -1, 0), (0, 0, 1))))
    # sections that cannot warp at the ends shorten the bar by w sqrt(E / (48 G)) at each (Vlasov, narrow rectangle)
    effective = 1.2 - 2.0 * 0.09 * float(np.sqrt(beams.young_modulus / (48.0 * beams.shear_modulus)))
    assert d[4] == pytest.approx(twist / effective * rotation, rel=0.02)  # (12), (13)
    assert float(beams.end_torque) * 1.2 == pytest.approx(twist, rel=0.06)  # one shear modulus for both directions


def test_loads_on_the_frame_balance_those_on_the_block(slender: tuple[ChipDesign, ChipResponse]) -> None:
    design, response = slender
    outer = design.block_half_width_mm + design.beam_length_mm
    arms = outer * np.array([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]])
    forces, moments = response.clamp_loads[..., :3], response.clamp_loads[..., 3:]
    total = np.concatenate([forces.sum(axis=1), (moments + np.cross(arms, forces)).sum(axis=1)], axis=1)
    assert total == pytest.approx(np.diag([1.0, 1.0, -1.0, 1.0, 1.0, 1.0]), abs=1e-6)


def test_short_beams_are_softer_than_the_closed_forms_by_their_shear() -> None:
    """Timoshenko: deflection grows by ``12 E I / (k G A L^2)``, k = 5/6 with the shear modulus across the wafer."""
    design = assumed_chip()
    response = solve_chip(design, ChipResolution(along=8, across=2, through=2), whole=False)
    beams = design.closed_forms
    shear = design.crystal.shear_modulus((1, 1, 0), (0, 0, 1))
    extra = (
        12.0
        * float(beams.young_modulus * beams.second_moment)
        / (5.0 / 6.0 * shear * design.beam_width_mm * design.beam_thickness_mm * design.beam_length_mm**2)
    )
    assert response.force_stiffness == pytest.approx(float(beams.force_stiffness) / (1.0 + extra), rel=0.03)
