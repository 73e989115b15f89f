"""Sessions with rigid indenters: poses, velocities and forces; contact that is kept from step to step; constraints beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform, rotation_matrix
from naibu.mechanics.contact.indenter_motion import IndenterForce, IndenterVelocity
from naibu.mechanics.contact.rigid_indenters import RigidIndenter, box_indenter, mesh_indenter, plane_indenter, spherical_indenter
from naibu.mechanics.contact.session_protocol import Engine
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState
from naibu.mechanics.lattices.simulation.contact import push, push_by_force

LATTICE = classic_lattice(box_mask((3, 3, 3)), 10.0, total_mass_kg=0.1)
BOTTOM = ConstrainedNodes.of(np.flatnonzero(LATTICE.points[:, 2] == 0.0))
TOP = np.flatnonzero(LATTICE.points[:, 2] == 30.0)
FLOOR = plane_indenter((0, 0, 0), static_friction=0.5, kinetic_friction=0.4)
BALL = spherical_indenter((10.0, 20.0, 40.5), 10.0, static_friction=0.4, kinetic_friction=0.3)
DOWN = IndenterVelocity((4.0, 0.0, -30.0))
STILL = IndenterVelocity()


def engine(**options: object) -> LatticeEngine:
    return LatticeEngine.of(LATTICE, lattice_parameters(LATTICE, 40.0, 2.0, 100.0), tolerance=1e-6, **options)  # type: ignore[arg-type]


def same(ours: LatticeState, theirs: LatticeState) -> None:
    np.testing.assert_array_equal(ours.position, theirs.position)
    np.testing.assert_array_equal(ours.velocity, theirs.velocity)
    assert ours.contact is not None and theirs.contact is not None
    for name in ("mode", "touched", "compression", "extension", "friction", "multiplier", "centres", "axes"):
        np.testing.assert_array_equal(getattr(ours.contact, name), getattr(theirs.contact, name))


def test_a_session_in_contact_takes_the_steps_of_a_push() -> None:
    made = engine()
    expected = push(made, made.rest(), [FLOOR, BALL], [[0, 0, 0], [4.0, 0.0, -30.0]], steps=40)
    with made.session(indenters=[FLOOR, BALL]) as session:
        forces = [session.step(motions=[STILL, DOWN]).indenters[0] for _ in range(30)]
        forces += list(session.step(motions=[STILL, DOWN], steps=10).indenters)
        same(session.state(), expected.state)
    np.testing.assert_array_equal(forces, expected.reaction)
    assert forces[-1][1, 2] < -10.0
    np.testing.assert_array_equal(session.forces().indenters, expected.reaction[30:])


def test_poses_lead_where_velocities_do() -> None:
    made = engine()
    by_velocity, by_pose = made.session(indenters=[FLOOR, BALL]), made.session(indenters=[FLOOR, BALL])
    for n in range(20):
        by_velocity.step(motions=[STILL, DOWN])
        moved = (n + 1) * made.step * np.array([4.0, 0.0, -30.0])
        by_pose.step(motions=[STILL, RigidTransform.of(np.eye(3), moved)])
    np.testing.assert_allclose(by_pose.positions(), by_velocity.positions(), atol=1e-9)
    np.testing.assert_allclose(by_pose.forces().indenters, by_velocity.forces().indenters, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("by", ["pose", "angular velocity"])
def test_a_plate_that_turns_twists_what_sticks_to_it(by: str) -> None:
    """The top follows a rotation about the vertical axis through the middle, the bottom is constrained."""
    plate = box_indenter((15.0, 15.0, 35.0), (40.0, 40.0, 10.0), static_friction=100.0, kinetic_friction=100.0)
    made = engine()
    session = made.session(constrained=BOTTOM, indenters=[plate])
    session.step(motions=[IndenterVelocity((0.0, 0.0, -20.0))], steps=50)  # 2 mm down
    pressed = session.positions(TOP)
    rate, steps = 0.5, 200  # rad/s: 0.2 rad
    for n in range(steps):
        turned = rotation_matrix(np.array([0.0, 0.0, rate * made.step * (n + 1)]))
        pose = RigidTransform(turned, np.array([15.0, 15.0, 35.0]), np.array([15.0, 15.0, 33.0]))
        session.step(motions=[pose if by == "pose" else IndenterVelocity(angular_velocity=(0.0, 0.0, rate))])
    middle = np.array([15.0, 15.0, 0.0])
    expected = (pressed - middle) @ rotation_matrix(np.array([0.0, 0.0, 0.2])).T + middle
    np.testing.assert_allclose(session.positions(TOP)[:, :2], expected[:, :2], atol=0.02)
    np.testing.assert_allclose(session.positions(TOP)[:, 2], 28.0, atol=0.1)  # a hundredth of an element
    contact = session.state().contact
    assert contact is not None
    np.testing.assert_allclose(contact.axes[0], rotation_matrix(np.array([0.0, 0.0, 0.2])).T, atol=1e-9)


def test_a_force_drives_an_indenter_as_push_by_force_does() -> None:
    made, plate = engine(), box_indenter((15, 15, 35), (30, 30, 10))
    force = np.linspace(100.0, 500.0, 25)
    expected = push_by_force(made, made.rest(), [FLOOR, plate], np.append(500.0, force), driven=1, direction=[0, 0, -1], indenter_mass=0.05)
    session = made.session(indenters=[FLOOR, plate])
    for applied in [500.0, *force]:
        session.step(motions=[STILL, IndenterForce(float(applied), (0, 0, -2.0), 0.05)])
    np.testing.assert_allclose(session.positions(), expected.state.position, atol=1e-3)
    assert -session.forces().indenters[0, 1, 2] == pytest.approx(-expected.reaction[-1, 1, 2], abs=1.0)


def test_contact_is_not_forgotten() -> None:
    made = engine()
    session = made.session(indenters=[FLOOR, BALL])
    session.step(motions=[STILL, DOWN], steps=30)
    pressed = session.state()
    assert session.step(steps=100).indenters[-1, 1, 2] < -5.0  # no motions given: the ball stays, and presses
    with pytest.raises(InputError, match="in contact with 2 indenters, which these steps leave out"):
        made.run(pressed, 1)
    with pytest.raises(InputError, match="in contact with 2 indenters, and indenters has 0"):
        made.session(pressed)
    with pytest.raises(InputError, match="in contact with 2 indenters, and there are 1"):
        push(made, pressed, [FLOOR], 0.0, steps=1)
    assert made.run(replace(pressed, contact=None), 1).state.contact is None


def test_a_ball_that_comes_back_to_where_it_pressed_is_borne_again() -> None:
    """What nodes bore of it has faded to hardly anything meanwhile, by a factor in every step, and is no different from nothing."""
    made = engine()
    session = made.session(constrained=BOTTOM, indenters=[BALL])
    for speed, steps in ((-50.0, 100), (100.0, 100), (0.0, 400)):
        session.step(motions=[IndenterVelocity((0.0, 0.0, speed))], steps=steps)
    assert not session.forces().indenters.any()
    left = session.state()
    assert left.contact is not None and left.contact.multiplier.max() > 0.0
    nothing = replace(left, contact=replace(left.contact, multiplier=np.zeros_like(left.contact.multiplier)))
    back = []
    for begun in (left, nothing):
        session.restore(begun)
        back.append(session.step(motions=[IndenterVelocity((0.0, 0.0, -50.0))], steps=200).indenters[:, 0, 2])
    assert back[1].min() < -100.0
    np.testing.assert_allclose(back[0], back[1], atol=1e-3 * abs(back[1].min()))


def test_a_state_goes_in_and_out() -> None:
    made = engine()
    session = made.session(indenters=[FLOOR, BALL])
    session.step(motions=[STILL, DOWN], steps=20)
    kept = session.state()
    session.step(motions=[STILL, DOWN], steps=10)
    first = session.state()
    session.restore(kept)
    session.step(motions=[STILL, DOWN], steps=10)
    same(session.state(), first)
    other = made.session(kept, indenters=[FLOOR, BALL])
    other.step(motions=[STILL, DOWN], steps=10)
    same(other.state(), first)


def test_momentum_balances_with_the_forces_of_constraints_and_indenters() -> None:
    made = engine()
    session = made.session(constrained=BOTTOM, indenters=[BALL])
    forces = session.step([[2.0, 0.0, 0.0]], [DOWN], steps=100)
    state = session.state()
    impulse = made.step * (forces.bodies.sum(axis=(0, 1)) + forces.indenters.sum(axis=(0, 1)))
    momentum = (LATTICE.node_mass[:, None] * state.velocity).sum(axis=0)
    np.testing.assert_allclose(momentum, impulse, atol=1e-3 * made.step * np.abs(forces.bodies).sum())
    bottom = LATTICE.points[BOTTOM.node[::3]]
    np.testing.assert_allclose(state.position[BOTTOM.node[::3]] - bottom, np.tile([0.4, 0.0, 0.0], (len(bottom), 1)), atol=1e-9)
    assert forces.indenters[-1, 0, 2] < -10.0
    assert BALL.gap(state.position - (0.8, 0.0, -6.0)).min() > -1.1  # the ball is as small as a face: the foundation yields


@pytest.mark.parametrize("driven", [False, True], ids=["velocity", "force"])
def test_a_fast_thin_plate_does_not_pass_through(driven: bool) -> None:
    """5 m/s: in a step a plate of 2 mm moves by 10 mm. It does what it does when steps are short enough."""
    plate = box_indenter((15.0, 15.0, 36.0), (60.0, 60.0, 2.0))
    made, parts = engine(step=2e-3), 32
    fine = LatticeEngine.of(LATTICE, made.parameters, tolerance=1e-6, step=made.step / parts)
    motion = IndenterForce(-4e6 if driven else 0.0, (0.0, 0.0, 1.0), 2.0) if driven else IndenterVelocity((0.0, 0.0, -5000.0))
    coarse, reference = (e.session(constrained=BOTTOM, indenters=[plate]) for e in (made, fine))
    coarse.step(motions=[motion], steps=2 if driven else 1)
    reference.step(motions=[motion], steps=2 * parts if driven else parts)
    ends = [session.state().contact.centres[0, 2] for session in (coarse, reference)]
    assert ends[0] < 29.0
    for session, end in zip((coarse, reference), ends, strict=True):
        assert session.positions(TOP)[:, 2].max() < end - 0.25  # below the middle of the plate, which is at its end
    if not driven:
        np.testing.assert_allclose(coarse.positions(), reference.positions(), atol=1e-3)
        mean = reference.forces().indenters.mean(axis=0)
        np.testing.assert_allclose(coarse.forces().indenters[0], mean, rtol=0.01, atol=0.01 * np.abs(mean).max())


def test_passes_that_end_early_leave_forces_as_exact_as_the_tolerance_asks() -> None:
    """Pressed and dragged to and fro: points begin to slip and stick again at each turn. A tolerance of 1e-8 allows no early end."""
    found = []
    for tolerance in (1e-8, 1e-2, 1e-4):
        made = LatticeEngine.of(LATTICE, lattice_parameters(LATTICE, 40.0, 2.0, 100.0), tolerance=tolerance)
        session = made.session(constrained=BOTTOM, indenters=[BALL])
        session.step(motions=[IndenterVelocity((0.0, 0.0, -30.0))], steps=100)
        paths = [IndenterVelocity((side * 60.0, 0.0, 0.0)) for side in (1.0, -1.0, 1.0) for _ in range(60)]
        found.append(np.array([session.step(motions=[path]).indenters[0, 0] for path in paths]))
        assert session.unsettled == 0
        np.testing.assert_allclose(found[-1], found[0], rtol=0.0, atol=0.5 * tolerance * np.abs(found[0]).max())
    drag, weight = found[0][:, 0], found[0][:, 2]
    assert drag.max() > 0.2 * -weight.min() > 0.0 > -0.2 * -weight.min() > drag.min()  # it slid both ways


def test_a_mesh_of_a_box_presses_as_the_box_does() -> None:
    corners = np.array([[x, y, z] for z in (-5, 5) for y in (-9, 9) for x in (-9, 9)], dtype=float)
    sides = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
    triangles = np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])
    made, friction = engine(), {"static_friction": 0.4, "kinetic_friction": 0.3}
    found = []
    for body in (
        box_indenter((15.0, 15.0, 35.2), (18.0, 18.0, 10.0), **friction),
        mesh_indenter((15.0, 15.0, 35.2), corners, triangles, **friction),
    ):
        session = made.session(constrained=BOTTOM, indenters=[body])
        session.step(motions=[DOWN], steps=60)
        found.append((session.positions(), session.forces().indenters))
    np.testing.assert_allclose(found[1][0], found[0][0], atol=1e-6)
    np.testing.assert_allclose(found[1][1], found[0][1], atol=1e-3)
    assert found[0][1][-1, 0, 2] < -10.0


def test_engines_and_sessions_follow_the_protocol() -> None:
    stepped: Engine[LatticeState, ConstrainedNodes] = engine()
    session = stepped.session(constrained=BOTTOM)
    session.press([BALL])
    assert session.step(motions=[DOWN]).indenters.shape == (1, 1, 3)
    session.press([])
    assert session.step(steps=2).indenters.shape == (2, 0, 3)
    assert session.forces().bodies.shape == (2, 1, 3)


INSIDE: list[RigidIndenter] = [spherical_indenter((15, 15, 30), 5.0)]
FORCE = IndenterForce(1.0, (0, 0, 1), 0.1)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: engine(method="euler", step=1e-5).session(indenters=[BALL]), "contact needs method='implicit' or 'symplectic_euler'"),
        (lambda: engine().session(indenters=INSIDE), "indenters[0], a sphere, begins inside the object"),
        (lambda: engine().session(indenters=[FLOOR, BALL]).step(motions=[DOWN]), "motions has 1 entries for 2 indenters"),
        (lambda: engine().session(indenters=[FLOOR, BALL]).step(motions=[FORCE, FORCE]), "one indenter can be driven by a force"),
        (lambda: engine().session(indenters=[BALL]).step(motions=[IndenterVelocity((np.nan, 0, 0))]), "velocity of motions[0][0] is nan"),
        (lambda: engine().session(indenters=[BALL]).step(motions=[IndenterForce(1.0, (0, 0, 0), 0.1)]), "must have a length"),
        (lambda: engine().session(indenters=[BALL]).step(motions=[IndenterForce(1.0, (0, 0, 1), 0.0)]), "mass_kg must be positive"),
        (lambda: engine().session().step(motions=[DOWN]), "motions has 1 entries for 0 indenters"),
    ],
)
def test_bad_input_is_named(call: Callable[[], object], said: str) -> None:
    with pytest.raises(InputError) as caught:
        call()
    assert said in str(caught.value)


@pytest.mark.parametrize("threads", [2, 3, 5])
def test_steps_in_several_parts_are_those_in_one(threads: int) -> None:
    """Balls over edges and the middle touch nodes of every part; the floor is held, so that its reactions are compared as well."""
    places = ((2.0, 2.0), (28.0, 27.0), (15.0, 16.0))
    balls = [spherical_indenter((*place, 38.1), 8.0, static_friction=0.4, kinetic_friction=0.3) for place in places]
    motions = [IndenterVelocity((4.0, 3.0, -30.0)), IndenterVelocity((-4.0, 0.0, -20.0)), IndenterVelocity((0.0, 5.0, -40.0))]
    found = []
    for count in (1, threads):
        made = engine(threads=count)
        with made.session(constrained=BOTTOM, indenters=balls) as session:
            steps = [session.step(motions=motions) for _ in range(30)]
            steps.append(session.step(motions=motions, steps=20))
            assert session.unsettled == 0
            forces = np.concatenate([np.concatenate([each.indenters, each.bodies], axis=1) for each in steps])
            found.append((session.positions(), forces))
    assert (found[0][1][-1, :3, 2] < -10.0).all()
    np.testing.assert_allclose(found[1][0], found[0][0], atol=1e-6)
    np.testing.assert_allclose(found[1][1], found[0][1], atol=1e-4 * np.abs(found[0][1]).max())


def test_momentum_of_steps_in_parts_is_what_indenters_give() -> None:
    made = engine(threads=3)
    with made.session(indenters=[BALL]) as session:
        forces = session.step(motions=[DOWN], steps=40).indenters
        momentum = LATTICE.node_mass @ session.state().velocity
    np.testing.assert_allclose(momentum, made.step * forces.sum(axis=(0, 1)), atol=1e-3 * made.step * np.abs(forces).sum())


def test_workers_come_back_after_a_session_is_closed_in_contact() -> None:
    found = []
    for close in (False, True):
        session = engine(threads=2).session(constrained=BOTTOM, indenters=[BALL])
        for _ in range(10):
            session.step(motions=[DOWN])
            if close:
                session.close()
        found.append(session.positions())
        session.close()
    np.testing.assert_array_equal(found[1], found[0])
