"""Contacts condensed to their nodes: closed solutions of springs before a wall."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.mechanics.finite_strain.sessions.condensed_contact import CondensedContact
from naibu.mechanics.finite_strain.sessions.earlier_tangent import EarlierTangent
from naibu.mechanics.linear_algebra.direct import SuperLUSolver
from naibu.mechanics.linear_algebra.updated_factors import BlockChange, UpdatedFactors

BODY, WALL, GAP = 10.0, 1e4, 0.5  # mN/mm, mN/mm, mm


class Wall:
    """A wall across z, at a gap above all nodes, that pushes and does not pull."""

    def __init__(self) -> None:
        self.deep = np.zeros(0)

    def __call__(self, motion: FloatArray) -> FloatArray:
        self.deep = np.maximum(motion[:, 2] - GAP, 0.0)
        return np.column_stack([np.zeros((len(motion), 2)), -WALL * self.deep])

    def change(self) -> BlockChange:
        nodes = np.flatnonzero(self.deep > 0.0)
        places = np.arange(len(nodes))
        return BlockChange(nodes, places, places, np.tile(WALL * np.diag([0.0, 0.0, 1.0]), (len(nodes), 1, 1)))


@pytest.mark.parametrize("begin", [0.0, 3.0])
def test_springs_stop_at_a_wall_or_do_not_reach_it(begin: float) -> None:
    solver = SuperLUSolver()
    factors = UpdatedFactors(solver.factorize(sp.bsr_matrix(BODY * np.eye(12), blocksize=(3, 3))), 4)
    tangent = EarlierTangent(
        factors, np.zeros((0, 0, 3)), np.zeros((0, 3, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3, 3)), solver
    )
    free = np.array([[0.0, 0.0, 2.0], [0.0, 0.3, 0.4], [0.1, 0.0, -4.0]])
    condensed = CondensedContact(tangent, np.array([0, 2, 3]))
    force = condensed.forces(free, Wall(), np.full((3, 3), begin), 1e-5, 1.0)
    # in equilibrium: BODY (free - y) = WALL (y - GAP)
    stopped = (BODY * 2.0 + WALL * GAP) / (BODY + WALL)
    np.testing.assert_allclose(force[:, 2], [-BODY * (2.0 - stopped), 0.0, 0.0], atol=0.2)
    np.testing.assert_allclose(force[:, :2], 0.0, atol=1e-6)
    assert condensed.serves(tangent, np.array([2, 3]))
    assert not condensed.serves(tangent, np.array([1, 2]))
