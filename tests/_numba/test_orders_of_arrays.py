"""Kernels are compiled once more for each order of their arrays: what users give as numbers, rows or columns reaches them as one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from naibu.imaging.volume_correlation.image_level import ImageLevel
from naibu.mechanics.finite_elements.linear_simplices import per_cell
from naibu.mechanics.lattices.cpu._explicit_kernels import explicit_steps
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.cpu.implicit._implicit_kernels import implicit_steps
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes, checked_velocity
from naibu.mechanics.small_strain import linear_elasticity
from naibu.meshing.primitives import box

STEPS, BODIES = 5, 2
PUSH = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, -30.0]])
VELOCITIES = {
    "one of all": PUSH[1],
    "one a body": PUSH,
    "one a step": np.linspace(0.0, 1.0, STEPS)[:, None, None] * PUSH[1],
    "columns": np.asfortranarray(np.linspace(0.0, 1.0, STEPS)[:, None, None] * PUSH),
    "a part": np.zeros((STEPS, BODIES, 7))[:, :, 2:5],
}


@pytest.mark.parametrize("given", VELOCITIES)
def test_velocities_of_bodies_are_rows(given: str) -> None:
    path = checked_velocity(VELOCITIES[given], STEPS, BODIES)
    np.testing.assert_array_equal(path, np.broadcast_to(VELOCITIES[given], (STEPS, BODIES, 3)))
    assert path.flags.c_contiguous and path.flags.writeable


@pytest.mark.parametrize(("method", "step", "kernel"), [("implicit", 2e-3, implicit_steps), ("symplectic_euler", 1e-4, explicit_steps)])
def test_steps_of_a_lattice_are_compiled_once(method: str, step: float, kernel: object) -> None:
    lattice = classic_lattice(box_mask((3, 3, 3)), 5.0, total_mass_kg=0.1)
    z = lattice.points[:, 2]
    held = ConstrainedNodes.of(np.flatnonzero(z < 1), 0) + ConstrainedNodes.of(np.flatnonzero(z > 14), 1)
    engine = LatticeEngine.of(lattice, lattice_parameters(lattice, 10.0, 0.01, 0.02), method=method, step=step, threads=1)
    engine.run(engine.rest(), STEPS, held, VELOCITIES["one a body"])
    before = len(kernel.signatures)  # type: ignore[attr-defined]
    for velocity in VELOCITIES.values():
        engine.run(engine.rest(), STEPS, held, velocity)
    assert len(kernel.signatures) == before  # type: ignore[attr-defined]


def test_moduli_of_cells_are_rows_and_assembled_by_one_kernel() -> None:
    mesh = box((1.0, 1.0, 1.0), (2, 2, 2), cell_type="tetra")
    body = linear_elasticity.LinearBody.of(mesh)
    first = body.stiffness(2.0, 1.0)
    before = len(linear_elasticity._assemble.signatures)
    every = np.linspace(1.0, 2.0, 2 * mesh.n_cells)
    for lame, shear in ((np.full(mesh.n_cells, 2.0), 1.0), (every[::2], every[1::2]), (2.0, np.ones(mesh.n_cells))):
        assert per_cell(lame, mesh.n_cells).flags.c_contiguous
        again = body.stiffness(lame, shear)
    np.testing.assert_array_equal(again.toarray(), first.toarray())
    assert len(linear_elasticity._assemble.signatures) == before


@pytest.mark.parametrize("order", ["C", "F"])
def test_runs_of_voxels_are_rows(order: str) -> None:
    mask = np.array(ndimage.generate_binary_structure(3, 1), order=order)  # type: ignore[call-overload]
    mask = np.pad(mask, 6)
    image = np.random.default_rng(0).normal(size=mask.shape).astype(np.float32)
    level = ImageLevel(image, image, mask, np.ones(3), (1, 1, 1), 1.0)
    assert level.runs.flags.c_contiguous
    np.testing.assert_array_equal(level.runs[:, 2] < level.runs[:, 3], True)
