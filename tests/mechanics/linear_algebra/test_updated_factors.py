"""Solutions after a change of blocks are those of the changed matrix."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.core.rigid_transform import rotation_matrix
from naibu.mechanics.linear_algebra.direct import SuperLUSolver
from naibu.mechanics.linear_algebra.turned_factors import TurnedFactors
from naibu.mechanics.linear_algebra.updated_factors import BlockChange, ChangedInverse, UpdatedFactors

N = 12


@pytest.fixture
def dense() -> FloatArray:
    random = np.random.default_rng(5)
    return np.asarray(random.standard_normal((3 * N, 3 * N)) + 20.0 * np.eye(3 * N))


def factors_of(matrix: FloatArray) -> UpdatedFactors:
    return UpdatedFactors(SuperLUSolver().factorize(sp.bsr_matrix(matrix, blocksize=(3, 3))), len(matrix) // 3)


def test_the_parts_of_the_inverse_are_those_of_the_matrix(dense: FloatArray) -> None:
    made, inverse, x = factors_of(dense), np.linalg.inv(dense), np.ones(3 * N)
    nodes, amounts = np.array([7, 2, 9]), np.random.default_rng(6).standard_normal((3, 3))
    made.prepare(np.array([2, 5]))
    rows = (3 * nodes[:, None] + np.arange(3)).ravel()
    np.testing.assert_allclose(made.between(nodes), inverse[np.ix_(rows, rows)], atol=1e-6)
    assert made.covered(np.array([[7, 3], [5, 2]])).tolist() == [[True, False], [True, True]]
    made.add_columns(nodes, amounts, x)
    np.testing.assert_allclose(x, 1.0 + inverse[:, rows] @ amounts.ravel(), atol=1e-6)


def test_factors_in_axes_that_have_turned_are_those_of_the_matrix_there(dense: FloatArray) -> None:
    made, turn, random = factors_of(dense), rotation_matrix(np.array([0.4, -0.9, 0.3])), np.random.default_rng(7)
    whole = np.kron(np.eye(N), turn)
    inverse, turned = whole @ np.linalg.inv(dense) @ whole.T, TurnedFactors(made, turn)
    nodes, amounts, b, x = np.array([7, 2, 9]), random.standard_normal((3, 3)), random.standard_normal(3 * N), np.ones(3 * N)
    rows = (3 * nodes[:, None] + np.arange(3)).ravel()
    np.testing.assert_allclose(turned.solve(b), inverse @ b, atol=1e-6)
    np.testing.assert_allclose(turned.between(nodes), inverse[np.ix_(rows, rows)], atol=1e-6)
    turned.add_columns(nodes, amounts, x)
    np.testing.assert_allclose(x, 1.0 + inverse[:, rows] @ amounts.ravel(), atol=1e-6)
    function = random.standard_normal((4, 3 * N)).astype(np.float32)
    found = turned.of_columns(nodes, lambda columns: function @ columns, np.zeros((4, 0), dtype=np.float32))
    np.testing.assert_allclose(found, function @ inverse[:, rows], atol=1e-5)
    assert turned.between(nodes[:0]).shape == (0, 0)  # as where nothing is in contact, and nodes are gripped that do not count
    assert turned.covered(np.array([7, 3])).tolist() == made.covered(np.array([7, 3])).tolist() == [True, False]


@pytest.mark.parametrize("nodes", [[2, 7], [0, 2, 5], [7, 2]])
def test_the_changed_system_is_solved(dense: FloatArray, nodes: list[int]) -> None:
    random = np.random.default_rng(8)
    some, made = np.array([0, 2, 5, 7, 11]), factors_of(dense)
    rows, columns = np.array([0, 0, 1]), np.array([0, 1, 0])
    blocks, b = 10.0 * random.standard_normal((3, 3, 3)), random.standard_normal((len(some), 3))
    changed = np.eye(3 * len(some))
    inverse = made.between(some).astype(float)
    change = np.zeros_like(changed)
    places = np.searchsorted(some, nodes)
    for r, c, block in zip(places[rows], places[columns], blocks, strict=True):
        change[3 * r : 3 * r + 3, 3 * c : 3 * c + 3] += block
    found = ChangedInverse.of(made.between(some), BlockChange(places, rows, columns, blocks)).solve(b)
    expected = np.linalg.solve(changed + inverse @ change, b.ravel())
    np.testing.assert_allclose(found.ravel(), expected, atol=1e-4 * np.abs(expected).max())


def test_without_a_change_nothing_happens(dense: FloatArray) -> None:
    none, b = np.zeros(0, dtype=np.int64), np.ones((2, 3))
    same = ChangedInverse.of(factors_of(dense).between(np.array([1, 4])), BlockChange(none, none, none, np.zeros((0, 3, 3))))
    np.testing.assert_allclose(same.solve(b), b)
    np.testing.assert_allclose(factors_of(np.diag(np.arange(1.0, 10.0))).solve(np.ones(9)), 1.0 / np.arange(1.0, 10.0))


def test_nodes_in_pairs_are_solved_by_their_relative_motion(dense: FloatArray) -> None:
    """Two pairs that resist relative motion, one of them unsymmetrically, beside a node that is held: half of the unknowns of the pairs."""
    random = np.random.default_rng(9)
    some, made = np.array([0, 2, 3, 5, 7, 11]), factors_of(dense)
    first, second, held = np.array([1, 5]), np.array([3, 0]), 2
    stiff = random.standard_normal((2, 3, 3)) + 20.0 * np.eye(3)
    rows = np.concatenate([first, second, first, second, [held]])
    columns = np.concatenate([first, second, second, first, [held]])
    blocks = np.concatenate([stiff, stiff, -stiff, -stiff, 30.0 * np.eye(3)[None]])
    places = np.unique(rows)
    change = BlockChange(places, places.searchsorted(rows), places.searchsorted(columns), blocks)
    inverse, whole = made.between(some).astype(float), np.zeros((3 * len(some),) * 2)
    for r, c, block in zip(rows, columns, blocks, strict=True):
        whole[3 * r : 3 * r + 3, 3 * c : 3 * c + 3] += block
    b = random.standard_normal((len(some), 3))
    changed = ChangedInverse.of(made.between(some), change)
    expected = np.linalg.solve(np.eye(len(whole)) + inverse @ whole, b.ravel())
    np.testing.assert_allclose(changed.solve(b).ravel(), expected, atol=1e-4 * np.abs(expected).max())
    assert len(changed.change.nodes) == 3


def test_components_that_do_not_change_are_not_counted(dense: FloatArray) -> None:
    """Blocks that are diagonal, or have columns of zeros, beside whole ones and a pair."""
    random = np.random.default_rng(12)
    some, made = np.array([0, 2, 3, 5, 7, 11]), factors_of(dense)
    rows, columns = np.array([0, 1, 1, 2, 3, 4, 3, 4]), np.array([0, 1, 2, 1, 3, 4, 4, 3])
    stiff = 20.0 * np.eye(3) + random.standard_normal((3, 3))
    blocks = np.concatenate([np.zeros((4, 3, 3)), stiff[None], stiff[None], -stiff[None], -stiff[None]])
    blocks[0], blocks[1] = np.diag([9.0, 0.0, 5.0]), np.diag([0.0, 8.0, 0.0])
    blocks[2, :2, 1], blocks[3, 1, :2] = random.standard_normal((2, 2))  # of node 2, only component 1 is in them
    places = np.unique(rows)
    inverse, whole = made.between(some).astype(float), np.zeros((3 * len(some),) * 2)
    for r, c, block in zip(rows, columns, blocks, strict=True):
        whole[3 * r : 3 * r + 3, 3 * c : 3 * c + 3] += block
    b = random.standard_normal((len(some), 3))
    changed = ChangedInverse.of(made.between(some), BlockChange(places, rows, columns, blocks))
    expected = np.linalg.solve(np.eye(len(whole)) + inverse @ whole, b.ravel())
    np.testing.assert_allclose(changed.solve(b).ravel(), expected, atol=1e-4 * np.abs(expected).max())
    assert len(changed.counted) == 2 + 2 + 1 + 3  # of the pair, the relative motion


def test_a_node_that_is_in_a_pair_and_held_besides_counts_by_itself(dense: FloatArray) -> None:
    some, stiff = np.array([0, 2, 3]), 15.0 * np.eye(3)
    rows, columns = np.array([0, 1, 0, 1]), np.array([0, 1, 1, 0])
    change = BlockChange(np.array([0, 2]), rows, columns, np.array([stiff + 5.0, stiff, -stiff, -stiff]))
    inverse, whole = factors_of(dense).between(some).astype(float), np.zeros((9, 9))
    for r, c, block in zip(change.nodes[rows], change.nodes[columns], change.blocks, strict=True):
        whole[3 * r : 3 * r + 3, 3 * c : 3 * c + 3] += block
    b = np.arange(9.0).reshape(3, 3)
    expected = np.linalg.solve(np.eye(9) + inverse @ whole, b.ravel())
    found = ChangedInverse.of(factors_of(dense).between(some), change).solve(b)
    np.testing.assert_allclose(found.ravel(), expected, atol=1e-4 * np.abs(expected).max())
