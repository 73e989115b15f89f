"""Nodes, cubes and elements of a grid of voxels, in the order of their numbers: neighbours are known, so that nothing is sorted."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy.ndimage as ndi
from numpy.typing import NDArray

from naibu._numba.compilation import UNCOUNTED, njit
from naibu.core.arrays import BoolArray, Int8Array, IntArray

_ALL = 255  # bits of the eight voxels around a node
# from a node to its neighbours of larger numbers (x, y, z), in the order of these
_TO_LATER = np.array([(x, y, z) for z, y, x in product((-1, 0, 1), repeat=3) if (z, y, x) > (0, 0, 0)])
# corners of a voxel in VTK's order of a hexahedron
_CORNERS = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))


@dataclass(frozen=True, slots=True, eq=False)
class VoxelElements:
    """Corners of the voxels of an object, and the pairs of them that have a voxel in common.

    Attributes
    ----------
    nodes : ndarray, shape (n, 3), int64
        Positions of the corners on the grid, sorted by z, then y, then x.
    cells : ndarray, shape (k, 8), int64
        Corners of every voxel in VTK's order of a hexahedron, voxels in the order of `numpy.argwhere`.
    pairs : ndarray, shape (m, 2), int64
        Numbers of the two nodes of every element, the smaller one first, sorted.
    element_class, element_zone : ndarray, shape (m,), int8
        As of `naibu.mechanics.lattices.model.lattice.Lattice`.
    surface : ndarray, shape (n,), bool
        Nodes that less than eight voxels surround.
    connected : bool
        Whether the object is in one piece.
    """

    nodes: IntArray
    cells: IntArray
    pairs: IntArray
    element_class: Int8Array
    element_zone: Int8Array
    surface: BoolArray
    connected: bool

    @classmethod
    def of(cls, filled: BoolArray) -> VoxelElements:
        """Find the elements of the voxels (nx, ny, nz) of an object."""
        around = _around(filled)
        keys = np.flatnonzero(around)
        number = np.cumsum(around != 0, dtype=np.int64).reshape(around.shape) - 1
        _, ny, nx = around.shape
        nodes = np.stack([keys % nx, keys // nx % ny, keys // (nx * ny)], axis=1)
        bits = np.array([_common(step) for step in _TO_LATER.tolist()], dtype=np.uint8)
        m = sum(int(np.count_nonzero(around & bit)) for bit in bits)
        pairs, kind, zone = np.empty((m, 2), dtype=np.int64), np.empty(m, dtype=np.int8), np.empty(m, dtype=np.int8)
        kinds = (np.count_nonzero(_TO_LATER, axis=1) - 1).astype(np.int8)
        _list_elements(around.ravel(), number.ravel(), keys, bits, _TO_LATER @ (1, nx, nx * ny), kinds, pairs, kind, zone)
        surface = around.ravel()[keys] != _ALL
        pieces = ndi.label(filled, np.ones((3, 3, 3), dtype=bool))[1]
        return cls(nodes, _cells(filled, number), pairs, kind, zone, surface, pieces == 1)


def _around(filled: BoolArray) -> NDArray[np.uint8]:
    """Return which voxels lie around every node of the grid, (nz + 1, ny + 1, nx + 1): bit a + 2 b + 4 c for the one at (-a, -b, -c)."""
    turned = np.ascontiguousarray(filled.T).astype(np.uint8)
    around = np.zeros(tuple(n + 1 for n in turned.shape), dtype=np.uint8)
    nz, ny, nx = turned.shape
    for c, b, a in product((0, 1), repeat=3):
        around[c : c + nz, b : b + ny, a : a + nx] |= turned << (a + 2 * b + 4 * c)
    return around


def _common(step: list[int]) -> int:
    """Return the bits of the voxels around a node that have its neighbour, at `step` from it, as a corner too."""
    beside = [(0, 1) if s == 0 else (0,) if s > 0 else (1,) for s in step]
    return sum(1 << (a + 2 * b + 4 * c) for a, b, c in product(*beside))


def _cells(filled: BoolArray, number: IntArray) -> IntArray:
    """Return the corners (k, 8) of the voxels, from the numbers of the nodes of the grid (nz + 1, ny + 1, nx + 1)."""
    (nx, ny, nz), by_axis = filled.shape, number.T
    cells = np.empty((int(np.count_nonzero(filled)), 8), dtype=np.int64)
    for corner, (a, b, c) in enumerate(_CORNERS):
        cells[:, corner] = by_axis[a : a + nx, b : b + ny, c : c + nz][filled]
    return cells


@njit(cache=True, **UNCOUNTED)
def _list_elements(around, number, keys, bits, gaps, kinds, pairs, kind, zone):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill the pairs of nodes that have a voxel in common, and their classes and zones, in the order of their numbers."""
    e = 0
    for i in range(len(keys)):
        key = keys[i]
        here = around[key]
        for d in range(len(gaps)):
            if here & bits[d]:
                there = key + gaps[d]
                pairs[e, 0] = i
                pairs[e, 1] = number[there]
                kind[e] = kinds[d]
                zone[e] = here != _ALL or around[there] != _ALL
                e += 1
