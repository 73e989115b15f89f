"""Elements in blocks of eight whose nodes stand in a row, so that vectors of numbers can be loaded as they lie (see `simd`)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from naibu._numba.intrinsics.simd import WIDTH, aligned
from naibu.core.arrays import AnyFloatArray, BoolArray, FloatArray, IntArray
from naibu.mechanics.lattices.cpu._block_kernels import add_to_keys, cover, in_order, mark_filled, number_kinds, tabulate
from naibu.mechanics.lattices.cpu.implicit.coarse_space import coarse_space
from naibu.mechanics.lattices.cpu.scratch import KernelTuple, ScratchPool
from naibu.mechanics.lattices.model.coefficients import explicit_coefficients, implicit_coefficients
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Storage of elements in blocks: lane k of block b joins the nodes first[b] + k and second[b] + k, or none.

    Attributes
    ----------
    first, second : ndarray, shape (nb,), int64
        Nodes of lane 0. `first` is a multiple of eight and grows, so that what the blocks of eight nodes share is loaded once.
    lane : ndarray, shape (m,), int64
        8 b + k of every element.
    n_nodes : int
        Number of nodes; arrays of nodes have eight more places, which lanes without element may read.
    """

    first: IntArray
    second: IntArray
    lane: IntArray
    n_nodes: int

    @classmethod
    def of(cls, lattice: Lattice) -> Blocks:
        """Cover the elements of a lattice by blocks."""
        pairs, m = np.ascontiguousarray(lattice.elements), lattice.n_elements
        order = None
        if not in_order(pairs):
            order = np.argsort(pairs.min(axis=1) // WIDTH, kind="stable")
            pairs = pairs[order]
        gaps, first, second, lane = (np.empty(m, dtype=np.int64) for _ in range(4))  # of all but the lanes only a part is touched
        count = cover(pairs, gaps, first, second, lane)
        if order is not None:
            sorted_lane = lane.copy()
            lane[order] = sorted_lane
        for array in (first, second):
            array.resize(count, refcheck=False)
        return cls(first, second, lane, lattice.n_nodes)

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return len(self.first)

    def parts(self, count: int, end: int) -> tuple[IntArray, IntArray, IntArray]:
        """Return where blocks and nodes, up to `end`, of parts begin (count + 1,), and where the nodes end that they reach (count,)."""
        nodes = np.append(np.round(np.arange(count) * self.n_nodes / count / WIDTH).astype(np.int64) * WIDTH, end)
        cuts = np.searchsorted(self.first, nodes)
        reached = [self.second[i:j].max(initial=0) + WIDTH for i, j in pairwise(cuts)]
        return cuts, nodes, np.maximum(np.array(reached), nodes[1:])

    def patterns(self, *columns: FloatArray) -> tuple[IntArray, list[FloatArray]]:
        """Return where the values of every block start, (nb,), in tables that hold equal ones once; zero in empty lanes.

        Most blocks of a lattice with few parameters share theirs, so that the tables stay in the fast cache. Blocks are told apart by one
        number each, made from the bits of their values; should two kinds share a number, blocks are sorted.
        """
        filled = np.zeros(self.n_blocks, dtype=np.uint8)
        mark_filled(self.lane, filled)
        bits = [np.ascontiguousarray(column, dtype=np.float64).view(np.uint64) for column in columns]
        kind, count = _kinds(self._keys(filled, bits))
        kept = np.zeros(count, dtype=np.uint8)
        kept[kind] = filled
        tables = [np.zeros(WIDTH * count, dtype=np.uint64) for _ in columns]
        alike = np.array_equal(kept[kind], filled)
        if not (alike and all(tabulate(self.lane, kind, own, table) for own, table in zip(bits, tables, strict=True))):
            kind, tables = self._sorted_patterns(filled, bits)
        kind *= WIDTH
        return kind, [table.view(np.float64) for table in tables]

    def parameter_patterns(self, parameters: LatticeParameters) -> tuple[IntArray, LatticeParameters, BoolArray]:
        """Return where the parameters of every block start (nb,), those that differ, and which of these stand in empty lanes.

        Coefficients of steps are worked out from them once, and not for every element. Those of empty lanes are finite.
        """
        rows, (k, c1, c2) = self.patterns(parameters.stiffness, parameters.voigt_damping, parameters.series_damping)
        empty = c2 == 0.0  # C2 of elements is positive
        c2[empty] = np.inf
        return rows, LatticeParameters(k, c1, c2, np.full(len(k), 0.5)), empty

    def _keys(self, filled: NDArray[np.uint8], bits: list[NDArray[np.uint64]]) -> NDArray[np.uint64]:
        """Return a number for each block, the same for equal ones."""
        keys = filled.astype(np.uint64)
        for own in bits:
            keys *= np.uint64(0x9FB21C651E98DF25)
            add_to_keys(self.lane, own, keys)
        return keys

    def _sorted_patterns(self, filled: NDArray[np.uint8], bits: list[NDArray[np.uint64]]) -> tuple[IntArray, list[NDArray[np.uint64]]]:
        """Return the kind of every block and the tables, from whole blocks."""
        wide = np.zeros((len(bits), WIDTH * self.n_blocks), dtype=np.uint64)
        wide[:, self.lane] = bits
        rows = np.column_stack([filled, *wide.reshape(len(bits), -1, WIDTH)])
        kept, kind = np.unique(rows, axis=0, return_inverse=True)
        return kind.ravel().astype(np.int64), [np.ascontiguousarray(own).ravel() for own in np.split(kept[:, 1:], len(bits), axis=1)]


def _kinds(keys: NDArray[np.uint64]) -> tuple[IntArray, int]:
    """Return the number of its kind for every key, and how many kinds there are."""
    kind = np.empty(len(keys), dtype=np.int64)
    places = np.zeros(2 << len(keys).bit_length(), dtype=np.int64)
    return kind, int(number_kinds(keys, places, kind))


def explicit_tables(parameters: LatticeParameters, step: float, forward: bool) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the coefficients of explicit steps of every element: tension ``A l' + B y``, and ``y`` grows by ``D l' - G y``.

    If not `forward`, the tension follows the extension after the step, as positions follow the velocity after it.
    """
    a, b, d, g = explicit_coefficients(parameters)
    if not forward:
        a, b = a + b * d * step, b * (1.0 - g * step)
    return a, b, d * step, g * step


def explicit_kernel(
    parameters: LatticeParameters, step: float, blocks: Blocks, mass: AnyFloatArray, threads: int, forward: bool
) -> KernelTuple:
    """Return what explicit steps need: blocks, tables, nodal masses with their inverses, and the parts of each thread.

    A part has blocks and nodes; the nodes that its blocks touch begin and end at the last two.
    """
    rows, own, empty = blocks.parameter_patterns(parameters)
    tables = [np.where(empty, 0.0, table).astype(mass.dtype.type) for table in explicit_tables(own, step, forward)]
    inverse = np.divide(1.0, mass, out=np.zeros_like(mass), where=mass > 0.0)
    cuts, nodes, high = blocks.parts(threads, len(mass) - WIDTH)
    return (blocks.first, blocks.second, rows), tuple(tables), (mass, inverse), (cuts, nodes, nodes[:-1], high)


def implicit_kernel(
    lattice: Lattice, parameters: LatticeParameters, step: float, blocks: Blocks, mass: AnyFloatArray, threads: int
) -> tuple[KernelTuple, ScratchPool]:
    """Return what implicit steps need: blocks and tables, which they read only, and the pool of their scratch arrays."""
    rows, own, empty = blocks.parameter_patterns(parameters)
    tables = [np.where(empty, 0.0, table) for table in (*implicit_coefficients(own, step), own.stiffness)]
    tables.append(step**2 * tables[0])
    stiff = tables[5][rows[blocks.lane // WIDTH] + blocks.lane % WIDTH]
    single, places, pad = np.float32, WIDTH * blocks.n_blocks, len(mass)
    diagonal = np.bincount(lattice.elements.ravel(), np.repeat(stiff / 3.0, 2), minlength=lattice.n_nodes) + lattice.node_mass
    smoother, light = aligned((pad,), single), aligned((pad,), single)
    smoother[: lattice.n_nodes] = 1.0 / diagonal
    light[:] = mass
    coarse = coarse_space(lattice, stiff, diagonal, smoother, pad, threads)
    pool = ScratchPool(tables[5].astype(single), light, smoother, coarse, places)
    return ((blocks.first, blocks.second, rows), tuple(tables)), pool
