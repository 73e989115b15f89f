"""Cutting of tetrahedral meshes by the swept surface of a blade: refine near the surface, then separate along faces.

Cells that the surface passes are bisected until the faces between them follow it within half of a given distance; then two neighbours are
separated where the segment between their centres crosses the surface. No cell is removed or split by the blade itself, so that volume is
conserved to rounding and the quality of all cells is that of bisection :cite:p:`arnold2000`; the cut is faceted, with facets of the size of
the refined cells, where virtual nodes :cite:p:`molino2004` would follow the blade within cells. A cut may end inside the body, leave and
enter it again, and cross earlier cuts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import AnyArray, FloatArray, IntArray, require_shape
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.cutting._crossing_kernels import interpolate_midpoints
from naibu.meshing.cutting.forest_cut import ForestCut, cut_forest, face_vertices, forest_pieces
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.meshing.refinement.forest import BisectionForest, LeafMesh


@dataclass(frozen=True, slots=True, eq=False)
class VolumeCut:
    """A cut mesh, and how it comes from the mesh before.

    Attributes
    ----------
    mesh : Mesh
        Refined and separated; where nothing is cut, and nothing was refined, the mesh as it was.
    positions : ndarray, shape (n, 3)
        Where its nodes were when it was cut, mm.
    parents : ndarray, shape (m,), int64
        Cell of the mesh before that each cell is or is a part of.
    ends : ndarray, shape (k, 2), int64
        Ends of the edge that each node made by bisection halves; these nodes follow those of the mesh before.
    source : ndarray, shape (n,), int64
        Node of the refined mesh that each node is or is a copy of.
    faces : ndarray, shape (2 f, 3), int64
        New surface: faces of the side from which the blade's triangles are seen clockwise, then in the same order those of the other;
        their nodes are counterclockwise seen from outside. Faces at the front that are not open yet are no part of it.
    piece : ndarray, shape (m,), int64
        Piece that each cell belongs to, the one of the largest volume first.
    deviation_mm : float
        Largest distance of a node of the new surface from the blade, or from the straight way to it from an earlier cut.
    smallest_angle_deg : float
        Smallest dihedral angle of the cells that are new; of all cells, where none is.
    forest : BisectionForest
        Whose leaves are the cells, for the next cut of this mesh.
    joined_mm : float
        Length of the fronts of earlier cuts from which the cut goes on, or into which it runs; 0 where `earlier` was given.
    bridges : ndarray, shape (b, 3)
        Places in the reference configuration, mm, at the fronts of earlier cuts near which the body still hangs together between them and
        this cut.
    """

    mesh: Mesh
    positions: FloatArray
    parents: IntArray
    ends: IntArray
    source: IntArray
    faces: IntArray
    piece: IntArray
    deviation_mm: float
    smallest_angle_deg: float
    forest: BisectionForest
    joined_mm: float
    bridges: FloatArray

    @property
    def n_pieces(self) -> int:
        """Number of pieces of the mesh."""
        return int(self.piece.max()) + 1

    def nodal(self, values: FloatArray) -> FloatArray:
        """Return nodal values (n, ...) from those of the nodes before the cut: means at halved edges, the same on both sides of the cut.

        Displacements, positions and velocities of linear cells are kept everywhere, and with them strain, momentum and energy.
        """
        before = len(values)
        extended = np.zeros((before + len(self.ends), *values.shape[1:]))
        extended[:before] = values
        interpolate_midpoints(extended.reshape(len(extended), -1), self.ends, before)
        return np.asarray(extended[self.source])

    def cellwise(self, values: AnyArray) -> AnyArray:
        """Return values of the cells (m, ...) from those of the cells before the cut, such as history variables."""
        return np.asarray(values[self.parents])


def cut_volume(
    mesh: Mesh,
    blade: SweptBlade,
    distance_mm: float,
    *,
    positions: FloatArray | None = None,
    least_angle_deg: float | None = None,
    forest: BisectionForest | None = None,
    earlier: SweptBlade | None = None,
) -> VolumeCut:
    """Cut a tetrahedral mesh along the surface that a blade has swept.

    Parameters
    ----------
    mesh : Mesh
        Linear tetrahedra.
    blade : SweptBlade
        The surface; it may end inside the body.
    distance_mm : float
        Twice the largest distance that the new surface may have from the blade: near it, cells are bisected until it has.
    positions : ndarray, shape (n, 3), optional
        Where the nodes are while the blade passes, mm; by default in the reference configuration of the mesh.
    least_angle_deg : float, optional
        The cut is refused where it would make cells with a smaller dihedral angle; by default a tenth of the smallest one of the cells that
        are bisected.
    forest : BisectionForest, optional
        `VolumeCut.forest` of the cut that the mesh comes from; it is not changed. A cut then takes a fraction of the time, as where a blade
        goes on step by step, and the quality of all cells is that of one bisection of the first mesh.
    earlier : SweptBlade, optional
        Of a blade that goes on step by step, what it swept in the steps before, as far back as a cell reaches. Cells that are bisected now
        are separated along it too. Without it, the fronts of earlier cuts are found in the mesh: from those within 0.75 of the longest edge
        around them the cut goes on straight to the blade, if they end near its rim or would run into it.

    Raises
    ------
    InputError
        Other cells, a forest of another mesh, inverted or duplicate cells, positions that are not finite, a distance that is not positive
        or larger than the body, or so small that the mesh would grow beyond 20 million cells or would need cells of lower quality; the mesh
        is left as it was.
    """
    if mesh.cell_type != "tetra":
        raise InputError(f"cutting needs linear tetrahedra, not {mesh.cell_type!r} cells; split hexahedra by naibu.meshing.to_tetra first")
    where = mesh.points if positions is None else positions
    require_shape("positions", where, mesh.points.shape)
    if forest is None:
        forest = BisectionForest.of(mesh)
    elif (forest.n_cells, forest.n_nodes, forest.node_rows) != (mesh.n_cells, mesh.n_points, mesh.n_points):
        raise InputError(
            f"forest has {forest.n_cells} cells and {forest.n_nodes} nodes, the mesh {mesh.n_cells} and {mesh.n_points}; give that of the "
            "cut that made the mesh"
        )
    else:
        forest = forest.copied()
    before = forest.leaves_in_order()
    found = cut_forest(forest, blade, distance_mm, positions=where, least_angle_deg=least_angle_deg, earlier=earlier)
    return _described(mesh, forest, found, before, where)


def _described(mesh: Mesh, forest: BisectionForest, found: ForestCut, before: IntArray, where: FloatArray) -> VolumeCut:
    """Describe the cut of a forest whose leaves were `before`, and in which no vertex number is unused."""
    leaf = forest.leaf_mesh()
    cells, places = found.faces[:, [0, 2]].T, found.faces[:, [1, 3]].T
    faces = np.concatenate([face_vertices(forest, cells[side], places[side]) for side in (0, 1)])
    refined = forest.n_nodes - len(found.copies)
    return VolumeCut(
        mesh=leaf.mesh, positions=found.nodal(forest, where), parents=_parents(forest, before, leaf),
        ends=forest.node_parents[mesh.n_points : refined].astype(np.int64),
        source=np.concatenate([np.arange(refined), found.copies[:, 0]]).astype(np.int64), faces=faces, piece=forest_pieces(forest),
        deviation_mm=found.deviation_mm, smallest_angle_deg=found.smallest_angle_deg, forest=forest,
        joined_mm=found.joined_mm, bridges=forest.points[found.bridges],
    )  # fmt: skip


def _parents(forest: BisectionForest, before: IntArray, leaf: LeafMesh) -> IntArray:
    """Place among the leaves before that each leaf is a part of."""
    out, parents = leaf.cells.copy(), forest.parents
    place = np.full(forest.cell_rows, -1, dtype=np.int64)
    place[before] = np.arange(len(before))
    while (later := place[out] < 0).any():
        out[later] = parents[out[later]]
    return np.asarray(place[out])
