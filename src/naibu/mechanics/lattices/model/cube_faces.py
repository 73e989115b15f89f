"""Faces of the cubes of a lattice: which cubes share them, also of two sizes, which are joined there, and which lie on the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.lattices.model.lattice import Lattice

# Corners of a cube's faces, -x, +x, -y, +y, -z, +z, in VTK's order; those of opposite faces that stand at the same place match.
FACES = np.array([[0, 4, 7, 3], [1, 5, 6, 2], [0, 1, 5, 4], [3, 2, 6, 7], [0, 3, 2, 1], [4, 7, 6, 5]])
_OUTWARDS = np.array([FACES[0], FACES[1][::-1], FACES[2], FACES[3][::-1], FACES[4], FACES[5][::-1]])  # counterclockwise from outside
_WAYS = np.array([(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)])


@dataclass(frozen=True, slots=True, eq=False)
class CubeFaces:
    """Faces of the cubes of a lattice.

    Attributes
    ----------
    beyond : ndarray, shape (c, 6), int64
        Cube beyond the middle of every face, joined or not, -1 where there is none.
    pairs : ndarray, shape (p, 2), int64
        Cubes that share a face; the smaller one first.
    face : ndarray, shape (p,), int64
        Number of the face of the first one.
    unit : ndarray, shape (p,), int64
        The face of the larger cube, ``6 cube + face``: what is joined there, or separated, as a whole.
    joined : ndarray, shape (p,), bool
        Whether no cut has gone through the unit.
    edge : ndarray, shape (c,), int64
        Edges of the cubes, in spacings.
    """

    beyond: IntArray
    pairs: IntArray
    face: IntArray
    unit: IntArray
    joined: BoolArray
    edge: IntArray

    def triangles(self, cells: IntArray, faces: IntArray) -> IntArray:
        """Return the triangles (2 f, 3), counterclockwise from outside, of faces given as ``6 cube + face`` (f,)."""
        a, b, c, d = cells[faces // 6][np.arange(len(faces))[:, None], _OUTWARDS[faces % 6]].T
        return np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3)

    def sides(self, chosen: BoolArray) -> IntArray:
        """Return the faces, ``6 cube + face``, on both sides of chosen pairs (p,)."""
        small = 6 * self.pairs[chosen, 0] + self.face[chosen]
        return np.unique(np.concatenate([small, self.unit[chosen]]))

    def opened(self, cells: IntArray) -> BoolArray:
        """Return which pairs (p,) a cut has opened: at its front, all nodes of two cubes may still be the same."""
        small, large = self.pairs.T
        here = cells[small[:, None], FACES[self.face]]
        there = cells[large[:, None], FACES[self.unit % 6]]
        return np.asarray(~self.joined & ((self.edge[small] != self.edge[large]) | (here != there).any(axis=1)))

    def outer(self, cells: IntArray) -> IntArray:
        """Return the faces, ``6 cube + face``, that lie on the surface, also on that of cuts."""
        return np.union1d(np.flatnonzero(self.beyond.ravel() < 0), self.sides(self.opened(cells)))


def cube_faces(lattice: Lattice) -> CubeFaces:
    """Return the faces of the cubes of a lattice, cut or not.

    Raises
    ------
    InputError
        A lattice without cubes, such as one made from tetrahedra.
    """
    cells = require_cubes(lattice)
    grid = np.rint((lattice.points - lattice.points.min(axis=0)) / lattice.spacing_mm).astype(np.int64)
    at, edge = grid[cells[:, 0]], grid[cells[:, 6], 0] - grid[cells[:, 0], 0]
    beyond = _beyond(at, edge)
    cube, face = np.nonzero(beyond >= 0)
    other = beyond[cube, face]
    kept = (edge[cube] < edge[other]) | ((edge[cube] == edge[other]) & (cube < other))
    pairs, face = np.stack([cube[kept], other[kept]], axis=1), face[kept]
    unit = 6 * pairs[:, 1] + (face ^ 1)
    joined = np.ones(len(unit), dtype=bool) if lattice.parted is None else ~np.isin(unit, lattice.parted)
    return CubeFaces(beyond, pairs, face, unit, joined, edge)


def require_cubes(lattice: Lattice) -> IntArray:
    """Return the cubes (c, 8).

    Raises
    ------
    InputError
        A lattice without cubes, such as one made from tetrahedra.
    """
    if lattice.cells is None:
        raise InputError("the lattice has no cubes, as one made from tetrahedra has none; make it from voxels")
    return lattice.cells


def _beyond(at: IntArray, edge: IntArray) -> IntArray:
    """Cubes (c, 6) that hold the finest voxel beyond the middle of every face, -1 where there is none."""
    shape = (at + edge[:, None]).max(axis=0) + 2
    owner = np.full(shape, -1, dtype=np.int32)
    for size in np.unique(edge):
        chosen = np.flatnonzero(edge == size)
        steps = np.array(list(np.ndindex(size, size, size)))
        owner[tuple((at[chosen, None, :] + steps + 1).reshape(-1, 3).T)] = np.repeat(chosen, len(steps))
    middle, size = edge[:, None, None] // 2, edge[:, None, None]
    place = at[:, None, :] + np.where(_WAYS > 0, size, np.where(_WAYS < 0, -1, middle)) + 1
    return np.asarray(owner[tuple(np.moveaxis(place, 2, 0))], dtype=np.int64)


def corner_volumes(lattice: Lattice) -> FloatArray:
    """Return the volume (c,) that every cube gives each of its corners, mm^3."""
    cells = require_cubes(lattice)
    edges = np.abs(lattice.points[cells[:, 6]] - lattice.points[cells[:, 0]])
    return np.asarray(edges.prod(axis=1) / 8.0)
