"""Normal equations of volume correlation, solved by preconditioned conjugate gradients: beside the dense matrix in double precision."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.imaging.volume_correlation.image_level import ImageLevel
from naibu.imaging.volume_correlation.splines.normal_equations import BLOCK, ROUNDING, SplineSystem
from naibu.imaging.volume_correlation.splines.spline_grid import SplineGrid

Array = np.ndarray
SPACING = np.array([0.8, 1.0, 1.3])
STIFF = 1e2  # of volume, over what the intensities weigh: the object is nearly incompressible


@pytest.fixture(scope="module")
def system() -> SplineSystem:
    """An object with a hole and a rim that few voxels of its cells see, and its matrix."""
    mask = np.zeros((14, 15, 13), dtype=bool)
    mask[1:-3, 2:-1, 1:-2] = True
    mask[7, 7] = False
    images = np.random.default_rng(0).standard_normal((2, *mask.shape)).astype(np.float32)
    level = ImageLevel(images[0], images[1], mask, SPACING, (1, 1, 1), 0.0)
    grid = SplineGrid.around([0.0, 0.0, 0.0], np.array(mask.shape[::-1]) * SPACING, [2.5, 3.0, 3.0])
    made, rng, n = SplineSystem(level, grid), np.random.default_rng(1), int(mask.sum())
    forces = rng.standard_normal((n, 3)).astype(np.float32)
    products = np.stack([forces[:, i] * forces[:, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], axis=1)
    m = len(made.cells)
    made.assembled(np.zeros((*grid.shape, 3)), products, forces, np.full((m, 3), 1e-2), STIFF * made.gauss_volume)
    return made


def dense(system: SplineSystem) -> Array:
    """Return the matrix (n, 3, n, 3) of all coefficients."""
    whole = np.zeros((system.n, 3, system.n + 1, 3))
    each = system.matrix.reshape(system.n, 3, -1, 3)
    for o in range(each.shape[2]):
        whole[np.arange(system.n), :, system.neighbours[:, o]] += each[:, :, o]
    return whole[:, :, :-1]


def test_solutions_are_the_coefficients_that_made_the_loads(system: SplineSystem) -> None:
    """Loads in double precision, of one field, and of more than are solved at once."""
    wanted = np.random.default_rng(2).standard_normal((system.n, 3, 19))
    matrix = dense(system).reshape(3 * system.n, -1)
    loads = (matrix @ wanted.reshape(len(matrix), -1)).reshape(wanted.shape).astype(np.float32)
    for found, exact in (
        (system.solved_many(loads, 1e-5, 400)[0], wanted),
        (system.solved(loads[:, :, 0], 1e-5, 400)[0][:, :, None], wanted[:, :, :1]),
    ):
        fields = [field.reshape(len(matrix), -1) for field in (found - exact, exact)]
        energies = [np.einsum("is,is->s", e, matrix @ e) for e in fields]
        assert np.sqrt(energies[0] / energies[1]).max() < 1e-3


def test_preconditioners_solve_for_blocks_of_nodes_apart(system: SplineSystem) -> None:
    matrix, r = dense(system), np.random.default_rng(3).standard_normal((system.n, 3, 2)).astype(np.float32)
    found = system.preconditioned(r)
    blocks = np.stack(system.nodes, axis=1) // BLOCK
    sizes = set()
    for block in np.unique(blocks, axis=0):
        own = np.flatnonzero((blocks == block).all(axis=1))
        part = matrix[own][:, :, own].reshape(3 * len(own), -1)
        part += ROUNDING * np.diag(np.diag(part))
        x, own_r = found[own].reshape(len(part), -1), r[own].reshape(len(part), -1)
        assert np.abs(part @ x - own_r).max() < 1e-5 * (np.abs(part) @ np.abs(x)).max()
        sizes.add(len(own))
    assert sizes > {8} and min(sizes) < 8  # those at the border of the object are not whole


def test_blocks_of_nodes_take_fewer_iterations_than_nodes(system: SplineSystem) -> None:
    """Where volume hardly changes, neighbours can only move together; a node alone is stiff."""
    matrix = dense(system).reshape(3 * system.n, -1)
    b = matrix @ np.random.default_rng(4).standard_normal(len(matrix))
    alone = np.linalg.inv(np.einsum("ninj->nij", matrix.reshape(system.n, 3, system.n, 3)))
    x, r = np.zeros_like(b), b.copy()
    z = np.einsum("nij,nj->ni", alone, r.reshape(-1, 3)).ravel()
    p, rz, first, steps = z.copy(), r @ z, r @ z, 0
    while rz > 1e-2**2 * first:
        steps += 1
        along = matrix @ p
        a = rz / (p @ along)
        x, r = x + a * p, r - a * along
        z = np.einsum("nij,nj->ni", alone, r.reshape(-1, 3)).ravel()
        p, rz = z + (r @ z) / rz * p, r @ z
    assert system.solved(b.reshape(-1, 3).astype(np.float32), 1e-2, 400)[1] < 0.75 * steps


def test_penalties_alone_are_added_to_a_matrix_that_is_given(system: SplineSystem) -> None:
    """The matrix is the sum of that of the intensities and that of the penalties; without voxels their forces load nothing."""
    parts, rng, m = SplineSystem(system.level, system.grid), np.random.default_rng(4), len(system.cells)
    n = len(system.level.intensity)
    products, force = rng.random((n, 6)).astype(np.float32), rng.standard_normal((n, 3)).astype(np.float32)
    c, weights = 0.1 * rng.standard_normal((*system.grid.shape, 3)), (rng.random((m, 3)), STIFF * system.gauss_volume)
    load = parts.assembled(c, products, force, *weights)
    whole = parts.matrix.copy()
    parts.sum_intensities(products)
    intensities = parts.matrix.copy()
    alone = parts.assembled(c, products, force, *weights, intensities, voxels=False)
    np.testing.assert_allclose(parts.matrix, whole, atol=1e-5 * np.abs(whole).max())
    pulled = parts.force_loads(force[:, :, None])[:, :, 0]
    np.testing.assert_allclose(alone + pulled, load, atol=1e-5 * np.abs(load).max())
