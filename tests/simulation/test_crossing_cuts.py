"""Cuts that cross earlier ones in a live body of finite elements, up to one that frees a piece."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.mechanics import Assembler, elements, material
from naibu.mechanics.finite_strain.lip_assembly import lips_of
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeSession
from naibu.meshing import box, to_tetra
from naibu.meshing.quality import smallest_dihedral_angle
from naibu.simulation import FiniteElementBody, InteractiveSimulation
from naibu.simulation.cuts.lattice_cut import LatticeCut

SIZE = 60.0  # mm
STEPS = 8  # behind every cut
ITERATIONS = 4  # of a step in the mean; where most pairs were held in the state of an earlier step, a hundred found no balance


def gel(friction: float = 0.0) -> FiniteElementBody:
    """A soft, nearly incompressible block under its weight, whose runs are repeatable."""
    mesh = to_tetra(box((SIZE,) * 3, (11, 11, 11)))
    law = material(young_modulus=70.0, poisson_ratio=0.499)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    floor = np.flatnonzero(mesh.points[:, 2] < mesh.points[:, 2].min() + 1e-9)
    body = FiniteElementBody.of(mesh, assembler, supported=floor, gravity=(0.0, 0.0, -9810.0), background=False)
    return replace(body, lips_friction=friction)


def blades(body: FiniteElementBody) -> dict[str, list[list[list[float]]]]:
    """A cut to the middle of the height, one across it, one between both, and one that takes the top off on one side."""
    low, high = body.points.min(axis=0) - 5.0, body.points.max(axis=0) + 5.0
    x, y, z = 0.5 * (low + high) + [1.3, -2.1, 0.0]
    return {
        "straight": [[[x, low[1], high[2]], [x, low[1], z]], [[x, high[1], high[2]], [x, high[1], z]]],
        "across": [[[low[0], y, high[2]], [low[0], y, z]], [[high[0], y, high[2]], [high[0], y, z]]],
        "oblique": [[[low[0], low[1], z + 21.0], [low[0], low[1], z]], [[high[0], high[1], z + 33.0], [high[0], high[1], z - 6.0]]],
        "piece": [[[low[0], y - 4.0, z + 18.0], [high[0], y - 4.0, z + 18.0]], [[low[0], high[1], z + 15.0], [high[0], high[1], z + 15.0]]],
    }


def volumes(body: FiniteElementBody) -> FloatArray:
    corners = body.mesh.points[body.mesh.cells]
    return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0)


def momentum(simulation: InteractiveSimulation) -> FloatArray:
    session = simulation._session
    assert isinstance(session, RealTimeSession)
    return np.asarray(session.engine.mass @ session.state().velocity)


@pytest.mark.parametrize("order", [("straight", "across", "piece"), ("straight", "oblique", "across")])
def test_a_body_goes_on_in_balance_behind_cuts_that_cross(order: tuple[str, ...]) -> None:
    body = gel()
    simulation, whole, angle = (
        InteractiveSimulation(body, {}),
        volumes(body).sum(),
        np.min(smallest_dihedral_angle(body.mesh.points, body.mesh.cells)),
    )
    for _ in range(STEPS):
        simulation.advance()
    for name in order:
        before = momentum(simulation)
        found = simulation.cut(blades(body)[name])
        assert not isinstance(found, LatticeCut)
        after = simulation.body
        assert isinstance(after, FiniteElementBody)
        np.testing.assert_allclose(volumes(after).sum(), whole, rtol=1e-12)
        assert found.n_pieces == (3 if name == "piece" else 1)
        assert found.deviation_mm <= 0.5 * SIZE / 11 * np.sqrt(3.0)
        assert found.smallest_angle_deg > 0.1 * angle
        np.testing.assert_allclose(momentum(simulation), before, atol=1e-9 * after.engine.mass.sum() * SIZE)
        session = simulation._session
        assert isinstance(session, RealTimeSession)
        for _ in range(STEPS):
            frame = simulation.advance()
            assert not frame.failed
            assert frame.unbalanced < 0.25
            (lips,) = lips_of(after.engine.assembler)
            gap = lips.gaps(session.state().displacement)
            assert gap.min() > -0.02 * lips.edge.max()
        assert session.newton_steps == session.divided_steps == 0
        assert session.iterations <= STEPS * ITERATIONS
    simulation.close()


def test_a_piece_that_crossing_cuts_free_falls_as_a_body_of_its_own() -> None:
    body = gel()
    simulation = InteractiveSimulation(body, {})
    for name in ("straight", "across", "piece"):
        found = simulation.cut(blades(body)[name])
    assert not isinstance(found, LatticeCut)
    after = simulation.body
    assert isinstance(after, FiniteElementBody)
    loose = np.unique(after.mesh.cells[found.piece == 1])
    rest = np.unique(after.mesh.cells[found.piece == 0])
    assert not np.isin(loose, rest).any()
    for _ in range(STEPS):
        simulation.advance()
    mass = after.engine.mass[loose]
    speed = float((mass @ simulation._session.state().velocity[loose])[1] / mass.sum())
    # down the blade, as a block on a slope without friction
    low, high = body.points.min(axis=0)[1], body.points.max(axis=0)[1]
    slope = 3.0 / (high + 5.0 - (0.5 * (low + high) - 6.1))
    expected = 9810.0 * slope / (1.0 + slope**2) * STEPS / 60.0
    assert 0.9 * expected < speed < 1.02 * expected
    simulation.close()


def test_crossing_cuts_are_undone_and_repeated_alike() -> None:
    body = gel()
    simulation = InteractiveSimulation(body, {})
    runs = []
    for _ in range(2):
        for name in ("straight", "across"):
            simulation.cut(blades(body)[name])
            for _ in range(3):
                frame = simulation.advance()
        runs.append(frame.positions.copy())
        assert simulation.undo()
        assert simulation.undo()
        assert simulation.body is body
        assert not simulation.undo()
        np.testing.assert_allclose(simulation.last.positions, body.points, atol=1e-12)
    np.testing.assert_array_equal(runs[0], runs[1])
    simulation.close()
