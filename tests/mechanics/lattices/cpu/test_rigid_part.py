"""The rigid motion that has the momenta of an impulse, which frees a body's momenta from the early end of a solver."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.mechanics.lattices.cpu.implicit._implicit_kernels import rigid_part

RNG = np.random.default_rng(3)
CLOUD = RNG.normal(size=(12, 3)) * [30.0, 4.0, 11.0] + [200.0, -50.0, 7.0]
TURN = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
LINE = np.add(np.outer(np.linspace(-3.0, 8.0, 12), TURN[0]), [1.0, 2.0, 3.0])
PLATE = CLOUD * [1.0, 1.0, 0.0]


def momenta(points: FloatArray, impulse: FloatArray) -> FloatArray:
    return np.concatenate([impulse.sum(axis=0), np.cross(points, impulse).sum(axis=0)])


@pytest.mark.parametrize(
    ("points", "rank"),
    [(CLOUD, 6), (CLOUD @ TURN, 6), (PLATE @ TURN, 6), (LINE, 5), (LINE * [1.0, 0.0, 0.0], 5)],
    ids=["cloud", "turned cloud", "turned plate", "line", "line along x"],
)
def test_it_is_rigid_and_has_the_momenta(points: FloatArray, rank: int) -> None:
    rng = np.random.default_rng(4)
    mass = np.array([*rng.uniform(0.5, 2.0, len(points)), 0.0])  # the last is a place to fill up
    impulse = rng.normal(size=(len(points), 3))
    padded, x, out = (np.zeros((3, len(mass))) for _ in range(3))
    padded[:, :-1], x[:, :-1] = impulse.T, points.T
    rigid_part(x.ravel(), mass, padded.ravel(), out.ravel())
    moved = out[:, :-1].T
    np.testing.assert_allclose(momenta(points, mass[:-1, None] * moved), momenta(points, impulse), atol=1e-9 * np.abs(x).max())
    arms = points - points.mean(axis=0)
    motions = [np.broadcast_to(e, points.shape).ravel() for e in np.eye(3)] + [np.cross(e, arms).ravel() for e in np.eye(3)]
    basis, sizes, _ = np.linalg.svd(np.array(motions).T, full_matrices=False)
    assert np.sum(sizes > 1e-9 * sizes[0]) == rank
    basis = basis[:, :rank]
    np.testing.assert_allclose(basis @ (basis.T @ moved.ravel()), moved.ravel(), atol=1e-9 * np.abs(moved).max())
    assert not out[:, -1].any()
