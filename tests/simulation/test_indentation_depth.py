"""How deep a tool presses, by where it is."""

from __future__ import annotations

import numpy as np
import pytest
from touched_lattice import TOP, touched_lattice

from naibu.mechanics import Assembler, elements, material, spherical_indenter
from naibu.mechanics.contact.rigid_indenters import RigidIndenter, box_indenter
from naibu.meshing import box
from naibu.simulation import FiniteElementBody, InteractiveBody, InteractiveSimulation
from naibu.simulation.tool_places import indentation_depth, surface_samples

FACES = np.array([[0, 1, 2], [0, 2, 3]])
SQUARE = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [10.0, 10.0, 0.0], [0.0, 10.0, 0.0]])


def body(kind: str) -> InteractiveBody:
    if kind == "lattice":
        return touched_lattice()
    mesh = box((TOP, TOP, TOP), (4, 4, 4), centred=False)
    law = material(young_modulus=20.0, poisson_ratio=0.45)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    return FiniteElementBody.of(mesh, assembler, supported=np.flatnonzero(mesh.points[:, 2] < 1e-9).astype(np.int64), background=False)


@pytest.mark.parametrize("kind", ["lattice", "gel"])
@pytest.mark.parametrize(
    ("tool", "lowest"),
    [(box_indenter((20.0, 20.0, 60.0), (60.0, 60.0, 10.0)), 5.0), (spherical_indenter((20.0, 20.0, 60.0), 9.0), 9.0)],
    ids=["plate", "ball"],
)
def test_it_is_the_depth_of_a_tool_below_the_surface_at_rest(kind: str, tool: RigidIndenter, lowest: float) -> None:
    """Above a node, by tools that go down; the overlap, which the page had called penetration, is far less."""
    touched = InteractiveSimulation(body(kind), {"tool": tool})
    touched.take("tool")
    for _ in range(8):
        assert touched.advance().indentation_mm == 0.0
    touched.move((20.0, 20.0, TOP + lowest - 6.0))
    for _ in range(60):
        frame = touched.advance()
    assert frame.indentation_mm == pytest.approx(6.0, abs=0.1)
    assert frame.penetration_mm < 2.5


def test_the_surface_is_seen_between_nodes_and_only_along_the_force() -> None:
    """A square of two triangles under a small ball in the middle of it, whose lowest point is a little above it, or in it."""
    moved = SQUARE + np.array([0.7, 0.0, -0.4])
    down = np.array([0.0, 0.0, -3.0])
    for height in (0.9, 1.1, 0.6):  # by as much deeper or higher, as the ball is over the middle of an edge
        ball = spherical_indenter((5.7, 5.0, height - 0.4), 1.0)
        assert indentation_depth(ball, down, SQUARE, moved, FACES) == pytest.approx(0.4 + 1.0 - height)
        assert indentation_depth(ball, np.zeros(3), SQUARE, moved, FACES) == 0.0
    assert indentation_depth(ball, -0.01 * down, SQUARE, moved, FACES) == 0.0
    dented = np.concatenate([SQUARE, [[5.0, 5.0, -1.5]]])
    around = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    flat = np.concatenate([SQUARE, [[5.0, 5.0, 0.0]]])
    assert indentation_depth(spherical_indenter((5.0, 5.0, -0.5), 1.0), down, flat, dented, around) == pytest.approx(1.5)


def test_samples_are_corners_middles_and_centroid() -> None:
    found = {tuple(np.round(p, 9)) for p in surface_samples(SQUARE, FACES[:1])}
    assert found == {(0, 0, 0), (10, 0, 0), (10, 10, 0), (5, 0, 0), (10, 5, 0), (5, 5, 0), (round(20 / 3, 9), round(10 / 3, 9), 0)}
