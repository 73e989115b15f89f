"""Forces of indenters on refined meshes: published solutions, errors that are known, and contact that a coarse mesh would miss."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.mechanics.contact.rigid_indenters import spherical_indenter
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.primitives import box
from naibu.simulation.adaptive.conditions import Conditions
from naibu.simulation.adaptive.contact_refinement import LEAST_POINTS, mesh_in_contact
from naibu.simulation.adaptive.force_error import path_force_errors
from naibu.simulation.adaptive.indentation import indent
from naibu.simulation.adaptive.statics import hyperelastic_problem, hyperelastic_static, pressed_by, solve_adaptively

E_KPA, NU = 10.0, 0.3
BOTTOM = Conditions(
    lambda p: p[:, 2] < 1e-9, rollers=((lambda p: p[:, 0] < 1e-9, 0), (lambda p: p[:, 1] < 1e-9, 1))
)  # a quarter of the block


def layer_force(radius, depth, height):
    """Force of a sphere on a layer bonded to a rigid base, mN (Dimitriadis et al. 2002)."""
    chi = np.sqrt(radius * depth) / height
    a = -(1.2876 - 1.4678 * NU + 1.3442 * NU**2) / (1.0 - NU)
    b = (0.6387 - 1.0277 * NU + 1.5164 * NU**2) / (1.0 - NU)
    series = (
        1.0
        - 2.0 * a / np.pi * chi
        + 4.0 * a**2 / np.pi**2 * chi**2
        - 8.0 / np.pi**3 * (a**3 + 4.0 * np.pi**2 / 15.0 * b) * chi**3
        + 16.0 * a / np.pi**4 * (a**3 + 3.0 * np.pi**2 / 5.0 * b) * chi**4
    )
    return 4.0 * E_KPA / (3.0 * (1.0 - NU**2)) * np.sqrt(radius) * depth**1.5 * series


def test_the_corrected_force_is_that_of_the_published_layer_on_few_unknowns():
    law = material("linear_elastic", young_modulus=E_KPA, poisson_ratio=NU)
    radius, depth, height = 40.0, 0.2, 20.0
    mesh = box((40, 40, height), (4, 4, 2), cell_type="tetra", centred=False)
    sphere = spherical_indenter((0.0, 0.0, height + radius), radius)
    found = indent(mesh, [law], BOTTOM, [sphere], [(0.0, 0.0, -depth)], tolerance=0.0, max_unknowns=2500, steps=2)
    exact = layer_force(radius, depth, height)
    plain, corrected = -4.0 * found.forces[-1, 0, 2], -4.0 * found.corrected[-1, 0, 2]
    assert abs(corrected / exact - 1.0) < 0.01
    assert abs(corrected / exact - 1.0) < 0.5 * abs(plain / exact - 1.0)
    assert found.fractions == pytest.approx([0.0, 0.5, 1.0])
    assert found.forces[0] == pytest.approx(0.0) and found.displacement.shape == (3, found.mesh.n_points, 3)


@pytest.mark.parametrize(("friction", "formulation", "nu"), [(0.4, "standard", 0.3), (0.0, "mean_dilatation", 0.49)])
def test_the_estimated_error_is_that_of_the_force_at_finite_strain(friction, formulation, nu):
    law = material("neo_hookean", young_modulus=E_KPA, poisson_ratio=nu)
    sphere = spherical_indenter((0.0, 0.0, 35.0), 15.0, static_friction=friction, kinetic_friction=friction)
    contacts = pressed_by([sphere], (0.0, 0.0, -3.0), faces=lambda p: p[:, 2] > 19.9)
    solve_on = hyperelastic_static(BOTTOM, [law], contacts=contacts, formulation=formulation, goal="force")
    mesh = box((20, 20, 20), (3, 3, 3), cell_type="tetra", centred=False)
    found = solve_adaptively(mesh, solve_on, tolerance=0.0, max_unknowns=6000, fraction=0.6)
    forces = np.array([-r.reactions["indenter 0"][2] for r in found.rounds])
    corrected = np.array([-r.corrected_force("indenter 0")[2] for r in found.rounds])
    coarse = [k for k, n in enumerate(found.unknowns) if 800 < n < 2500]
    truth = corrected[-1]  # itself corrected by a few percent
    assert forces[-1] / truth - 1.0 < 0.05
    assert (np.abs(corrected[coarse] - truth) < 0.35 * (forces[coarse] - truth)).all()
    assert all(found.rounds[k].relative_error >= abs(1.0 - truth / forces[k]) * 0.5 for k in coarse)


def test_a_force_without_travel_has_no_error_along_it():
    law = material("neo_hookean", young_modulus=E_KPA, poisson_ratio=NU)
    mesh = box((20, 20, 10), (3, 3, 3), cell_type="tetra", centred=False)
    balls = [spherical_indenter((6.0, 6.0, 18.0), 8.0), spherical_indenter((14.0, 14.0, 17.9), 8.0)]
    contacts = pressed_by(balls, [(0.0, 0.0, -1.5), (0.0, 0.0, 0.0)])(mesh)
    problem = hyperelastic_problem(mesh, Conditions(lambda p: p[:, 2] < 1e-9), [law], contacts=contacts)
    path = solve(problem)
    errors = path_force_errors(mesh, path.problem, path.states[-2:])[0]
    assert errors.total["indenter 0"][2] != 0.0 and not errors.total["indenter 1"].any()
    assert errors.forces["indenter 0"] == pytest.approx(path.reactions["indenter 0"], rel=1e-9)


def test_the_mesh_is_refined_until_a_small_indenter_touches_it():
    mesh = box((40, 40, 20), (2, 2, 1), cell_type="tetra")
    ball = spherical_indenter((3.3, 1.1, 21.0), 1.0)
    law = material("neo_hookean", young_modulus=E_KPA, poisson_ratio=NU)
    finer = mesh_in_contact(mesh, [ball], (0.0, 0.0, -0.5))
    assert mesh.n_cells < finer.n_cells < 5000
    contact = pressed_by([ball], (0.0, 0.0, -0.5))(finer)[0]
    assert (contact.gap(np.zeros_like(finer.points), 1.0) < 0.0).sum() >= LEAST_POINTS
    with pytest.raises(InputError, match=r"indenters\[0\] does not press"):
        mesh_in_contact(mesh, [ball], (0.0, 0.0, 5.0))
    with pytest.raises(InputError, match="steps"):
        indent(mesh, [law], BOTTOM, [ball], [(0, 0, -1)], steps=0)
