"""Factors of a matrix of 3 x 3 blocks in axes that have turned: those of ``T A T^T``, with the same rotation T of all nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.mechanics.linear_algebra.updated_factors import UpdatedFactors


@dataclass(frozen=True, slots=True, eq=False)
class TurnedFactors:
    """`UpdatedFactors` of a matrix A, used for ``T A T^T``; what is computed of the inverse of A is kept there.

    Attributes
    ----------
    factors : UpdatedFactors
        Of A.
    rotation : ndarray, shape (3, 3)
        Of every node.
    """

    factors: UpdatedFactors
    rotation: FloatArray

    @property
    def column_bytes(self) -> int:
        """Memory of the columns of the inverse."""
        return self.factors.column_bytes

    def covered(self, nodes: IntArray) -> BoolArray:
        """For which of these nodes (any shape) the part of the inverse is known."""
        return self.factors.covered(nodes)

    def prepare(self, nodes: IntArray) -> None:
        """Compute the part of the inverse that belongs to nodes (k,)."""
        self.factors.prepare(nodes)

    def prepared(self, nodes: IntArray) -> Iterator[None]:
        """Prepare a few nodes of (k,) at a time; see `UpdatedFactors.prepared`."""
        return self.factors.prepared(nodes)

    def solve(self, b: FloatArray) -> FloatArray:
        """Return x of ``T A T^T x = b`` for b of shape (3 n,)."""
        return self._there(self.factors.solve((b.reshape(-1, 3) @ self.rotation).ravel()))

    def between(self, nodes: IntArray) -> NDArray[np.float32]:
        """Return the part of the inverse (3 k, 3 k) between nodes (k,), in the order of columns."""
        part, turn = self.factors.between(nodes), self.rotation.astype(np.float32)
        rows = np.matmul(turn, part.T.reshape(len(nodes), 3, 3 * len(nodes)))  # of the transposed part, which lies row by row
        return np.asarray(rows.reshape(-1, 3) @ turn.T, dtype=np.float32).reshape(part.shape).T

    def of_columns(
        self, nodes: IntArray, of: Callable[[NDArray[np.float32]], NDArray[np.float32]], of_condensed: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return what a linear function makes of columns of the inverse; see `UpdatedFactors.of_columns`."""
        turn = self.rotation.astype(np.float32)

        def of_turned(columns: NDArray[np.float32]) -> NDArray[np.float32]:
            rows = np.matmul(turn, columns.reshape(len(columns) // 3, 3, columns.shape[1]))
            return of(rows.reshape(columns.shape))

        here = (of_condensed.reshape(-1, 3) @ turn).reshape(of_condensed.shape)
        made = self.factors.of_columns(nodes, of_turned, here)
        return (made.reshape(-1, 3) @ turn.T).reshape(made.shape)

    def add_columns(self, nodes: IntArray, amounts: FloatArray, x: FloatArray) -> None:
        """Add the columns of the inverse that belong to nodes (k,), times amounts (k, 3), to x (3 n,)."""
        sums = np.zeros_like(x)
        self.factors.add_columns(nodes, amounts @ self.rotation, sums)
        x += self._there(sums)

    def _there(self, x: FloatArray) -> FloatArray:
        return np.asarray((x.reshape(-1, 3) @ self.rotation.T).ravel())
