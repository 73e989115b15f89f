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
from naibu.mechanics.linear_algebra.direct import pardiso_library, use_threads
from naibu.mechanics.linear_algebra.protocols import LinearSolver
from naibu.mechanics.linear_algebra.updated_factors import BlockChange, UpdatedFactors

THRESHOLD = 5e-4  # of the largest stiffness of the contact: change of a block that is taken into account


@dataclass(frozen=True, slots=True, eq=False)
class EarlierTangent:
    """The tangent at an earlier state.

    Attributes
    ----------
    factors : UpdatedFactors
        Of the tangent, with inertia and the contacts of then.
    dilatation : ndarray, shape (m, k, 3)
        Derivatives of the dilatations, see `naibu.mechanics.finite_elements.pressure_elements`.
    contact : ndarray, shape (n_blocks, 3, 3)
        Stiffness of the contacts of then, mN/mm, in the pattern of the surface.
    held : ndarray, shape (h,), int64
        Nodes that do not move in it.
    solver : LinearSolver
        What the factors belong to; they end when it factorizes another matrix.
    """

    factors: UpdatedFactors
    dilatation: FloatArray
    contact: FloatArray
    held: IntArray
    solver: LinearSolver


@dataclass(slots=True, eq=False)
class TangentThread:
    """A thread that makes one tangent at a time; use it as a context manager, or close it."""

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
    """Solvers of one pattern whose factors nobody uses any more."""

    make: Callable[[], LinearSolver]
    _spare: list[LinearSolver] = field(init=False, default_factory=list)

    def get(self) -> LinearSolver:
        """Return a solver that may factorize."""
        return self._spare.pop() if self._spare else self.make()

    def put(self, solver: LinearSolver) -> None:
        """Take back a solver."""
        self._spare.append(solver)


def contact_change(pattern: BlockPattern, blocks: FloatArray, tangent: EarlierTangent, gripped: IntArray, hold: float) -> BlockChange:
    """Return where, and by how much, the stiffness of contacts and grips differs from that of a tangent, mN/mm.

    Parameters
    ----------
    pattern : BlockPattern
        Of the surface.
    blocks : ndarray, shape (n_blocks, 3, 3)
        Stiffness of the contacts now, mN/mm.
    tangent : EarlierTangent
        With that of then.
    gripped : ndarray, shape (g,), int64
        Nodes that move as they are told, beside those that the tangent holds.
    hold : float
        Stiffness that represents this, mN/mm.
    """
    change = blocks - tangent.contact
    largest = max(float(np.abs(blocks).max(initial=0.0)), float(np.abs(tangent.contact).max(initial=0.0)))
    marked = np.zeros(pattern.n_points, dtype=bool)
    marked[gripped] = True
    taken = _changed_blocks(pattern.indptr, pattern.indices, change, THRESHOLD * largest, marked)
    marked[tangent.held] = False
    nodes, place = np.flatnonzero(marked).astype(np.int64), np.cumsum(marked) - 1
    rows = np.repeat(np.arange(pattern.n_points), np.diff(pattern.indptr))
    kept = np.flatnonzero(taken & marked[rows] & marked[pattern.indices])
    own = place[gripped[marked[gripped]]]
    return BlockChange(
        nodes, np.concatenate([place[rows[kept]], own]), np.concatenate([place[pattern.indices[kept]], own]),
        np.concatenate([change[kept], np.tile(hold * np.eye(3), (len(own), 1, 1))]),
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _changed_blocks(indptr, indices, change, threshold, marked):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Mark the nodes of blocks with an entry above a threshold; returns which blocks have one."""
    taken = np.zeros(len(indices), np.bool_)
    for i in range(len(indptr) - 1):
        for at in range(indptr[i], indptr[i + 1]):
            for a in range(9):
                if abs(change[at, a // 3, a % 3]) > threshold:
                    taken[at] = True
                    marked[i] = True
                    marked[indices[at]] = True
                    break
    return taken
