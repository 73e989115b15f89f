"""Cutting of tetrahedral meshes by the swept surface of a blade: refine near the surface, then separate along faces.

Cells that the surface passes are bisected until the faces between them follow it within half of a given distance; then two neighbours are
separated where the segment between their centres crosses the surface an odd number of times. No cell is removed or split by the blade
itself, so that volume is conserved to rounding and the quality of all cells is that of bisection :cite:p:`arnold2000`; the cut is faceted,
with facets of the size of the refined cells, where virtual nodes :cite:p:`molino2004` would follow the blade within cells. A cut may end
inside the body, leave and enter it again, and cross earlier cuts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import AnyArray, BoolArray, FloatArray, IntArray, require_positive, require_shape
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.cutting._crossing_kernels import crossings, distances, interpolate_midpoints
from naibu.meshing.cutting.separation import LOCAL_FACES, FacePairs, face_pairs, pieces, separated, smallest_dihedral_angle
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.meshing.quality import signed_volumes
from naibu.meshing.refinement.forest import BisectionForest, LeafMesh

ROUNDS = 60  # of bisection at most
MOST_CELLS = 20_000_000


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
        New surface: faces of the side from which the blade's triangles are seen counterclockwise, then in the same order those of the
        other; their nodes are counterclockwise seen from outside.
    piece : ndarray, shape (m,), int64
        Piece that each cell belongs to, the one of the largest volume first.
    deviation_mm : float
        Largest distance of a node of the new surface from the blade.
    smallest_angle_deg : float
        Smallest dihedral angle of the cells that are new.
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


def cut_volume(mesh: Mesh, blade: SweptBlade, distance_mm: float, *, positions: FloatArray | None = None) -> VolumeCut:
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

    Raises
    ------
    InputError
        Other cells, inverted or duplicate ones, a distance that is not positive or larger than the body, or so small that the mesh would
        grow beyond 20 million cells; the mesh is left as it was.
    """
    where = mesh.points if positions is None else positions
    _require_cuttable(mesh, where, distance_mm)
    forest = BisectionForest.of(mesh)
    deformed = where
    ends = np.zeros((0, 2), dtype=np.int64)
    for _ in range(ROUNDS):
        leaf = forest.leaf_mesh()
        pairs, cut = crossed(deformed, leaf.mesh.cells, face_pairs(leaf.mesh.cells), blade)
        coarse, deviation = _too_coarse(deformed, leaf.mesh.cells, pairs, cut, blade, 0.5 * distance_mm)
        if not coarse.any():
            return _finished(mesh, forest, leaf, deformed, ends, pairs, cut, deviation)
        if forest.n_cells + 2 * int(coarse.sum()) > MOST_CELLS:
            break
        before = forest.node_rows
        forest.refine(leaf.cells[coarse])
        ends = forest.node_parents[len(where) : forest.node_rows].astype(np.int64)
        grown = np.concatenate([deformed, np.zeros((forest.node_rows - before, 3))])
        interpolate_midpoints(grown, ends[before - len(where) :], before)
        deformed = grown
    raise InputError(
        f"distance_mm is {distance_mm:g} mm, for which the mesh would need more than {MOST_CELLS} cells or {ROUNDS} bisections; choose a "
        "larger one. The mesh is as it was"
    )


def crossed(positions: FloatArray, cells: IntArray, pairs: FacePairs, blade: SweptBlade) -> tuple[FacePairs, BoolArray]:
    """Return the interior faces with the cell above the surface first where they are cut, and which (f,) are cut.

    A face is cut if its cells have their centres on two sides of the surface. A small shift of the centres, the same for a cell at all of
    its faces, keeps them off surfaces that pass right through them.
    """
    centres = positions[cells].mean(axis=1)
    centres += 1e-9 * np.sqrt(np.arange(1.0, 4.0)) * (positions[cells[:, 1]] - positions[cells[:, 0]])
    corners = blade.points[blade.triangles]
    count, above = np.zeros(len(pairs.cells), dtype=np.int64), np.zeros(len(pairs.cells), dtype=bool)
    starts, stops = (np.ascontiguousarray(centres[pairs.cells[:, k]]) for k in (0, 1))
    crossings(starts, stops, blade.points, blade.triangles, corners.min(axis=1), corners.max(axis=1), count, above)
    cut = count % 2 == 1
    turned = (cut & ~above)[:, None]
    return FacePairs(np.where(turned, pairs.cells[:, ::-1], pairs.cells), np.where(turned, pairs.opposite[:, ::-1], pairs.opposite)), cut


def _too_coarse(
    positions: FloatArray, cells: IntArray, pairs: FacePairs, cut: BoolArray, blade: SweptBlade, tolerance_mm: float
) -> tuple[BoolArray, float]:
    """Which cells (m,) beside cut faces have a node on them that is farther from the blade than allowed; and the largest distance."""
    chosen = np.flatnonzero(cut)
    faces = _face_nodes(cells, pairs, chosen, 0)
    nodes, inverse = np.unique(faces, return_inverse=True)
    corners = blade.points[blade.triangles]
    gap = np.zeros(len(nodes))
    distances(np.ascontiguousarray(positions[nodes]), blade.points, blade.triangles, corners.min(axis=1), corners.max(axis=1), gap)
    far = (gap > tolerance_mm)[inverse.reshape(faces.shape)].any(axis=1)
    coarse = np.zeros(len(cells), dtype=bool)
    coarse[pairs.cells[chosen[far]].ravel()] = True
    return coarse, float(gap.max(initial=0.0))


def _face_nodes(cells: IntArray, pairs: FacePairs, chosen: IntArray, side: int) -> IntArray:
    """Nodes (c, 3) of chosen faces as the cell on a side has them, counterclockwise seen from outside of it."""
    return np.asarray(cells[pairs.cells[chosen, side]][np.arange(len(chosen))[:, None], LOCAL_FACES[pairs.opposite[chosen, side]]])


def _finished(
    mesh: Mesh,
    forest: BisectionForest,
    leaf: LeafMesh,
    deformed: FloatArray,
    ends: IntArray,
    pairs: FacePairs,
    cut: BoolArray,
    deviation: float,
) -> VolumeCut:
    cells, source = separated(leaf.mesh.cells, pairs, cut, leaf.mesh.n_points)
    chosen = np.flatnonzero(cut)
    faces = np.concatenate([_face_nodes(cells, pairs, chosen, side) for side in (0, 1)])
    parents = _roots(forest, leaf)
    changed = leaf.cells >= forest.n_roots
    angle = smallest_dihedral_angle(leaf.mesh.points, leaf.mesh.cells[changed] if changed.any() else leaf.mesh.cells)
    made = Mesh(leaf.mesh.points[source], cells, "tetra", leaf.mesh.regions, mesh.region_names)
    piece = pieces(signed_volumes(made), pairs, cut)
    return VolumeCut(made, deformed[source], parents, ends, source, faces, piece, deviation, angle)


def _roots(forest: BisectionForest, leaf: LeafMesh) -> IntArray:
    """Cell of the mesh before that each leaf is a part of."""
    out, parents = leaf.cells.copy(), forest.parents
    while (later := out >= forest.n_roots).any():
        out[later] = parents[out[later]]
    return out


def _require_cuttable(mesh: Mesh, where: FloatArray, distance_mm: float) -> None:
    if mesh.cell_type != "tetra":
        raise InputError(f"cutting needs linear tetrahedra, not {mesh.cell_type!r} cells; split hexahedra by naibu.meshing.to_tetra first")
    require_shape("positions", where, mesh.points.shape)
    require_positive("distance_mm", distance_mm, "mm")
    extent = float(np.ptp(where, axis=0).max())
    if distance_mm > extent:
        raise InputError(f"distance_mm is {distance_mm:g} mm, larger than the body of {extent:.4g} mm; choose a fraction of an element")
    corners = where[mesh.cells]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1])
    if not (volume > 0.0).all():
        bad = int(np.argmin(volume))
        raise InputError(f"cell {bad} is inverted or has no volume where the blade passes; mend the mesh, or cut a state with less strain")
