"""Relative motion of pairs of nodes along a direction of each, under forces along these directions, by the factors of a matrix.

Where only the approach of two nodes counts, as across the sides of a cut without friction, a pair is one unknown instead of six: the part
of the inverse that belongs to all pairs takes one column for each, and is small enough to take all of them into account at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.linear_algebra.turned_factors import TurnedFactors
from naibu.mechanics.linear_algebra.updated_factors import UpdatedFactors

COLUMNS = 96  # that are solved for at once


@dataclass(frozen=True, slots=True, eq=False)
class PairedMotion:
    """Pairs of nodes, and how forces along their directions, opposite on their two nodes, move all of them relative to each other.

    Attributes
    ----------
    numbers : ndarray, shape (p,), int64
        Of the pairs, among more of them.
    nodes : ndarray, shape (p, 2), int64
        First and second node.
    directions : ndarray, shape (p, 3)
        Unit vectors.
    inverse : ndarray, shape (p, p), float32
        ``B^T A^-1 B`` with the matrix A and the forces B of unit size: on the second nodes along, on the first ones against the directions.
    of_condensed : ndarray, shape (p, 3 l), float32
        ``B^T A^-1`` for the l nodes whose part of the inverse came with the factors, by the symmetry of A.
    """

    numbers: IntArray
    nodes: IntArray
    directions: FloatArray
    inverse: NDArray[np.float32]
    of_condensed: NDArray[np.float32]

    @classmethod
    def of(cls, factors: UpdatedFactors, numbers: IntArray, nodes: IntArray, directions: FloatArray, held: IntArray) -> Self:
        """Compute the relative motion of pairs, see the attributes; forces on nodes that are held (h,) move nothing."""
        inverse = np.empty((len(nodes), len(nodes)), dtype=np.float32, order="F")
        there = factors.condensed
        of_condensed = np.empty((len(nodes), len(there), 3), dtype=np.float32)
        for first in range(0, len(nodes), COLUMNS):
            some = slice(first, first + COLUMNS)
            unit = np.zeros((3 * factors.n_points, len(nodes[some])), order="F")
            at = np.arange(unit.shape[1])
            for c in range(3):  # a node may be in two pairs, but not twice in one
                unit[3 * nodes[some, 1] + c, at] += directions[some, c]
                unit[3 * nodes[some, 0] + c, at] -= directions[some, c]
                unit[3 * held + c] = 0.0
            motion = factors.solve_all(unit)
            inverse[:, some] = relative(motion, nodes, directions)
            of_condensed[some] = motion.reshape(-1, 3, len(at))[there].transpose(2, 0, 1)
        return cls(numbers, nodes, directions, inverse, of_condensed.reshape(len(nodes), 3 * len(there)))

    @classmethod
    def none(cls) -> Self:
        """Return no pairs."""
        empty = np.zeros(0, dtype=np.int64)
        return cls(empty, empty.reshape(0, 2), np.zeros((0, 3)), *(np.zeros((0, 0), dtype=np.float32),) * 2)

    @property
    def n_pairs(self) -> int:
        """Number of pairs."""
        return len(self.numbers)

    def under(self, factors: UpdatedFactors | TurnedFactors, nodes: IntArray) -> NDArray[np.float32]:
        """Return the relative motion (p, 3 k) under unit forces on nodes (k,), whose part of the inverse is known."""

        def of(columns: NDArray[np.float32]) -> NDArray[np.float32]:
            return relative(columns, self.nodes, self.directions).astype(np.float32)

        return factors.of_columns(nodes, of, self.of_condensed)


def relative(x: FloatArray | NDArray[np.float32], nodes: IntArray, directions: FloatArray) -> FloatArray:
    """Return the motion of the second nodes of pairs relative to the first along directions (p, 3), from motions (3 n,) or (3 n, r)."""
    first, second = 3 * nodes.T
    turned = directions.T if x.ndim == 1 else directions.T[:, :, None]
    rows = x.T  # columns lie one after the other: taken from this side, a third of the time
    moved = [rows.take(second + c, axis=-1).T - rows.take(first + c, axis=-1).T for c in range(3)]
    return np.asarray(sum(along * part for along, part in zip(turned, moved, strict=True)), dtype=np.float64)


def forces_along(amounts: FloatArray, nodes: IntArray, directions: FloatArray, n_points: int) -> FloatArray:
    """Return the forces (3 n,) of amounts (p,) along directions (p, 3) on the second nodes of pairs, and against them on the first."""
    out = np.zeros((n_points, 3))
    along = amounts[:, None] * directions
    np.add.at(out, nodes[:, 1], along)
    np.subtract.at(out, nodes[:, 0], along)
    return out.ravel()
