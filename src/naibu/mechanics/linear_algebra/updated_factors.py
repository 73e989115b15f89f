"""Factors of an earlier matrix, and what follows from a change of some of its blocks, by the formula of Woodbury :cite:p:`hager1989`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from naibu._numba.compilation import njit
from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.mechanics.linear_algebra.protocols import Factorization
from naibu.mechanics.linear_algebra.schur_complement import PardisoSchurSolver

COLUMNS = 96  # of the inverse that are computed at once
FEW = 8  # nodes that are prepared at once where one waits for them


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

    def and_also(self, other: BlockChange) -> BlockChange:
        """Return this change and another one of nodes behind those of this one."""
        first = len(self.nodes)
        return BlockChange(
            np.concatenate([self.nodes, other.nodes]), np.concatenate([self.rows, first + other.rows]),
            np.concatenate([self.columns, first + other.columns]), np.concatenate([self.blocks, other.blocks]),
        )  # fmt: skip

    def times(self, motion: FloatArray) -> FloatArray:
        """Return the product (m, 3) with a motion (m, 3) of all m nodes."""
        out = np.zeros_like(motion)
        np.add.at(out, self.nodes[self.rows], np.einsum("bij,bj->bi", self.blocks, motion[self.nodes[self.columns]]))
        return out

    def with_springs(self, stiffness: FloatArray) -> BlockChange:
        """Return the change with springs (m,) beside it, which hold each of all m nodes where it is."""
        held = np.flatnonzero(stiffness)
        if len(held) == 0:
            return self
        nodes = np.union1d(self.nodes, held)
        place, own = nodes.searchsorted(self.nodes), nodes.searchsorted(held)
        blocks = np.concatenate([self.blocks, stiffness[held][:, None, None] * np.eye(3)])
        return BlockChange(nodes, np.concatenate([place[self.rows], own]), np.concatenate([place[self.columns], own]), blocks)


@dataclass(slots=True, eq=False)
class UpdatedFactors:
    """Factors of a matrix A of 3 x 3 blocks, and the part of its inverse between nodes whose blocks change.

    Attributes
    ----------
    factors : Factorization
        Of A (3 n, 3 n); A is symmetric where they are those of a `PardisoSchurSolver`, whose part of the inverse is known without columns.
    n_points : int
        Number n of nodes.
    """

    factors: Factorization
    n_points: int
    _nodes: IntArray = field(init=False)
    _slot: IntArray = field(init=False)
    _columns: list[NDArray[np.float32]] = field(init=False, default_factory=list)  # of the inverse, of nodes behind those of the factors
    _inverse: NDArray[np.float32] = field(init=False)

    def __post_init__(self) -> None:
        self._slot = np.full(self.n_points, -1, dtype=np.int64)
        self._nodes, self._inverse = np.zeros(0, dtype=np.int64), np.zeros((0, 0), dtype=np.float32)
        if isinstance(self.factors, PardisoSchurSolver):
            self._nodes, self._inverse = self.factors.nodes, np.asarray(self.factors.inverse, dtype=np.float32)
            self._slot[self._nodes] = np.arange(len(self._nodes))

    def covered(self, nodes: IntArray) -> BoolArray:
        """For which of these nodes (any shape) the part of the inverse is known."""
        return np.asarray(self._slot[nodes] >= 0)

    @property
    def column_bytes(self) -> int:
        """Memory of the columns of the inverse."""
        return sum(columns.nbytes for columns in self._columns)

    def prepare(self, nodes: IntArray) -> None:
        """Compute the part of the inverse that belongs to nodes (k,) and those of earlier calls."""
        self._add(np.unique(nodes[self._slot[nodes] < 0]))
        self._gather()

    def _add(self, new: IntArray) -> None:
        """Compute the columns of the inverse that belong to nodes (k,) that are not known yet."""
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

    def _gather(self) -> None:
        """Take the part between the nodes out of the columns; it is of the order of its square, and not done after every few nodes."""
        if len(self._inverse) == 3 * len(self._nodes):
            return
        of_factors = 3 * len(self.condensed)
        at, whole = _rows(self._nodes), np.empty((3 * len(self._nodes),) * 2, dtype=np.float32, order="F")
        whole[:of_factors, :of_factors] = self._inverse[:of_factors, :of_factors]
        whole[:, of_factors:] = np.concatenate([part.T.take(at, axis=1) for part in self._columns]).T
        whole[of_factors:, :of_factors] = whole[:of_factors, of_factors:].T
        self._inverse = whole

    def prepared(self, nodes: IntArray) -> Iterator[None]:
        """Prepare a few nodes of (k,) at a time, and yield between them, until all are known: one may go on later."""
        while len(left := nodes[~self.covered(nodes)]):
            yield
            self._add(np.unique(left)[:FEW])

    def solve(self, b: FloatArray) -> FloatArray:
        """Return x of ``A x = b`` for b of shape (3 n,)."""
        return np.asarray(self.factors.solve(b), dtype=np.float64)

    def solve_all(self, b: FloatArray) -> FloatArray:
        """Return the solutions (3 n, r) for right sides (3 n, r) in the order of columns."""
        return np.asarray(self.factors.solve(b))

    @property
    def condensed(self) -> IntArray:
        """The nodes (k,) whose part of the inverse came with the factors, without columns: in a symmetric matrix only."""
        return self._nodes[: len(self._nodes) - sum(columns.shape[1] for columns in self._columns) // 3]

    def of_columns(
        self, nodes: IntArray, of: Callable[[NDArray[np.float32]], NDArray[np.float32]], of_condensed: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return what a linear function makes of the columns (3 n, 3 k) of the inverse that belong to nodes (k,): (p, 3 k).

        `of_condensed` (p, 3 l) is what it makes of the columns of the l nodes that are `condensed`.
        """
        self._add(np.unique(nodes[self._slot[nodes] < 0]))
        known = [of_condensed, *(of(columns) for columns in self._columns)]
        return np.concatenate(known, axis=1)[:, _rows(self._slot[nodes])]

    def between(self, nodes: IntArray) -> NDArray[np.float32]:
        """Return the part of the inverse (3 k, 3 k) between nodes (k,), in the order of columns."""
        self.prepare(nodes)
        at = _rows(self._slot[nodes])
        return self._inverse.T.take(at, axis=0).take(at, axis=1).T

    def add_columns(self, nodes: IntArray, amounts: FloatArray, x: FloatArray) -> None:
        """Add the columns of the inverse that belong to nodes (k,), times amounts (k, 3), to x (3 n,)."""
        slots = self._slot[nodes]
        first = len(self.condensed)
        if isinstance(self.factors, PardisoSchurSolver) and amounts[slots < first].any():
            condensed = np.zeros((first, 3))
            condensed[slots[slots < first]] = amounts[slots < first]
            x += self.factors.solve_condensed(condensed)
        for columns in self._columns:
            count = columns.shape[1] // 3
            here = (slots >= first) & (slots < first + count)
            _add_columns(columns, 3 * (slots[here] - first), amounts[here].astype(np.float32), x)
            first += count


@dataclass(frozen=True, slots=True, eq=False)
class ChangedInverse:
    """Solutions d (m, 3) of ``(1 + inverse change) d = b``, with a part of the inverse of a matrix between m nodes.

    Nodes that a change joins in pairs, as those of the two sides of a cut, count by their relative motion alone: a small matrix of half the
    size is factorized for them. Of other nodes, components that a change does not concern do not count.

    Attributes
    ----------
    change : BlockChange
        Between nodes and relative motions: its nodes are those whose motion counts, less that of the partner where there is one.
    partner : ndarray, shape (s,), int64
        The other node of a pair; -1 where a node counts by itself.
    counted : ndarray, shape (c,), int64
        Which of the 3 s components count.
    """

    change: BlockChange
    partner: IntArray
    counted: IntArray
    _components: tuple[
        IntArray, IntArray, IntArray
    ]  # those that count, as numbers among the 3 m; of them, those in pairs, and their others
    _place: IntArray
    _columns: NDArray[np.float32]
    _factors: tuple[NDArray[np.float32], NDArray[np.int32]]

    @classmethod
    def of(cls, inverse: NDArray[np.float32], change: BlockChange) -> ChangedInverse:
        """Factorize for a part of the inverse (3 m, 3 m), in the order of columns; the nodes of the change are places among the m."""
        change, partner = _by_relative_motion(change)
        joined = np.repeat(partner >= 0, 3)
        counted = np.flatnonzero(joined | _concerned(len(change.nodes), change.rows, change.columns, change.blocks))
        at, paired, other = _rows(change.nodes)[counted], np.flatnonzero(joined[counted]), _rows(partner[partner >= 0])
        columns = inverse.T.take(at, axis=0).T  # contiguous both here and there: three times as fast as indices of columns
        between = columns.T.take(at, axis=1).T
        if len(paired):
            columns[:, paired] -= inverse.T.take(other, axis=0).T
            between = columns.T.take(at, axis=1).T
            between[paired] -= columns.T.take(other, axis=1).T
        matrix = np.asfortranarray(np.eye(len(at), dtype=np.float32))
        place = np.zeros(len(joined), dtype=np.int64)
        place[counted] = np.arange(len(at))
        _add_product(between, place, change.rows, change.columns, change.blocks, matrix)
        factors = la.lu_factor(matrix, overwrite_a=True, check_finite=False) if len(at) else (matrix, np.zeros(0, np.int32))
        return cls(change, partner, counted, (at, paired, other), place, columns, factors)

    def solve(self, b: FloatArray) -> FloatArray:
        """Return d (m, 3) for b (m, 3)."""
        (at, paired, other), change, flat = self._components, self.change, b.ravel()
        if len(at) == 0:
            return b
        right = flat[at]
        if len(paired):
            right[paired] -= flat[other]
        there = la.lapack.sgetrs(*self._factors, right.astype(np.float32))[0]
        reaction = np.zeros(len(at), dtype=np.float32)
        _react(self._place, change.rows, change.columns, change.blocks, there, reaction)
        out = flat - self._columns @ reaction
        if len(paired) == 0:
            out[at] = there
            return np.asarray(out.reshape(-1, 3))
        both = at[paired]
        wrong = 0.5 * (there[paired] - (out[both] - out[other]))
        sides = out[both] + wrong, out[other] - wrong
        out[at] = there
        out[both], out[other] = sides
        return np.asarray(out.reshape(-1, 3))


def _by_relative_motion(change: BlockChange) -> tuple[BlockChange, IntArray]:
    """Return a change with one place for every pair of nodes that resists nothing but its relative motion, and the partners (s,)."""
    count = len(change.nodes)
    other = _partners(count, change.rows, change.columns, change.blocks)
    kept = np.flatnonzero((other < 0) | (other > np.arange(count)))
    if len(kept) == count:
        return change, np.full(count, -1, dtype=np.int64)
    place = np.full(count, -1, dtype=np.int64)
    place[kept] = np.arange(len(kept))
    some = (place[change.rows] >= 0) & (place[change.columns] >= 0)
    partner = np.where(other[kept] >= 0, change.nodes[other[kept]], -1)
    return BlockChange(change.nodes[kept], place[change.rows[some]], place[change.columns[some]], change.blocks[some]), partner


def _rows(nodes: IntArray) -> IntArray:
    return np.asarray((3 * nodes[:, None] + np.arange(3)).ravel())


@njit(cache=True, nogil=True)
def _partners(count, rows, columns, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the other node of pairs whose blocks are K, -K, -K and K, and touch no other node; -1 of all others."""
    entries, own, across, other = np.zeros(count, np.int64), np.full(count, -1), np.full(count, -1), np.full(count, -1)
    for b in range(len(rows)):
        i = rows[b]
        entries[i] += 1
        if columns[b] == i:
            own[i] = b
        else:
            across[i] = b
    for i in range(count):
        if entries[i] != 2 or own[i] < 0 or across[i] < 0:
            continue
        j = columns[across[i]]
        if entries[j] != 2 or own[j] < 0 or across[j] < 0 or columns[across[j]] != i:
            continue
        same = True
        for a in range(3):
            for c in range(3):
                k = blocks[own[i], a, c]
                same = same and blocks[across[i], a, c] == -k and blocks[across[j], a, c] == -k and blocks[own[j], a, c] == k
        if same:
            other[i] = j
    return other


@njit(cache=True, nogil=True)
def _react(place, rows, columns, blocks, motion, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the product of a matrix of blocks and the motion of components (c,) to `reaction` (c,); see `_add_product` for `place`."""
    for b in range(len(rows)):
        r, c = 3 * rows[b], 3 * columns[b]
        m0, m1, m2 = motion[place[c]], motion[place[c + 1]], motion[place[c + 2]]
        for i in range(3):
            reaction[place[r + i]] += blocks[b, i, 0] * m0 + blocks[b, i, 1] * m1 + blocks[b, i, 2] * m2


@njit(cache=True, nogil=True)
def _concerned(count, rows, columns, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return which components of the motion of `count` nodes (3 count,) have anything but zeros in their rows and columns."""
    found = np.zeros(3 * count, dtype=np.bool_)
    for k in range(len(rows)):
        for i in range(3):
            for j in range(3):
                if blocks[k, i, j] != 0.0:
                    found[3 * rows[k] + i] = found[3 * columns[k] + j] = True
    return found


@njit(cache=True, nogil=True, fastmath=True)
def _add_product(inverse, place, rows, columns, blocks, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the product of the inverse between components and a matrix of blocks; arrays are in the order of columns.

    `place` (3 s,) are the places of all components of the nodes, 0 of those that do not count.
    """
    for k in range(len(rows)):
        r, c = 3 * rows[k], 3 * columns[k]
        b = blocks[k].astype(np.float32)
        if b[0, 1] == 0.0 and b[0, 2] == 0.0 and b[1, 0] == 0.0 and b[1, 2] == 0.0 and b[2, 0] == 0.0 and b[2, 1] == 0.0:
            for j in range(3):
                if b[j, j] != 0.0:
                    alone, to, of = b[j, j], place[c + j], place[r + j]
                    for i in range(len(out)):
                        out[i, to] += inverse[i, of] * alone
            continue
        r0, r1, r2, c0, c1, c2 = place[r], place[r + 1], place[r + 2], place[c], place[c + 1], place[c + 2]
        b00, b01, b02, b10, b11, b12 = b[0, 0], b[0, 1], b[0, 2], b[1, 0], b[1, 1], b[1, 2]
        b20, b21, b22 = b[2, 0], b[2, 1], b[2, 2]
        for i in range(len(out)):  # all three columns at once: what is read counts, not what is multiplied
            first, second, third = inverse[i, r0], inverse[i, r1], inverse[i, r2]
            out[i, c0] += first * b00 + second * b10 + third * b20
            out[i, c1] += first * b01 + second * b11 + third * b21
            out[i, c2] += first * b02 + second * b12 + third * b22


@njit(cache=True, nogil=True, fastmath=True)
def _add_columns(columns, first, amounts, x):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add columns (in Fortran's order), three from each first one, times amounts (k, 3) to x."""
    for k in range(len(first)):
        c = first[k]
        a0, a1, a2 = amounts[k, 0], amounts[k, 1], amounts[k, 2]
        if a0 != 0.0 or a1 != 0.0 or a2 != 0.0:
            for i in range(len(x)):
                x[i] += a0 * columns[i, c] + a1 * columns[i, c + 1] + a2 * columns[i, c + 2]
