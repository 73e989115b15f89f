"""A mesh that follows the deformation of what moves on it, and the transfer of the state from one mesh to the next."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.cutting.forest_cut import ForestCut, cut_forest
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.meshing.refinement.forest import BisectionForest, LeafMesh, MeshChange
from naibu.meshing.refinement.marking import Criterion
from naibu.meshing.refinement.transfer import transferred_cells, transferred_motion, transferred_nodes


@dataclass(frozen=True, slots=True, eq=False)
class MeshState:
    """What is carried from one mesh to the next.

    Attributes
    ----------
    displacement, velocity : ndarray, shape (n, d)
        Of the vertices, mm and mm/s.
    mass : ndarray, shape (n,)
        Lumped masses, kg.
    cell_mass : ndarray, shape (m,)
        Masses of the cells, kg.
    history : ndarray, shape (m, h)
        History variables of the cells.
    nodal : ndarray, shape (n, k), optional
        Other values of the vertices: new ones have the mean of the ends of their edges.
    """

    displacement: FloatArray
    velocity: FloatArray
    mass: FloatArray
    cell_mass: FloatArray
    history: FloatArray
    nodal: FloatArray | None = None


@dataclass(slots=True, eq=False)
class AdaptiveMesh:
    """A bisection forest with the criterion by which it is refined and coarsened.

    Attributes
    ----------
    forest : BisectionForest
        The mesh, and all meshes that it was made of.
    criterion : Criterion or None
        Where to refine and to coarsen; None: nowhere.
    max_level : int
        Cells of this level are not refined; three bisections make an eighth of the volume.
    bisections : int
        Bisections of a marked cell in one adaptation.
    leaf : LeafMesh
        The present mesh.
    """

    forest: BisectionForest
    criterion: Criterion | None
    max_level: int
    bisections: int
    leaf: LeafMesh

    @classmethod
    def of(cls, mesh: Mesh, criterion: Criterion | None, *, max_level: int = 3, bisections: int = 3) -> AdaptiveMesh:
        """Begin with a mesh, as the coarsest one.

        Raises
        ------
        InputError
            Cells that cannot be bisected, a negative level, or no bisection.
        """
        if max_level < 0 or bisections < 1:
            raise InputError(f"max_level must not be negative, and bisections must be at least 1, not {max_level} and {bisections}")
        forest = BisectionForest.of(mesh)
        return cls(forest, criterion, max_level, bisections, forest.leaf_mesh())

    def adapted(self, state: MeshState) -> MeshState | None:
        """Refine and coarsen by the criterion; return the state on the new mesh, or None where nothing changed."""
        if self.criterion is None:
            return None
        marks = self.criterion.marks(self.forest, self.leaf, state.displacement)
        cells = self.leaf.cells
        return self.changed(state, cells[marks.refine & (self.forest.levels[cells] < self.max_level)], cells[marks.coarsen & ~marks.refine])

    def changed(self, state: MeshState, refine: IntArray, coarsen: IntArray) -> MeshState | None:
        """Refine and coarsen given leaves; return the state on the new mesh, or None where nothing changed."""
        forest, leaf = self.forest, self.leaf
        d = state.displacement.shape[1]
        nodal, velocity = (_scattered(v, leaf.nodes, forest.node_rows) for v in (_with_nodal(state), state.velocity))
        mass = _scattered(state.mass, leaf.nodes, forest.node_rows)
        cell_mass, history = (_scattered(v, leaf.cells, forest.cell_rows) for v in (state.cell_mass, state.history))
        anything = False
        for change in self._changes(refine, coarsen):
            anything = True
            nodal = transferred_nodes(forest, change, nodal)
            history = transferred_cells(forest, change, history)
            cell_mass = transferred_cells(forest, change, cell_mass, extensive=True)
            mass, velocity = transferred_motion(forest, change, mass, velocity, cell_mass)
        if not anything:
            return None
        self.leaf = forest.leaf_mesh()
        nodes, cells = self.leaf.nodes, self.leaf.cells
        others = None if state.nodal is None else nodal[nodes, d:]
        return MeshState(nodal[nodes, :d], velocity[nodes], mass[nodes], cell_mass[cells], history[cells], others)

    def cut(
        self, state: MeshState, blade: SweptBlade, distance_mm: float, earlier: SweptBlade | None = None
    ) -> tuple[MeshState, ForestCut]:
        """Cut the deformed mesh along the surface that a blade has swept; return the state behind the cut, and the cut.

        Vertices are doubled with displacement and velocity, masses follow from the cells on each side.

        Raises
        ------
        InputError
            What `naibu.meshing.cut_forest` refuses; the mesh is then as it was.
        """
        forest, leaf = self.forest, self.leaf
        displacement = _scattered(state.displacement, leaf.nodes, forest.node_rows)
        velocity = _scattered(state.velocity, leaf.nodes, forest.node_rows)
        cell_mass, history = (_scattered(v, leaf.cells, forest.cell_rows) for v in (state.cell_mass, state.history))
        others = None if state.nodal is None else _scattered(state.nodal, leaf.nodes, forest.node_rows)
        found = cut_forest(forest, blade, distance_mm, positions=forest.points + displacement, earlier=earlier)
        nodal = [found.nodal(forest, values) for values in (displacement, velocity)]
        self.leaf = forest.leaf_mesh()
        nodes, cells = self.leaf.nodes, self.leaf.cells
        of_cell = found.cellwise(forest, cell_mass, extensive=True)[cells]
        corners = self.leaf.mesh.cells
        mass = np.bincount(corners.ravel(), np.repeat(of_cell / corners.shape[1], corners.shape[1]), minlength=len(nodes)).astype(
            np.float64
        )
        own = None if others is None else found.nodal(forest, others)[nodes]
        behind = MeshState(nodal[0][nodes], nodal[1][nodes], mass, of_cell, found.cellwise(forest, history)[cells], own)
        return behind, found

    def _changes(self, refine: IntArray, coarsen: IntArray) -> Iterator[MeshChange]:
        """Refine, then coarsen what is still a leaf, and yield each change when it has happened."""
        for _ in range(self.bisections if len(refine) else 0):
            if change := self.forest.refine(refine, max_level=self.max_level):
                yield change
            first = self.forest.children[refine]
            first = first[first >= 0].astype(np.int64)
            refine = np.concatenate([first, first + 1])
        for _ in range(self.bisections if len(coarsen) else 0):
            change = self.forest.coarsen(coarsen)
            if not change:
                return
            yield change
            coarsen = np.concatenate([coarsen, change.parents])


def _with_nodal(state: MeshState) -> FloatArray:
    return state.displacement if state.nodal is None else np.concatenate([state.displacement, state.nodal], axis=1)


def _scattered(values: FloatArray, rows: IntArray, count: int) -> FloatArray:
    out = np.zeros((count, *values.shape[1:]))
    out[rows] = values
    return out
