"""Contact of the faces of lattices: smooth forces that hardly depend on the mesh, all indenters, balance, small and large ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.mechanics.contact.contact_surfaces import face_quadrature
from naibu.mechanics.contact.indenter_motion import IndenterVelocity
from naibu.mechanics.contact.rigid_indenters import (
    RigidIndenter,
    bar_indenter,
    box_indenter,
    capsule_indenter,
    cylindrical_indenter,
    mesh_indenter,
    plane_indenter,
    spherical_indenter,
)
from naibu.mechanics.lattices.cpu.contact._cells import covered
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import CLASSES, box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes

SIDE_MM = 80.0
DOUGH = ((60.0, 40.0, 25.0), (30.0, 18.0, 12.0), (2000.0, 1500.0, 1000.0))  # of the bundled studies, at a spacing of 10 mm


def dough(nodes: int, step: float = 4e-3, tolerance: float = 1e-3) -> LatticeEngine:
    """A cube of dough; its elements are as stiff as their length asks for."""
    spacing = SIDE_MM / (nodes - 1)
    lattice = classic_lattice(box_mask((nodes - 1,) * 3), spacing, total_mass_kg=0.63)
    values = [dict(zip(CLASSES, (v * spacing / 10.0 for v in row), strict=True)) for row in DOUGH]
    return LatticeEngine.of(lattice, lattice_parameters(lattice, *values), step=step, tolerance=tolerance)


def bottom(engine: LatticeEngine) -> ConstrainedNodes:
    return ConstrainedNodes.of(np.flatnonzero(engine.lattice.points[:, 2] < 1e-9))


def pushed(engine: LatticeEngine, indenter: RigidIndenter, depth: float, steps: int) -> FloatArray:
    """Force downwards, mN, while an indenter that just touches goes down."""
    session = engine.session(constrained=bottom(engine), indenters=[indenter])
    speed = depth / (steps * engine.step)
    forces = [session.step(motions=[IndenterVelocity((0.0, 0.0, -speed))]).indenters[0, 0, 2] for _ in range(steps)]
    assert session.unsettled == 0
    return -np.array(forces)


@pytest.mark.parametrize("place", [(40.0, 40.0), (40.0, 45.0), (42.5, 42.5), (45.0, 45.0), (43.3, 46.1)])
def test_a_sphere_meets_a_smooth_force_that_a_finer_mesh_confirms(place: tuple[float, float]) -> None:
    """5 mm deep with a radius as large as a face: over a node, an edge, a quarter, the middle of a face, and elsewhere."""
    curves = [pushed(dough(nodes), spherical_indenter((*place, SIDE_MM + 10.0), 10.0), 5.0, 250) for nodes in (9, 17)]
    for curve in curves:
        assert np.abs(np.diff(curve)).max() < 0.02 * np.ptp(curve)
        assert 0.01 * np.ptp(curve) < curve[0] < 0.035 * np.ptp(curve)  # the dashpots of a half-space resist the first touch by 2.6 %
    assert np.abs(curves[0] - curves[1]).max() < 0.03 * np.ptp(curves[1])


@pytest.mark.parametrize(
    ("order", "depth", "within"), [(5, 0.1, 0.5), (5, 0.3, 0.2), (5, 1.0, 0.06), (5, 3.0, 0.03), (3, 1.0, 0.15), (3, 3.0, 0.06)]
)
def test_cells_of_faces_add_up_to_the_volume_of_the_cap_that_a_sphere_has_below_them(order: int, depth: float, within: float) -> None:
    """Integral of ``R - r`` over the section of a sphere whose centre is R - d above a plane, wherever it stands over its faces."""
    radius, edge = 10.0, 10.0
    grid = np.arange(-1.0, 3.0) * edge
    points = np.stack([*np.meshgrid(grid, grid, indexing="ij"), np.zeros((4, 4))], axis=2).reshape(-1, 3)
    corner = (4 * np.arange(3)[:, None] + np.arange(3)).ravel()
    faces = np.stack([corner, corner + 4, corner + 5, corner + 1], axis=1)
    shape, weight = face_quadrature(points, faces, order)
    at, height = np.einsum("qk,fki->fqi", shape, points[faces]).reshape(-1, 3), radius - depth
    exact = np.pi * radius * (radius**2 - height**2) - 2.0 * np.pi / 3.0 * (radius**3 - height**3)
    for place in np.random.default_rng(2).uniform(0.0, edge, (20, 2)):
        away = np.linalg.norm(at - [*place, height], axis=1)
        slope = np.linalg.norm(at[:, :2] - place, axis=1) / away
        mean = [covered(d, s, np.sqrt(w), 1.0 / radius)[0] for d, s, w in zip(radius - away, slope, weight.ravel(), strict=True)]
        assert weight.ravel() @ mean == pytest.approx(exact, rel=within)


def test_a_plate_presses_as_nodes_that_move_with_it() -> None:
    """An indenter that covers the surface leaves the foundation nothing to do."""
    engine = dough(9)
    steps, speed = 100, 20.0
    force = pushed(engine, plane_indenter((0.0, 0.0, SIDE_MM), (0.0, 0.0, -1.0)), steps * engine.step * speed, steps)
    top = ConstrainedNodes.of(np.flatnonzero(engine.lattice.points[:, 2] > SIDE_MM - 1e-9), 1, axes=(2,))
    session = engine.session(constrained=bottom(engine) + top)
    moved = -session.step([[0.0, 0.0, 0.0], [0.0, 0.0, -speed]], steps=steps).bodies[:, 1, 2]
    np.testing.assert_allclose(force[10:], moved[10:], rtol=0.03)  # the sides bulge and touch as well
    assert abs(np.median(force[10:] / moved[10:]) - 1.0) < 0.01


CORNERS = np.array([[x, y, z] for z in (-9, 9) for y in (-9, 9) for x in (-9, 9)], dtype=float)
SIDES = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
TRIANGLES = np.concatenate([SIDES[:, [0, 1, 2]], SIDES[:, [0, 2, 3]]])
INDENTERS = {
    "plane": plane_indenter((0.0, 0.0, SIDE_MM), (0.0, 0.0, -1.0), static_friction=0.4, kinetic_friction=0.3),
    "box": box_indenter((33.0, 38.0, SIDE_MM + 9.0), (18.0, 18.0, 18.0), static_friction=0.4, kinetic_friction=0.3),
    "cylinder": cylindrical_indenter((33.0, 38.0, SIDE_MM + 9.0), 9.0, 40.0, (1.0, 0.2, 0.0), static_friction=0.4, kinetic_friction=0.3),
    "sphere": spherical_indenter((33.0, 38.0, SIDE_MM + 9.0), 9.0, static_friction=0.4, kinetic_friction=0.3),
    "capsule": capsule_indenter((33.0, 38.0, SIDE_MM + 9.0), 9.0, 20.0, (1.0, 0.2, 0.0), static_friction=0.4, kinetic_friction=0.3),
    "bar": bar_indenter((33.0, 38.0, SIDE_MM), "y", 18.0, corner_radius_mm=3.0, static_friction=0.4, kinetic_friction=0.3),
    "mesh": mesh_indenter((33.0, 38.0, SIDE_MM + 9.0), CORNERS, TRIANGLES, static_friction=0.4, kinetic_friction=0.3),
}


@pytest.mark.parametrize("name", INDENTERS)
def test_all_indenters_push_and_drag_with_what_they_exert(name: str) -> None:
    """The forces told are those that move the lattice, friction obeys Coulomb, and no step jumps."""
    engine = dough(9)
    session = engine.session(constrained=bottom(engine), indenters=[INDENTERS[name]])
    forces, held = [], np.zeros(3)
    for n in range(120):
        step = session.step(motions=[IndenterVelocity((20.0 if n >= 60 else 0.0, 0.0, -10.0 if n < 60 else 0.0))])
        forces.append(step.indenters[0, 0])
        held += step.bodies[0, 0]
    found, state = np.array(forces), session.state()
    momentum = (engine.lattice.node_mass[:, None] * state.velocity).sum(axis=0)
    impulse = engine.step * (found.sum(axis=0) + held)
    np.testing.assert_allclose(momentum, impulse, atol=2e-3 * engine.step * np.abs(found).sum())
    assert -found[59, 2] > 300.0
    assert found[-1, 0] > 50.0
    assert np.abs(np.diff(found[3:60, 2])).max() < 0.15 * np.ptp(found[:60, 2])  # a lying cylinder meets whole rows of faces
    if name == "plane":
        assert (np.hypot(found[:, 0], found[:, 1]) <= 0.4 * 1.002 * -found[:, 2] + 1e-6).all()


def test_a_frictionless_sphere_keeps_the_angular_momentum_about_its_centre() -> None:
    """All its forces pass through its centre: a free block thrown at it keeps what it had."""
    lattice = classic_lattice(box_mask((4, 4, 4)), 10.0, total_mass_kg=0.08)
    engine = LatticeEngine.of(lattice, lattice_parameters(lattice, 40.0, 2.0, np.inf), step=5e-4, tolerance=1e-6)
    ball = spherical_indenter((13.0, 26.0, 52.0), 10.0)
    rest = engine.rest()
    thrown = rest.velocity + np.array([0.0, 0.0, 400.0])
    session = engine.session(replace(rest, velocity=thrown), indenters=[ball])

    def angular(position: FloatArray, velocity: FloatArray) -> FloatArray:
        return np.cross(position - ball.centre, lattice.node_mass[:, None] * velocity).sum(axis=0)

    before = angular(rest.position, thrown)
    forces = session.step(steps=120).indenters
    state = session.state()
    assert forces.max() == 0.0 or forces[:, 0, 2].min() < -500.0
    np.testing.assert_allclose(angular(state.position, state.velocity), before, atol=0.01 * np.linalg.norm(before))


def test_an_indenter_smaller_than_a_face_does_not_fall_between_the_nodes() -> None:
    """A pin of 2 mm over the middle of a face of 10 mm."""
    force = pushed(dough(9), spherical_indenter((45.0, 45.0, SIDE_MM + 2.0), 2.0), 2.0, 100)
    assert force[-1] > 20.0
    assert np.abs(np.diff(force[1:])).max() < 0.1 * np.ptp(force)
