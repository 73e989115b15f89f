"""The relative motion of pairs of nodes is that of the whole inverse."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.mechanics.linear_algebra.direct import SuperLUSolver, pardiso_library
from naibu.mechanics.linear_algebra.paired_motion import PairedMotion, forces_along, relative
from naibu.mechanics.linear_algebra.schur_complement import PardisoSchurSolver
from naibu.mechanics.linear_algebra.updated_factors import UpdatedFactors

N = 10
NODES, HELD = np.array([[0, 3], [3, 7], [9, 2]]), np.array([2])


def stiffness() -> FloatArray:
    """A symmetric matrix in which node 2 is held."""
    random = np.random.default_rng(3)
    out = random.standard_normal((3 * N, 3 * N))
    out = out @ out.T + 5.0 * np.eye(3 * N)
    rows = 3 * HELD[0] + np.arange(3)
    out[rows], out[:, rows] = 0.0, 0.0
    out[rows, rows] = 7.0
    return np.asarray(out)


def directions() -> FloatArray:
    out = np.random.default_rng(4).standard_normal((len(NODES), 3))
    return np.asarray(out / np.linalg.norm(out, axis=1)[:, None])


@pytest.mark.parametrize("condensed", [None, [3, 5], [3, 8]])
def test_pairs_move_as_the_whole_matrix_says(condensed: list[int] | None) -> None:
    if condensed and pardiso_library() is None:
        pytest.skip("needs oneMKL")
    matrix, along = stiffness(), directions()
    blocks = sp.bsr_matrix(matrix, blocksize=(3, 3))
    solver = PardisoSchurSolver(blocks) if condensed else SuperLUSolver()
    if isinstance(solver, PardisoSchurSolver):
        solver.condense(np.array(condensed))
    factors = UpdatedFactors(solver.factorize(blocks), N)
    forces = np.zeros((len(NODES), N, 3))
    for own, (first, second), unit in zip(forces, NODES, along, strict=True):
        own[second] += unit
        own[first] -= unit
        np.testing.assert_allclose(forces_along(np.array([2.0]), np.array([[first, second]]), unit[None], N), 2.0 * own.ravel())
        np.testing.assert_allclose(relative(np.arange(3.0 * N), np.array([[first, second]]), unit[None]), own.ravel() @ np.arange(3.0 * N))
    forces[:, HELD] = 0.0
    b = forces.reshape(len(NODES), -1).T
    pairs = PairedMotion.of(factors, np.arange(3), NODES, along, HELD)
    np.testing.assert_allclose(pairs.inverse, b.T @ np.linalg.inv(matrix) @ b, atol=1e-6)
    nodes = np.array([8, 3])
    rows = (3 * nodes[:, None] + np.arange(3)).ravel()
    np.testing.assert_allclose(pairs.under(factors, nodes), (b.T @ np.linalg.inv(matrix))[:, rows], atol=1e-6)
    assert pairs.under(factors, nodes[:0]).shape == (3, 0)
    assert PairedMotion.of(factors, np.arange(0), NODES[:0], along[:0], HELD).under(factors, nodes).shape == (0, 6)
