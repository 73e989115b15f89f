"""Sessions in real time: the steps of Newton's method, the equilibrium of the static solver, and grips."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.core.rigid_transform import RigidTransform
from naibu.mechanics import (
    Assembler,
    DynamicEngine,
    IndenterVelocity,
    QuasiStaticEngine,
    RealTimeEngine,
    RigidIndenter,
    body_force,
    box_indenter,
    elements,
    material,
    plane_indenter,
    spherical_indenter,
)
from naibu.mechanics.contact.indenter_contacts import indenter_contacts
from naibu.mechanics.finite_strain.sessions import real_time_session
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicSession, DynamicState
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeSession
from naibu.mechanics.finite_strain.sessions.tangents.turned_tangent import rotation_to
from naibu.meshing import boundary_faces, box
from naibu.meshing.element_conversion import to_tetra

SIZE = 40.0


def engine(cells: str = "hexahedron", kind: type[DynamicEngine] = RealTimeEngine, divisions: int = 4, **options: bool) -> DynamicEngine:
    mesh = box((SIZE, SIZE, SIZE), (divisions, divisions, divisions))
    mesh = to_tetra(mesh) if cells == "tetra" else mesh
    discrete = elements(mesh, "mean_dilatation")
    assembler = Assembler.from_materials(discrete, mesh.regions, [material(young_modulus=70.0, poisson_ratio=0.499)])
    mass = body_force(discrete, np.full(mesh.n_cells, 1e-6), np.array([1.0, 0.0, 0.0]))[:, 0]
    return kind(mesh.points, assembler, mass, boundary_faces(mesh).faces, normal_stiffness=2e3, **options)


def lowest(points: FloatArray) -> np.ndarray:
    return np.flatnonzero(points[:, 2] < 1e-9)


@pytest.mark.parametrize("cells", ["hexahedron", "tetra"])
def test_it_settles_where_the_static_solver_finds_equilibrium(cells: str) -> None:
    made = engine(cells, background=False)
    plate = plane_indenter((0.0, 0.0, SIZE), (0.0, 0.0, -1.0), static_friction=0.5, kinetic_friction=0.5)
    held = [lowest(made.points)]
    session = made.session(constrained=held, indenters=[plate])
    for _ in range(20):
        session.step(motions=[IndenterVelocity((0.0, 0.0, -0.2 * SIZE / 20 * 60.0))])
    session.step(steps=30)
    static = QuasiStaticEngine(made.points, made.assembler, made.faces, normal_stiffness=2e3).session(constrained=held, indenters=[plate])
    for part in (0.5, 1.0):
        expected = static.step(motions=[RigidTransform.of(np.eye(3), (0.0, 0.0, -0.2 * SIZE * part))])
    moved = np.abs(static.positions() - made.points).max()
    assert np.abs(session.positions() - static.positions()).max() < 0.01 * moved
    force = session.forces()
    assert force.indenters[-1, 0, 2] == pytest.approx(expected.indenters[0, 0, 2], rel=0.01)
    assert -force.bodies[-1, 0, 2] == pytest.approx(force.indenters[-1, 0, 2], rel=5e-3)


@pytest.mark.parametrize("background", [False, True])
def test_the_path_under_a_sphere_is_that_of_newtons_method(background: bool) -> None:
    paths = []
    for made in (engine(background=background), engine(kind=DynamicEngine)):
        sphere = spherical_indenter((3.0, 0.0, SIZE + 9.0), 8.0, static_friction=0.3, kinetic_friction=0.3)
        with made.session(constrained=[lowest(made.points)], indenters=[sphere]) as session:
            path, forces = [], []
            for _ in range(13):
                time.sleep(0.005 if background else 0.0)
                session.step(motions=[IndenterVelocity((0.0, 0.0, -24.0))])
                path.append(session.positions())
                forces.append(session.forces().indenters[0, 0, 2])
            paths.append((np.array(path), np.array(forces)))
    (found, force), (expected, newton) = paths
    moved = np.abs(expected - made.points).max()
    assert np.abs(found - expected).max() < 0.02 * moved
    np.testing.assert_allclose(force, newton, atol=0.02 * np.abs(newton).max())


def test_a_plate_that_stops_at_once_and_leaves_fast_needs_no_step_of_newtons_method() -> None:
    paths = []
    for made in (engine(background=False), engine(kind=DynamicEngine)):
        plate = plane_indenter((0.0, 0.0, SIZE + 0.5), (0.0, 0.0, -1.0), static_friction=0.3, kinetic_friction=0.3)
        with made.session(constrained=[lowest(made.points)], indenters=[plate]) as session:
            path = []
            for speed in [-24.0] * 10 + [0.0] * 3 + [200.0] * 6:
                session.step(motions=[IndenterVelocity((0.0, 0.0, speed))])
                path.append(session.positions())
            paths.append(np.array(path))
        if isinstance(session, RealTimeSession):
            assert session.newton_steps == 0
            assert session.unbalanced <= 0.2
    moved = np.abs(paths[1] - made.points).max()
    assert np.abs(paths[0][:13] - paths[1][:13]).max() < 0.03 * moved
    assert np.abs(paths[0] - paths[1]).max() < 0.15 * moved


def test_a_tool_that_leaves_a_compressed_body_waits_for_no_tangent() -> None:
    made = engine("tetra", background=False)
    plate = plane_indenter((0.0, 0.0, SIZE + 0.1), (0.0, 0.0, -1.0), static_friction=0.3, kinetic_friction=0.3)
    with made.session(constrained=[lowest(made.points)], indenters=[plate]) as session:
        assert isinstance(session, RealTimeSession)
        for speed in [-30.0] * 16 + [0.0] * 5 + [60.0] * 20:
            session.step(motions=[IndenterVelocity((0.0, 0.0, speed))])
            assert session.unbalanced <= 0.2
        assert session.waits == 0
        assert session.newton_steps == 0
        assert np.abs(session.positions() - made.points).max() < 1e-3 * SIZE


@pytest.mark.parametrize("thickness", [2.0, 20.0])
def test_a_body_does_not_spring_through_a_thin_tool_that_stops(thickness: float) -> None:
    """At rest it would be in balance too, with the tool within."""
    made = engine("tetra", background=False)
    middle = SIZE + 0.1 + 0.5 * thickness
    plate = box_indenter((0.0, 0.0, middle), (80.0, 80.0, thickness), static_friction=0.3, kinetic_friction=0.3)
    with made.session(constrained=[lowest(made.points)], indenters=[plate]) as session:
        for speed in [-60.0] * 12 + [0.0] * 6:
            forces = session.step(motions=[IndenterVelocity((0.0, 0.0, speed))])
            if speed == 0.0:
                assert forces.indenters[-1, 0, 2] < -1e4
        assert session.positions()[:, 2].max() < SIZE - 11.0


def test_while_nothing_touches_the_inverse_is_prepared_for_what_will() -> None:
    made = engine(background=False)
    with made.session(constrained=[lowest(made.points)]) as session:
        assert isinstance(session, RealTimeSession)
        session.step(steps=2)
        session.press([plane_indenter((0.0, 0.0, SIZE + 1.0), (0.0, 0.0, -1.0))])
        top = np.flatnonzero(made.points[:, 2] > SIZE - 1e-9)
        covered = []
        for _ in range(6):
            session.step(motions=[IndenterVelocity((0.0, 0.0, 0.0))])
            assert session._earlier is not None
            covered.append(int(session._earlier.factors.covered(top).sum()))
        assert covered[0] < len(top) == covered[-1]


def test_a_machine_that_has_no_time_takes_longer_and_ends_at_the_same_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every step is late, and tangents come late, as on a busy machine."""
    monkeypatch.setattr(real_time_session, "BUDGET_S", 0.0)
    make = RealTimeSession._made
    monkeypatch.setattr(RealTimeSession, "_made", lambda self, *given: (time.sleep(0.1), make(self, *given))[1])
    rests = []
    for made in (engine(), engine(kind=DynamicEngine)):
        plate = plane_indenter((0.0, 0.0, SIZE + 0.1), (0.0, 0.0, -1.0), static_friction=0.3, kinetic_friction=0.3)
        with made.session(constrained=[lowest(made.points)], indenters=[plate]) as session:
            for speed in [-40.0] * 8 + [0.0] * 12:
                session.step(motions=[IndenterVelocity((0.0, 0.0, speed))])
                if isinstance(session, RealTimeSession):
                    assert session.unbalanced <= 0.2
            rests.append((session.positions(), session.forces().indenters[-1, 0, 2]))
    moved = np.abs(rests[1][0] - made.points).max()
    assert np.abs(rests[0][0] - rests[1][0]).max() < 0.02 * moved
    assert rests[0][1] == pytest.approx(rests[1][1], rel=0.02)


def test_penalties_that_rise_under_a_tool_leave_the_force_as_it_is_with_stiff_ones() -> None:
    """They rise at the edges of a plate.

    The mesh resolves these: on one of 4^3 cells some sixteen points of quadrature bear the plate, and there are several equilibria with
    other points at its edges, whose forces differ by 8 %. The static solver, too, comes to one or another of them with other load steps.
    """
    forces = []
    for made in (
        replace(engine("tetra", divisions=7, background=False), normal_stiffness=500.0),
        replace(engine("tetra", DynamicEngine, divisions=7), normal_stiffness=1.2e4),
    ):
        plate = box_indenter((0.0, 0.0, SIZE + 2.5), (28.0, 28.0, 4.8), static_friction=0.3, kinetic_friction=0.3)
        with made.session(constrained=[lowest(made.points)], indenters=[plate]) as session:
            forces.append([session.step(motions=[IndenterVelocity((0.0, 0.0, -16.0))]).indenters[-1, 0, 2] for _ in range(27)])
            rises = session.state().normal_stiffness[0].max() > made.normal_stiffness
            assert rises == isinstance(session, RealTimeSession)
    np.testing.assert_allclose(forces[0][12:], forces[1][12:], rtol=0.02)


@pytest.mark.parametrize("friction", [0.3, 0.8])
def test_a_step_says_how_far_its_force_is_from_balance(friction: float) -> None:
    """The truth of every step is where Newton's method leads from its end; the sphere presses, drags, stops and leaves."""
    made, exact = (replace(e, normal_stiffness=1e4) for e in (engine("tetra", background=False), engine("tetra", DynamicEngine)))
    sphere = spherical_indenter((0.0, 0.0, SIZE + 8.2), 8.0, static_friction=friction, kinetic_friction=friction)
    session, newton = (e.session(constrained=[lowest(made.points)], indenters=[sphere]) for e in (made, replace(exact, tolerance=1e-5)))
    assert isinstance(session, RealTimeSession)
    apart, touched = [], 0
    for way in [(0.0, 0.0, -30.0)] * 8 + [(30.0, 0.0, 0.0)] * 8 + [(0.0, 0.0, 0.0)] * 2 + [(0.0, 0.0, 60.0)] * 5:
        newton.restore(session.state())
        found = session.step(motions=[IndenterVelocity(way)]).indenters[-1, 0]
        contacts = newton._contacts(made.step, np.array([way]), np.zeros((1, 3)))
        u = newton._implicit_step(made.step, contacts).solved(session.state().displacement, newton._solved)
        response = contacts[0].evaluate(u, newton.reached.anchors[0], 1.0)
        true = response.orientation @ response.force.sum(axis=0)
        if np.linalg.norm(true) > 50.0:
            touched += 1
            apart.append(float(np.linalg.norm(found - true) / np.linalg.norm(true)))
            assert apart[-1] <= max(0.02, session.unbalanced), (way, apart, session.unbalanced)
    assert touched >= 18
    assert max(apart) > 1e-6  # they are not the same method


def test_a_step_that_is_taken_in_many_calls_is_the_same_step() -> None:
    made, paths = engine("tetra", background=False), []
    for budget in (np.inf, 0.0):
        sphere = spherical_indenter((1.0, 2.0, SIZE + 8.2), 8.0, static_friction=0.3, kinetic_friction=0.3)
        with made.session(constrained=[lowest(made.points)], indenters=[sphere]) as session:
            assert isinstance(session, RealTimeSession)
            path, waited = [], 0
            for speed in [-30.0] * 6 + [60.0] * 3:
                before = session.positions()
                while (forces := session.step_within(budget, motions=[IndenterVelocity((0.0, 0.0, speed))])) is None:
                    waited += 1
                    assert session.under_way
                    np.testing.assert_array_equal(session.positions(), before)
                assert not session.under_way
                path.append(np.vstack([session.positions(), forces.indenters[-1]]))
            paths.append(np.array(path))
            assert (waited > 9) == (budget == 0.0)
    np.testing.assert_allclose(paths[1], paths[0], rtol=1e-12, atol=1e-12)


def test_a_step_under_way_is_given_up_where_supports_tools_or_the_state_change() -> None:
    made = engine(background=False)
    sphere = spherical_indenter((1.0, 2.0, SIZE + 7.0), 8.0)
    with made.session(constrained=[lowest(made.points)], indenters=[sphere]) as session:
        assert isinstance(session, RealTimeSession)
        begun = session.state()
        for change in (
            lambda: session.constrain([lowest(made.points)]),
            lambda: session.press([sphere]),
            lambda: session.restore(begun),
        ):
            assert session.step_within(0.0) is None
            change()
            assert not session.under_way


def test_gripped_nodes_follow_and_let_go() -> None:
    made = engine(background=False)
    top = np.flatnonzero((made.points[:, 2] > SIZE - 1e-9) & (np.abs(made.points[:, :2]).max(axis=1) < 0.3 * SIZE))
    session = made.session(constrained=[lowest(made.points)])
    session.constrain([lowest(made.points), top])
    for _ in range(10):
        session.step(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 24.0]]))
    session.step(np.zeros((2, 3)), steps=15)
    np.testing.assert_allclose(session.positions(top)[:, 2], SIZE + 4.0, atol=1e-9)
    bodies = session.forces().bodies[-1]
    assert bodies[1, 2] > 0.0
    assert bodies[0, 2] == pytest.approx(-bodies[1, 2], rel=0.01)
    assert session.newton_steps == 0
    session.constrain([lowest(made.points), []])
    session.step(np.zeros((2, 3)), steps=60)
    assert np.abs(session.positions() - made.points).max() < 0.05


def test_a_session_goes_on_from_its_state() -> None:
    made = engine(background=False)
    sphere = spherical_indenter((0.0, 0.0, SIZE + 8.0), 8.0)
    down = [IndenterVelocity((0.0, 0.0, -40.0))]
    session = made.session(constrained=[lowest(made.points)], indenters=[sphere])
    session.step(motions=down, steps=3)
    kept = session.state()
    session.step(motions=down, steps=2)
    first = session.positions()
    session.restore(kept)
    session.step(motions=down, steps=2)
    np.testing.assert_allclose(session.positions(), first, atol=0.01 * np.abs(first - made.points).max())


def test_an_indenter_of_5_m_per_s_rests_where_one_that_came_slowly_does() -> None:
    """It goes 8 mm in a step of 1.6 ms."""
    made = replace(engine(background=False), step=1.6e-3)
    held, rests = [lowest(made.points)], []
    indenter = spherical_indenter((1.0, 2.0, SIZE + 11.0), 8.0)
    for steps in (1, 8):
        session = made.session(constrained=held, indenters=[indenter])
        session.step(motions=[IndenterVelocity((0.0, 0.0, -5000.0 / steps))], steps=steps)
        assert depth(session, indenter, 8.0) < 0.03 * 10.0  # of the edge of a face; penalties follow after the step
        session.step(steps=40)
        rests.append((session.positions(), session.forces().indenters[-1, 0]))
    moved = np.abs(rests[1][0] - made.points).max()
    assert rests[1][1][2] < -100.0
    np.testing.assert_allclose(rests[0][0], rests[1][0], atol=0.03 * moved)
    np.testing.assert_allclose(rests[0][1], rests[1][1], atol=0.03 * np.linalg.norm(rests[1][1]))


@pytest.mark.parametrize("kind", [DynamicEngine, RealTimeEngine])
def test_a_thin_plate_of_5_m_per_s_does_not_pass_through_nor_does_the_body_that_bounces(kind: type[DynamicEngine]) -> None:
    made = replace(engine(kind=kind, **({} if kind is DynamicEngine else {"background": False})), step=1.6e-3)
    plate = box_indenter((0.0, 0.0, SIZE + 6.0), (60.0, 60.0, 4.0))
    session = made.session(constrained=[lowest(made.points)], indenters=[plate])
    for k in range(4):
        force = session.step(motions=[IndenterVelocity((0.0, 0.0, 0.0 if k else -5000.0))]).indenters[-1, 0]
        assert force[2] < -1e4 if k == 0 else force[2] <= 0.0  # it bounces off
        assert depth(session, plate, 8.0) < 0.02 * 10.0 + 1e-9
        assert session.positions()[:, 2].max() < SIZE - 4.0 + 0.2


def depth(session: DynamicSession, indenter: RigidIndenter, lowered: float) -> float:
    """Return how deep the quadrature points of the faces lie in an indenter that was lowered."""
    contact = indenter_contacts([indenter], session.engine.points, session.engine.faces, normal_stiffness=1.0, tangential_stiffness=1.0)[0]
    at = contact.positions(session.state().displacement)
    return float(-indenter.gap(at + np.array([0.0, 0.0, lowered])).min())


def test_a_body_that_turns_needs_few_iterations_with_an_earlier_tangent() -> None:
    """A block tumbles over its edge on the floor, while its tangent is that of the block as it stood."""
    made = engine(background=False)
    floor = plane_indenter((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), static_friction=1.0, kinetic_friction=1.0)
    weight = made.mass[:, None] * np.array([0.0, 0.0, -9810.0])
    spin, edge = np.array([0.0, 18.0, 0.0]), np.array([0.5 * SIZE, 0.0, 0.0])
    start = DynamicState(np.zeros_like(made.points), np.cross(spin, made.points - edge))
    with made.session(state=start, external_force=weight, indenters=[floor]) as session:
        assert isinstance(session, RealTimeSession)
        for _ in range(9):
            session.step(motions=[IndenterVelocity((0.0, 0.0, 0.0))])
            assert session.unbalanced < 0.03
        assert np.trace(rotation_to(made.points, session.positions())[0]) < 1.1  # by more than 87 degrees
        assert session.waits == session.divided_steps == session.newton_steps == 0
        assert session.iterations < 80  # some 200 with a tangent that does not turn
