"""Pushing lattices: bilinear weights, unilateral contact, Coulomb friction, pull-off, reactions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.mechanics.contact.rigid_indenters import box_indenter, cylindrical_indenter, plane_indenter, spherical_indenter
from naibu.mechanics.lattices.cpu.contact._kernels import AGREED_FRICTION
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.contact_state import begin_contact, check_outside
from naibu.mechanics.lattices.model.contact_surface import ContactSurface
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, general_lattice, lattice_parameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState
from naibu.mechanics.lattices.simulation.contact import displacement_drive, force_drive, hand_over, push, push_by_force

GRAVITY = 9810.0  # mm/s^2


def block(shape=(3, 3, 3), mass=0.1, k=20.0, c1=1.0, c2=np.inf, **options):
    lattice = classic_lattice(box_mask(shape), 10.0, total_mass_kg=mass)
    return lattice, LatticeEngine.of(lattice, lattice_parameters(lattice, k, c1, c2), tolerance=1e-6, **options)


def test_bilinear_weights_are_opposite_areas_and_snap():
    lattice = classic_lattice(box_mask((2, 2, 1)), 10.0, density=1e-6)
    corners, weights = hand_over(lattice, "+z", [[13.0, 4.0, 0.0], [12.0, 4.0, 0.0], [18.0, 9.0, 0.0]])
    x, y = lattice.points[corners][..., 0], lattice.points[corners][..., 1]
    assert (lattice.points[corners][..., 2] == 10.0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    np.testing.assert_allclose((weights * x).sum(axis=1), [13.0, 10.0, 20.0])  # the second and third stand on lines of nodes
    np.testing.assert_allclose((weights * y).sum(axis=1), [4.0, 4.0, 10.0])


def test_force_and_moment_are_handed_over():
    lattice = classic_lattice(box_mask((4, 4, 2)), 10.0, density=1e-6)
    points = np.array([[x, y, 20.0] for x in (14.0, 25.0) for y in (5.0, 16.0)])
    forces = force_drive(lattice, "+z", points, [0.0, 0.0, -8.0])
    np.testing.assert_allclose(forces.sum(axis=0), [0.0, 0.0, -8.0])
    np.testing.assert_allclose(np.cross(lattice.points, forces).sum(axis=0), np.cross(points, [0.0, 0.0, -2.0]).sum(axis=0))


def test_a_face_covered_by_points_moves_as_the_body_does():
    lattice, engine = block()
    points = [[x, y, 30.0] for x in np.linspace(0, 30, 7) for y in np.linspace(0, 30, 7)]
    constrained = displacement_drive(lattice, "+z", points, 1) + ConstrainedNodes.of(np.flatnonzero(lattice.points[:, 2] == 0.0))
    motion = engine.run(engine.rest(), 100, constrained, [[0, 0, 0], [0, 0, -20.0]])
    top = lattice.points[:, 2] == 30.0
    np.testing.assert_allclose(motion.state.position[top] - lattice.points[top], [[0, 0, -4.0]] * 16, atol=1e-9)


@pytest.mark.parametrize("kind", ["box", "cylinder", "sphere", "plane"])
def test_gaps_and_normals_of_bodies(kind):
    body = {
        "box": box_indenter((1.0, 2.0, 3.0), (4.0, 6.0, 8.0)),
        "cylinder": cylindrical_indenter((1.0, 2.0, 3.0), 2.0, 5.0, (1.0, 1.0, 0.0)),
        "sphere": spherical_indenter((1.0, 2.0, 3.0), 2.5),
        "plane": plane_indenter((1.0, 2.0, 3.0), (0.0, 1.0, 1.0)),
    }[kind]
    rng = np.random.default_rng(0)
    points = rng.uniform(-6.0, 9.0, (200, 3))
    gap = body.gap(points)
    local = (points - body.centre) @ body.geometry.axes.T
    surface = local.copy()
    if kind == "box":
        surface = np.clip(local, [-2, -3, -4], [2, 3, 4])
    elif kind == "cylinder":
        radius = np.linalg.norm(local[:, :2], axis=1)
        surface[:, :2] *= np.minimum(1.0, 2.0 / radius)[:, None]
        surface[:, 2] = np.clip(local[:, 2], -2.5, 2.5)
    elif kind == "sphere":
        surface *= np.minimum(1.0, 2.5 / np.linalg.norm(local, axis=1))[:, None]
    else:
        surface[:, 2] = np.minimum(local[:, 2], 0.0)
    np.testing.assert_allclose(np.maximum(gap, 0.0), np.linalg.norm(local - surface, axis=1), atol=1e-12)
    assert (gap < 0).any()


def test_a_block_at_rest_is_carried_by_the_floor():
    lattice, engine = block()
    weight = lattice.total_mass * GRAVITY
    forces = -np.outer(lattice.node_mass, [0.0, 0.0, GRAVITY])
    motion = push(
        engine,
        engine.rest(),
        [plane_indenter((0, 0, 0), static_friction=0.5, kinetic_friction=0.4)],
        0.0,
        steps=1500,
        external_force=forces,
    )
    allowed = 0.5 * weight * AGREED_FRICTION  # the friction of a step is settled to that, and its rounding decides where in between
    np.testing.assert_allclose(motion.reaction[-1, 0], [0.0, 0.0, weight], rtol=2e-4, atol=allowed)
    assert motion.unsettled == 0


def test_momentum_balances_with_the_reactions():
    lattice, engine = block()
    bodies = [
        plane_indenter((0, 0, 0), static_friction=0.3, kinetic_friction=0.2),
        spherical_indenter((15.0, 15.0, 41.0), 10.0, static_friction=0.5, kinetic_friction=0.3),
    ]
    motion = push(engine, engine.rest(), bodies, [[0, 0, 0], [10.0, 0, -30.0]], steps=200)
    momentum = (lattice.node_mass[:, None] * motion.state.velocity).sum(axis=0)
    impulse = engine.step * motion.reaction.sum(axis=(0, 1))
    np.testing.assert_allclose(momentum, impulse, atol=2e-3 * np.abs(engine.step * motion.reaction).sum())
    assert motion.reaction[-1, 1, 2] < 0.0
    # 0.91 mm, the depth by which the solid between the nodes of faces as large as the ball yields under 0.8 N
    assert bodies[1].gap(motion.state.position - (10.0 * 0.4, 0, -30.0 * 0.4)).min() > -0.95


@pytest.mark.parametrize(("pull", "slides"), [(0.6, False), (1.1, True)])
def test_static_friction_holds_until_its_limit(pull, slides):
    """A block under its weight, pulled sideways by less and by more than mu_s m g: it stays, or goes off with (pull - mu_k m g) / m."""
    lattice, engine = block((2, 2, 2), k=200.0, c1=5.0)
    floor = [plane_indenter((0, 0, 0), static_friction=0.4, kinetic_friction=0.3)]
    gravity = -np.outer(lattice.node_mass, [0.0, 0.0, GRAVITY])
    rest = push(engine, engine.rest(), floor, 0.0, steps=600, external_force=gravity)
    sideways = np.zeros_like(gravity)
    low = lattice.points[:, 2] < 1.0  # at the height of the floor, so that the block does not tip
    sideways[low, 0] = pull * 0.4 * lattice.total_mass * GRAVITY / low.sum()
    motion = push(engine, rest.state, floor, 0.0, steps=400, external_force=gravity + sideways)
    speed = (lattice.node_mass @ motion.state.velocity[:, 0]) / lattice.total_mass
    if slides:
        assert speed == pytest.approx((1.1 * 0.4 - 0.3) * GRAVITY * 400 * engine.step, rel=0.03)
        assert motion.reaction[-100:, 0, 0].mean() == pytest.approx(-0.3 * lattice.total_mass * GRAVITY, rel=0.02)
    else:
        assert abs(speed) < 1e-2
        assert motion.reaction[-1, 0, 0] == pytest.approx(-0.6 * 0.4 * lattice.total_mass * GRAVITY, rel=1e-2)


def pair(gap, speed):
    """Two nodes one above the other, the lower one at a gap over the floor; both leave it."""
    lattice = general_lattice([[0.0, 0.0, gap], [0.0, 0.0, gap + 10.0]], [[0, 1]], [0.01, 0.01])
    engine = LatticeEngine.of(lattice, lattice_parameters(lattice, 100.0, 1.0, np.inf))
    return lattice, engine, LatticeState(lattice.points, np.full((2, 3), (0.0, 0.0, speed)), np.zeros(1))


@pytest.mark.parametrize(("speed", "expected"), [(2.0, 3.0 * 0.5 + 0.2 * 2.0), (8.0, 0.0), (-2.0, 0.0)])
def test_pull_off_acts_on_masses_that_leave_slowly(speed, expected):
    lattice, engine, state = pair(0.5, speed)
    floor = [plane_indenter((0, 0, 0), pull_stiffness=3.0, pull_damping=0.2, pull_speed=5.0)]
    contact = begin_contact(lattice, ContactSurface.of(lattice, engine.parameters), floor, state.position)
    contact.touched[:] = np.array([True, False])
    motion = push(engine, replace(state, contact=contact), floor, 0.0, steps=1)
    assert -motion.reaction[0, 0, 2] == pytest.approx(expected)
    contact.touched[:] = False
    assert push(engine, replace(state, contact=contact), floor, 0.0, steps=1).reaction[0, 0, 2] == 0.0


def test_pull_off_never_turns_a_mass_around():
    lattice, engine, state = pair(0.5, 2.0)
    floor = [plane_indenter((0, 0, 0), pull_stiffness=1e6, pull_damping=1e6, pull_speed=5.0)]
    contact = begin_contact(lattice, ContactSurface.of(lattice, engine.parameters), floor, state.position)
    contact.touched[:] = True
    motion = push(engine, replace(state, contact=contact), floor, 0.0, steps=1)
    assert motion.reaction[0, 0, 2] == pytest.approx(-2 * 0.01 * 2.0 / engine.step)


def test_a_released_plate_leaves_the_object():
    _, engine = block(c2=50.0)
    bodies = [
        plane_indenter((0, 0, 0), static_friction=0.5, kinetic_friction=0.5),
        box_indenter((15, 15, 35), (30, 30, 10), static_friction=0.5, kinetic_friction=0.5),
    ]
    path = np.zeros((300, 2, 3))
    path[:100, 1, 2], path[200:, 1, 2] = -20.0, 40.0
    motion = push(engine, engine.rest(), bodies, path)
    assert motion.reaction[150, 1, 2] < -100.0
    np.testing.assert_allclose(motion.reaction[-20:, 1], 0.0, atol=1e-9)
    assert (motion.state.contact.mode[motion.state.contact.first[1] :] == 0).all()
    assert motion.reaction[:, 1, 2].max() < 1e-3 * -motion.reaction[:, 1, 2].min()  # a body without pull-off never pulls


def test_a_body_driven_by_a_force_comes_to_balance():
    _, engine = block(k=50.0, c1=2.0)
    bodies = [plane_indenter((0, 0, 0)), box_indenter((15, 15, 35), (30, 30, 10))]
    force = np.full(250, 800.0)
    motion = push_by_force(engine, engine.rest(), bodies, force, driven=1, direction=[0, 0, -1], indenter_mass=0.05)
    assert -motion.reaction[-1, 1, 2] == pytest.approx(800.0, rel=1e-2)
    mass, step = 0.05, engine.step
    speed = -motion.speed[:, 1, 2]
    balance = mass * np.diff(speed, prepend=0.0) / step - motion.reaction[:, 1, 2]
    np.testing.assert_allclose(balance, 800.0, atol=1.0)
    other = push(engine, engine.rest(), bodies, motion.speed)  # the same path, prescribed, gives the same forces
    np.testing.assert_allclose(other.reaction[-1], motion.reaction[-1], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: check_outside(block()[0], [spherical_indenter((15, 15, 30), 5.0)]), "begins inside the object"),
        (lambda: check_outside(block()[0], []), "indenters is empty"),
        (lambda: plane_indenter((0, 0, 0), (0, 0, 0)), "length"),
        (lambda: plane_indenter((0, 0, 0), static_friction=0.2, kinetic_friction=0.3), "0.3 (kinetic)"),
        (lambda: box_indenter((0, 0, 0), (1, -1, 1)), "-1"),
        (lambda: spherical_indenter((np.nan, 0, 0), 1.0), "centre[0] is nan"),
        (lambda: hand_over(block()[0], "+z", [[40.0, 5.0, 0.0]]), "beside the face"),
        (lambda: hand_over(block()[0], "top", [[4.0, 5.0, 0.0]]), "'top'"),
        (lambda: push(block(method="euler", step=1e-5)[1], block()[1].rest(), [plane_indenter((0, 0, 0))], 0.0, steps=1), "implicit"),
        (lambda: push(block()[1], block()[1].rest(), [plane_indenter((0, 0, 0))], np.nan, steps=1), "NaN"),
        (lambda: push(block()[1], block()[1].rest(), [plane_indenter((0, 0, 0))], np.zeros((4, 2, 3))), "2 indenters"),
    ],
)
def test_bad_input_is_named(call, said):
    with pytest.raises(InputError) as caught:
        call()
    assert said in str(caught.value)


@pytest.mark.parametrize("friction", [0.2, 0.5])
@pytest.mark.parametrize("slope", [0.6, 0.9])
def test_a_soft_block_slides_down_a_slope_as_coulomb_says(friction, slope):
    """Set upon a slope at once, it bounces and leans; it still gains (tan - mu) g on the mean, with equal coefficients too."""
    lattice, engine = block((4, 4, 2), mass=0.04, k=40.0, c1=20.0, c2=60.0)
    floor = [plane_indenter((0, 0, 0), static_friction=friction, kinetic_friction=friction)]
    forces = GRAVITY * np.outer(lattice.node_mass, [slope, 0.0, -1.0])
    motion = push(engine, engine.rest(), floor, 0.0, steps=300, external_force=forces)
    speed = (lattice.node_mass @ motion.state.velocity[:, 0]) / lattice.total_mass
    assert speed == pytest.approx((slope - friction) * GRAVITY * 300 * engine.step, rel=0.03)
    assert motion.unsettled == 0
    tangential, normal = np.hypot(motion.reaction[:, 0, 0], motion.reaction[:, 0, 1]), motion.reaction[:, 0, 2]
    beyond = tangential - friction * normal  # the first step is an impact, in which points alternate between stick and slip
    assert (beyond <= 0.002 * friction * normal + 2e-4 * normal.max()).all()


def test_a_thrown_block_stops_and_stays():
    """It slides v^2 / (2 mu g) and then sticks."""
    lattice, engine = block((4, 4, 1), mass=0.04, k=400.0, c1=20.0)
    floor = [plane_indenter((0, 0, 0), static_friction=0.4, kinetic_friction=0.4)]
    weight = GRAVITY * np.outer(lattice.node_mass, [0.0, 0.0, -1.0])
    rest = push(engine, engine.rest(), floor, 0.0, steps=500, external_force=weight)
    thrown = replace(rest.state, velocity=rest.state.velocity + np.array([300.0, 0.0, 0.0]))
    motion = push(engine, thrown, floor, 0.0, steps=150, external_force=weight)
    way = (motion.state.position - rest.state.position)[:, 0].mean()
    assert way == pytest.approx(300.0**2 / (2 * 0.4 * GRAVITY), rel=0.05)
    assert np.abs(motion.state.velocity).max() < 0.5
    assert np.abs(motion.reaction[-1, 0, :2]).max() < 0.4 * lattice.total_mass * GRAVITY
