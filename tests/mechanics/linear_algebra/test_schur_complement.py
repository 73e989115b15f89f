"""Parts of inverses by Schur complements, and solutions beside them, are those of dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import ConvergenceError
from naibu.mechanics.linear_algebra import direct
from naibu.mechanics.linear_algebra.schur_complement import PardisoSchurSolver
from naibu.mechanics.linear_algebra.updated_factors import UpdatedFactors

pytestmark = pytest.mark.skipif(direct.pardiso_library() is None, reason="needs oneMKL")

EDGE = 6
SOME = np.array([0, 3, 40, 41, 107, 215])


def springs(held: float = 0.1) -> sp.bsr_matrix:
    """Nodes of a grid that springs join, and hold where they are."""
    line = sp.diags([-np.ones(EDGE - 1), [1.0, *[2.0] * (EDGE - 2), 1.0], -np.ones(EDGE - 1)], [-1, 0, 1])
    grid = sp.kronsum(sp.kronsum(line, line), line)
    return sp.bsr_matrix(sp.kron(grid, np.eye(3) + 0.3) + held * sp.eye(3 * EDGE**3), blocksize=(3, 3))


def pushed(matrix: sp.bsr_matrix, nodes: IntArray, stiffness: float) -> sp.bsr_matrix:
    """The same with springs of a stiffness, which may be negative, at some nodes."""
    diagonal = np.zeros((EDGE**3, 3))
    diagonal[nodes] = stiffness
    return sp.bsr_matrix(matrix + sp.diags(diagonal.ravel()), blocksize=(3, 3))


def rows(nodes: IntArray) -> IntArray:
    return np.asarray((3 * nodes[:, None] + np.arange(3)).ravel())


def agrees(solver: PardisoSchurSolver, matrix: sp.bsr_matrix, close: float) -> None:
    inverse, b = np.linalg.inv(matrix.toarray()), np.random.default_rng(4).standard_normal(matrix.shape[0])
    at = rows(solver.nodes)
    np.testing.assert_allclose(solver.inverse, inverse[np.ix_(at, at)], atol=close * np.abs(inverse).max())
    for found, expected in (
        (solver.solve(b), inverse @ b),
        (solver.solve_condensed(b[: len(at)].reshape(-1, 3)), inverse[:, at] @ b[: len(at)]),
    ):
        np.testing.assert_allclose(found, expected, atol=close * np.abs(expected).max())


@pytest.mark.parametrize(("single", "close"), [(False, 1e-10), (True, 1e-3)])
@pytest.mark.parametrize("threads", [1, 2])
def test_parts_of_the_inverse_and_solutions_are_those_of_dense_algebra(single: bool, close: float, threads: int) -> None:
    direct.use_threads(threads)
    try:
        solver, soft = PardisoSchurSolver(springs(), single_precision=single), springs()
        for nodes in (SOME, np.arange(50, 120), np.zeros(0, np.int64), SOME):
            solver.condense(nodes)
            indefinite = [pushed(soft, where, -2.5) for where in (SOME, np.array([17, 99, 120]))]
            for matrix in (soft, *indefinite, pushed(soft, SOME, 20.0)):
                agrees(solver.factorize(matrix) and solver, matrix, close)
    finally:
        direct.use_threads(0)
    assert min(np.linalg.eigvalsh(matrix.toarray())[0] for matrix in indefinite) < -0.1


def test_a_singular_matrix_is_refused() -> None:
    solver = PardisoSchurSolver(springs())
    solver.condense(SOME)
    with pytest.raises(ConvergenceError, match="singular"):
        solver.factorize(springs(held=0.0))


def columns_of(inverse: FloatArray, nodes: IntArray, amounts: FloatArray) -> FloatArray:
    return np.asarray(inverse[:, rows(nodes)] @ amounts.ravel())


def test_nodes_beyond_those_of_the_factors_are_known_by_columns() -> None:
    matrix, random = springs(), np.random.default_rng(7)
    solver = PardisoSchurSolver(matrix)
    solver.condense(SOME)
    made, inverse = UpdatedFactors(solver.factorize(matrix), EDGE**3), np.linalg.inv(matrix.toarray())
    assert made.column_bytes == 0
    for more in ([], [7, 150], [8]):
        made.prepare(np.array(more, dtype=np.int64))
        nodes = np.array([150, 41, 7, 0, 8])[: 2 + len(more)] if len(more) else SOME[::-1]
        at = rows(nodes)
        np.testing.assert_allclose(made.between(nodes), inverse[np.ix_(at, at)], atol=1e-6)
    assert made.covered(np.array([[3, 8], [9, 150]])).tolist() == [[True, True], [False, True]]
    nodes, amounts, x = np.array([8, 3, 150, 215]), random.standard_normal((4, 3)), np.ones(3 * EDGE**3)
    made.add_columns(nodes, amounts, x)
    np.testing.assert_allclose(x, 1.0 + columns_of(inverse, nodes, amounts), atol=1e-6)
