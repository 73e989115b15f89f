"""A gel that is pulled off its table: what is out of balance is told beside the pull, not beside a table hardly touched."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.mechanics import Assembler, elements, material, plane_indenter
from naibu.meshing import box
from naibu.simulation import FiniteElementBody, InteractiveSimulation

EDGE = 40.0


@pytest.mark.parametrize("lift_mm", [20.0, 40.0])
def test_the_pull_comes_to_the_weight_and_what_is_out_of_balance_is_a_small_part_of_it(lift_mm: float) -> None:
    mesh = box((EDGE,) * 3, (3, 3, 3))
    assembler = Assembler.from_materials(
        elements(mesh, "mean_dilatation"), mesh.regions, [material(young_modulus=30.0, poisson_ratio=0.499)]
    )
    table = plane_indenter((0.0, 0.0, 0.0), static_friction=0.5, kinetic_friction=0.5)
    body = FiniteElementBody.of(mesh, assembler, fixtures=(table,), gravity=(0.0, 0.0, -9810.0), background=False)
    simulation = InteractiveSimulation(body, {})
    for _ in range(30):
        simulation.advance()
    corner = int(np.argmin(np.linalg.norm(body.points - [0.0, 0.0, EDGE], axis=1)))
    simulation.grip(corner, 4.0)
    at, unbalanced = np.array(simulation.last.positions[corner]), []
    for height in np.minimum(np.arange(1, 61) / 30.0, 1.0) * lift_mm:
        simulation.pull(at + np.array([0.0, 0.0, height]))
        frame = simulation.advance()
        unbalanced.append(frame.unbalanced)
    simulation.close()
    assert frame.positions[:, 2].min() > 1.0  # it hangs
    assert frame.pull[2] == pytest.approx(9810.0 * body.engine.mass.sum(), rel=0.005)
    assert max(unbalanced) < 0.25
