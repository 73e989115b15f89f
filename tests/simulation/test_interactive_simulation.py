"""Interactive simulation: tools, gripping, undo, and the loop that keeps time."""

from __future__ import annotations

import itertools
import time
from collections.abc import Generator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from touched_lattice import SPACING, TOP, touched_lattice

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.rigid_transform import rotation_matrix
from naibu.mechanics import Assembler, box_indenter, cylindrical_indenter, elements, material, plane_indenter, spherical_indenter
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeSession
from naibu.mechanics.lattices.cpu.session import LatticeSession
from naibu.mechanics.lattices.model.state import LatticeState
from naibu.meshing import box
from naibu.meshing.cutting.swept_blade import swept_blade
from naibu.simulation import FiniteElementBody, InteractiveBody, InteractiveSimulation, RealTimeLoop


def simulation() -> InteractiveSimulation:
    return InteractiveSimulation(
        touched_lattice(), {"sphere": spherical_indenter((20.0, 20.0, 60.0), 8.0), "far": spherical_indenter((0, 0, 90.0), 5.0)}
    )


def test_the_tool_pushes_and_the_body_springs_back() -> None:
    touched = simulation()
    touched.take("sphere")
    touched.move((20.0, 20.0, TOP + 4.0))
    for _ in range(30):
        frame = touched.advance()
    assert frame.force[2] < 0.0
    assert np.abs(frame.force[:2]).max() < 0.02 * abs(frame.force[2])
    assert frame.penetration_mm < 0.2 * SPACING  # a sphere smaller than a face: the foundation between the nodes yields
    touched.move((20.0, 20.0, 80.0))
    for _ in range(30):
        frame = touched.advance()
    np.testing.assert_array_equal(frame.force, 0.0)


def test_the_tool_is_never_faster_than_its_limit() -> None:
    touched = simulation()
    touched.take("sphere")
    touched.move((20.0, 20.0, -1e5))
    centres = np.array([touched.advance().tool_centre for _ in range(12)])
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert steps.max() <= 3.0 * touched.extent_mm * touched.steps * touched.body.step_s * (1 + 1e-9)


def lattice_or_gel(kind: str) -> InteractiveBody:
    if kind == "lattice":
        return touched_lattice()
    mesh = box((TOP, TOP, TOP), (4, 4, 4))
    mesh = replace(mesh, points=mesh.points - mesh.points.min(axis=0))
    law = material(young_modulus=20.0, poisson_ratio=0.45)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    return FiniteElementBody.of(mesh, assembler, supported=np.flatnonzero(mesh.points[:, 2] < 1e-9).astype(np.int64), background=False)


@pytest.mark.parametrize("kind", ["lattice", "gel"])
def test_a_tool_that_was_turned_presses_like_one_that_was_made_so(kind: str) -> None:
    """Half a right angle about the vertical and a third of one about its own long axis, in steps; no faster than its limit."""
    about = (np.array([0.0, 0.0, 0.25 * np.pi]), np.array([0.3, 0.3, 0.0]))
    turned = rotation_matrix(about[1]) @ rotation_matrix(about[0])
    plain = box_indenter((20.0, 18.0, 60.0), (30.0, 10.0, 6.0), static_friction=0.3, kinetic_friction=0.3)
    made = replace(plain, geometry=replace(plain.geometry, axes=plain.geometry.axes @ turned.T))
    rests = []
    for tool in (plain, made):
        touched = InteractiveSimulation(lattice_or_gel(kind), {"box": tool})
        touched.take("box")
        rotations = [touched.advance().tool_rotation]
        if tool is plain:
            for part in about:
                touched.turn(part)
        for _ in range(30):
            rotations.append(touched.advance().tool_rotation)
        angles = [np.linalg.norm(Rotation.from_matrix(b @ a.T).as_rotvec()) for a, b in itertools.pairwise(rotations)]
        assert max(angles) <= 3.0 * touched.frame_s * (1 + 1e-9)
        np.testing.assert_allclose(rotations[-1], turned if tool is plain else np.eye(3), atol=1e-9)
        touched.move((20.0, 18.0, TOP + 2.0))
        for _ in range(60):
            frame = touched.advance()
        assert frame.force[2] < -20.0 and not frame.failed
        rests.append(frame)
    moved = np.abs(rests[1].positions - touched.body.points).max()
    np.testing.assert_allclose(rests[0].positions, rests[1].positions, atol=0.01 * moved)
    np.testing.assert_allclose(rests[0].force, rests[1].force, atol=0.01 * np.linalg.norm(rests[1].force))
    assert rests[0].penetration_mm == pytest.approx(rests[1].penetration_mm, abs=0.02)


def test_a_tool_is_aimed_the_shortest_way() -> None:
    """The rotation between two directions, also opposite ones, by SciPy's alignment of vectors where that is unique."""
    touched = InteractiveSimulation(touched_lattice(), {"rod": cylindrical_indenter((20.0, 20.0, 70.0), 5.0, 10.0)})
    touched.take("rod")
    for direction in ((0.0, 0.0, 2.0), (1.0, -2.0, 0.5), (-1.0, 2.0, -0.5), (0.0, 1.0, 0.0)):
        touched.aim(direction)
        for _ in range(80):
            frame = touched.advance()
        unit = np.array(direction) / np.linalg.norm(direction)
        np.testing.assert_allclose(frame.tool_rotation @ (0.0, 0.0, 1.0), unit, atol=1e-9)
        np.testing.assert_allclose(frame.tool_rotation @ frame.tool_rotation.T, np.eye(3), atol=1e-9)
    with pytest.raises(InputError, match="length of the direction"):
        touched.aim((0.0, 0.0, 0.0))


def test_a_gripped_node_follows_the_hand() -> None:
    touched = simulation()
    corner = int(np.argmax(touched.body.points.sum(axis=1)))
    touched.grip(corner, 12.0)
    goal = touched.body.points[corner] + [3.0, 4.0, 5.0]
    touched.pull(goal)
    for _ in range(10):
        frame = touched.advance()
    np.testing.assert_allclose(frame.positions[corner], goal, atol=1e-9)
    assert frame.pull @ [3.0, 4.0, 5.0] > 0.0
    assert frame.gripped == corner
    touched.release()
    assert touched.advance().gripped == -1


def test_undo_returns_to_the_state_before() -> None:
    touched = simulation()
    touched.take("sphere")
    before = touched.advance().positions
    touched.grip(124)
    touched.pull(touched.body.points[124] + [0.0, 0.0, 8.0])
    for _ in range(5):
        touched.advance()
    assert np.abs(touched.last.positions - before).max() > 1.0
    assert touched.undo()
    np.testing.assert_allclose(touched.last.positions, before, atol=1e-12)
    assert touched.undo()
    assert not touched.undo()


@pytest.mark.parametrize("kind", ["lattice", "gel"])
def test_a_tool_is_taken_also_where_the_body_was_pulled_around_its_waiting_place(kind: str) -> None:
    """A sphere that waits between the nodes of a face that came to it: the lattice's contact had refused it, which ended the thread."""
    touched = InteractiveSimulation(lattice_or_gel(kind), {"sphere": spherical_indenter((15.0, 15.0, 44.0), 3.0)})
    middle = int(np.linalg.norm(touched.body.points - (20.0, 20.0, TOP), axis=1).argmin())
    touched.grip(middle, 30.0)
    touched.pull(touched.body.points[middle] + (0.0, 0.0, 4.0))
    for _ in range(10):
        touched.advance()
    touched.take("sphere")
    assert touched.last.positions[middle, 2] == pytest.approx(44.0, abs=0.01)
    frame = touched.advance()
    assert frame.tool == "sphere" and not frame.force.any() and frame.tool_centre[2] > 47.0


def test_reset_brings_the_body_to_rest() -> None:
    touched = simulation()
    touched.take("sphere")
    touched.move((20.0, 20.0, TOP))
    for _ in range(10):
        touched.advance()
    touched.reset()
    np.testing.assert_array_equal(touched.last.positions, touched.body.points)
    assert touched.advance().time_s == pytest.approx(touched.steps * touched.body.step_s)


def test_a_step_that_fails_is_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    touched = simulation()
    touched.take("sphere")
    good = touched.advance()

    def fails(*_: object, **__: object) -> None:
        raise ConvergenceError("an element is inverted")

    monkeypatch.setattr(type(touched._session), "step", fails)
    frame = touched.advance()
    assert frame.failed == "an element is inverted"
    np.testing.assert_array_equal(frame.positions, good.positions)


def test_frames_of_a_lattice_copy_no_state_and_measure_no_depth_that_is_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lattice of 17^3 nodes spent 1.5 times as long on these as on its steps, and a haptic device asks for 1000 frames a second."""
    touched = simulation()
    touched.take("sphere")
    touched.move((20.0, 20.0, TOP + 4.0))
    frames = [touched.advance() for _ in range(30)]
    asked = {"states": 0, "gaps": 0}
    state, gap = type(touched._session).state, RigidIndenter.gap

    def counted_state(session: LatticeSession) -> LatticeState:
        asked["states"] += 1
        return state(session)

    def counted_gap(tool: RigidIndenter, points: ArrayLike) -> FloatArray:
        asked["gaps"] += 1
        return gap(tool, points)

    monkeypatch.setattr(type(touched._session), "state", counted_state)
    monkeypatch.setattr(RigidIndenter, "gap", counted_gap)
    frames += [touched.advance() for _ in range(30)]
    assert asked == {"states": 0, "gaps": 0}
    for frame in frames[::10]:  # the depth is that at the instant of the frame, whenever it is asked for
        surface = frame.positions[np.unique(touched.body.faces)]
        assert frame.penetration_mm == pytest.approx(max(0.0, 8.0 - np.linalg.norm(surface - frame.tool_centre, axis=1).min()), abs=1e-12)
    assert frames[-1].penetration_mm > 0.0


@pytest.mark.parametrize("kind", ["lattice", "gel"])
def test_a_body_of_which_two_steps_fail_one_after_the_other_is_stopped_and_that_is_said(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    touched = InteractiveSimulation(lattice_or_gel(kind), {"sphere": spherical_indenter((20.0, 20.0, 60.0), 8.0)})
    touched.take("sphere")
    touched.move((20.0, 20.0, TOP + 4.0))
    for _ in range(60):
        good = touched.advance()
        if np.abs(touched._session.state().velocity).max() > 1.0:
            break
    assert good.force[2] < 0.0

    def fails(*_: object, **__: object) -> None:
        raise ConvergenceError("no balance")

    with monkeypatch.context() as patch:
        patch.setattr(type(touched._session), "step", fails)
        first = touched.advance()
        assert np.abs(touched._session.state().velocity).max() > 1.0 and "stopped" not in first.failed
        loop = RealTimeLoop(touched)
        loop._advance(0.0)
        second = loop.latest()[0]
        assert loop.trouble() == second.failed and loop.trouble() == ""  # the page says it, once
    assert second.failed == "no balance; the body was stopped where it was"
    np.testing.assert_array_equal(second.positions, good.positions)
    np.testing.assert_array_equal(touched._session.state().velocity, 0.0)
    assert not touched.advance().failed
    touched.close()


def test_a_body_that_finds_no_balance_any_more_begins_anew_from_its_shape_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut to loose pieces under a tool, each step had failed for ever, tool and body standing still, until somebody pressed Reset."""
    touched = InteractiveSimulation(lattice_or_gel("gel"), {"sphere": spherical_indenter((20.0, 20.0, 60.0), 8.0)})
    touched.take("sphere")
    touched.move((20.0, 20.0, TOP + 4.0))
    while touched.last.force[2] == 0.0:
        touched.advance()
    step, kept = RealTimeSession.step, len(touched._kept)

    def fails_unless_at_rest(session: RealTimeSession, *given: object, **named: object) -> object:
        if np.abs(session.state().displacement).max() > 1.0:
            raise ConvergenceError("no balance")
        return step(session, *given, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(RealTimeSession, "step", fails_unless_at_rest)
    frames = [touched.advance() for _ in range(5)]
    assert [frame.failed.partition("; ")[2] for frame in frames] == [
        "", "the body was stopped where it was", "the body was put back into its shape at rest", "", "",
    ]  # fmt: skip
    np.testing.assert_array_equal(frames[2].positions, touched.body.points)
    assert not any(frame.failed for frame in frames[3:]) and frames[-1].tool == "sphere" and not frames[-1].force.any()
    np.testing.assert_array_equal(frames[2].tool_centre, (20.0, 20.0, 60.0))
    assert len(touched._kept) == kept  # what Undo returns to is what it was
    touched.close()


def without_quasi_newton(monkeypatch: pytest.MonkeyPatch) -> None:
    def finds_nothing(*_: object) -> Generator[None, None, None]:
        yield from ()

    monkeypatch.setattr(RealTimeSession, "_quasi_newton", finds_nothing)


def test_newtons_method_gives_up_a_step_that_a_loop_waits_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without quasi-Newton iterations and with no time for Newton's method; a step that nobody waits for is taken to its end."""
    monkeypatch.setattr("naibu.mechanics.finite_strain.sessions.newton_session.NEWTON_S", 0.0)
    without_quasi_newton(monkeypatch)
    ends = []
    for budget in (np.inf, 0.01):
        touched = InteractiveSimulation(lattice_or_gel("gel"), {"sphere": spherical_indenter((20.0, 20.0, 60.0), 8.0)}, budget_s=budget)
        touched.take("sphere")
        touched.move((20.0, 20.0, TOP + 5.0))
        for _ in range(4):
            frame = touched.advance()
            while frame.under_way:
                frame = touched.advance()
        ends.append(frame)
        touched.close()
    assert not ends[0].failed and ends[0].time_s == pytest.approx(4 / 60)
    assert "finds no balance" in ends[1].failed and ends[1].time_s == 0.0


def test_frames_go_on_while_newtons_method_finds_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread finds what it finds where nobody waits; a step that is given up, as by Reset, leaves nothing behind."""
    without_quasi_newton(monkeypatch)
    ends, most = [], 0
    for budget in (np.inf, 0.0, 0.0):
        touched = InteractiveSimulation(lattice_or_gel("gel"), {"sphere": spherical_indenter((20.0, 20.0, 60.0), 8.0)}, budget_s=budget)
        touched.take("sphere")
        for height in np.linspace(52.0, TOP + 5.0, 8):
            touched.move((20.0, 20.0, height))
            frame, frames = touched.advance(), 0
            if len(ends) == 2 and height < 50.0 and frame.under_way:
                touched.reset()
                assert touched.advance().failed == ""
                break
            while frame.under_way:
                frame, frames = touched.advance(), frames + 1
            most = max(most, frames)
        ends.append(frame)
        touched.close()
    assert most > 1
    np.testing.assert_allclose(ends[1].positions, ends[0].positions, atol=1e-3 * TOP)  # with other factors, to the same tolerance
    np.testing.assert_allclose(ends[1].force, ends[0].force, atol=0.01 * abs(ends[0].force[2]))
    np.testing.assert_allclose(touched.last.positions, touched.body.points, atol=1e-9)


def test_frames_that_leave_their_step_to_the_next_come_to_the_same_states() -> None:
    ends = []
    for budget in (np.inf, 0.0):
        touched = InteractiveSimulation(lattice_or_gel("gel"), {"sphere": spherical_indenter((20.0, 20.0, 60.0), 8.0)}, budget_s=budget)
        touched.take("sphere")
        frames = []
        for height in np.linspace(52.0, TOP + 5.0, 8):
            touched.move((20.0, 20.0, height))
            frames.append(touched.advance())
            while frames[-1].under_way:
                before = frames[-1]
                touched.move((20.0, 20.0, height + 1.0))  # not followed before the step has ended
                frames.append(touched.advance())
                if frames[-1].under_way:
                    assert frames[-1].number > before.number
                    assert frames[-1].time_s == before.time_s
                    assert frames[-1].positions is before.positions
                    assert frames[-1].unbalanced == before.unbalanced
                touched.move((20.0, 20.0, height))
        assert any(frame.under_way for frame in frames) == (budget == 0.0)
        ends.append([np.vstack([f.positions, f.force, f.tool_centre]) for f in frames if not f.under_way])
        touched.close()
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-12, atol=1e-12)
    assert ends[0][-1][-2, 2] < 0.0


def test_the_same_commands_give_the_same_frames() -> None:
    def run() -> np.ndarray:
        touched = simulation()
        touched.take("sphere")
        for k in range(12):
            touched.move((20.0 + k, 20.0, 56.0 - 2 * k))
            frame = touched.advance()
        return frame.positions

    np.testing.assert_array_equal(run(), run())


def test_a_cut_keeps_momentum_and_the_halves_part_under_tension() -> None:
    mesh = box((20.0, 20.0, 20.0), (4, 4, 4), cell_type="tetra")
    law = material(young_modulus=20.0, poisson_ratio=0.45)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    lowest = np.flatnonzero(mesh.points[:, 2] < 1e-9)
    touched = InteractiveSimulation(FiniteElementBody.of(mesh, assembler, supported=lowest, background=False), {})
    corner = int(np.argmax(mesh.points @ [1.0, 0.2, 1.0]))
    touched.grip(corner, 30.0)
    touched.pull(mesh.points[corner] + [0.0, 0.0, 4.0])
    for _ in range(8):
        touched.advance()
    engine, state = touched.body.engine, touched._session.state()  # type: ignore[attr-defined]
    momentum = (engine.mass[:, None] * state.velocity).sum(axis=0)
    found = touched.cut([[[x, -20.0, 12.0], [x, 20.0, 12.0]] for x in (-20.0, 20.0)], 4.0)
    assert found.n_pieces == 2
    engine, state = touched.body.engine, touched._session.state()  # type: ignore[attr-defined]
    np.testing.assert_allclose((engine.mass[:, None] * state.velocity).sum(axis=0), momentum, atol=1e-12)
    lower = np.unique(found.mesh.cells[found.piece == found.piece[np.argmin(found.mesh.points[found.mesh.cells][:, :, 2].mean(axis=1))]])
    for _ in range(40):
        frame = touched.advance()
    assert not frame.failed
    assert np.abs(frame.positions[lower] - found.mesh.points[lower]).max() < 0.1  # what is held goes back
    assert touched.undo()
    assert len(touched.last.positions) == mesh.n_points


def test_a_body_moves_on_while_its_cut_is_prepared() -> None:
    mesh = box((20.0, 20.0, 20.0), (3, 3, 3), cell_type="tetra")
    law = material(young_modulus=20.0, poisson_ratio=0.45)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    body = FiniteElementBody.of(
        mesh, assembler, supported=np.flatnonzero(mesh.points[:, 2] < 1e-9), gravity=(0.0, 0.0, -9810.0), background=False
    )
    touched = InteractiveSimulation(body, {})
    through = [[[x, -20.0, 12.0], [x, 20.0, 12.0]] for x in (-20.0, 20.0)]
    touched.begin_cut(through, 4.0)
    with pytest.raises(InputError, match="a cut is under way"):
        touched.begin_cut(through, 4.0)
    moved = touched.advance()
    assert moved.topology == 0
    before = touched._session.state().displacement
    assert touched.finish_cut(wait=True)
    after = touched._session.state().displacement
    np.testing.assert_allclose(after.min(axis=0), before.min(axis=0), atol=0.03)  # mm: what it had become meanwhile is kept
    assert touched.last.topology == 1
    assert len(touched.body.points) > mesh.n_points
    assert not touched.advance().failed
    assert not touched.finish_cut()
    touched.begin_cut(through, -1.0)
    with pytest.raises(InputError, match="distance_mm"):
        touched.finish_cut(wait=True)
    assert touched.last.topology == 1


def test_a_nearly_incompressible_body_goes_on_in_real_time_behind_a_cut() -> None:
    """The patches that share a volume strain are divided: unless that is settled before, Newton's method takes seconds at first."""
    mesh = box((60.0, 60.0, 60.0), (11, 11, 11), cell_type="tetra")
    assembler = Assembler.from_materials(
        elements(mesh, "mean_dilatation"), mesh.regions, [material(young_modulus=70.0, poisson_ratio=0.499)]
    )
    body = FiniteElementBody.of(
        mesh, assembler, supported=np.flatnonzero(mesh.points[:, 2] < 1e-9), gravity=(0.0, 0.0, -9810.0), background=False
    )
    touched = InteractiveSimulation(body, {})
    for _ in range(30):
        touched.advance()
    touched.begin_cut([[[x, -5.0, 24.0], [x, 30.0, 24.0]] for x in (-5.0, 65.0)])
    stages = [touched.cut_stage]
    while not touched.finish_cut():
        stages.append(touched.cut_stage)
        time.sleep(0.01)
    assert touched.cut_stage == -1 and min(stages) == 0
    assert stages == sorted(stages)
    before = touched.last.positions
    for _ in range(5):
        frame = touched.advance()
    session = touched._session
    assert isinstance(session, RealTimeSession)
    assert (session.newton_steps, session.waits) == (0, 0)
    assert session.unbalanced < 0.01 and not frame.failed
    assert np.abs(frame.positions - before).max() < 0.1  # mm: the weight above keeps the cut closed


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_a_cut_at_once_goes_on_as_one_that_was_prepared(friction: float) -> None:
    """Volume strains and the sides of the cut are in balance behind both, so that no step needs Newton's method."""
    size, n, motions = 60.0, 7, []
    mesh = box((size,) * 3, (n,) * 3, cell_type="tetra")
    law = material(young_modulus=70.0, poisson_ratio=0.499)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    whole = FiniteElementBody.of(
        mesh, assembler, supported=np.flatnonzero(mesh.points[:, 2] < 1e-9), gravity=(0.0, 0.0, -9810.0), background=False
    )
    for prepared in (False, True):
        touched = InteractiveSimulation(replace(whole, lips_friction=friction), {})
        for _ in range(20):
            touched.advance()
        blade = [[[x, -0.6 * size, 26.0], [x, 0.6 * size, 22.0]] for x in (-0.6 * size, 0.6 * size)]
        if prepared:
            touched.begin_cut(blade)
            assert touched.finish_cut(wait=True)
        else:
            assert touched.cut(blade).n_pieces == 2  # type: ignore[union-attr]
        frames = [touched.advance() for _ in range(5)]
        session = touched._session
        assert isinstance(session, RealTimeSession)
        assert session.newton_steps == 0 and not any(frame.failed for frame in frames)
        motions.append([frame.positions for frame in frames])
    np.testing.assert_allclose(*motions, atol=0.01)  # mm: threads of the solver add in different orders


def test_the_tangent_behind_a_cut_knows_the_table_on_which_the_body_lies() -> None:
    """Without it a load would move the body, which nothing else holds, as a free mass in a step: by F h^2 / m."""
    size = 30.0
    mesh = box((size,) * 3, (3,) * 3, cell_type="tetra")
    law = material(young_modulus=70.0, poisson_ratio=0.49)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    table = plane_indenter((0.0, 0.0, -0.5 * size), (0.0, 0.0, 1.0), static_friction=0.5, kinetic_friction=0.5)
    whole = FiniteElementBody.of(mesh, assembler, fixtures=[table], gravity=(0.0, 0.0, -9810.0), background=False)
    touched = InteractiveSimulation(whole, {})
    for _ in range(20):
        touched.advance()
    touched.cut([[[0.4, y, size], [0.4, y, 0.0]] for y in (-size, size)])
    session = touched._session
    assert isinstance(session, RealTimeSession)
    engine = session._engine
    (tangent,) = engine._rest
    load = -engine.mass[:, None] * np.array([0.0, 0.0, 9810.0])
    moved = tangent.factors.solve(load.ravel()).reshape(-1, 3)
    assert np.abs(moved).max() < 0.05 * 9810.0 * engine.step**2
    touched.close()


def test_a_lattice_is_cut_while_it_is_touched() -> None:
    touched = simulation()
    before = touched.body.engine.lattice  # type: ignore[attr-defined]
    touched.take("sphere")
    touched.move((20.0, 20.0, TOP + 4.0))
    for _ in range(10):
        touched.advance()
    found = touched.cut([[[-50.0, y, 21.0], [50.0, y, 21.0]] for y in (-50.0, 50.0)])
    assert found.n_pieces == 2
    engine = touched.body.engine  # type: ignore[attr-defined]
    assert engine.lattice.total_mass == pytest.approx(before.total_mass, rel=1e-12)
    corner = int(np.argmax(engine.lattice.points.sum(axis=1)))
    touched.grip(corner, 12.0)
    touched.pull(engine.lattice.points[corner] + [0.0, 0.0, 15.0])
    for _ in range(40):
        frame = touched.advance()
    upper, lower = (frame.positions[engine.lattice.cells[found.piece == found.piece[k]]] for k in (-1, 0))
    assert upper[..., 2].min() > 25.0
    assert lower[..., 2].max() < 24.0
    assert touched.undo() and touched.undo()
    assert len(touched.last.positions) == before.n_nodes


def test_a_body_that_has_sunk_into_its_table_can_be_touched() -> None:
    held = touched_lattice()
    weight = np.tile([0.0, 0.0, -5.0], (len(held.points), 1))  # mN a node, ten times its own
    table = plane_indenter((0.0, 0.0, 0.0), static_friction=0.5)
    lying = replace(held, supported=np.zeros(0, dtype=np.int64), fixtures=(table,), external_force=weight)
    touched = InteractiveSimulation(lying, {"sphere": spherical_indenter((20.0, 20.0, 60.0), 8.0)})
    for _ in range(30):
        touched.advance()
    assert table.gap(touched.last.positions).min() < -1e-4  # the foundation yields
    touched.take("sphere")
    touched.move((20.0, 20.0, TOP + 4.0))
    for _ in range(30):
        frame = touched.advance()
    assert frame.force[2] < 0.0 and not frame.failed
    touched.take("")
    touched.take("sphere")  # and again
    with pytest.raises(InputError, match="inside the object"):  # a tool that was not in play
        touched._session.press((table, spherical_indenter((20.0, 20.0, 20.0), 8.0)))


def test_what_cannot_be_is_refused() -> None:
    touched = simulation()
    with pytest.raises(InputError, match="there is no tool 'hammer'; choose one of sphere, far"):
        touched.take("hammer")
    with pytest.raises(InputError, match="faces of the lattice's cubes lie up to 5 mm from the blade; choose 10 mm"):
        touched.cut([[[-50.0, y, 15.0], [50.0, y, 15.0]] for y in (-50.0, 50.0)], 4.0)
    with pytest.raises(InputError, match="node is 125"):
        touched.grip(125)
    with pytest.raises(InputError, match="begins inside the body"):
        InteractiveSimulation(touched_lattice(), {"sphere": spherical_indenter((20.0, 20.0, 20.0), 8.0)})
    with pytest.raises(InputError, match="less than a step"):
        InteractiveSimulation(touched_lattice(), {}, frame_s=1e-4)


class _Clock:
    """A clock that only sleeping moves."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def test_the_loop_keeps_real_time_and_records_thirty_frames_a_second() -> None:
    clock = _Clock()
    loop = RealTimeLoop(simulation(), clock, clock.sleep)
    loop.record(True)
    due = 0.0
    for _ in range(90):
        loop._obey()
        due = loop._once(due)
    frame, pace = loop.latest()
    assert pace.real_time == pytest.approx(1.0, abs=0.06)
    assert frame.time_s == pytest.approx(90 * 8 * 2e-3)
    assert len(loop.recorded()) == pytest.approx(0.5 * 90, abs=2)
    loop.record(False)
    loop.replay()
    due = loop._once(due)
    assert loop.latest()[1].replaying
    assert loop.latest()[0] is loop.recorded()[0]


def test_commands_are_carried_out_by_the_thread_and_their_trouble_is_told_once() -> None:
    import time

    with RealTimeLoop(simulation()) as loop:
        loop.submit(lambda s: s.take("hammer"))
        loop.submit(lambda s: s.take("sphere"))
        end = time.monotonic() + 20.0
        while loop.latest()[0].tool != "sphere" and time.monotonic() < end:
            time.sleep(0.01)
        assert loop.latest()[0].tool == "sphere"
        assert "there is no tool 'hammer'" in loop.trouble()
        assert loop.trouble() == ""


@pytest.mark.parametrize(("friction", "radius", "offset"), [(0.5, 6.0, 0.0), (0.2, 8.0, 1.0)])
def test_a_sphere_dragged_across_a_cut_and_back_finds_a_balance_in_every_frame(friction: float, radius: float, offset: float) -> None:
    """Points of the sphere and pairs of the two sides of the cut open and close by turns."""
    size, n = 40.0, 5
    mesh = box((size,) * 3, (n,) * 3, cell_type="tetra", centred=False)
    law = material(young_modulus=10.0, poisson_ratio=0.45)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    whole = FiniteElementBody.of(mesh, assembler, supported=np.flatnonzero(mesh.points[:, 2] < 1e-9), background=False)
    middle = 0.5 * size + offset
    blade = swept_blade([[[middle, y, size + 5.0], [middle, y, 0.5 * size]] for y in (-5.0, size + 5.0)])
    body = whole.cut(whole.session().state(), blade, size / n)[0]
    above = size + radius + 3.0
    sphere = spherical_indenter((0.5 * size, 0.5 * size, above), radius, static_friction=friction, kinetic_friction=friction)
    touched = InteractiveSimulation(body, {"sphere": sphere})
    touched.take("sphere")
    forces = []
    for x, height in [(-3.5, 0.0), (-3.5, -9.0), *2 * [(3.5, -9.0), (-3.5, -9.0)], (-3.5, 0.0)]:
        goal = np.array([0.5 * size + x, 0.5 * size, above + height])
        touched.move(goal)
        while np.abs(touched.last.tool_centre - goal).max() > 1e-9:
            frame = touched.advance()
            assert not frame.failed
            forces.append(frame.force[2])
    assert min(forces) < -200.0
    session = touched._session
    assert isinstance(session, RealTimeSession)
    assert session.newton_steps <= 6
    lips = body.engine.assembler.lips  # type: ignore[attr-defined]
    gaps = lips.gaps(session.state().displacement)
    assert gaps[np.isfinite(gaps)].min() > -0.02 * lips.edge.min()


def pressed_gel() -> tuple[InteractiveSimulation, float]:
    """A block of finite elements that a sphere presses by a quarter of its height, at rest; and that height, mm."""
    size = 20.0
    mesh = box((size,) * 3, (5,) * 3, cell_type="tetra", centred=False)
    law = material(young_modulus=10.0, poisson_ratio=0.45)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    body = FiniteElementBody.of(mesh, assembler, supported=np.flatnonzero(mesh.points[:, 2] < 1e-9), background=False)
    above = size + 5.0
    tools = {name: spherical_indenter((0.5 * size, 0.5 * size, above), 4.0) for name in ("sphere", "other")}
    touched = InteractiveSimulation(body, tools)
    touched.take("sphere")
    touched.move((0.5 * size, 0.5 * size, above - 0.3 * size))
    for _ in range(60):
        touched.advance()
    assert touched.last.force[2] < -50.0 and not touched.last.failed
    return touched, size


@pytest.mark.parametrize("tool", ["", "other"])
def test_a_tool_that_presses_is_lifted_before_another_one_is_taken(tool: str) -> None:
    touched, size = pressed_gel()
    touched.take(tool)
    for _ in range(60):
        frame = touched.advance()
        assert not frame.failed
    assert frame.tool == tool
    assert not frame.force.any()
    assert abs(float(frame.positions[:, 2].max()) - size) < 0.01 * size  # it has sprung back


def test_undo_of_a_reset_brings_back_the_body_with_the_tool_that_presses_it() -> None:
    touched, _ = pressed_gel()
    before = touched.last
    touched.reset()
    touched.advance()
    assert touched.undo()
    assert touched.last.tool == "sphere"
    np.testing.assert_allclose(touched.last.tool_centre, before.tool_centre, atol=1e-12)
    for _ in range(5):
        frame = touched.advance()
        assert not frame.failed
    np.testing.assert_allclose(frame.force[2], before.force[2], rtol=0.02)
    assert np.abs(frame.positions - before.positions).max() < 0.02


def clamped_sphere() -> InteractiveSimulation:
    """A block with a cavity that holds a sphere: its roof is gripped and pulled down until the sphere is held fast from both sides."""
    size = 20.0
    mesh = box((size,) * 3, (5,) * 3, cell_type="tetra", centred=False)
    hollow = np.abs(mesh.points[mesh.cells].mean(axis=1) - 0.5 * size).max(axis=1) < 6.0
    used, cells = np.unique(mesh.cells[~hollow], return_inverse=True)
    mesh = replace(mesh, points=mesh.points[used], cells=cells.reshape(-1, 4), regions=mesh.regions[~hollow])
    law = material(young_modulus=10.0, poisson_ratio=0.45)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    body = FiniteElementBody.of(mesh, assembler, supported=np.flatnonzero(mesh.points[:, 2] < 1e-9), background=False)
    tools = {"sphere": spherical_indenter((0.5 * size,) * 3, 5.9), "other": spherical_indenter((0.5 * size, 0.5 * size, 40.0), 4.0)}
    touched = InteractiveSimulation(body, tools)
    touched.take("sphere")
    roof = int(np.argmin(np.linalg.norm(mesh.points - [0.4 * size, 0.4 * size, size], axis=1)))
    touched.grip(roof, 30.0)
    touched.pull(mesh.points[roof] - [0.0, 0.0, 3.5])
    for _ in range(60):
        assert not touched.advance().failed
    assert touched.last.penetration_mm > 0.0
    return touched


def test_a_tool_that_the_body_holds_fast_keeps_neither_frames_nor_cuts_waiting() -> None:
    touched = clamped_sphere()
    touched.take("other")
    frames = 0
    with pytest.raises(InputError, match="sphere did not leave the body within 3 s, and it stays in play"):
        while not touched.finish_cut():
            assert not touched.advance().failed
            frames += 1
            assert frames < 400
    assert frames * touched.frame_s == pytest.approx(3.0, abs=0.1)
    assert touched.last.tool == "sphere"
    assert not touched.finish_cut()  # said once
    touched.begin_cut([[[x, 10.0, 30.0], [x, 10.0, 10.0]] for x in (-5.0, 25.0)])
    with pytest.raises(InputError, match="the cut came to nothing: move it out"):
        touched.finish_cut(wait=True)
    assert touched.last.topology == 0
    assert not touched.advance().failed
    touched.pull(touched.last.positions[touched.last.gripped] + [0.0, 0.0, 3.5])  # the roof goes up again, and lets it go
    for _ in range(60):
        touched.advance()
    touched.take("other")
    for _ in range(60):
        touched.advance()
    assert touched.last.tool == "other"
