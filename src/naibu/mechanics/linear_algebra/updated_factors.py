"""Solutions with the factors of an earlier matrix and a change of some of its blocks, by the formula of Woodbury :cite:p:`hager1989`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.linear_algebra.protocols import Factorization

COLUMNS = 48  # of the inverse that are computed at once


@dataclass(frozen=True, slots=True, eq=False)
class BlockChange:
    """A change of blocks of a matrix between some of its nodes.

    Attributes
    ----------
    nodes : ndarray, shape (k,), int64
        The nodes.
    rows, columns : ndarray, shape (b,), int64
        For every block that changes, the places of its nodes in `nodes`.
    blocks : ndarray, shape (b, 3, 3)
        By how much.
    """

    nodes: IntArray
    rows: IntArray
    columns: IntArray
    blocks: FloatArray


@dataclass(slots=True, eq=False)
class UpdatedFactors:
    """Factors of a matrix A of 3 x 3 blocks, and the part of its inverse between nodes whose blocks change.

    Attributes
    ----------
    factors : Factorization
        Of A (3 n, 3 n).
    n_points : int
        Number n of nodes.
    """

    factors: Factorization
    n_points: int
    _nodes: IntArray = field(init=False)
    _slot: IntArray = field(init=False)
    _columns: list[NDArray[np.float32]] = field(init=False, default_factory=list)
    _inverse: NDArray[np.float32] = field(init=False)
    _change: BlockChange | None = field(init=False, default=None)
    _small: Any = field(init=False, default=None)

    def __post_init__(self) -> None:
        self._nodes = np.zeros(0, dtype=np.int64)
        self._slot = np.full(self.n_points, -1, dtype=np.int64)
        self._inverse = np.zeros((0, 0), dtype=np.float32)

    def covers(self, nodes: IntArray) -> bool:
        """Whether the part of the inverse is known for these nodes (k,)."""
        return bool((self._slot[nodes] >= 0).all())

    def prepare(self, nodes: IntArray) -> None:
        """Compute the part of the inverse that belongs to nodes (k,) and those of earlier calls."""
        new = np.unique(nodes[self._slot[nodes] < 0])
        if len(new) == 0:
            return
        own = _rows(new)
        columns = np.empty((3 * self.n_points, len(own)), dtype=np.float32, order="F")
        for first in range(0, len(own), COLUMNS):
            some = own[first : first + COLUMNS]
            unit = np.zeros((3 * self.n_points, len(some)), order="F")
            unit[some, np.arange(len(some))] = 1.0
            columns[:, first : first + len(some)] = self.factors.solve(unit)
        self._slot[new] = len(self._nodes) + np.arange(len(new))
        self._nodes = np.concatenate([self._nodes, new])
        self._columns.append(columns)
        at = _rows(self._nodes)
        self._inverse = np.concatenate([part[at] for part in self._columns], axis=1)

    def solve(self, b: FloatArray, change: BlockChange) -> FloatArray:
        """Return x of ``(A + change) x = b`` for b of shape (3 n,).

        The same object `change` as in the last call is not factorized again.
        """
        x = np.asarray(self.factors.solve(b), dtype=np.float64)
        if len(change.nodes) == 0:
            return x
        rows = _rows(change.nodes)
        if self._change is not change:
            self.prepare(change.nodes)
            at = _rows(self._slot[change.nodes])
            matrix = np.asfortranarray(np.eye(len(rows), dtype=np.float32))
            _add_product(np.asfortranarray(self._inverse[np.ix_(at, at)]), change.rows, change.columns, change.blocks, matrix)
            self._small, self._change = la.lu_factor(matrix, overwrite_a=True, check_finite=False), change
        there = la.lu_solve(self._small, x[rows].astype(np.float32), check_finite=False).astype(np.float64).reshape(-1, 3)
        reaction = np.zeros((len(change.nodes), 3))
        np.add.at(reaction, change.rows, np.einsum("bij,bj->bi", change.blocks, there[change.columns]))
        left = b.copy()
        left[rows] -= reaction.ravel()
        return np.asarray(self.factors.solve(left), dtype=np.float64)


def _rows(nodes: IntArray) -> IntArray:
    return np.asarray((3 * nodes[:, None] + np.arange(3)).ravel())


@njit(cache=True, nogil=True, fastmath=True)
def _add_product(inverse, rows, columns, blocks, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the product of the inverse between the nodes and a matrix of blocks; arrays are in the order of columns."""
    for k in range(len(rows)):
        r, c = 3 * rows[k], 3 * columns[k]
        for j in range(3):
            b0, b1, b2 = np.float32(blocks[k, 0, j]), np.float32(blocks[k, 1, j]), np.float32(blocks[k, 2, j])
            for i in range(len(out)):
                out[i, c + j] += inverse[i, r] * b0 + inverse[i, r + 1] * b1 + inverse[i, r + 2] * b2
