"""Indenters that cover whole faces of a viscous block: pressures of nodes must neither grow by themselves nor give way at the rim."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.mechanics.contact.indenter_motion import IndenterVelocity
from naibu.mechanics.contact.rigid_indenters import (
    RigidIndenter,
    box_indenter,
    capsule_indenter,
    cylindrical_indenter,
    plane_indenter,
    spherical_indenter,
)
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes
from naibu.mechanics.lattices.simulation.contact import ContactMotion, push

SIDE, SPEED = 30.0, 9.0


def engine_of(step: float, k: float = 30.0, c1: float = 15.0, c2: float = 600.0, mass: float = 0.03) -> LatticeEngine:
    """Return a block of 3 x 3 x 3 cubes, in which damping outweighs stiffness by default."""
    lattice = classic_lattice(box_mask((3, 3, 3)), 10.0, total_mass_kg=mass)
    return LatticeEngine.of(lattice, lattice_parameters(lattice, k, c1, c2), step=step, tolerance=1e-6)


def plates(friction: float, width: float = 3.0 * SIDE) -> list[RigidIndenter]:
    """Return a floor and a plate that stands on the block."""
    surface = {"static_friction": friction, "kinetic_friction": friction}
    return [plane_indenter((0.0, 0.0, 0.0), **surface), box_indenter((SIDE / 2, SIDE / 2, SIDE + 5.0), (width, width, 10.0), **surface)]


def pressed(step: float, seconds: float, *, stiffer: float = 1.0, friction: float = 0.9) -> tuple[LatticeEngine, ContactMotion]:
    """Press the block at a steady speed."""
    engine, path = engine_of(step, 30.0 * stiffer, 15.0 * stiffer), np.zeros((round(seconds / step), 2, 3))
    path[:, 1, 2] = -SPEED
    return engine, push(engine, engine.rest(), plates(friction), path)


@pytest.mark.parametrize("friction", [0.0, 0.3, 0.9])
def test_what_rounding_differs_by_does_not_grow(friction: float) -> None:
    """In 2 ms steps differences of 1e-10 had grown to hundredths of a millimetre in .6 s, and a symmetric block had leant over."""
    engine, motion = pressed(0.002, 0.6, friction=friction)
    _, other = pressed(0.002, 0.6, friction=friction, stiffer=1.0 + 1e-9)
    assert motion.unsettled == 0
    free = np.s_[:, 2] if friction == 0.0 else np.s_[:]  # nothing else holds a body without friction
    assert np.abs((other.state.position - motion.state.position)[free]).max() < 1e-6
    assert np.abs(motion.reaction[:, :, :2]).max() < 1e-4 * np.abs(motion.reaction).max()
    if friction:
        moved = motion.state.position - engine.lattice.points
        mirrored = np.argsort(np.lexsort(engine.lattice.points.T)), np.lexsort((engine.lattice.points * [-1.0, 1.0, 1.0]).T)
        np.testing.assert_allclose(moved[mirrored[1]][mirrored[0]] * [-1.0, 1.0, 1.0], moved, atol=1e-6)


def rubbed(step: float, indenter: RigidIndenter) -> list[FloatArray]:
    """Return the nodes (n, 3) in every step while an indenter goes down 4 mm, rests, and goes to and fro."""
    engine = engine_of(step)
    held = ConstrainedNodes.of(np.flatnonzero(engine.lattice.points[:, 2] == 0.0))
    down, still = [(0.0, 0.0, -20.0)] * round(0.2 / step), [(0.0, 0.0, 0.0)] * round(0.4 / step)
    fro = [(sign * 10.0, 0.0, 0.0) for sign in (1.0, -1.0) for _ in range(round(0.3 / step))]
    with engine.session(constrained=held, indenters=[indenter]) as session:
        found = []
        for velocity in [*down, *still, *fro]:
            session.step(motions=[IndenterVelocity(velocity)])
            found.append(session.positions())
    return found


@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("radius", [12.0, 200.0])
@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
def test_what_rounding_differs_by_does_not_grow_under_round_indenters(kind: str, radius: float, friction: float) -> None:
    """Their pressures follow what they cover at the time, which for flat ones had made differences grow by some per cent in every step."""
    surface = {"static_friction": friction, "kinetic_friction": friction}

    def placed(height: float) -> RigidIndenter:
        at = (16.3, 18.1, SIDE + radius + height)
        sphere = spherical_indenter(at, radius, **surface)
        return sphere if kind == "sphere" else capsule_indenter(at, radius, 3.0 * SIDE, (0.0, 1.0, 0.0), **surface)

    apart = 1e-10
    one, other = rubbed(0.002, placed(0.0)), rubbed(0.002, placed(apart))
    assert np.abs(one[-1] - one[0]).max() > 0.5
    assert max(np.abs(a - b).max() for a, b in zip(one, other, strict=True)) < 100.0 * apart


def tied_force(step: float, seconds: float) -> FloatArray:
    """Return the force on the upper face (steps,) where both faces are held as a whole."""
    engine = engine_of(step)
    low, high = (np.flatnonzero(engine.lattice.points[:, 2] == z) for z in (0.0, SIDE))
    constrained = ConstrainedNodes.of(low) + ConstrainedNodes.of(high, 1)
    motion = engine.run(engine.rest(), round(seconds / step), constrained, [[0.0, 0.0, 0.0], [0.0, 0.0, -SPEED]])
    return np.asarray(motion.reaction[:, 1, 2])


@pytest.mark.parametrize("step", [0.0005, 0.002, 0.01])
def test_plates_on_which_everything_sticks_press_as_held_faces_do(step: float) -> None:
    """Nodes at the rim had sunk by tenths of a millimetre into both plates, the more the longer the steps."""
    _, motion = pressed(step, 0.3)
    force, held = motion.reaction[-1, 1, 2], tied_force(step, 0.3)[-1]
    assert force == pytest.approx(held, rel=0.03)
    assert motion.state.position[:, 2].min() > -0.1


def test_contacts_settle_where_a_plate_stops_and_leaves() -> None:
    """A multiplier that was lost within micrometres of the surface had made points come and go from pass to pass."""
    engine = engine_of(0.002, 20.0, 1.0, 50.0, mass=0.1)
    path = np.zeros((300, 2, 3))
    path[:100, 1, 2], path[200:, 1, 2] = -20.0, 40.0
    motion = push(engine, engine.rest(), plates(0.5, SIDE), path)
    assert motion.unsettled == 0
    pressing = motion.reaction[50:100, 1, 2]
    assert (np.abs(np.diff(pressing)) < 0.02 * np.abs(pressing).max()).all()
    np.testing.assert_allclose(motion.reaction[-20:, 1], 0.0, atol=1e-9)


def test_a_plate_that_drags_slides_as_coulomb_says_and_takes_few_solutions() -> None:
    """Where points slid, what friction lacked had fallen by a tenth only from pass to pass: 12.4 passes a step, 8 steps not settled."""
    path = np.zeros((75, 2, 3))
    path[:25, 1, 2], path[25:, 1, 0] = -0.4 * SPEED, SPEED
    engine = engine_of(0.02)
    motion = push(engine, engine.rest(), plates(0.3), path)
    sliding = motion.reaction[-25:, 1]
    assert motion.unsettled <= 1
    np.testing.assert_allclose(sliding[:, 0], 0.3 * np.abs(sliding[:, 2]), rtol=1e-3)
    assert motion.passes < 7.0


@pytest.mark.parametrize("shorter", [0.1, 0.5, 2.0, 10.0])
def test_a_plate_at_rest_presses_alike_whatever_the_next_step_is(shorter: float) -> None:
    """A block that slid under a plate and rests is in balance: the next step changes nothing, however long it is.

    Points that had come away by what their multiplier still pressed had kept it: the foundations of steps a tenth as long are several
    times as stiff, and the force had jumped by half.
    """
    path = np.zeros((500, 2, 3))
    path[:100, 1, 2], path[100:200, 1, 0] = -20.0, 50.0
    engine, other = engine_of(0.002), engine_of(0.002 * shorter)
    motion = push(engine, engine.rest(), plates(0.3), path)
    assert abs(motion.reaction[199, 1, 0]) > 0.29 * abs(motion.reaction[199, 1, 2])  # it slides
    still = push(other, motion.state, plates(0.3), np.zeros((5, 2, 3)))
    size = np.linalg.norm(motion.reaction[-1, 1])
    np.testing.assert_allclose(still.reaction[:, 1] / size, np.broadcast_to(motion.reaction[-1, 1] / size, (5, 3)), atol=0.02)


@pytest.mark.parametrize("tool", ["box", "cylinder"])
def test_contacts_settle_beside_the_edges_of_a_flat_tool_that_drags(tool: str) -> None:
    """The pressure of points beside an edge had leapt where its nearest side changed: no solution lay between, and the force leapt with it.

    Of 300 and 600 steps up to five had not settled, and the forces of the box in steps half as long had differed by 5 % (root mean square).
    """
    lattice = classic_lattice(box_mask((4, 4, 4)), 10.0, total_mass_kg=0.08)
    parameters, surface = lattice_parameters(lattice, 10.0, 5.0, 10.0), {"static_friction": 0.3, "kinetic_friction": 0.3}
    centre, found = (20.0, 20.0, 45.0), []
    flat = box_indenter(centre, (24.0, 24.0, 10.0), **surface) if tool == "box" else cylindrical_indenter(centre, 12.0, 10.0, **surface)
    floor = plane_indenter((0.0, 0.0, 0.0), static_friction=0.9, kinetic_friction=0.9)
    for step in (0.001, 0.0005):
        engine, down, across = LatticeEngine.of(lattice, parameters, step=step, tolerance=0.1), round(0.1 / step), round(0.2 / step)
        path = np.zeros((down + across, 2, 3))
        path[:down, 1, 2], path[down:, 1, 1] = -40.0, 25.0
        path[down:, 1, 0] = 60.0 * np.cos(2.0 * np.pi * np.arange(across) / across)
        motion = push(engine, engine.rest(), [floor, flat], path)
        assert motion.unsettled == 0
        found.append(motion.reaction[:, 1])
    coarse, fine = found[0], 0.5 * (found[1][::2] + found[1][1::2])
    off = np.linalg.norm(coarse - fine, axis=1)[20:]  # from the impact on
    assert np.sqrt((off**2).mean()) < 0.03 * np.sqrt((fine[20:] ** 2).sum(axis=1).mean())
