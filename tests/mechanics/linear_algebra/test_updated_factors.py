"""Solutions after a change of blocks are those of the changed matrix."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from naibu.mechanics.linear_algebra.direct import SuperLUSolver
from naibu.mechanics.linear_algebra.updated_factors import BlockChange, UpdatedFactors


def test_the_changed_system_is_solved_also_where_nodes_come_later() -> None:
    random = np.random.default_rng(5)
    n = 12
    dense = random.standard_normal((3 * n, 3 * n)) + 20.0 * np.eye(3 * n)
    updated = UpdatedFactors(SuperLUSolver().factorize(sp.bsr_matrix(dense, blocksize=(3, 3))), n)
    b = random.standard_normal(3 * n)
    for nodes in ([2, 7], [0, 2, 5], [2, 7]):
        rows, columns = np.array([0, 0, 1]), np.array([0, 1, 0])
        blocks = 10.0 * random.standard_normal((3, 3, 3))
        changed = dense.copy()
        for r, c, block in zip(rows, columns, blocks, strict=True):
            changed[3 * nodes[r] : 3 * nodes[r] + 3, 3 * nodes[c] : 3 * nodes[c] + 3] += block
        x = updated.solve(b, BlockChange(np.array(nodes), rows, columns, blocks))
        np.testing.assert_allclose(x, np.linalg.solve(changed, b), atol=1e-4 * np.abs(x).max())


def test_without_a_change_the_factors_answer() -> None:
    dense = np.diag(np.arange(1.0, 10.0))
    updated = UpdatedFactors(SuperLUSolver().factorize(sp.bsr_matrix(dense, blocksize=(3, 3))), 3)
    none = np.zeros(0, dtype=np.int64)
    np.testing.assert_allclose(updated.solve(np.ones(9), BlockChange(none, none, none, np.zeros((0, 3, 3)))), 1.0 / np.arange(1.0, 10.0))
