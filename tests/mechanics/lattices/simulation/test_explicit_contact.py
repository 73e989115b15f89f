"""Contact in explicit steps, and in short implicit ones: energy, momentum, statics, friction, fast indenters, and forces that drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.contact.indenter_motion import IndenterForce, IndenterVelocity
from naibu.mechanics.contact.rigid_indenters import RigidIndenter, box_indenter, plane_indenter, spherical_indenter
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes, Method, explicit_step_limit
from naibu.mechanics.lattices.simulation.contact import push

GRAVITY = 9810.0
FLOOR = plane_indenter((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
PEG = spherical_indenter((15.0, 15.0, -10.0), 10.0)
BOX = box_indenter((15.0, 15.0, -5.0), (16.0, 12.0, 10.0))


def block(method: Method, share: float, c1: float = 0.0, cells: int = 3) -> LatticeEngine:
    """A block of 30 mm whose steps are a share of those that explicit ones allow."""
    lattice = classic_lattice(box_mask((cells,) * 3), 30.0 / cells, total_mass_kg=0.08)
    parameters = lattice_parameters(lattice, 4000.0 * 3 / cells, c1 * 3 / cells, np.inf)
    step = share * explicit_step_limit(lattice, parameters)
    return LatticeEngine.of(lattice, parameters, step=step, method=method, tolerance=1e-6)


@pytest.mark.parametrize("share", [0.5, 0.1, 0.02])
@pytest.mark.parametrize("method", ["implicit", "symplectic_euler"])
@pytest.mark.parametrize("support", [FLOOR, BOX], ids=["floor", "box"])
def test_energy_does_not_grow_while_an_elastic_block_comes_to_lie(support: RigidIndenter, method: Method, share: float) -> None:
    """Twenty times its weight is put on an elastic block that touches: nothing but the weight does work, and nothing dissipates it."""
    engine = block(method, share)
    weight = -20.0 * GRAVITY * engine.lattice.node_mass[:, None] * [0.0, 0.0, 1.0]
    mass, rest, each = engine.lattice.node_mass, engine.rest(), max(int(2e-4 / engine.step), 2)
    energy, unit = [], 0.0
    with engine.session(rest, external_force=weight, indenters=[support]) as session:
        for _ in range(150):
            session.step(steps=each - 1)
            before = session.state()
            session.step()
            state = session.state()
            if method != "implicit":  # velocities are those between the positions, and extensions follow a step behind
                state = replace(state, position=before.position, velocity=0.5 * (before.velocity + state.velocity))
            energy.append(engine.energy(state) - float((weight * (state.position - rest.position)).sum()))
            unit = max(unit, 0.5 * float((mass * (state.velocity**2).sum(axis=1)).sum()))
    assert max(energy) <= (2e-3 if support is FLOOR else 0.03) * unit  # over edges the normals of contact come and go


@pytest.mark.parametrize("external", [None, (0.0, 0.0, -GRAVITY)])
def test_many_explicit_steps_in_one_call_are_those_one_by_one(external: tuple[float, float, float] | None) -> None:
    engine = block("symplectic_euler", 0.5, 0.01)
    lattice = engine.lattice
    force = None if external is None else np.outer(lattice.node_mass, external)
    ends = []
    for each in (1, 40, 200):
        with engine.session(external_force=force, indenters=[FLOOR, spherical_indenter((15.0, 15.0, 40.5), 10.0)]) as session:
            motions = [IndenterVelocity(), IndenterVelocity((100.0, 0.0, -800.0))]
            taken = [session.step(motions=motions, steps=each) for _ in range(200 // each)]
            ends.append((session.state().position, np.concatenate([one.indenters for one in taken])))
    assert np.abs(ends[0][1]).max() > 0.0
    for position, exerted in ends[1:]:
        np.testing.assert_allclose(position, ends[0][0], atol=1e-9 * np.abs(ends[0][0] - lattice.points).max())
        np.testing.assert_allclose(exerted, ends[0][1], atol=1e-9 * np.abs(ends[0][1]).max())


@pytest.mark.parametrize("share", [0.9, 0.2])
def test_a_free_elastic_block_that_hits_something_keeps_at_most_its_energy(share: float) -> None:
    engine = block("symplectic_euler", share)
    rest = engine.rest()
    thrown = replace(rest, velocity=rest.velocity + np.array([30.0, -20.0, -400.0]))
    before = engine.energy(thrown)
    for support in (FLOOR, PEG, BOX):
        with engine.session(thrown, indenters=[support]) as session:
            session.step(steps=int(0.03 / engine.step))
            state = session.state()
        assert (engine.lattice.node_mass * state.velocity[:, 2]).sum() > 0.0  # it came back
        assert 0.5 * before < engine.energy(state) <= 1.005 * before


def test_momentum_balances_with_the_forces_of_constraints_and_indenters() -> None:
    engine = block("symplectic_euler", 0.5, c1=0.2)
    held = ConstrainedNodes.of(np.flatnonzero(engine.lattice.points[:, 2] < 1e-9))
    ball = spherical_indenter((13.0, 17.0, 40.0), 10.0, static_friction=0.4, kinetic_friction=0.3)
    impulse = np.zeros(3)
    with engine.session(constrained=held, indenters=[ball]) as session:
        for n in range(400):
            step = session.step(motions=[IndenterVelocity((50.0 if n > 200 else 0.0, 0.0, -150.0 if n <= 200 else 0.0))])
            impulse += engine.step * (step.bodies[0, 0] + step.indenters[0, 0])
        state = session.state()
        assert session.unsettled == 0
        reaction = session.forces().indenters[0, 0]
    momentum = (engine.lattice.node_mass[:, None] * state.velocity).sum(axis=0)
    scale = float((engine.lattice.node_mass * np.linalg.norm(state.velocity, axis=1)).sum())
    np.testing.assert_allclose(momentum, impulse, atol=1e-5 * max(scale, np.abs(impulse).max()))
    assert reaction[2] < -1000.0
    assert reaction[0] > 50.0
    assert np.abs(state.velocity[held.node]).max() == 0.0


@pytest.mark.parametrize(
    "shape",
    [
        spherical_indenter((15.0, 15.0, 40.0), 10.0),
        spherical_indenter((17.0, 18.0, 50.0), 20.0),
        box_indenter((15.0, 15.0, 35.0), (15.0, 15.0, 10.0)),
        plane_indenter((0.0, 0.0, 30.0), (0.0, 0.0, -1.0)),
    ],
    ids=["sphere", "large", "box", "plane"],
)
def test_what_comes_to_rest_is_what_implicit_steps_come_to(shape: RigidIndenter) -> None:
    """Pushed in by 2 mm and held: the force is that of long implicit steps, in which multipliers follow from step to step."""
    found = []
    for method, share in (("symplectic_euler", 0.8), ("implicit", 40.0)):
        engine = block(method, share, c1=2.0, cells=3)
        held = ConstrainedNodes.of(np.flatnonzero(engine.lattice.points[:, 2] < 1e-9))
        count = int(np.ceil(0.01 / engine.step))
        with engine.session(constrained=held, indenters=[shape]) as session:
            session.step(motions=[IndenterVelocity((0.0, 0.0, -2.0 / (count * engine.step)))], steps=count)
            session.step(motions=[IndenterVelocity()], steps=2 * count)
            found.append(float(session.forces().indenters[-1, 0, 2]))
    assert found[1] < -500.0
    assert found[0] == pytest.approx(found[1], rel=0.01)


def test_a_fast_thin_plate_does_not_pass_through() -> None:
    """A plate at 5 m/s goes further than half its thickness in a step."""
    engine = block("symplectic_euler", 0.9)
    plate = box_indenter((15.0, 15.0, 30.5), (60.0, 60.0, 0.8))
    assert engine.step * 5000.0 > 0.4
    with engine.session(indenters=[plate]) as session:
        for _ in range(60):
            session.step(motions=[IndenterVelocity((0.0, 0.0, -5000.0))])
            assert session.positions()[:, 2].max() < session.poses()[0][0, 2]


def test_a_block_slides_down_a_slope_as_coulomb_says() -> None:
    engine = block("symplectic_euler", 0.8, c1=1.0)
    for friction, slope in ((0.3, 0.6), (0.5, 0.3)):
        down = np.array([np.sin(slope), 0.0, -np.cos(slope)])
        floor = plane_indenter((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), static_friction=friction, kinetic_friction=friction)
        weight = GRAVITY * engine.lattice.node_mass[:, None] * down
        with engine.session(external_force=weight, indenters=[floor]) as session:
            session.step(steps=int(0.1 / engine.step))
            mean = (engine.lattice.node_mass[:, None] * session.state().velocity).sum(axis=0) / engine.lattice.node_mass.sum()
        expected = max(GRAVITY * (np.sin(slope) - friction * np.cos(slope)), 0.0) * session.steps * engine.step
        assert mean[0] == pytest.approx(expected, rel=0.02, abs=1.0)


def test_a_driven_plate_comes_to_balance_and_sessions_go_on_from_their_states() -> None:
    engine = block("symplectic_euler", 0.8, c1=4.0)
    held = ConstrainedNodes.of(np.flatnonzero(engine.lattice.points[:, 2] < 1e-9))
    plate = plane_indenter((0.0, 0.0, 30.0), (0.0, 0.0, -1.0))
    drive = IndenterForce(-3000.0, (0.0, 0.0, 1.0), 0.01)

    def forward(steps: int, state: object = None) -> tuple[object, FloatArray]:
        with engine.session(state, constrained=held, indenters=[plate]) as session:  # type: ignore[arg-type]
            session.step(motions=[drive], steps=steps)
            return session.state(), session.forces().indenters[-1, 0]

    half, _ = forward(1500)
    _, force = forward(1500, half)
    assert force[2] == pytest.approx(-3000.0, rel=0.02)
    again, _ = forward(1500)
    np.testing.assert_array_equal(again.position, half.position)  # type: ignore[attr-defined]


def test_push_takes_explicit_steps_and_refuses_what_it_cannot_do() -> None:
    engine = block("symplectic_euler", 0.5, c1=0.2)
    ball = spherical_indenter((15.0, 15.0, 40.0), 10.0)
    moved = push(engine, engine.rest(), [FLOOR, ball], [[0.0, 0.0, 0.0], [0.0, 0.0, -100.0]], steps=200)
    assert moved.unsettled == 0
    assert moved.reaction[-1, 1, 2] < -10.0
    forward = LatticeEngine.of(engine.lattice, engine.parameters, step=engine.step, method="euler")
    with pytest.raises(InputError, match="'symplectic_euler'"):
        push(forward, forward.rest(), [FLOOR], 0.0, steps=1)
    single = LatticeEngine.of(engine.lattice, engine.parameters, step=engine.step, method="symplectic_euler", precision="single")
    with pytest.raises(InputError, match="precision='double'"):
        single.session(indenters=[FLOOR])
