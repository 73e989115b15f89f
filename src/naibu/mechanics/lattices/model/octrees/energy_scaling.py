"""Element factors of octree lattices that keep the energy of the classic lattice in uniform strain.

By one factor an element K, C1 and C2 are multiplied alike, so that relaxation times stay. `edge_factors` takes the mean edge of the cubes
around an element, `energy_factors` what a cube, a piece of the surface or one of its edges would have in the classic lattice: given to the
elements along its own directions, and handed down where finer nodes stand on them. Both are too soft where nodes hang on the edges and
faces of coarser cubes, for these are constrained by the finer side only: see `compliance_correction`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray

_OCTANTS = np.array(list(np.ndindex(2, 2, 2)))
_FACES = np.array([(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)])
_FRACTIONS = np.array([0.25, 0.5, 1.0])  # of an edge, a face diagonal and a space diagonal that belongs to one voxel


@dataclass(frozen=True, slots=True, eq=False)
class OctreeGrid:
    """An octree lattice on the grid of its finest voxels.

    Attributes
    ----------
    filled : ndarray, shape (nx, ny, nz), bool
        Voxels of the object.
    cubes : ndarray, shape (k, 3), int64
        Least corners of the cubes.
    sizes : ndarray, shape (k,), int64
        Their edges, in voxels.
    nodes : ndarray, shape (n, 3), int64
        Positions of the nodes.
    pairs : ndarray, shape (m, 2), int64
        Masses of the elements.
    """

    filled: BoolArray
    cubes: IntArray
    sizes: IntArray
    nodes: IntArray
    pairs: IntArray

    @property
    def offset(self) -> IntArray:
        """From the first to the second node of all elements (m, 3)."""
        return np.asarray(self.nodes[self.pairs[:, 1]] - self.nodes[self.pairs[:, 0]])

    @property
    def span(self) -> IntArray:
        """Edges of the cubes that have the elements (m,)."""
        return np.asarray(np.abs(self.offset).max(axis=1))

    @property
    def element_class(self) -> IntArray:
        """0 along an edge, 1 along a face diagonal, 2 along a space diagonal (m,)."""
        return np.asarray(np.count_nonzero(self.offset, axis=1) - 1)

    def sizes_at(self) -> IntArray:
        """Return the edges of the cubes that hold the voxels, 0 outside, with one empty layer around: (nx + 2, ny + 2, nz + 2)."""
        constrained = np.zeros(tuple(n + 2 for n in self.filled.shape), dtype=np.int64)
        for size in np.unique(self.sizes):
            steps = np.array(list(np.ndindex(size, size, size))) + 1
            constrained[tuple((self.cubes[self.sizes == size][:, None, :] + steps).reshape(-1, 3).T)] = size
        return constrained

    def around_masses(self) -> IntArray:
        """Return the edges of the cubes in the eight octants around the nodes, 0 outside (n, 8)."""
        constrained = self.sizes_at()
        return np.stack([constrained[tuple((self.nodes + step).T)] for step in _OCTANTS], axis=1)

    def around_middles(self) -> IntArray:
        """Return the edges of the cubes around the middles of the elements, each as often as it fills octants, 0 outside (m, 8)."""
        constrained, middle = self.sizes_at(), self.nodes[self.pairs].sum(axis=1)  # in half voxels
        return np.stack([constrained[tuple(((middle - step) // 2 + 1).T)] for step in _OCTANTS], axis=1)

    def hanging(self, around: IntArray) -> IntArray:
        """Return in how many octants around the nodes there is a cube of which they are no corner (n,)."""
        return np.asarray((self.nodes[:, None, :] % np.maximum(around, 1)[:, :, None] != 0).any(axis=2).sum(axis=1))


def edge_factors(grid: OctreeGrid) -> FloatArray:
    """Return the mean edge, in voxels, of the cubes around the middle of every element (m,)."""
    around = grid.around_middles()
    return np.asarray(around.sum(axis=1) / np.count_nonzero(around, axis=1))


def energy_factors(grid: OctreeGrid) -> FloatArray:
    """Return factors (m,) that give every cube, with its fraction of the surface, the energy it has as a classic lattice in uniform strain.

    Springs K on the edges, face and space diagonals of voxels belong to voxels by 1/4, 1/2 and 1. A cube of h voxels an edge has their
    energy with h K instead. On the surface the classic lattice has more than its voxels' shares, 1/4 and 1/2 for each face: a face of h
    voxels an edge has that energy with K, whatever h. The rest, on edges where faces meet, is K / h along an edge of h voxels.
    """
    first, second = np.triu_indices(8, 1)
    offset = _OCTANTS[second] - _OCTANTS[first]
    fraction = _FRACTIONS[np.count_nonzero(offset, axis=1) - 1]
    begin = grid.cubes[:, None, :] + grid.sizes[:, None, None] * _OCTANTS[first]
    exposed = _exposed_parts(grid)
    factors = np.outer(grid.sizes.astype(float), fraction)
    for face, part in zip(_FACES, exposed, strict=True):
        axis, side = int(np.flatnonzero(face)[0]), int(face.sum() > 0)
        on_face = (offset[:, axis] == 0) & (_OCTANTS[first][:, axis] == side)
        factors += np.outer(part, np.where(on_face, np.array([0.25, 0.5, 0.0])[np.count_nonzero(offset, axis=1) - 1], 0.0))
    spans = np.repeat(grid.sizes, len(first))
    directions = np.tile(offset, (len(grid.cubes), 1))
    given = _handed_down(grid, begin.reshape(-1, 3), directions, spans, factors.ravel())
    return given + _edge_remainders(grid)


def _exposed_parts(grid: OctreeGrid) -> FloatArray:
    """Return the part of each of the six faces of the cubes that lies on the surface (6, k)."""
    owner = np.full(grid.filled.shape, -1, dtype=np.int64)
    for size in np.unique(grid.sizes):
        chosen = np.flatnonzero(grid.sizes == size)
        steps = np.array(list(np.ndindex(size, size, size)))
        owner[tuple((grid.cubes[chosen][:, None, :] + steps).reshape(-1, 3).T)] = np.repeat(chosen, len(steps))
    padded = np.pad(grid.filled, 1)
    parts = []
    for face in _FACES:
        outside = ~np.roll(padded, -face, axis=(0, 1, 2))[1:-1, 1:-1, 1:-1]
        parts.append(np.bincount(owner[grid.filled & outside], minlength=len(grid.cubes)) / grid.sizes**2)
    return np.array(parts)


def _handed_down(grid: OctreeGrid, begin: IntArray, directions: IntArray, spans: IntArray, factors: FloatArray) -> FloatArray:
    """Return the sums (m,) of factors of straight segments, each given to the elements that it consists of, with its energy.

    A spring of length L and stiffness k has the energy of its two halves with 2 k each.
    """
    stride = np.int64(max(grid.filled.shape) + 1)
    weights = np.array([1, stride, stride**2])
    ends = np.sort(grid.nodes[grid.pairs] @ weights, axis=1)
    known = ends[:, 0] * stride**3 + ends[:, 1]
    order = np.argsort(known)
    chain, length = np.arange(len(begin)), spans.copy()
    found: list[tuple[IntArray, IntArray, FloatArray, IntArray]] = []
    while len(begin):
        ends = np.sort(np.stack([begin @ weights, (begin + directions * length[:, None]) @ weights], axis=1), axis=1)
        key = ends[:, 0] * stride**3 + ends[:, 1]
        spot = np.minimum(np.searchsorted(known, key, sorter=order), len(known) - 1)
        hit = known[order[spot]] == key
        found.append((chain[hit], order[spot[hit]], factors[hit], length[hit]))
        more = ~hit & (length > 1)
        begin, directions, length, factors, chain = begin[more], directions[more], length[more] // 2, 2.0 * factors[more], chain[more]
        begin = np.concatenate([begin, begin + directions * length[:, None]])
        directions, length, factors, chain = (np.concatenate([a, a]) for a in (directions, length, factors, chain))
    chains, elements, values, lengths = (np.concatenate(column) for column in zip(*found, strict=True))
    reached = np.bincount(chains, lengths, minlength=len(spans))  # beside notches of the object a part may have no element
    return np.asarray(np.bincount(elements, values * spans[chains] / reached[chains], minlength=len(grid.pairs)), dtype=np.float64)


def _edge_remainders(grid: OctreeGrid) -> FloatArray:
    """Return what the classic lattice has along edges of voxels beyond the fractions of voxels and faces, for all elements (m,)."""
    offset, span = grid.offset, grid.span
    along = grid.element_class == 0
    low = np.minimum(grid.nodes[grid.pairs[:, 0]], grid.nodes[grid.pairs[:, 1]])
    padded = np.pad(grid.filled, 1)
    result = np.zeros(len(grid.pairs))
    for axis in range(3):
        across = [a for a in range(3) if a != axis]
        chosen = np.flatnonzero(along & (offset[:, axis] != 0))
        for step in range(int(span[chosen].max(initial=0))):
            here = chosen[span[chosen] > step]
            full = np.zeros((2, 2, len(here)), dtype=bool)
            for a, b in product((0, 1), repeat=2):
                cell = low[here] + 1
                cell[:, axis] += step
                cell[:, across] -= (1 - a, 1 - b)
                full[a, b] = padded[tuple(cell.T)]
            faces = (full[0] != full[1]).sum(axis=0) + (full[:, 0] != full[:, 1]).sum(axis=0)
            result[here] += (1.0 - 0.25 * full.sum(axis=(0, 1)) - 0.25 * faces) / span[here] ** 2
    return result


def surroundings(grid: OctreeGrid) -> IntArray:
    """Return numbers (m,) of groups of elements of like surroundings, whatever their size and orientation.

    Alike are the class, and in units of the element's own cube the cubes around its middle and around its nodes, with the number of those
    on whose edges or faces a node hangs.
    """
    around, middle = grid.around_masses(), grid.around_middles()
    hanging, level = grid.hanging(around), np.log2(grid.span).astype(np.int64)

    def relative(sizes: IntArray) -> IntArray:
        steps = np.where(sizes > 0, np.log2(np.maximum(sizes, 1)).astype(np.int64) - level[:, None] + 16, 0)
        return np.asarray(np.sort(steps, axis=1) @ 32 ** np.arange(8, dtype=np.int64))

    ends = np.sort(np.stack([relative(around[i]) * 16 + hanging[i] for i in grid.pairs.T], axis=1), axis=1)
    return np.asarray(np.unique(np.column_stack([grid.element_class, ends, relative(middle)]), axis=0, return_inverse=True)[1].ravel())
