"""Friction between the two sides of a cut: Coulomb's law on an inclined plane, sticking, dissipation, and nothing without it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.assembly import Assembler, body_force
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.lip_assembly import LipAssembler, going_on, with_lips
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicEngine
from naibu.mechanics.finite_strain.sessions.quasi_static_session import QuasiStaticEngine
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeEngine
from naibu.mechanics.finite_strain.statics import LoadState, Solution, solve
from naibu.meshing.cutting.swept_blade import swept_blade
from naibu.meshing.cutting.volume import cut_volume
from naibu.meshing.primitives import box
from naibu.meshing.surface import boundary_faces

SIZE = 20.0
LAW = material("neo_hookean", young_modulus=10.0, poisson_ratio=0.3)
FINE = SolverSettings(tolerance=1e-8)


def inclined(slope: float, n: int = 4, through: bool = True) -> Mesh:
    """A cube that is cut in two along a plane inclined about the x axis; its cells lie along the plane."""
    whole = box((SIZE,) * 3, (n, n, n), cell_type="tetra", centred=False)
    mesh = whole
    if through:
        edge = np.array([[-1.0, -1.0, 0.5 * SIZE], [-1.0, SIZE + 1.0, 0.5 * SIZE]])
        mesh = cut_volume(whole, swept_blade(np.stack([edge, edge + np.array([SIZE + 2.0, 0.0, 0.0])])), SIZE / n).mesh
    points = mesh.points.copy()
    share = 1.0 - np.abs(points[:, 2] - 0.5 * SIZE) / (0.5 * SIZE)
    points[:, 2] += share * slope * (points[:, 1] - 0.5 * SIZE)
    return Mesh.from_arrays(points, mesh.cells, "tetra")


def problem(mesh: Mesh, top: tuple[float, float, float], friction: float | None) -> Problem:
    """The lower face is fixed, the upper one moves by `top`, mm; without friction as a number, the sides pass through each other."""
    assembler = Assembler.from_materials(elements(mesh, "standard"), mesh.regions, [LAW])
    if friction is not None:
        assembler = with_lips(assembler, mesh.points, boundary_faces(mesh).faces, friction)
    low, high = mesh.points[:, 2] < 1e-9, mesh.points[:, 2] > SIZE - 1e-9
    value = np.where(high[:, None], np.array(top), 0.0)
    held = PrescribedDisplacement(np.repeat((low | high)[:, None], 3, axis=1), value)
    return Problem(mesh.points, assembler, (), held, np.zeros_like(mesh.points))


def force_on_top(found: Solution, mesh: Mesh) -> np.ndarray:
    high = mesh.points[:, 2] > SIZE - 1e-9
    return np.asarray(found.problem.assembler.forces(found.displacement)[1][high].sum(axis=0))


def force_of(task: Problem, state: LoadState, high: np.ndarray) -> np.ndarray:
    """Force on the upper face in a state, which anchors without slip of their own would not change."""
    assembler = going_on(task.assembler, state.lips)
    return np.asarray(assembler.forces(state.displacement)[1][high].sum(axis=0))


@pytest.mark.parametrize("friction", [0.1, 0.2])
def test_on_a_slope_steeper_than_the_angle_of_friction_the_force_is_that_of_a_sliding_wedge(friction: float) -> None:
    """The resultant on a sliding plane is inclined by the angle of friction to its normal, whatever strains there are (here small ones)."""
    slope, mesh = 0.4, inclined(0.4)
    found = solve(problem(mesh, (0.0, 0.0, -0.05), friction), settings=FINE)
    assembler = found.problem.assembler
    assert isinstance(assembler, LipAssembler) and assembler.lips is not None
    across, along = assembler.lips.slip_forces(found.displacement)
    assert np.linalg.norm(along, axis=1) == pytest.approx(friction * across, rel=1e-6)  # all pairs slide
    assert np.linalg.norm(along.sum(axis=0)) == pytest.approx(friction * across.sum(), rel=0.01)
    force = force_on_top(found, mesh)
    assert abs(force[1]) / -force[2] == pytest.approx(np.tan(np.arctan(slope) - np.arctan(friction)), rel=0.01)


def test_on_a_slope_less_steep_than_the_angle_of_friction_the_pieces_stick() -> None:
    whole, mesh = inclined(0.2, through=False), inclined(0.2)
    expected = force_on_top(solve(problem(whole, (0.0, 0.0, -2.0), None), settings=FINE), whole)
    stuck = solve(problem(mesh, (0.0, 0.0, -2.0), 1.0), settings=FINE)
    free = solve(problem(mesh, (0.0, 0.0, -2.0), 0.0), settings=FINE)
    assert force_on_top(stuck, mesh)[2] == pytest.approx(expected[2], rel=0.015)
    assert abs(force_on_top(free, mesh)[2]) < 0.97 * abs(expected[2])
    across, along = stuck.problem.assembler.lips.slip_forces(stuck.displacement)
    assert (np.linalg.norm(along, axis=1) < 0.9 * across).mean() > 0.9


def test_without_friction_nothing_changes() -> None:
    mesh = inclined(0.3)
    plain = Assembler.from_materials(elements(mesh, "standard"), mesh.regions, [LAW])
    one = with_lips(plain, mesh.points, boundary_faces(mesh).faces)
    other = problem(mesh, (0.0, 0.0, -1.0), 0.0).assembler
    u = 0.05 * np.random.default_rng(3).normal(size=mesh.points.shape)
    for a, b in zip(one.evaluate(u), other.evaluate(u), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not other.unsymmetric


def test_to_and_fro_the_sides_dissipate_what_friction_does_over_their_slip() -> None:
    """Pressed and sheared in a closed loop, work is lost: the force of friction times the slip. No increment gives any back."""
    mesh, friction = inclined(0.0), 0.3
    high = mesh.points[:, 2] > SIZE - 1e-9
    top = np.array([0.0, 0.0, -0.2])
    task = problem(mesh, tuple(top), friction)
    state = solve(task, settings=FINE).states[-1]
    shears = np.concatenate([np.linspace(0.0, 0.6, 11), np.linspace(0.6, -0.6, 21)[1:], np.linspace(-0.6, 0.6, 21)[1:]])
    force, lost = [force_of(task, state, high)], [0.0]
    for before, after in pairwise(shears):
        values = [np.where(high[:, None], top + np.array([shear, 0.0, 0.0]), 0.0) for shear in (before, after)]
        held = PrescribedDisplacement(task.prescribed.constrained, values[1], values[0])
        moved = Problem(mesh.points, task.assembler, (), held, task.external_force)
        found = solve(moved, settings=SolverSettings(tolerance=1e-8, first_step=1.0, largest_step=1.0), start=state)
        lips = found.problem.assembler.lips
        slip = found.states[-1].lips - (state.lips if state.lips is not None else 0.0)
        lost.append(float((lips.slip_forces(found.displacement)[1] * slip).sum()))
        state = found.states[-1]
        force.append(force_on_top(found, mesh))
    along = np.array(force)[:, 0]
    assert min(lost) > -1e-6
    loop = slice(10, None)  # from the first extreme to the other one and back
    work = float((0.5 * (along[loop][1:] + along[loop][:-1]) * np.diff(shears[loop])).sum())
    assert work == pytest.approx(sum(lost[11:]), rel=0.02)
    pressed = -np.array(force)[loop, 2]
    assert along[-1] == pytest.approx(friction * pressed[-1], rel=0.02)
    assert 0.4 < work / (2.4 * friction * pressed.mean()) < 1.0  # the ways to and fro, less what the pieces yield


def test_a_negative_coefficient_is_refused() -> None:
    with pytest.raises(InputError, match="lips_friction"):
        problem(inclined(0.2), (0.0, 0.0, -1.0), -0.1)


def test_a_solve_goes_on_from_how_the_sides_slipped() -> None:
    """Two solutions one after the other find what a single one along the same path does."""
    mesh, friction = inclined(0.4), 0.2
    whole = problem(mesh, (0.0, 0.0, -0.2), friction)
    once = solve(whole, settings=FINE)
    state = solve(problem(mesh, (0.0, 0.0, -0.1), friction), settings=FINE).states[-1]
    held = PrescribedDisplacement(whole.prescribed.constrained, whole.prescribed.values, 0.5 * whole.prescribed.values)
    then = solve(Problem(mesh.points, whole.assembler, (), held, whole.external_force), settings=FINE, start=state)
    np.testing.assert_allclose(then.displacement, once.displacement, atol=2e-4)
    assert then.states[-1].lips is not None and once.states[-1].lips is not None
    np.testing.assert_allclose(then.states[-1].lips, once.states[-1].lips, atol=2e-4)


def test_a_quasi_static_session_slides_rests_and_slides_back() -> None:
    """Pressed, sheared to and fro in steps that each begin where the last one ended: friction turns round, and never exceeds its limit."""
    mesh, friction = inclined(0.0), 0.3
    task = problem(mesh, (0.0, 0.0, 0.0), friction)
    low, high = (np.flatnonzero(side) for side in (mesh.points[:, 2] < 1e-9, mesh.points[:, 2] > SIZE - 1e-9))
    engine = QuasiStaticEngine(mesh.points, task.assembler, boundary_faces(mesh).faces)
    still, forces = [0.0, 0.0, 0.0], []
    with engine.session(constrained=[low, high]) as session:
        session.step([still, [0.0, 0.0, -0.2]])
        for way in [0.1] * 6 + [0.0] * 2 + [-0.1] * 12:
            forces.append(session.step([still, [way, 0.0, 0.0]]).bodies[0, 1])
    found = np.array(forces)
    ratio = found[:, 0] / -found[:, 2]
    assert ratio[5] == pytest.approx(friction, rel=0.02) and ratio[-1] == pytest.approx(-friction, rel=0.02)
    assert ratio[7] == pytest.approx(ratio[5], rel=1e-5)  # at rest nothing creeps
    assert abs(ratio).max() < 1.02 * friction


def stepped_by(kind: type[DynamicEngine], made: Assembler, mesh: Mesh, step: float) -> tuple[DynamicEngine, np.ndarray]:
    """An engine of a body as dense as water, and its nodal masses, kg."""
    mass = body_force(made.elements, np.full(mesh.n_cells, 1e-6), np.array([1.0, 0.0, 0.0]))[:, 0]
    options = {"background": False} if kind is RealTimeEngine else {}
    return kind(mesh.points, made, mass, boundary_faces(mesh).faces, step=step, tolerance=1e-5, **options), mass


def sliding(slope: float, friction: float, steps: int, kind: type[DynamicEngine]) -> tuple[np.ndarray, np.ndarray]:
    """Mean position and velocity (steps, 3) of the piece above an inclined cut, under its weight; what lies below is fixed."""
    mesh = inclined(slope)
    made = problem(mesh, (0.0, 0.0, 0.0), friction).assembler
    upper = np.zeros(mesh.n_points, dtype=bool)
    centre = mesh.points[mesh.cells].mean(axis=1)
    share = 1.0 - np.abs(centre[:, 2] - 0.5 * SIZE) / (0.5 * SIZE)
    upper[mesh.cells[centre[:, 2] > 0.5 * SIZE + share * slope * (centre[:, 1] - 0.5 * SIZE)]] = True
    engine, mass = stepped_by(kind, made, mesh, 1e-3)
    weight = mass[:, None] * np.array([0.0, 0.0, -9810.0])
    share_of = (mass * upper / mass[upper].sum())[:, None]
    place, speed = [], []
    with engine.session(constrained=[np.flatnonzero(~upper)], external_force=weight) as session:
        for _ in range(steps):
            session.step()
            place.append((share_of * session.state().displacement).sum(axis=0))
            speed.append((share_of * session.state().velocity).sum(axis=0))
    return np.array(place), np.array(speed)


@pytest.mark.parametrize("kind", [DynamicEngine, RealTimeEngine])
def test_a_piece_slides_down_a_cut_with_the_acceleration_of_a_block_on_a_slope(kind: type[DynamicEngine]) -> None:
    slope, friction = 0.4, 0.2
    _, speed = sliding(slope, friction, 40, kind)
    angle = np.arctan(slope)
    along = -speed @ np.array([0.0, np.cos(angle), np.sin(angle)])
    found = np.polyfit(1e-3 * np.arange(15, 40), along[15:], 1)[0]  # once the piece has settled on the slope
    assert found == pytest.approx(9810.0 * (np.sin(angle) - friction * np.cos(angle)), rel=0.02)


@pytest.mark.parametrize("kind", [DynamicEngine, RealTimeEngine])
def test_a_piece_rests_on_a_cut_that_is_less_steep_than_the_angle_of_friction(kind: type[DynamicEngine]) -> None:
    place, speed = sliding(0.3, 0.5, 300, kind)
    assert np.abs(speed[20]).max() > 1.0  # it sinks in and sways
    assert np.abs(speed[-1]).max() < 0.005
    assert np.linalg.norm(place[-1] - place[-100]) < 1e-4  # and does not creep: at 0.01 mm/s it would have gone 1e-3 mm


def rubbed(kind: type[DynamicEngine], friction: float, slope: float, path: list[tuple[float, float]]) -> tuple[np.ndarray, list[float]]:
    """Forces on the upper face (steps, 3), mN, that moves along x and z at these speeds, mm/s, and the work of friction in each step."""
    mesh = inclined(slope)
    made = problem(mesh, (0.0, 0.0, 0.0), friction).assembler
    engine, _ = stepped_by(kind, made, mesh, 5e-3)
    low, high = (np.flatnonzero(side) for side in (mesh.points[:, 2] < 1e-9, mesh.points[:, 2] > SIZE - 1e-9))
    forces, lost = [], []
    with engine.session(constrained=[low, high]) as session:
        for along, down in path:
            before = session.state()
            forces.append(session.step([[0.0, 0.0, 0.0], [along, 0.0, down]]).bodies[0, 1])
            after = session.state()
            stepped = engine.assembler.in_step(before.displacement, before.lips)
            assert isinstance(stepped, LipAssembler) and stepped.lips is not None
            anchors = stepped.lips._relative(np.zeros_like(mesh.points)) if before.lips is None else before.lips
            across, traction = stepped.lips.slip_forces(after.displacement)
            assert (np.linalg.norm(traction, axis=1) <= friction * across * (1.0 + 1e-9)).all()
            slip = np.where(across[:, None] > 0.0, after.lips - anchors, 0.0)
            lost.append(float((traction * slip).sum()))
    return np.array(forces), lost


def test_sides_of_a_cut_rub_in_real_time_as_newtons_method_has_it_and_always_dissipate() -> None:
    path = [(0.0, -10.0)] * 20 + [(6.0, 0.0)] * 50 + [(0.0, 0.0)] * 10 + [(-6.0, 0.0)] * 100
    (exact, _), (found, lost) = (rubbed(kind, 0.3, 0.0, path) for kind in (DynamicEngine, RealTimeEngine))
    np.testing.assert_allclose(found, exact, atol=0.005 * np.abs(exact[:, 0]).max())
    assert min(lost) > -1e-9 and sum(lost) > 1.0
    ratio = found[:, 0] / -found[:, 2]
    assert ratio[60] > 0.25 and ratio[-1] < -0.25 and np.abs(ratio[20:]).max() < 0.3  # the pieces yield at the rim, where less presses


def test_many_pairs_that_turn_round_at_once_are_balanced_in_real_time() -> None:
    """180 pairs, pressed on and sheared to and fro by constrained nodes: no step needs Newton's method, which takes seconds."""
    mesh, friction = inclined(0.0, n=9), 0.3
    made = problem(mesh, (0.0, 0.0, 0.0), friction).assembler
    engine, _ = stepped_by(RealTimeEngine, made, mesh, 1.0 / 60.0)
    low, high = (np.flatnonzero(side) for side in (mesh.points[:, 2] < 1e-9, mesh.points[:, 2] > SIZE - 1e-9))
    with engine.session(constrained=[low, high]) as session:
        for along, down in [(0.0, -4.0)] * 5 + [(12.0, 0.0)] * 7 + [(-12.0, 0.0)] * 14:
            before = session.state()
            force = session.step([[0.0, 0.0, 0.0], [along, 0.0, down]]).bodies[0, 1]
        assert session.newton_steps == 0
        stepped = engine.assembler.in_step(before.displacement, before.lips)
        assert isinstance(stepped, LipAssembler) and stepped.lips is not None and len(stepped.lips.pairs) == 180
        across, traction = stepped.lips.slip_forces(session.state().displacement)
    slides = np.linalg.norm(traction, axis=1) > friction * across * (1.0 - 1e-9)
    assert slides[across > 0.0].mean() > 0.9  # at the rim some do not press
    assert -force[0] == pytest.approx(-friction * force[2], rel=0.03)


def test_in_real_time_the_force_on_a_steep_cut_is_that_of_a_sliding_wedge() -> None:
    friction, slope = 0.2, 0.4
    forces, _ = rubbed(RealTimeEngine, friction, slope, [(0.0, -0.5)] * 20)  # slowly, by a quarter of a per cent
    assert abs(forces[-1, 1]) / -forces[-1, 2] == pytest.approx(np.tan(np.arctan(slope) - np.arctan(friction)), rel=0.01)


def test_the_way_by_the_balance_without_friction_comes_to_the_same_balance() -> None:
    """Pressed and sheared in one step from where nothing pressed: by Newton's method, its secant, or by way of the frictionless balance."""
    mesh = inclined(0.0)
    made = problem(mesh, (0.0, 0.0, 0.0), 0.3).assembler
    engine, _ = stepped_by(DynamicEngine, made, mesh, 5e-3)
    low, high = (np.flatnonzero(side) for side in (mesh.points[:, 2] < 1e-9, mesh.points[:, 2] > SIZE - 1e-9))
    moving = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, -20.0]])
    with engine.session(constrained=[low, high]) as session:
        direct = session._balanced(5e-3, moving, ())
        guess = np.zeros_like(mesh.points)
        guess[high] = 5e-3 * moving[1]
        step = session._implicit_step(5e-3, ())
        around, straight = session._by_way_of_no_friction(step, guess), session._found(session._with_secant(step), guess)
    assert direct is not None and around is not None and straight is not None
    stepped = engine.assembler.in_step(np.zeros_like(mesh.points))
    assert isinstance(stepped, LipAssembler) and stepped.lips is not None
    across, traction = stepped.lips.slip_forces(around)
    assert across.sum() > 10.0 and np.linalg.norm(traction, axis=1).max() > 0.1
    np.testing.assert_allclose(stepped.lips.slip_forces(direct)[1], traction, atol=2e-3 * np.abs(traction).max())
    np.testing.assert_allclose(direct, around, atol=2e-3 * np.abs(direct).max())
    np.testing.assert_allclose(straight, around, atol=2e-3 * np.abs(direct).max())
