"""Quasi-static sessions reach the equilibria of single solves, keep their state, and balance forces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from builders import assembler
from numpy.typing import ArrayLike

from naibu.core.errors import ConvergenceError, InputError
from naibu.core.rigid_transform import RigidTransform
from naibu.mechanics.contact.contact_surfaces import Friction, rigid_contact
from naibu.mechanics.contact.indenter_motion import IndenterForce, IndenterVelocity
from naibu.mechanics.contact.rigid_indenters import RigidIndenter, box_indenter, plane_indenter, spherical_indenter
from naibu.mechanics.contact.session_protocol import Engine
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.sessions.quasi_static_session import EquilibriumState, QuasiStaticEngine
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.primitives import box
from naibu.meshing.surface import faces_towards, side_nodes

MESH = box((20.0, 20.0, 16.0), (4, 4, 4))
BASE = side_nodes(MESH, "z-")
TOP = 16.0
DOWN = (0.0, 0.0, -1.0)


def engine() -> QuasiStaticEngine:
    return QuasiStaticEngine(MESH.points, assembler(MESH), faces_towards(MESH, (0.0, 0.0, 1.0)))


def plate(friction: float = 0.0) -> RigidIndenter:
    return plane_indenter((0.0, 0.0, TOP), DOWN, static_friction=friction, kinetic_friction=friction)


def reference(depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Displacement and force of one frictionless solve."""
    made = engine()
    body = plate()
    contact = rigid_contact(
        "plate", MESH.points, made.faces, body.geometry, start=(0, 0, TOP), stop=(0, 0, TOP - depth), friction=Friction(0.0),
        normal_stiffness=made.normal_stiffness,
    )  # fmt: skip
    held = PrescribedDisplacement.none(MESH.n_points).and_also(BASE, (0.0, 0.0, 0.0))
    solution = solve(Problem(MESH.points, made.assembler, (contact,), held, np.zeros_like(MESH.points)))
    return solution.displacement, solution.reactions["plate"]


def test_the_engine_follows_the_protocol() -> None:
    typed: Engine[EquilibriumState, Sequence[ArrayLike]] = engine()
    with typed.session() as session:
        np.testing.assert_array_equal(session.positions(), MESH.points)
    assert typed.energy(typed.rest()) == 0.0


@pytest.mark.parametrize("steps", [1, 4])
def test_steps_end_where_one_solve_ends(steps: int) -> None:
    expected, force = reference(2.0)
    session = engine().session(constrained=[BASE], indenters=[plate()])
    told = session.step(motions=[IndenterVelocity((0.0, 0.0, -2.0 / steps))], steps=steps)
    np.testing.assert_allclose(session.positions() - MESH.points, expected, atol=1e-6)
    np.testing.assert_allclose(told.indenters[-1, 0], force, rtol=1e-6, atol=1e-6 * np.linalg.norm(force))
    np.testing.assert_allclose(told.bodies[-1, 0] + told.indenters[-1, 0], 0.0, atol=1e-5 * np.linalg.norm(force))  # action and reaction
    assert engine().energy(session.state()) > 0.0


def test_a_step_without_motions_keeps_the_contact() -> None:
    session = engine().session(constrained=[BASE], indenters=[plate()])
    first = session.step(motions=[IndenterVelocity((0.0, 0.0, -1.0))])
    np.testing.assert_allclose(session.step().indenters, first.indenters, rtol=1e-5, atol=1e-6)


def test_a_restored_state_goes_on_the_same_way() -> None:
    down, aside = [IndenterVelocity((0.0, 0.0, -1.0))], [IndenterVelocity((0.5, 0.0, 0.0), (0.0, 0.0, 0.05))]
    made = engine()
    session = made.session(constrained=[BASE], indenters=[plate(0.3)])
    session.step(motions=down)
    kept = session.state()
    once = session.step(motions=aside).indenters
    assert abs(once[0, 0, 0]) > 1.0  # friction drags the top along
    session.restore(kept)
    np.testing.assert_array_equal(session.step(motions=aside).indenters, once)
    other = made.session(kept, [BASE], indenters=[plate(0.3)])
    np.testing.assert_array_equal(other.step(motions=aside).indenters, once)


def test_a_pose_is_reached_at_the_end_of_the_steps() -> None:
    session = engine().session(constrained=[BASE], indenters=[plate()])
    session.step(motions=[RigidTransform.of(np.eye(3), (0.0, 0.0, -2.0))], steps=2)
    np.testing.assert_allclose(session.state().centres[0], (0.0, 0.0, TOP - 2.0))
    np.testing.assert_allclose(session.positions() - MESH.points, reference(2.0)[0], atol=1e-6)


def test_a_force_is_balanced() -> None:
    sphere = spherical_indenter((0.0, 0.0, TOP + 8.0), 8.0)
    session = engine().session(constrained=[BASE], indenters=[sphere])
    told = session.step(motions=[IndenterForce(900.0, DOWN, 0.1)])
    assert told.indenters[0, 0] @ DOWN == pytest.approx(900.0, rel=1e-3)
    more = session.step(motions=[IndenterForce(300.0, DOWN, 0.1)])  # lets go of some of it
    assert more.indenters[0, 0] @ DOWN == pytest.approx(300.0, rel=1e-3)
    with pytest.raises(ConvergenceError, match="does not balance"):
        session.step(motions=[IndenterForce(-900.0, DOWN, 0.1)])


def test_bodies_of_constrained_nodes_move() -> None:
    session = engine().session(constrained=[BASE, side_nodes(MESH, "z+")])
    told = session.step([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)], steps=2)
    np.testing.assert_allclose(session.positions(side_nodes(MESH, "z+")), MESH.points[side_nodes(MESH, "z+")] + (2.0, 0.0, 0.0), atol=1e-9)
    assert told.bodies[1, 1, 0] > told.bodies[0, 1, 0] > 0.0
    np.testing.assert_allclose(told.bodies.sum(axis=1), 0.0, atol=1e-4 * told.bodies[1, 1, 0])


@pytest.mark.parametrize("thickness", [1.0, 40.0])
def test_a_thin_plate_does_not_pass_through(thickness: float) -> None:
    """Of 1 mm, it ends 7 mm below where it began in a single step: the force is that of a half space in its place."""
    session = engine().session(
        constrained=[BASE], indenters=[box_indenter((10.0, 10.0, TOP + 5.0 + 0.5 * thickness), (60.0, 60.0, thickness))]
    )
    forces = session.step(motions=[IndenterVelocity((0.0, 0.0, -7.0))])
    displacement, force = reference(2.0)
    np.testing.assert_allclose(forces.indenters[0, 0], force, rtol=1e-3, atol=1e-3 * abs(force[2]))
    np.testing.assert_allclose(session.positions() - MESH.points, displacement, atol=1e-3)


def test_a_way_through_the_body_is_no_equilibrium() -> None:
    """A plate that would have to squash it flat fails, and does not appear below it."""
    hasty = replace(engine(), settings=SolverSettings(first_step=1.0, largest_step=1.0, smallest_step=0.3))
    session = hasty.session(constrained=[BASE], indenters=[box_indenter((10.0, 10.0, TOP + 5.5), (60.0, 60.0, 1.0))])
    with pytest.raises(ConvergenceError):
        session.step(motions=[IndenterVelocity((0.0, 0.0, -500.0))])
    np.testing.assert_array_equal(session.positions(), MESH.points)


def test_what_cannot_be_is_refused() -> None:
    made = engine()
    with pytest.raises(InputError, match="belongs to two bodies"):
        made.session(constrained=[BASE, BASE[:1]])
    with pytest.raises(InputError, match="nodes 0 to"):
        made.session(constrained=[[10_000]])
    with pytest.raises(InputError, match="pull-off"):
        made.session(indenters=[plane_indenter((0.0, 0.0, TOP), DOWN, pull_stiffness=1.0, pull_speed=1.0)])
    with pytest.raises(InputError, match="two friction coefficients"):
        made.session(indenters=[plane_indenter((0.0, 0.0, TOP), DOWN, static_friction=0.4, kinetic_friction=0.3)])
    session = made.session(constrained=[BASE], indenters=[plate()])
    with pytest.raises(InputError, match="2 entries for 1 indenters"):
        session.step(motions=[IndenterVelocity(), IndenterVelocity()])
    with pytest.raises(InputError, match="2 nodes"):
        session.restore(EquilibriumState(np.zeros((2, 3))))
