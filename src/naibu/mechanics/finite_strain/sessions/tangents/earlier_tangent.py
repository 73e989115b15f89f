"""Tangents of earlier states of a body, factorized by a thread of its own while the steps go on with the one before."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, IntArray
from naibu.core.cores import usable_cores
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern
from naibu.mechanics.linear_algebra.direct import SuperLUSolver, pardiso_library, use_threads
from naibu.mechanics.linear_algebra.paired_motion import PairedMotion
from naibu.mechanics.linear_algebra.protocols import LinearSolver
from naibu.mechanics.linear_algebra.schur_complement import PardisoSchurSolver
from naibu.mechanics.linear_algebra.turned_factors import TurnedFactors
from naibu.mechanics.linear_algebra.updated_factors import BlockChange, UpdatedFactors

MORE = 160  # nodes beyond those that are asked for, which take less time than another analysis of the pattern
THRESHOLD = 5e-4  # of the largest stiffness of the contact: change of a block that is taken into account


@dataclass(frozen=True, slots=True, eq=False)
class EarlierTangent:
    """The tangent at an earlier state.

    Attributes
    ----------
    factors : UpdatedFactors or TurnedFactors
        Of the tangent, with inertia and the contacts of then.
    dilatation : ndarray, shape (m, k, 3)
        Derivatives of the dilatations, see `naibu.mechanics.finite_elements.pressure_elements`.
    contact : ndarray, shape (n_blocks, 3, 3)
        Stiffness of the contacts of then, mN/mm, in the pattern of the surface.
    held : ndarray, shape (h,), int64
        Nodes that do not move in it.
    touched : ndarray, shape (t,), int64
        Nodes that these contacts concern.
    lips : ndarray, shape (p, 3, 3)
        Stiffness of the contact of the sides of cuts of then, mN/mm, which is none of `contact`.
    solver : LinearSolver
        What the factors belong to; they end when it factorizes another matrix.
    displacement : ndarray, shape (n, 3)
        Of the nodes in that state, mm.
    seconds : float
        Of a processor that it took to make.
    pairs : PairedMotion
        Pairs of the sides of cuts without friction, along their normals of then, that may open or close.
    """

    factors: UpdatedFactors | TurnedFactors
    dilatation: FloatArray
    contact: FloatArray
    held: IntArray
    touched: IntArray
    lips: FloatArray
    solver: LinearSolver
    displacement: FloatArray
    seconds: float = 0.0
    pairs: PairedMotion = field(default_factory=PairedMotion.none)


@dataclass(slots=True, eq=False)
class TangentThread:
    """A thread that makes one tangent at a time; use it as a context manager, or close it.

    It factorizes with a solver of its own while steps solve with another: PARDISO permits that, and a lock would let steps wait.
    """

    _work: Callable[[], EarlierTangent] | None = field(init=False, default=None)
    _done: EarlierTangent | None = field(init=False, default=None)
    _failure: BaseException | None = field(init=False, default=None)
    _wake: threading.Condition = field(init=False, default_factory=threading.Condition)
    _thread: threading.Thread | None = field(init=False, default=None)
    _closed: bool = field(init=False, default=False)

    def __enter__(self) -> Self:
        """Return the thread."""
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self.close()

    @property
    def idle(self) -> bool:
        """Whether it waits for work and its last tangent has been taken."""
        with self._wake:
            return self._work is None and self._done is None

    def submit(self, make: Callable[[], EarlierTangent]) -> None:
        """Have a tangent made; only while it is idle."""
        with self._wake:
            self._work = make
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="naibu tangents", daemon=True)
                self._thread.start()
            self._wake.notify()

    def take(self) -> EarlierTangent | None:
        """Return the tangent that has been made since the last call, None where there is none.

        Raises
        ------
        BaseException
            What ended the work.
        """
        with self._wake:
            if self._failure is not None:
                failure, self._failure = self._failure, None
                raise failure
            done, self._done = self._done, None
            return done

    def close(self) -> None:
        """End the thread, after the work that it has begun."""
        with self._wake:
            self._closed = True
            self._wake.notify()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        if pardiso_library() is not None:
            use_threads(max(1, usable_cores() - 1))
        while True:
            with self._wake:
                while self._work is None and not self._closed:
                    self._wake.wait()
                make = self._work
                if self._closed or make is None:
                    return
            done, failure = None, None
            try:
                done = make()
            except BaseException as error:
                failure = error
            with self._wake:
                self._work, self._done, self._failure = None, done, failure


@dataclass(slots=True, eq=False)
class SolverPool:
    """Solvers for symmetric matrices of one pattern whose factors nobody uses any more; in single precision where that is possible."""

    pattern: BlockPattern
    _spare: list[LinearSolver] = field(init=False, default_factory=list)

    def get(self, nodes: IntArray) -> LinearSolver:
        """Return a solver that may factorize; where it can, it brings the part of the inverse between these nodes (k,), ascending.

        One that knows the pattern with just these nodes, or not many more, is preferred: another has to analyse it.
        """
        serving = [s for s in self._spare if isinstance(s, PardisoSchurSolver) and _serves(s.nodes, nodes)]
        for solver in [*sorted(serving, key=lambda s: len(s.nodes)), *self._spare]:
            try:
                self._spare.remove(solver)
            except ValueError:  # another thread has just taken it
                continue
            if solver not in serving and isinstance(solver, PardisoSchurSolver):
                solver.condense(nodes)
            return solver
        if pardiso_library() is None:
            return SuperLUSolver()
        made = PardisoSchurSolver(self.pattern.matrix(np.zeros((self.pattern.n_blocks, 3, 3))), single_precision=True)
        made.condense(nodes)
        return made

    def put(self, solver: LinearSolver) -> None:
        """Take back a solver."""
        self._spare.append(solver)


def _serves(known: IntArray, nodes: IntArray) -> bool:
    return len(known) <= len(nodes) + MORE and bool(np.isin(nodes, known, assume_unique=True).all())


def contact_change(pattern: BlockPattern, blocks: FloatArray, tangent: EarlierTangent, nodes: IntArray, place: IntArray) -> BlockChange:
    """Return where, and by how much, the stiffness of contacts differs from that of a tangent, mN/mm.

    Parameters
    ----------
    pattern : BlockPattern
        Of the surface.
    blocks : ndarray, shape (n_blocks, 3, 3)
        Stiffness of the contacts now, mN/mm.
    tangent : EarlierTangent
        With that of then.
    nodes : ndarray, shape (k,), int64
        The nodes concerned, of which the change is sought.
    place : ndarray, shape (n,), int64
        Of every node among them, or -1.
    """
    count, at, rows, columns = _changed_blocks(pattern.indptr, pattern.indices, blocks, tangent.contact, nodes, place, THRESHOLD)
    at, rows, columns = at[:count], rows[:count], columns[:count]
    marked = np.zeros(len(nodes), dtype=bool)
    marked[rows] = marked[columns] = True
    number = np.cumsum(marked) - 1
    return BlockChange(np.flatnonzero(marked).astype(np.int64), number[rows], number[columns], blocks[at] - tangent.contact[at])


@njit(cache=True, nogil=True)
def _changed_blocks(indptr, indices, blocks, earlier, nodes, place, fraction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return how many blocks between these nodes changed by more than a fraction of the largest entry, and which: number, row, column."""
    largest, most = 0.0, 0
    for i in nodes:
        most += indptr[i + 1] - indptr[i]
        for at in range(indptr[i], indptr[i + 1]):
            for a in range(9):
                largest = max(largest, abs(blocks[at, a // 3, a % 3]), abs(earlier[at, a // 3, a % 3]))
    found, rows, columns, count = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64), 0
    for k in range(len(nodes)):
        for at in range(indptr[nodes[k]], indptr[nodes[k] + 1]):
            column = place[indices[at]]
            if column < 0:
                continue
            for a in range(9):
                if abs(blocks[at, a // 3, a % 3] - earlier[at, a // 3, a % 3]) > fraction * largest:
                    found[count], rows[count], columns[count] = at, k, column
                    count += 1
                    break
    return count, found, rows, columns


@njit(cache=True, nogil=True)
def add_earlier_forces(indptr, indices, blocks, nodes, place, motion, force):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the product of blocks between these nodes and their motion (k, 3) to `force`, in their order."""
    for k in range(len(nodes)):
        for at in range(indptr[nodes[k]], indptr[nodes[k] + 1]):
            column = place[indices[at]]
            if column >= 0:
                for i in range(3):
                    force[k, i] += (
                        blocks[at, i, 0] * motion[column, 0] + blocks[at, i, 1] * motion[column, 1] + blocks[at, i, 2] * motion[column, 2]
                    )
