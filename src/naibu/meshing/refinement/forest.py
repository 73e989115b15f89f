# mypy: disallow-untyped-decorators=False
"""Bisection forests: triangles or tetrahedra that are refined and coarsened locally and conform at all times :cite:p:`maubach1995`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray, BoolArray, FloatArray, Int32Array, IntArray, require_shape
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.refinement import _forest_kernels as kernels
from naibu.meshing.refinement._forest_kernels import CHILD, FLIPPED, LEAF, LEVEL, PARENT, REGION, TAG
from naibu.meshing.refinement.cut_front import NO_FRONT, followed_front
from naibu.meshing.refinement.root_cells import determinants, join_roots, require_volumes
from naibu.meshing.refinement.tagging import tagged

_Arrays = tuple[Int32Array, FloatArray, Int32Array, Int32Array, Int32Array, IntArray]


@dataclass(frozen=True, slots=True, eq=False)
class MeshChange:
    """What one refinement or coarsening changed, in the order in which it happened.

    Attributes
    ----------
    refined : bool
        Whether cells were bisected, or joined again.
    nodes : ndarray, shape (v,), int64
        Vertices that were made, or removed.
    ends : ndarray, shape (v, 2), int64
        Ends of the edge whose midpoint each of them is, or was.
    parents : ndarray, shape (c,), int64
        Cells that were bisected, or restored.
    patches : ndarray, shape (c,), int64
        Place in `nodes` of the vertex that each of them got, or lost.
    children : ndarray, shape (c, 2), int64
        Their children, which are, or were, half as large.
    """

    refined: bool
    nodes: IntArray
    ends: IntArray
    parents: IntArray
    patches: IntArray
    children: IntArray

    def __bool__(self) -> bool:
        """Return whether anything changed."""
        return len(self.nodes) > 0


@dataclass(frozen=True, slots=True, eq=False)
class LeafMesh:
    """The mesh of the leaves of a forest, numbered without gaps.

    Attributes
    ----------
    mesh : Mesh
        Vertices in use, and leaves, positively oriented if the coarsest mesh is.
    nodes : ndarray, shape (n,), int64
        Number in the forest of every vertex.
    cells : ndarray, shape (m,), int64
        Number in the forest of every cell.
    """

    mesh: Mesh
    nodes: IntArray
    cells: IntArray


@dataclass(slots=True, eq=False)
class BisectionForest:
    """Forest of binary trees of triangles or tetrahedra, whose leaves are a conforming mesh; made by `BisectionForest.of`.

    Cells and vertices keep their numbers while they exist; those of removed ones are used again. Refining and coarsening take a time that
    depends on the number of cells that change only: every cell knows its neighbours, and a bisection changes all cells around an edge.

    Attributes
    ----------
    dimension : int
        2 or 3.
    region_names : tuple of str
        Names of the regions of the coarsest mesh.
    n_roots : int
        Number of cells of the coarsest mesh, which have the numbers 0 to n_roots - 1.
    cut_front : ndarray, shape (f, 3), int64
        Vertices of faces inside that a blade went through, but around which other cells still hold all vertices together; the cut that
        parts these opens them (`naibu.meshing.cut_forest`).
    since_cut : ndarray, shape (r,), bool
        Which cells, of the numbers below r, bisections have made since the last cut.
    """

    dimension: int
    region_names: tuple[str, ...]
    n_roots: int
    _arrays: _Arrays
    cut_front: IntArray = field(default_factory=lambda: NO_FRONT)
    since_cut: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    _ring: IntArray = field(default_factory=lambda: np.empty(kernels.MAX_RING, dtype=np.int64))
    _stack: IntArray = field(default_factory=lambda: np.empty(kernels.MAX_DEPTH, dtype=np.int64))

    @classmethod
    def of(cls, mesh: Mesh) -> BisectionForest:
        """Return the forest whose roots are the cells of a mesh.

        Parameters
        ----------
        mesh : Mesh
            Triangles or linear tetrahedra, conforming.

        Raises
        ------
        InputError
            Other cells, cells without volume, a face that more than two cells share, or cells that overlap: inverted or duplicate ones.

        Notes
        -----
        Of tetrahedra that are only numbered the other way round, `leaf_mesh` has the positive order.

        The quality of all descendants of a cell is bounded: there are finitely many classes of similar cells, three on Kuhn's cubes. See
        `naibu.meshing.refinement.tagging` for what is bisected first.
        """
        require_volumes(mesh)
        k, m, n = mesh.dimension + 1, mesh.n_cells, mesh.n_points
        order, tags = tagged(mesh.points, mesh.cells)
        cells = np.zeros((2 * m + 1024, kernels.WIDTH), dtype=np.int32)
        cells[:m, :k], cells[:m, 4:8], cells[:m, PARENT], cells[:m, CHILD] = order, -1, -1, LEAF
        cells[:m, TAG], cells[:m, REGION], cells[:m, kernels.PLACE] = tags, mesh.regions, np.arange(m)
        cells[:m, FLIPPED] = determinants(mesh.points, order) < 0.0
        nodes = np.full((2 * n + 1024, 4), -1, dtype=np.int32)
        nodes[:n, 2] = 0
        nodes[cells[:m, :k].ravel(), 3] = np.repeat(np.arange(m), k)
        points = np.empty((len(nodes), mesh.dimension))
        points[:n] = mesh.points
        counters = np.array([m, -1, n, -1, m, n], dtype=np.int64)
        leaves = np.empty(len(cells), dtype=np.int32)
        leaves[:m] = np.arange(m)
        join_roots(cells[:m], k, mesh)
        table = np.zeros(_table_size(len(nodes)), dtype=np.int32)
        return cls(mesh.dimension, mesh.region_names, m, (cells, points, nodes, table, leaves, counters))

    @property
    def n_cells(self) -> int:
        """Number of leaves."""
        return int(self._arrays[5][kernels.LEAVES])

    @property
    def n_nodes(self) -> int:
        """Number of vertices in use."""
        return int(self._arrays[5][kernels.COUNT])

    @property
    def cell_rows(self) -> int:
        """Length that an array with one entry for every cell number must have."""
        return int(self._arrays[5][kernels.ROWS])

    @property
    def node_rows(self) -> int:
        """Length that an array with one entry for every vertex number must have."""
        return int(self._arrays[5][kernels.NODES])

    @property
    def points(self) -> FloatArray:
        """Positions (node_rows, d) of the vertices, mm; a view, rows of removed vertices included."""
        return self._arrays[1][: self.node_rows]

    @property
    def simplices(self) -> Int32Array:
        """Vertices (cell_rows, d + 1) of all cells, leaves or not, in the order of bisection; a view."""
        return self._arrays[0][: self.cell_rows, : self.dimension + 1]

    @property
    def neighbours(self) -> Int32Array:
        """Cells (cell_rows, d + 1) across the face opposite to each vertex, of leaves; -1 - marker on the boundary; a view."""
        return self._arrays[0][: self.cell_rows, 4 : 5 + self.dimension]

    @property
    def parents(self) -> Int32Array:
        """Parents (cell_rows,) of the cells, -1 of roots; a view."""
        return self._arrays[0][: self.cell_rows, PARENT]

    @property
    def children(self) -> Int32Array:
        """First children (cell_rows,), the second one follows it; -1 of leaves, -2 of numbers that are not in use; a view."""
        return self._arrays[0][: self.cell_rows, CHILD]

    @property
    def levels(self) -> Int32Array:
        """Number of bisections (cell_rows,) that made each cell of its root; a view."""
        return self._arrays[0][: self.cell_rows, LEVEL]

    @property
    def regions(self) -> Int32Array:
        """Region (cell_rows,) of every cell; a view that may be written, on leaves."""
        return self._arrays[0][: self.cell_rows, REGION]

    @property
    def node_parents(self) -> Int32Array:
        """Ends (node_rows, 2) of the edge whose midpoint each vertex is, -1 of vertices of the coarsest mesh; a view."""
        return self._arrays[2][: self.node_rows, :2]

    @property
    def node_cells(self) -> Int32Array:
        """A leaf (node_rows,) that touches each vertex in use; a view."""
        return self._arrays[2][: self.node_rows, 3]

    @property
    def node_used(self) -> BoolArray:
        """Whether each vertex number (node_rows,) is in use."""
        return np.asarray(self._arrays[2][: self.node_rows, 2] >= 0)

    def leaves(self) -> IntArray:
        """Return the numbers (n_cells,) of all leaves, in no order."""
        return self._arrays[4][: self.n_cells].astype(np.int64)

    def leaves_in_order(self) -> IntArray:
        """Return the numbers (n_cells,) of all leaves, ascending."""
        return np.flatnonzero(self.children == LEAF).astype(np.int64, copy=False)

    def volumes(self, cells: ArrayLike) -> FloatArray:
        """Return the volumes (mm^3), or areas (mm^2), of cells (c,)."""
        sizes = np.abs(determinants(self.points, self.simplices[self._known(cells)]))
        return np.asarray(sizes / (2.0 if self.dimension == 2 else 6.0))

    def leaf_mesh(self) -> LeafMesh:
        """Return the leaves as a mesh, sorted by their numbers; takes a time in proportion to its size."""
        cells = self.leaves_in_order()
        nodes = np.flatnonzero(self.node_used)
        number = np.full(self.node_rows, -1, dtype=np.int64)
        number[nodes] = np.arange(len(nodes))
        corners = number[self.simplices[cells]]
        flipped = self._arrays[0][cells, FLIPPED] == 1
        corners[flipped, -2:] = corners[flipped, -2:][:, ::-1]
        kind = "tetra" if self.dimension == 3 else "triangle"
        mesh = Mesh(self.points[nodes].copy(), corners, kind, self.regions[cells].astype(np.int64), self.region_names)
        return LeafMesh(mesh, nodes, cells)

    def refine(self, cells: ArrayLike, *, max_level: int | None = None) -> MeshChange:
        """Bisect leaves once, and others where the mesh would not conform otherwise.

        Parameters
        ----------
        cells : array_like, shape (c,)
            Numbers of leaves, or a mask over the leaves in the order of `leaves`; others, such as those that are already bisected, are
            passed over.
        max_level : int, optional
            Cells of this level are not bisected. Where roots of other kinds than Kuhn's meet, those that must conform to their neighbours
            may exceed it by two.

        Raises
        ------
        InputError
            Numbers of no cell, or cells that wait for each other, as those of a mesh that does not conform may; the mesh is then as it was.
        """
        marked = self._known(cells)
        keep = self.children[marked] == LEAF
        if max_level is not None:
            keep &= self.levels[marked] < max_level
        marked = np.ascontiguousarray(marked[keep])
        begin, n_made, made, split = 0, 0, [np.zeros(0, np.int64)], [np.zeros((0, 3), np.int64)]
        while True:
            count = 4 * (len(marked) - begin) + 64
            new, cut = np.empty(count, dtype=np.int64), np.empty((4 * count + kernels.MAX_RING, 3), dtype=np.int64)
            arguments = (self.dimension + 1, marked, begin, self._ring, self._stack, new, cut)
            status, begin, n_new, n_cut = kernels.refine(self._arrays, *arguments)
            cut[:n_cut, 2] += n_made
            n_made += n_new
            made.append(new[:n_new])
            split.append(cut[:n_cut])
            if status == kernels.DONE:
                return self._change(True, np.concatenate(made), np.concatenate(split))
            if status == kernels.FULL:
                self.reserve(8 * (len(marked) - begin) + 4096)
                continue
            kernels.undo(self._arrays, self.dimension + 1, np.concatenate(made), self._ring)
            why = "wait for each other" if status == kernels.CYCLE else f"have more than {kernels.MAX_RING} around one edge"
            raise InputError(f"cell {marked[begin]} cannot be bisected: cells {why}; the mesh is as it was, check that it conforms")

    def coarsen(self, cells: ArrayLike) -> MeshChange:
        """Undo the last bisection of leaves, wherever all leaves around the vertex that it made are among them.

        Parameters
        ----------
        cells : array_like, shape (c,)
            Numbers of leaves, or a mask over the leaves in the order of `leaves`.

        Raises
        ------
        InputError
            Numbers of no cell.
        """
        marked = self._known(cells)
        marked = np.ascontiguousarray(marked[self.children[marked] == LEAF])
        removed, joined = np.empty(len(marked), dtype=np.int64), np.empty((len(marked), 3), dtype=np.int64)
        n_removed, n_joined = kernels.coarsen(self._arrays, self.dimension + 1, marked, self._ring, removed, joined)
        return self._change(False, removed[:n_removed].copy(), joined[:n_joined])

    def midpoints(self, edges: ArrayLike) -> IntArray:
        """Return the vertex (e,) at the midpoint of every edge (e, 2), -1 where it is not bisected."""
        ends = np.ascontiguousarray(edges, dtype=np.int64).reshape(-1, 2)
        out = np.empty(len(ends), dtype=np.int64)
        _midpoints(self._arrays[2], self._arrays[3], ends, out)
        return out

    def around_edge(self, cell: int, first: int, second: int) -> IntArray:
        """Return the leaves around the edge of a leaf between its vertices numbered `first` and `second`, the leaf first.

        Raises
        ------
        InputError
            They are not two of its vertices, or the edge has too many cells.
        """
        corners = self.simplices[cell].tolist()
        if first == second or first not in corners or second not in corners:
            raise InputError(f"cell {cell} has the vertices {corners}; {first} and {second} are not the ends of one of its edges")
        n = kernels.ring_of_edge(self._arrays[0], self.dimension + 1, cell, corners.index(first), corners.index(second), self._ring)
        if n < 0:
            raise InputError(f"the edge from {first} to {second} has more than {kernels.MAX_RING} cells around it; remesh there")
        return np.array(self._ring[:n])

    def around_node(self, node: int) -> IntArray:
        """Return the leaves that touch a vertex and are joined with each other by faces.

        Raises
        ------
        InputError
            The vertex is not in use.
        """
        if not (0 <= node < self.node_rows and self.node_used[node]):
            raise InputError(f"vertex {node} is not in use")
        found = np.empty(256, dtype=np.int64)
        while (n := kernels.around_node(self._arrays[0], self._arrays[2], self.dimension + 1, node, found)) < 0:
            found = np.empty(4 * len(found), dtype=np.int64)
        return np.array(found[:n])

    def boundary_faces(self) -> tuple[IntArray, IntArray]:
        """Return cell and place (f, 2) of the boundary faces of leaves, and their markers (f,); faces lie opposite to the vertex there."""
        cells = self.leaves_in_order()
        across = self.neighbours[cells]
        row, place = np.nonzero(across < 0)
        return np.stack([cells[row], place], axis=1), (-1 - across[row, place]).astype(np.int64)

    def mark_boundary(self, faces: ArrayLike, markers: ArrayLike) -> None:
        """Give boundary faces (f, 2), of cells and places as in `boundary_faces`, markers (f,), which their parts inherit.

        Raises
        ------
        InputError
            A negative marker, or a face inside.
        """
        cell, place = np.asarray(faces, dtype=np.int64).reshape(-1, 2).T
        marker = np.broadcast_to(np.asarray(markers, dtype=np.int64), cell.shape)
        if len(marker) and marker.min() < 0:
            raise InputError(f"markers must not be negative, not {marker.min()}")
        inside = self.neighbours[cell, place] >= 0
        if inside.any():
            raise InputError(f"face {place[inside][0]} of cell {cell[inside][0]} is not on the boundary")
        self.neighbours[cell, place] = -1 - marker

    def _known(self, cells: ArrayLike) -> IntArray:
        given = np.asarray(cells)
        if given.dtype == bool:
            require_shape("cells (a mask over the leaves)", given, (self.n_cells,))
            return np.array(self.leaves()[given])
        numbers = given.astype(np.int64).ravel()
        if len(numbers) and (numbers.min() < 0 or numbers.max() >= self.cell_rows):
            raise InputError(f"cells have the numbers 0 to {self.cell_rows - 1}, not {numbers.min()} to {numbers.max()}")
        return np.asarray(numbers)

    def _change(self, refined: bool, nodes: IntArray, rows: IntArray) -> MeshChange:
        """Return the change of rows (c, 3) of parents, their first children and the places of their vertices."""
        parents, first, patches = np.ascontiguousarray(rows.T)
        ends = self._arrays[2][nodes, :2].astype(np.int64)
        children = np.stack([first, first + 1], axis=1)
        self.cut_front = followed_front(self.cut_front, refined, nodes, ends)
        if refined:
            if len(self.since_cut) < self.cell_rows:
                self.since_cut = np.append(self.since_cut, np.zeros(2 * self.cell_rows - len(self.since_cut), dtype=bool))
            self.since_cut[children] = True
        return MeshChange(refined, nodes, ends, parents, patches, children)

    def copied(self) -> BisectionForest:
        """Return a copy."""
        arrays = _copied(self._arrays)
        return BisectionForest(self.dimension, self.region_names, self.n_roots, arrays, self.cut_front, self.since_cut.copy())

    def become(self, other: BisectionForest) -> None:
        """Take over the cells and vertices of a copy, which is not used any more."""
        self._arrays, self.cut_front, self.since_cut = other._arrays, other.cut_front, other.since_cut

    @property
    def arrays(self) -> _Arrays:
        """What the kernels change; see `naibu.meshing.refinement._forest_kernels`."""
        return self._arrays

    def reserve(self, more: int) -> None:
        """Make room for so many more cells and vertices; arrays that grow become twice as long at least."""
        cells, points, nodes, table, leaves, counters = self._arrays
        if len(cells) - self.cell_rows < more:
            cells = _grown(cells, more)
        if len(nodes) - self.node_rows < more:
            points, nodes = _grown(points, more), _grown(nodes, more)
            if 2 * len(nodes) > len(table):
                table = np.zeros(_table_size(len(nodes)), dtype=np.int32)
                _rehash(nodes, table, self.node_rows)
        if len(leaves) < len(cells):
            leaves = _grown(leaves, len(cells) - len(leaves))
        self._arrays = (cells, points, nodes, table, leaves, counters)


def _grown(array: AnyArray, more: int) -> AnyArray:
    out = np.empty((len(array) + max(more, len(array)), *array.shape[1:]), dtype=array.dtype)
    out[: len(array)] = array
    return out


def _copied(arrays: _Arrays) -> _Arrays:
    cells, points, nodes, table, leaves, counters = arrays
    return cells.copy(), points.copy(), nodes.copy(), table.copy(), leaves.copy(), counters.copy()


def _table_size(n_nodes: int) -> int:
    """Entries of the hash table of midpoints: a power of two, at most half of which are taken."""
    return 1 << int(2 * n_nodes - 1).bit_length()


@njit(cache=True)
def _midpoints(nodes, table, ends, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    for e in range(len(ends)):
        out[e] = kernels.find_midpoint(nodes, table, ends[e, 0], ends[e, 1])


@njit(cache=True)
def _rehash(nodes, table, count):  # type: ignore[no-untyped-def]  # pragma: no cover
    for z in range(count):
        if nodes[z, 2] > 0:
            kernels.insert_midpoint(nodes, table, z)
