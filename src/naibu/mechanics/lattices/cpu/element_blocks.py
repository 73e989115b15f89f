"""Elements in blocks of eight whose nodes stand in a row, so that vectors of numbers can be loaded as they lie (see `simd`)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from naibu._numba.simd import WIDTH, aligned
from naibu.core.arrays import AnyFloatArray, FloatArray, IntArray
from naibu.mechanics.lattices.cpu.coarse_space import coarse_space
from naibu.mechanics.lattices.cpu.scratch import KernelTuple, ScratchPool
from naibu.mechanics.lattices.model.coefficients import explicit_coefficients, implicit_coefficients
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters

_STRIDE = 4  # a neighbour along y, z or a diagonal, and the two beside it along x, overlap


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
        i, j = np.sort(lattice.elements, axis=1).T
        tile = i // WIDTH
        order = np.lexsort((j - i, tile))
        change = np.flatnonzero(np.diff(tile[order], prepend=-1) | np.diff((j - i)[order], prepend=-1))
        block = np.repeat(np.arange(len(change)), np.diff(change, append=len(order)))
        first, gap = WIDTH * tile[order][change], (j - i)[order][change]
        turn = _spread(first)
        place = np.empty(len(turn), dtype=np.int64)
        place[turn] = np.arange(len(turn))
        position = np.empty(len(order), dtype=np.int64)
        position[order] = WIDTH * place[block] + i[order] % WIDTH
        return cls(first[turn], (first + gap)[turn], position, lattice.n_nodes)

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return len(self.first)

    def stored(self, values: FloatArray, dtype: type[np.floating] = np.float64) -> AnyFloatArray:
        """Return values (m,) as they lie in blocks (8 nb,), zero where there is no element."""
        result = np.zeros(WIDTH * self.n_blocks, dtype=dtype)
        result[self.lane] = values
        return result

    def patterns(self, *columns: FloatArray, dtype: type[np.floating] = np.float64) -> tuple[IntArray, list[AnyFloatArray]]:
        """Return where the coefficients of every block start, (nb,), in tables that hold equal ones once; zero in empty lanes.

        Most blocks of a lattice with few parameters share theirs, so that the tables stay in the fast cache.
        """
        wide = np.concatenate([self.stored(column).reshape(-1, WIDTH) for column in columns], axis=1)
        rows = np.ascontiguousarray(wide).view([("", wide.dtype)] * wide.shape[1]).ravel()
        _, chosen, number = np.unique(rows, return_index=True, return_inverse=True)
        kept = wide[chosen]
        tables = [np.ascontiguousarray(kept[:, WIDTH * c : WIDTH * (c + 1)]).astype(dtype).ravel() for c in range(len(columns))]
        return WIDTH * number.ravel().astype(np.int64), tables


def _spread(first: IntArray) -> IntArray:
    """Return an order of blocks that keeps `first` sorted but sets apart blocks whose second nodes overlap.

    These are neighbours by their distance; a processor stalls where it loads what it has just stored in other pieces.
    """
    rank = np.arange(len(first)) - np.searchsorted(first, first)
    return np.lexsort((rank // _STRIDE, rank % _STRIDE, first))


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
    rows, tables = blocks.patterns(*explicit_tables(parameters, step, forward), dtype=mass.dtype.type)
    inverse = np.divide(1.0, mass, out=np.zeros_like(mass), where=mass > 0.0)
    first, second = blocks.first, blocks.second
    nodes = np.append(np.round(np.arange(threads) * blocks.n_nodes / threads / WIDTH).astype(np.int64) * WIDTH, len(mass) - WIDTH)
    cuts = np.searchsorted(first, nodes)
    low = np.minimum(first[np.minimum(cuts[:-1], len(first) - 1)], nodes[:-1]) if len(first) else nodes[:-1]
    ends = [second[i:j].max(initial=0) + WIDTH for i, j in pairwise(cuts)]
    return (first, second, rows), tuple(tables), (mass, inverse), (cuts, nodes, low, np.maximum(np.array(ends), nodes[1:]))


def implicit_kernel(
    lattice: Lattice, parameters: LatticeParameters, step: float, blocks: Blocks, mass: AnyFloatArray
) -> tuple[KernelTuple, ScratchPool]:
    """Return what implicit steps need: blocks and tables, which they read only, and the pool of their scratch arrays."""
    a, b, decay, g = implicit_coefficients(parameters, step)
    rows, tables = blocks.patterns(a, b, decay, g, parameters.stiffness, step**2 * a)
    single, places, pad = np.float32, WIDTH * blocks.n_blocks, len(mass)
    diagonal = np.bincount(lattice.elements.ravel(), np.repeat(step**2 * a / 3.0, 2), minlength=lattice.n_nodes) + lattice.node_mass
    smoother, light = aligned((pad,), single), aligned((pad,), single)
    smoother[: lattice.n_nodes] = 1.0 / diagonal
    light[:] = mass
    coarse = coarse_space(lattice, step**2 * a, diagonal, smoother, pad, 1)
    pool = ScratchPool(tables[5].astype(single), light, smoother, coarse, places)
    return ((blocks.first, blocks.second, rows), tuple(tables)), pool
