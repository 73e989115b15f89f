"""A tool is held back by planes and by crushed cells: it neither passes through the table nor through the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from touched_lattice import TOP, touched_lattice

from naibu.core.arrays import FloatArray
from naibu.core.rigid_transform import rotation_matrix
from naibu.mechanics import Assembler, elements, material, plane_indenter, spherical_indenter
from naibu.mechanics.contact.rigid_indenters import box_indenter, capsule_indenter, cylindrical_indenter
from naibu.meshing import box
from naibu.simulation import FiniteElementBody, InteractiveBody, InteractiveSimulation
from naibu.simulation.crushed_cells import CrushedCells
from naibu.simulation.held_tool import CRUSHED, outside_planes
from naibu.simulation.tool_places import placed
from naibu.workflows import tools_for, touchable

TURNED = rotation_matrix(np.array([0.4, -0.9, 0.3]))


def test_least_principal_stretches_are_singular_values() -> None:
    """Of single tetrahedra under random deformation gradients, and of all of them together."""
    rng = np.random.default_rng(1)
    special = [np.eye(3), 2.0 * TURNED, TURNED @ np.diag([1.0, 1.0, 0.2]), np.zeros((3, 3)), -np.eye(3)]
    gradients = np.concatenate([rng.normal(size=(300, 3, 3)), special])
    expected = np.linalg.svd(gradients, compute_uv=False)[:, 2] * np.where(np.linalg.det(gradients) < 0.0, -1.0, 1.0)
    rest = np.array([[0.0, 0, 0], [3, 0, 0.5], [0.4, 2, 0], [0.3, 0.2, 2.5]])
    cells = CrushedCells.of(rest, np.array([[0, 1, 2, 3]]))
    found = [cells.least_stretch(rest @ gradient.T, 0)[0] for gradient in gradients]
    np.testing.assert_allclose(found, expected, atol=1e-7)
    points = np.concatenate([rest + 10.0 * k for k in range(len(gradients))])
    many = CrushedCells.of(points, np.arange(len(points)).reshape(-1, 4))
    moved = np.concatenate([rest @ gradient.T for gradient in gradients])
    least, place = many.least_stretch(moved, 0)
    assert least == pytest.approx(expected.min(), abs=1e-7)
    np.testing.assert_allclose(place, (rest @ gradients[expected.argmin()].T).mean(axis=0), atol=1e-9)
    assert many.least_stretch(points, 0, 0.6) == (0.6, pytest.approx(np.zeros(3)))


def test_slivers_are_left_out() -> None:
    points = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10], [3, 3, 0.01]])
    cells = np.array([[0, 1, 2, 3], [0, 1, 2, 4]])
    found = CrushedCells.of(points, cells, 2)
    assert sorted(len(part) for part in found.cells) == [0, 1]
    moved = points * (1.0, 1.0, 0.3) - (0.0, 0.0, 5.0)
    least, place = found.least_stretch(moved, 0)
    assert least == pytest.approx(0.3)
    np.testing.assert_allclose(place, moved[:4].mean(axis=0))
    assert found.least_stretch(moved, 1)[0] == np.inf


@pytest.mark.parametrize("shape", ["sphere", "box", "capsule", "cylinder"])
def test_a_tool_is_put_on_a_plane_that_it_would_enter(shape: str) -> None:
    tool = {
        "sphere": spherical_indenter((0.0, 0.0, 0.0), 5.0),
        "box": box_indenter((0.0, 0.0, 0.0), (4.0, 9.0, 2.0), TURNED),
        "capsule": capsule_indenter((0.0, 0.0, 0.0), 2.0, 9.0, (1.0, 2.0, 0.5)),
        "cylinder": cylindrical_indenter((0.0, 0.0, 0.0), 3.0, 7.0, (1.0, 2.0, 0.5)),
    }[shape]
    plane = plane_indenter((1.0, 2.0, -3.0), (0.1, 0.2, 1.0))
    axis = np.arange(-8.0, 8.0, 0.2)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    own = grid[tool.gap(grid) <= 0.0]  # what the tool fills about its centre
    kept = outside_planes((plane,), tool, np.array([4.0, -2.0, -30.0]))
    assert -0.1 <= plane.gap(own + kept).min() < 0.4  # it stands on the plane, to the spacing of the grid
    np.testing.assert_allclose(np.cross(kept - [4.0, -2.0, -30.0], plane.geometry.normal), 0.0, atol=1e-12)
    clear = np.array([4.0, -2.0, 30.0])
    np.testing.assert_array_equal(outside_planes((plane,), tool, clear), clear)


def standing(kind: str) -> InteractiveBody:
    """A cube of 40 mm that stands on a plane at z = 0."""
    table = plane_indenter((0.0, 0.0, 0.0), static_friction=0.6, kinetic_friction=0.6)
    if kind == "lattice":
        return replace(touched_lattice(), supported=np.zeros(0, dtype=np.int64), fixtures=(table,))
    mesh = box((TOP, TOP, TOP), (5, 5, 5), centred=False)
    law = material(young_modulus=20.0, poisson_ratio=0.49)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    return FiniteElementBody.of(mesh, assembler, fixtures=(table,), background=False)


def led(touched: InteractiveSimulation, places: FloatArray) -> list[float]:
    """Lead the tool frame by frame; return its downward force in each, mN."""
    forces = []
    for place in places:
        touched.move(place)
        frame = touched.advance()
        assert not frame.failed
        forces.append(-float(frame.force[2]))
    return forces


@pytest.mark.parametrize("kind", ["lattice", "gel"])
@pytest.mark.parametrize("tool", ["sphere", "plate"])
def test_a_tool_that_keys_press_down_for_ever_is_held_by_the_body(kind: str, tool: str) -> None:
    """The hand goes on through body and table; the force is that of the table on the body, and ends when the tool goes back."""
    body = standing(kind)
    touched = InteractiveSimulation(body, tools_for(body))
    touched.take(tool)
    start = touched.advance().tool_centre
    pressed = led(touched, start - np.outer(1.3 * np.arange(60), (0.0, 0.0, 1.0)))
    frame = touched.last
    assert frame.held
    assert frame.tool_centre[2] > 0.3 * TOP
    cells = CrushedCells.of(body.points, body.cells)
    assert -0.05 < cells.least_stretch(frame.positions, 0)[0] < 0.3  # as far as it goes, and hardly farther
    assert frame.penetration_mm < touched.tools[tool].geometry.inradius  # the surface has not passed the middle of the tool
    rest = led(touched, np.tile(start - (0.0, 0.0, 80.0), (60, 1)))
    assert min(rest[-30:]) > 0.02 * max(pressed)  # it still presses
    assert np.ptp(rest[-10:]) < 0.1 * rest[-1]  # steadily
    assert touched.last.tool_centre[2] > frame.tool_centre[2] - 0.05 * TOP
    table = placed(body.fixtures[0], np.zeros(3)).gap(touched.last.positions).min()
    assert table > -0.05 * TOP
    led(touched, np.tile(start, (60, 1)))
    assert not touched.last.held and not touched.last.force.any()
    np.testing.assert_allclose(touched.last.tool_centre, start, atol=1e-9)


@pytest.mark.parametrize("kind", ["lattice", "gel"])
def test_the_force_of_a_held_press_is_that_of_the_table(kind: str) -> None:
    body = standing(kind)
    touched = InteractiveSimulation(body, tools_for(body))
    touched.take("plate")
    touched.move(touched.advance().tool_centre - (0.0, 0.0, 100.0))
    for _ in range(150):
        frame = touched.advance()
    assert frame.held
    motions = touched._motions(np.zeros(3), np.zeros(3))
    forces = body.step(touched._session, body.grip_velocity(np.zeros(3)), motions, touched.steps, np.inf)
    assert forces is not None
    table, tool = forces.indenters[-1]
    np.testing.assert_allclose(table[2], -tool[2], rtol=0.03)
    np.testing.assert_allclose(frame.force[2], tool[2], rtol=0.03)


def test_a_press_that_crushes_nothing_goes_where_it_is_led() -> None:
    body = standing("gel")
    touched = InteractiveSimulation(body, tools_for(body))
    touched.take("sphere")
    goal = np.array([0.5 * TOP, 0.5 * TOP, TOP + 0.14 * TOP - 8.0])  # 8 mm deep, a fifth of the body
    touched.move(goal)
    for _ in range(40):
        frame = touched.advance()
        assert not frame.held and not frame.failed
    np.testing.assert_allclose(frame.tool_centre, goal, atol=1e-12)


@pytest.mark.parametrize("tool", ["sphere", "plate", "bar"])
def test_beside_the_body_a_tool_comes_to_stand_on_the_table(tool: str) -> None:
    body = standing("lattice")
    touched = InteractiveSimulation(body, tools_for(body))
    touched.take(tool)
    touched.move((90.0, 20.0, 60.0))
    touched.turn((0.5, 0.2, 0.0))
    for _ in range(80):
        touched.advance()
    touched.move((90.0, 20.0, -50.0))
    for _ in range(80):
        frame = touched.advance()
    turned = placed(touched.tools[tool], frame.tool_centre, frame.tool_rotation)
    assert frame.tool_centre[2] - turned.geometry.reach((0.0, 0.0, -1.0)) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(frame.tool_centre[:2], (90.0, 20.0), atol=1e-9)
    assert not frame.force.any()


def test_where_steps_are_shown_one_by_one_a_press_is_held_as_well() -> None:
    """As with a haptic device: the cells are looked at in parts, one in each step."""
    body = standing("lattice")
    touched = InteractiveSimulation(body, tools_for(body), frame_s=body.step_s)
    touched.take("sphere")
    start = touched.advance().tool_centre
    led(touched, start - np.outer(0.15 * np.arange(500), (0.0, 0.0, 1.0)))
    assert touched.last.held and touched.last.force[2] < 0.0
    cells = CrushedCells.of(body.points, body.cells)
    assert 0.5 * CRUSHED - 0.1 < cells.least_stretch(touched.last.positions, 0)[0] < 0.3
    assert touched.last.tool_centre[2] > 0.3 * TOP


def test_the_force_does_not_leap_while_crushed_cells_hold_a_tool_back() -> None:
    """Steps of 1 ms, as a haptic device feels them: braked anew at each look at the cells, the tool's force had leapt by 1.5 N in one."""
    body = touchable("dough-pressed-by-sphere").body
    tool = tools_for(body)["sphere"]
    touched = InteractiveSimulation(body, {"sphere": tool}, body.step_s)
    touched.take("sphere")
    forces, held = [], []
    for step in range(450):
        touched.move(tool.centre - (0.0, 0.0, 0.1 * step))
        frame = touched.advance()
        forces.append(np.linalg.norm(frame.force))
        held.append(frame.held)
    touched.close()
    braked = np.array(forces[150:])
    assert braked.max() > 10_000.0 and any(held[150:]) and held[-1]
    assert np.abs(np.diff(braked)).max() < 500.0
