"""Dynamic sessions: balance of momentum and energy, free fall, and the same equilibrium as the static solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform
from naibu.mechanics import (
    Assembler,
    DynamicEngine,
    IndenterForce,
    IndenterVelocity,
    QuasiStaticEngine,
    RealTimeEngine,
    body_force,
    box_indenter,
    elements,
    material,
    plane_indenter,
    spherical_indenter,
)
from naibu.meshing import boundary_faces, box

SIZE = 40.0


def engine(divisions: int = 3, poisson_ratio: float = 0.49, step: float = 1.0 / 60.0) -> DynamicEngine:
    mesh = box((SIZE, SIZE, SIZE), (divisions, divisions, divisions))
    discrete = elements(mesh, "mean_dilatation")
    law = material(young_modulus=70.0, poisson_ratio=poisson_ratio)
    assembler = Assembler.from_materials(discrete, mesh.regions, [law])
    mass = body_force(discrete, np.full(mesh.n_cells, 1e-6), np.array([1.0, 0.0, 0.0]))[:, 0]
    return DynamicEngine(mesh.points, assembler, mass, boundary_faces(mesh).faces, step, normal_stiffness=2e3)


def lowest(points: FloatArray) -> np.ndarray:
    return np.flatnonzero(points[:, 2] < 1e-9)


def test_a_free_body_falls_by_the_steps_of_backward_euler() -> None:
    made = engine()
    weight = made.mass[:, None] * np.array([0.0, 0.0, -9810.0])
    session = made.session(external_force=weight)
    session.step(steps=6)
    h = made.step
    fall = -9810.0 * h**2 * sum(range(1, 7))
    np.testing.assert_allclose(
        session.positions() - made.points, np.tile([0.0, 0.0, fall], (len(made.points), 1)), atol=made.tolerance * abs(fall)
    )


def test_without_forces_energy_never_grows_and_momentum_stays() -> None:
    made = engine(step=2e-3)
    squeezed = -0.1 * (made.points - made.points.mean(axis=0)) * np.array([1.0, 0.0, 0.0])
    session = made.session(state=replace(made.rest(), displacement=squeezed))
    energies = [made.energy(session.state())]
    for _ in range(12):
        session.step()
        energies.append(made.energy(session.state()))
    assert np.all(np.diff(energies) <= 1e-6 * energies[0])
    momentum = (made.mass[:, None] * session.state().velocity).sum(axis=0)
    largest = (made.mass[:, None] * np.abs(session.state().velocity)).sum()
    assert np.abs(momentum).max() < 2e-3 * largest


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_it_settles_where_the_static_solver_finds_equilibrium(friction: float) -> None:
    made = engine(poisson_ratio=0.499)
    plate = plane_indenter((0.0, 0.0, SIZE), (0.0, 0.0, -1.0), static_friction=friction, kinetic_friction=friction)
    held = [lowest(made.points)]
    session = made.session(constrained=held, indenters=[plate])
    for _ in range(20):
        session.step(motions=[IndenterVelocity((0.0, 0.0, -0.2 * SIZE / 20 * 60.0))])
    for _ in range(30):
        session.step()
    static = QuasiStaticEngine(made.points, made.assembler, made.faces, normal_stiffness=2e3).session(constrained=held, indenters=[plate])
    for part in (0.5, 1.0):
        expected = static.step(motions=[RigidTransform.of(np.eye(3), (0.0, 0.0, -0.2 * SIZE * part))])
    moved = np.abs(static.positions() - made.points).max()
    assert np.abs(session.positions() - static.positions()).max() < 0.01 * moved
    assert session.forces().indenters[0, 0, 2] == pytest.approx(expected.indenters[0, 0, 2], rel=0.01)
    assert -session.forces().bodies[0, 0, 2] == pytest.approx(session.forces().indenters[0, 0, 2], rel=1e-3)


@pytest.mark.parametrize("kind", [DynamicEngine, RealTimeEngine])
@pytest.mark.parametrize("width", [28.0, 60.0])
def test_a_body_under_a_plate_with_much_too_soft_penalties_ends_where_the_static_solver_does(
    kind: type[DynamicEngine], width: float
) -> None:
    """The penalties rise by up to a factor of 256 on the way; the static solver's are stiff from the beginning."""
    made = engine(divisions=4, poisson_ratio=0.499)
    plate = box_indenter((0.0, 0.0, SIZE + 2.5), (width, width, 4.8), static_friction=0.3, kinetic_friction=0.3)
    held, forces = [lowest(made.points)], []
    statics = QuasiStaticEngine(made.points, made.assembler, made.faces, normal_stiffness=1.2e4).session(
        constrained=held, indenters=[plate]
    )
    for part in (0.25, 0.5, 0.75, 1.0):
        found = statics.step(motions=[RigidTransform.of(np.eye(3), (0.0, 0.0, -9.6 * part))])
        forces.append(found.indenters[-1, 0, 2])
    options = {"background": False} if kind is RealTimeEngine else {}
    soft = kind(made.points, made.assembler, made.mass, made.faces, made.step, normal_stiffness=20.0, **options)
    with soft.session(constrained=held, indenters=[plate]) as session:
        for part, expected in enumerate(forces):
            session.step(motions=[IndenterVelocity((0.0, 0.0, -16.0))], steps=9)
            force = session.step(motions=[IndenterVelocity((0.0, 0.0, 0.0))], steps=8).indenters[-1, 0, 2]
            assert force == pytest.approx(expected, rel=0.08 if part == 0 else 0.02)
        assert session.state().normal_stiffness[0].max() >= 4.0 * soft.normal_stiffness


def test_a_sphere_that_stops_at_once_is_followed_in_shorter_steps_where_needed() -> None:
    made = engine(poisson_ratio=0.499)
    sphere = spherical_indenter((0.0, 0.0, SIZE + 8.0), 8.0, static_friction=0.3, kinetic_friction=0.3)
    session = made.session(constrained=[lowest(made.points)], indenters=[sphere])
    for _ in range(6):
        session.step(motions=[IndenterVelocity((0.0, 0.0, -80.0))])
    pressed = session.forces().indenters[0, 0, 2]
    for _ in range(10):
        session.step()
    assert pressed < 0.0
    assert np.isfinite(session.positions()).all()
    depth = -sphere.gap(session.positions() + np.array([0.0, 0.0, 8.0])).min()
    assert depth < 0.05 * SIZE / 3
    for _ in range(40):
        session.step(motions=[IndenterVelocity((0.0, 0.0, 60.0))])
    assert np.abs(session.positions() - made.points).max() < 0.02  # it springs back


def test_gripped_nodes_follow_and_the_forces_on_them_balance() -> None:
    made = engine()
    top = np.flatnonzero(made.points[:, 2] > SIZE - 1e-9)
    session = made.session(constrained=[lowest(made.points), top])
    for _ in range(10):
        session.step(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 24.0]]))
    for _ in range(15):
        session.step(np.zeros((2, 3)))
    np.testing.assert_allclose(session.positions(top)[:, 2], SIZE + 4.0, atol=1e-9)
    bodies = session.forces().bodies[0]
    assert bodies[1, 2] > 0.0
    assert bodies[0, 2] == pytest.approx(-bodies[1, 2], rel=2e-3)


def test_a_session_goes_on_from_its_state_to_the_same_positions() -> None:
    made = engine()
    sphere = spherical_indenter((0.0, 0.0, SIZE + 8.0), 8.0)
    session = made.session(constrained=[lowest(made.points)], indenters=[sphere])
    session.step(motions=[IndenterVelocity((0.0, 0.0, -60.0))], steps=3)
    kept = session.state()
    session.step(motions=[IndenterVelocity((0.0, 0.0, -60.0))], steps=2)
    first = session.positions()
    session.restore(kept)
    session.step(motions=[IndenterVelocity((0.0, 0.0, -60.0))], steps=2)
    np.testing.assert_allclose(session.positions(), first, atol=1e-3)


def test_what_it_cannot_do_is_refused() -> None:
    made = engine()
    session = made.session(indenters=[spherical_indenter((0.0, 0.0, 60.0), 5.0)])
    with pytest.raises(InputError, match="motions has a force"):
        session.step(motions=[IndenterForce(5.0, (0.0, 0.0, -1.0), 0.1)])
    with pytest.raises(InputError, match="two friction coefficients"):
        session.press([spherical_indenter((0.0, 0.0, 60.0), 5.0, static_friction=0.5, kinetic_friction=0.3)])
    with pytest.raises(InputError, match="mass must be positive"):
        DynamicEngine(made.points, made.assembler, np.zeros(len(made.points)), made.faces)
