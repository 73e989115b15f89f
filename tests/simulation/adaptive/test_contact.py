"""Rigid indenters on adaptive lattices and bodies: momentum, closed forms, friction and reactions while the mesh changes."""

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform
from naibu.mechanics.contact.indenter_motion import IndenterForce, IndenterVelocity
from naibu.mechanics.contact.penalty_contact import RAMP_MM
from naibu.mechanics.contact.rigid_indenters import plane_indenter, spherical_indenter
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.small_strain.rheology import elastic
from naibu.meshing.primitives import box
from naibu.meshing.refinement.marking import NearContact
from naibu.simulation.adaptive.body import AdaptiveBody
from naibu.simulation.adaptive.conditions import Conditions
from naibu.simulation.adaptive.hyperelastic_dynamics import HyperelasticDynamics
from naibu.simulation.adaptive.lattice import AdaptiveLattice, SpringMaterial
from naibu.simulation.adaptive.linear_dynamics import LinearDynamics

E_KPA, NU, DENSITY, SIDE = 50.0, 0.3, 1e-6, 20.0
LINEAR = (material("linear_elastic", young_modulus=E_KPA, poisson_ratio=NU),)
DOWN = IndenterVelocity((0.0, 0.0, -50.0))
ACROSS = IndenterVelocity((60.0, 0.0, -20.0))


def block(n=2):
    return box((SIDE, SIDE, SIDE), (n, n, n), cell_type="tetra", centred=False)


def nowhere(points):
    return np.zeros(len(points), dtype=bool)


def floor(points):
    return points[:, 2] < 1e-9


def ball(radius=6.0, friction=0.3):
    return spherical_indenter((9.0, 11.0, SIDE + radius), radius, static_friction=friction, kinetic_friction=friction)


def lattice(conditions, **settings):
    return AdaptiveLattice.of(block(), SpringMaterial(E_KPA, DENSITY), conditions, None, step=1e-3, tolerance=1e-6, **settings)


def body(conditions, method="backward_euler", step=1e-3, retardation_s=2e-3, **settings):
    dynamics = HyperelasticDynamics(LINEAR, DENSITY, step, method, retardation_s)
    return AdaptiveBody.of(block(), dynamics, conditions, None, **settings)


def momentum(moving):
    if isinstance(moving, AdaptiveLattice):
        return moving.lattice.node_mass @ moving.state().velocity
    return moving.prepared.mass @ moving.state.velocity


def forces(moving, motions, steps):
    """Take steps, and return the forces of the indenters (steps, k, 3)."""
    if isinstance(moving, AdaptiveLattice):
        return moving.step(motions=motions, steps=steps).indenters
    moving.step(steps, motions)
    return moving.indenter_forces()


def scattered(moving, seed):
    leaves = moving.mesh.leaf.cells
    return np.random.default_rng(seed).choice(leaves, len(leaves) // 3, replace=False)


@pytest.mark.parametrize("kind", ["lattice", "body", "body, explicit"])
def test_the_force_of_an_indenter_is_what_a_free_body_gains_in_momentum_while_its_mesh_changes(kind):
    settings, across, step = {"indenters": [ball()], "max_level": 6, "interval": 4}, ACROSS, 1e-3
    if kind == "lattice":
        moving = lattice(Conditions(nowhere), **settings)
    elif kind == "body":
        moving = body(Conditions(nowhere), **settings)
    else:
        step, across = 5e-6, IndenterVelocity((3000.0, 0.0, -1000.0))
        moving = body(Conditions(nowhere), "symplectic_euler", step, 0.0, **settings)
    impulse, largest = np.zeros(3), 0.0
    for k in range(4):
        if k:
            assert moving.change(scattered(moving, k))
        found = forces(moving, [across], 10)
        impulse += step * found[:, 0].sum(axis=0)
        largest = max(largest, float(np.abs(found).max()))
    assert largest > 1.0
    assert momentum(moving) == pytest.approx(impulse, abs=2e-3 * np.abs(impulse).max())


def test_a_frictionless_plate_meets_the_force_of_uniform_uniaxial_stress_on_every_mesh():
    rollers = tuple((lambda p, a=a: p[:, a] < 1e-9, a) for a in range(3))
    moving = body(Conditions(nowhere, rollers=rollers), indenters=[plane_indenter((0, 0, SIDE), (0, 0, -1.0))], max_level=6)
    lowered = RigidTransform.of(np.eye(3), (0.0, 0.0, -1.0))
    forces(moving, [lowered], 40)
    yielding = RAMP_MM / 2.0 + E_KPA / SIDE / moving.dynamics.normal_stiffness  # of the penalty, mm, to first order
    expected = -E_KPA * SIDE**2 * (1.0 - yielding) / SIDE
    for k in range(3):
        assert forces(moving, [lowered], 60)[-1, 0] == pytest.approx([0.0, 0.0, expected], abs=5e-4 * abs(expected))
        assert moving.change(scattered(moving, k))


def test_a_refined_lattice_comes_to_the_force_that_it_has_when_it_is_refined_before():
    found = []
    for early in (True, False):
        moving = lattice(Conditions(floor), indenters=[ball(friction=0.0)], max_level=3, interval=10)
        if early:
            assert moving.change(moving.mesh.leaf.cells)
        forces(moving, [DOWN], 40)
        if not early:
            assert moving.change(moving.mesh.leaf.cells)
        found.append(forces(moving, [IndenterVelocity()], 150)[-1, 0])
    assert np.linalg.norm(found[0]) > 100.0
    assert found[1] == pytest.approx(found[0], abs=0.01 * np.linalg.norm(found[0]))


@pytest.mark.parametrize("make", [lattice, body])
def test_the_mesh_follows_the_indenter_and_friction_stays_within_its_cone(make):
    moving = make(Conditions(floor), indenters=[ball()], max_level=3, interval=5)
    moving.mesh.criterion = NearContact(moving.indenter_distance, 1.0, 3.0)
    coarse = moving.mesh.leaf.mesh.n_points
    forces(moving, [DOWN], 30)
    near = moving.mesh.leaf.mesh.n_points
    assert near > coarse
    dragged = forces(moving, [IndenterVelocity((100.0, 0.0, 0.0))], 60)[:, 0]
    assert (np.linalg.norm(dragged[:, :2], axis=1) < 0.75 * np.abs(dragged[:, 2])).all()  # it slopes as well as it rubs
    forces(moving, [IndenterVelocity((0.0, 0.0, 300.0))], 60)
    assert np.abs(forces(moving, [IndenterVelocity()], 30)[-1]).max() < 1.0
    assert moving.mesh.leaf.mesh.n_points < near


@pytest.mark.parametrize("make", [lattice, body])
def test_a_fast_indenter_does_not_pass_through(make):
    moving = make(Conditions(floor), indenters=[ball(3.0, 0.0)], max_level=3, interval=10)
    found = forces(moving, [IndenterVelocity((0.0, 0.0, -5000.0))], 2)  # half of the block in two steps
    assert found.sum(axis=0)[0, 2] < -1e3 and momentum(moving)[2] < 0.0
    assert moving.indenter_distance(moving.positions()).min() > -0.6


def test_a_force_drives_an_indenter_on_changing_meshes():
    moving = lattice(Conditions(floor), indenters=[ball(friction=0.0)], max_level=3, interval=20)
    moving.mesh.criterion = NearContact(moving.indenter_distance, 1.0, 3.0)
    found = forces(moving, [IndenterForce(300.0, (0.0, 0.0, -1.0), 0.02)], 400)
    assert moving.adaptations > 1
    assert found[-40:, 0, 2].mean() == pytest.approx(-300.0, rel=0.02)


def test_what_cannot_be_is_refused():
    linear = AdaptiveBody.of(block(), LinearDynamics(elastic(E_KPA, NU), DENSITY, 1e-4), Conditions(nowhere), None)
    with pytest.raises(InputError, match="linear_elastic"):
        linear.press([ball()])
    moving = body(Conditions(floor), indenters=[ball()])
    with pytest.raises(InputError, match="2 entries for 1 indenters"):
        moving.step(1, [DOWN, DOWN])
    with pytest.raises(InputError, match="force"):
        moving.step(1, [IndenterForce(1.0, (0, 0, 1), 1.0)])
    with pytest.raises(InputError, match="pull-off"):
        moving.press([spherical_indenter((0, 0, 30), 3.0, pull_stiffness=1.0)])
    with pytest.raises(InputError, match="begins inside"):
        lattice(Conditions(floor), indenters=[spherical_indenter((10, 10, 15), 3.0)])
