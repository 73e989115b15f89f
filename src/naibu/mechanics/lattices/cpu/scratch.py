"""Scratch arrays of implicit steps: one set for each computation that runs at a time, so that threads never share one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from naibu._numba.intrinsics.simd import WIDTH, aligned
from naibu._numba.thread_pool import new_control
from naibu.core.arrays import AnyArray, AnyFloatArray, FloatArray, IntArray
from naibu.mechanics.lattices.cpu.contact._operator import new_operator

KernelTuple = tuple[Any, ...]  # arrays and numbers as kernels take them, in nested tuples, whose types Numba works out
PackedArguments = Any  # of `naibu._numba.intrinsics.packed_tuples.packed`
Scratch = tuple[KernelTuple, KernelTuple]


@dataclass(slots=True, eq=False)
class ScratchPool:
    """Sets of scratch arrays of one engine; calling it lends one for the time of a ``with`` block.

    A set goes back to the pool at the end of the block and is lent again: steps one after the other allocate nothing, and steps in several
    threads have a set each. A set lent in a block that raises is dropped.

    Attributes
    ----------
    table : ndarray
        Coefficients of the matrix of the step, in single precision; read only.
    light, smoother : ndarray, shape (pad,)
        Nodal masses and inverse diagonal of the matrix; copied into every set, since contact changes them during a step.
    coarse : tuple
        Of `naibu.mechanics.lattices.cpu.implicit.coarse_space.coarse_space`; copied into every set, since it holds vectors and an inverse.
    places : int
        Places for elements in the blocks.
    """

    table: AnyFloatArray
    light: AnyFloatArray
    smoother: AnyFloatArray
    coarse: KernelTuple
    places: int
    _spare: list[Scratch] = field(default_factory=list, repr=False)

    @classmethod
    def empty(cls) -> ScratchPool:
        """Return the pool of an explicit engine, whose steps need none."""
        none = np.zeros(0, np.float32)
        return cls(none, none, none, (), 0)

    @contextmanager
    def __call__(self) -> Iterator[Scratch]:
        """Lend a set: working arrays in double precision, and those of the solver in single precision."""
        try:
            scratch = self._spare.pop()  # list operations are atomic
        except IndexError:
            scratch = self.made()
        yield scratch
        self._spare.append(scratch)

    def made(self) -> Scratch:
        """Return a new set, for the exclusive use of the caller, whose steps are in one part."""
        pad, single = len(self.light), np.float32
        work = (aligned((3, self.places), float), *(aligned((3 * pad,), float) for _ in range(3)))
        vectors = tuple(aligned((3 * pad,), single) for _ in range(4))
        own = (_copied(self.light), _copied(self.smoother))
        blocks, nodes = np.array([0, self.places // WIDTH]), np.array([0, pad])
        pool = (new_control(1), (blocks, nodes, nodes[1:], nodes), work[3].reshape(1, -1), vectors[3].reshape(1, -1), *new_sums(1))
        inner = (self.table, aligned((3, self.places), single), *own, *vectors, _copied_tuple(self.coarse), new_operator(0, 0), pool)
        return work, inner

    def __getstate__(self) -> tuple[AnyFloatArray, AnyFloatArray, AnyFloatArray, KernelTuple, int]:
        """Leave out the sets: another process makes its own."""
        return self.table, self.light, self.smoother, self.coarse, self.places

    def __setstate__(self, state: tuple[AnyFloatArray, AnyFloatArray, AnyFloatArray, KernelTuple, int]) -> None:
        """Begin without any set."""
        self.table, self.light, self.smoother, self.coarse, self.places = state
        self._spare = []


def solver_entries(node: IntArray, direction: FloatArray, body: IntArray) -> KernelTuple:
    """Return constrained components as the solver takes them: with their speeds, and what it took of products along them."""
    return node, direction, np.zeros(len(node)), body, np.zeros(len(node))


def new_sums(parts: int) -> tuple[FloatArray, FloatArray]:
    """Return room for the sums of each part, a cache line each, and for the numbers that they all read."""
    return np.zeros((parts, 8)), np.zeros(8)


def _copied_tuple(arrays: KernelTuple) -> KernelTuple:
    return tuple(_copied_tuple(one) if isinstance(one, tuple) else _copied(one) if isinstance(one, np.ndarray) else one for one in arrays)


def _copied(arrays: AnyArray) -> AnyArray:
    """Return a copy, aligned as `aligned` does."""
    raw = np.zeros(arrays.nbytes + 64, dtype=np.uint8)
    start = -raw.ctypes.data % 64
    result: AnyArray = raw[start : start + arrays.nbytes].view(arrays.dtype).reshape(arrays.shape)
    result[...] = arrays
    return result
