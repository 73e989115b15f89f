"""Cutting of bisection forests by the swept surface of a blade: refine near the surface, then separate cells along their faces.

Two neighbours are separated where the segment between their centres crosses the surface. Cells beside such faces are bisected first, until
the faces lie within half of a given distance of the surface; so are cells in which the surface parts the centre from a vertex that is on no
such face and farther from it, so that slices which are thinner than a cell are cut off. Around every vertex of these faces, cells that are
joined by other faces keep one vertex; each other group of cells gets a copy, and so around vertices elsewhere whose cells a cut parts in
more pieces. So no piece hangs on another by a mere edge or vertex, a cut may end inside the body, where the vertices of its front have one
group, and cuts may cross. The forest is kept: leaves keep number, parent, level and tag, so that it can be refined and coarsened further;
bisections that the cut runs through are not undone any more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from naibu.core.arrays import AnyArray, BoolArray, FloatArray, Int8Array, IntArray, require_positive, require_shape
from naibu.core.errors import InputError
from naibu.meshing.cutting import _separation_kernels as kernels
from naibu.meshing.cutting._crossing_kernels import distances
from naibu.meshing.cutting.earlier_fronts import bridges, fronts_near
from naibu.meshing.cutting.pieces import of_more_pieces
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.meshing.quality import smallest_dihedral_angle
from naibu.meshing.refinement._forest_kernels import COUNT, FLIPPED, LEAF, NODES
from naibu.meshing.refinement.forest import BisectionForest, MeshChange
from naibu.meshing.refinement.transfer import transferred_cells, transferred_nodes

KernelBlade = tuple[FloatArray, IntArray, FloatArray, FloatArray, int, BoolArray]
_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])  # face k is opposite to vertex k, counterclockwise from outside
ROUNDS = 60  # of bisection at most
MOST_CELLS = 20_000_000
LEAST_ANGLE = 0.1  # of the smallest dihedral angle of the cells that are bisected; bisection keeps about a fifth of it
SPLINTER = 16  # cells of a piece that is not cut off where all of it lies as near to the blade as its cut faces may
OF_STEP = 64  # the same where a blade goes on: between its steps, refinement may have divided them


@dataclass(frozen=True, slots=True, eq=False)
class ForestCut:
    """A cut of a bisection forest, and how the forest comes from that before.

    Attributes
    ----------
    changes : tuple of MeshChange
        Refinements near the blade, in their order.
    copies : ndarray, shape (k, 2), int64
        Vertices that were doubled, and their copies.
    faces : ndarray, shape (f, 4), int64
        New surface: cell above the blade, place in it of the vertex opposite to the face, and the same of the cell below. Faces at the
        front that other cells still hold together are part of that of the cut that opens them; see `BisectionForest.cut_front`.
    deviation_mm : float
        Largest distance of a vertex of the new surface from the blade, or from the straight way to it from an earlier cut.
    smallest_angle_deg : float
        Smallest dihedral angle of the cells that are new; of all cells, where none is.
    joined_mm : float
        Length of the fronts of earlier cuts from which the cut goes on, or into which it runs; 0 where `earlier` was given.
    bridges : ndarray, shape (b,), int64
        Vertices at the fronts of earlier cuts near which the body still hangs together between them and this cut.
    """

    changes: tuple[MeshChange, ...]
    copies: IntArray
    faces: IntArray
    deviation_mm: float
    smallest_angle_deg: float
    joined_mm: float
    bridges: IntArray

    def nodal(self, forest: BisectionForest, values: FloatArray) -> FloatArray:
        """Return nodal values (rows, ...) from those before the cut, by numbers in the forest; new nodes have the mean of their edge."""
        values = values.copy()
        for change in self.changes:
            values = transferred_nodes(forest, change, values)
        return np.asarray(_extended(values, forest.node_rows, self.copies))

    def cellwise(self, forest: BisectionForest, values: FloatArray, *, extensive: bool = False) -> FloatArray:
        """Return values of cells (rows, ...) from those before the cut, by numbers in the forest; see `naibu.meshing.transferred_cells`."""
        values = values.copy()
        for change in self.changes:
            values = transferred_cells(forest, change, values, extensive=extensive)
        return values


def cut_forest(
    forest: BisectionForest,
    blade: SweptBlade,
    distance_mm: float,
    *,
    positions: FloatArray | None = None,
    least_angle_deg: float | None = None,
    earlier: SweptBlade | None = None,
) -> ForestCut:
    """Cut the leaves of a forest of tetrahedra along the surface that a blade has swept.

    Parameters
    ----------
    forest : BisectionForest
        Of tetrahedra; changed.
    blade : SweptBlade
        The surface; it may end inside the body.
    distance_mm : float
        Twice the largest distance that the new surface may have from the blade: near it, cells are bisected until it has.
    positions : ndarray, shape (node_rows, 3), optional
        Where the vertices are while the blade passes, mm; by default in the reference configuration.
    least_angle_deg : float, optional
        The cut is refused where it would make cells with a smaller dihedral angle; by default a tenth of the smallest one of the cells that
        are bisected.
    earlier : SweptBlade, optional
        Of a blade that goes on step by step, what it swept in the steps before, as far back as a cell reaches. Cells that were bisected
        since the last cut, or are now, are separated along it too; without it, the cut goes on straight from the fronts of earlier cuts
        that it meets.

    Raises
    ------
    InputError
        Triangles, inverted cells, positions that are not finite, a distance that is not positive or larger than the body, or so small that
        the mesh would grow beyond 20 million cells or would need cells of lower quality. The forest is then as it was.
    """
    where = forest.points.copy() if positions is None else np.array(positions, dtype=float)
    _require_cuttable(forest, where, distance_mm)
    before = forest.copied()
    fronts = fronts_near(forest, blade, where) if earlier is None else None
    on = blade if fronts is None or fronts.way is None else blade + fronts.way
    try:
        found = _cut(forest, on, on if earlier is None else on + earlier, distance_mm, where, least_angle_deg)
        return found if fronts is None else replace(found, joined_mm=fronts.joined_mm, bridges=bridges(forest, fronts, found.faces))
    except BaseException:
        forest.become(before)
        raise


def _cut(
    forest: BisectionForest, blade: SweptBlade, whole: SweptBlade, distance_mm: float, where: FloatArray, least_angle_deg: float | None
) -> ForestCut:
    changes: list[MeshChange] = []
    gap, centres = np.full(forest.node_rows, -1.0), np.empty((0, 3))
    for _ in range(ROUNDS):
        if len(centres) < forest.cell_rows:
            centres = np.empty((2 * forest.cell_rows, 3))
        fresh = np.append(forest.since_cut, np.zeros(max(0, forest.cell_rows - len(forest.since_cut)), dtype=bool))
        surface = (*whole.arrays, len(blade.triangles), fresh)
        faces = _crossed(forest, surface, where, centres)
        coarse = _too_coarse(forest, faces, where, surface, centres, 0.5 * distance_mm, gap)
        if not len(coarse):
            break
        if forest.n_cells + max(2 * len(coarse), _needed(forest, where, coarse, distance_mm)) > MOST_CELLS:
            raise _too_fine(distance_mm)
        changes.append(forest.refine(coarse))
        where = transferred_nodes(forest, changes[-1], where)
        gap = np.concatenate([gap, np.full(forest.node_rows - len(gap), -1.0)])
        gap[changes[-1].nodes] = -1.0
    else:
        raise _too_fine(distance_mm)
    angle = _quality(forest, changes, distance_mm, least_angle_deg)
    late = _late(forest, faces, where, whole)
    if len(whole.triangles) > len(blade.triangles):  # where cells are new, what the blade swept before has told already
        late = late[~fresh[late[:, ::2]].any(axis=1)]
    most = SPLINTER if len(whole.triangles) == len(blade.triangles) else OF_STEP
    whole_pieces = _labels(forest)
    faces = _opened(forest, np.concatenate([faces, late]), centres, whole, 0.5 * distance_mm, most)
    copies = _separated(forest, faces, _of_more_pieces(forest, *whole_pieces))
    apart = _apart(forest, faces)
    kernels.set_open(forest.arrays[0], faces[~apart], 0)
    forest.cut_front, forest.since_cut = _corners(forest, faces[~apart, 0], faces[~apart, 1]), np.zeros(0, dtype=bool)
    faces = faces[apart]
    now = faces[~np.isin(faces[:, 0] * 4 + faces[:, 1], late[:, 0] * 4 + late[:, 1])]
    where, gap = (_extended(values, forest.node_rows, copies) for values in (where, gap))
    _, deviation = kernels.too_coarse(forest.arrays[0], now, where, surface, np.inf, gap, np.empty(0, dtype=np.int64))
    return ForestCut(tuple(changes), copies, faces, float(deviation), angle, 0.0, np.empty(0, dtype=np.int64))


def _extended(values: AnyArray, rows: int, copies: IntArray) -> AnyArray:
    """Return nodal values (rows, ...) in which copies (k, 2) have the values of what they are copies of."""
    if len(values) < rows:
        values = np.concatenate([values, np.zeros((rows - len(values), *values.shape[1:]), values.dtype)])
    values[copies[:, 1]] = values[copies[:, 0]]
    return values


def forest_pieces(forest: BisectionForest) -> IntArray:
    """Return the number of the piece of every leaf (n_cells,), in the order of `BisectionForest.leaf_mesh`, the largest volume first."""
    label, count = _labels(forest)
    cells = forest.leaves_in_order()
    if count == 1:
        return np.zeros(len(cells), dtype=np.int64)
    rank = np.empty(count, dtype=np.int64)
    rank[np.argsort(-np.bincount(label[cells], forest.volumes(cells)), kind="stable")] = np.arange(count)
    return np.asarray(rank[label[cells]])


def _labels(forest: BisectionForest) -> tuple[IntArray, int]:
    """Return which of the parts that faces join each leaf belongs to (cell_rows,), -1 at other cells, and how many there are."""
    label = np.full(forest.cell_rows, -1, dtype=np.int64)
    count = kernels.components(forest.arrays[0], forest.arrays[4], forest.n_cells, label, np.empty(forest.n_cells, dtype=np.int64))
    return label, int(count)


def _of_more_pieces(forest: BisectionForest, before: IntArray, n_before: int) -> Int8Array:
    """Whether the leaves around each vertex (node_rows,) are of more pieces than before; see `pieces`."""
    label, count = _labels(forest)
    if count == n_before:
        return np.zeros(forest.node_rows, dtype=np.int8)
    leaves = forest.leaves()
    corners = forest.simplices[leaves].astype(np.int64)
    return of_more_pieces(corners, before[leaves], label[leaves], forest.node_rows).astype(np.int8)


def _crossed(forest: BisectionForest, surface: KernelBlade, where: FloatArray, centres: FloatArray) -> IntArray:
    """Faces (f, 4) of leaves that the blade crosses; fills in the centres of all leaves."""
    found = np.empty((4096, 4), dtype=np.int64)
    while (size := kernels.crossed_faces(forest.arrays[0], forest.arrays[4], forest.n_cells, where, surface, centres, found)) > len(found):
        found = np.empty((2 * size, 4), dtype=np.int64)
    return found[:size]


def _too_coarse(
    forest: BisectionForest,
    faces: IntArray,
    where: FloatArray,
    surface: KernelBlade,
    centres: FloatArray,
    tolerance: float,
    gap: FloatArray,
) -> IntArray:
    """Leaves to bisect: beside faces too far from the blade, or with vertices that the blade parts from them where no face does."""
    cells, leaves, beside = forest.arrays[0], forest.arrays[4], np.empty(2 * len(faces), dtype=np.int64)
    size, _ = kernels.too_coarse(cells, faces, where, surface, tolerance, gap, beside)
    within = np.empty(1024, dtype=np.int64)
    while True:
        touched = np.zeros(forest.node_rows, dtype=np.int8)
        count = kernels.unresolved(cells, leaves, forest.n_cells, faces, where, surface, centres, tolerance, gap, touched, within)
        if count <= len(within):
            return np.concatenate([beside[:size], within[:count]])
        within = np.empty(count, dtype=np.int64)


def _opened(forest: BisectionForest, faces: IntArray, centres: FloatArray, blade: SweptBlade, near_mm: float, most: int) -> IntArray:
    """Open faces, but not those around splinters: `most` cells or fewer that would be cut off though the blade only grazes them."""
    kernels.set_open(forest.arrays[0], faces, -1)
    while (closed := _around_splinters(forest, faces, centres, blade, near_mm, most)).any():
        kernels.set_open(forest.arrays[0], faces[closed], 0)
        faces = faces[~closed]  # and those towards splinters that have just been joined
    return faces


def _around_splinters(
    forest: BisectionForest, faces: IntArray, centres: FloatArray, blade: SweptBlade, near_mm: float, most: int
) -> BoolArray:
    """Which open faces (f,) join a splinter to what it shares the largest area with."""
    cells = forest.arrays[0]
    closed, small = np.zeros(len(faces), dtype=bool), kernels.small_pieces(cells, faces, most)
    if not small.any():
        return closed
    label = np.full(forest.cell_rows, -1, dtype=np.int64)
    kernels.components(cells, forest.arrays[4], forest.n_cells, label, np.empty(forest.n_cells, dtype=np.int64))
    leaves = forest.leaves()
    for piece in np.unique(label[faces[:, ::2]][small]):
        own = leaves[label[leaves] == piece]
        gap = np.empty(len(own))
        distances(centres[own], *blade.arrays, gap)
        if gap.max() > near_mm:
            continue
        of_piece = label[faces[:, ::2]] == piece
        beside = of_piece.any(axis=1) & ~small.all(axis=1)  # not those towards other splinters
        if not beside.any():
            continue
        # what lies above the piece and what lies below it are two, also where a cut that ends inside leaves one piece of both
        across = 2 * np.where(of_piece[:, 0], label[faces[:, 2]], label[faces[:, 0]]) + of_piece[:, 0]
        area = np.bincount(across[beside], _areas(forest, faces[beside]))
        closed |= beside & (across == int(area.argmax()))
    return closed


def _areas(forest: BisectionForest, faces: IntArray) -> FloatArray:
    corners = forest.points[face_vertices(forest, faces[:, 0], faces[:, 1])]
    return np.asarray(0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1))


def face_vertices(forest: BisectionForest, cells: IntArray, places: IntArray) -> IntArray:
    """Return the vertices (f, 3) of faces of cells opposite to their vertices at places, counterclockwise seen from outside the cell."""
    corners: IntArray = forest.simplices[cells].astype(np.int64)[np.arange(len(cells))[:, None], _FACES[places]]
    turned = forest.arrays[0][cells, FLIPPED] == 1
    corners[turned] = corners[turned][:, ::-1]
    return corners


def _separated(forest: BisectionForest, faces: IntArray, touched: Int8Array) -> IntArray:
    """Double the vertices of open faces, and those `touched` (node_rows,), and return them with their copies (k, 2)."""
    slot = np.full(forest.cell_rows, -1, dtype=np.int64)
    around, group, count = kernels.corner_groups(forest.arrays[0], forest.arrays[4], forest.n_cells, faces, touched, slot)
    first, source = forest.node_rows, np.empty(int(count), dtype=np.int64)
    forest.reserve(int(count))
    cells, points, nodes, _, _, counters = forest.arrays
    counters[[NODES, COUNT]] += int(count)
    kernels.double_vertices(cells, points, nodes, around, group, touched, first, source)
    return np.stack([source, first + np.arange(len(source))], axis=1)


def _apart(forest: BisectionForest, faces: IntArray) -> BoolArray:
    """Whether faces (f, 4) have other vertices on one side than on the other."""
    one, two = (_corners(forest, faces[:, k], faces[:, k + 1]) for k in (0, 2))
    return np.asarray((one != two).any(axis=1))


def _corners(forest: BisectionForest, cells: IntArray, places: IntArray) -> IntArray:
    """Sorted vertices (f, 3) of faces."""
    return np.sort(forest.simplices[cells].astype(np.int64)[np.arange(len(cells))[:, None], _FACES[places]], axis=1)


def _late(forest: BisectionForest, faces: IntArray, where: FloatArray, blade: SweptBlade) -> IntArray:
    """Faces (f, 4) at the fronts of cuts before, but for those that the blade crosses now.

    The cell first is the one above the part of the blade that is nearest to the face.
    """
    known, found = {frozenset((t, u)) for t, u in faces[:, ::2].tolist()}, []
    for face in forest.cut_front.tolist():
        around = forest.around_node(face[0])
        beside = around[np.isin(forest.simplices[around], face).sum(axis=1) == 3].tolist()
        if len(beside) == 2 and frozenset(beside) not in known:
            t, u = beside
            found.append((t, forest.neighbours[t].tolist().index(u), u, forest.neighbours[u].tolist().index(t)))
    if not found:
        return np.empty((0, 4), dtype=np.int64)
    rows = np.array(found, dtype=np.int64)
    a, b, c = blade.points[blade.triangles].transpose(1, 0, 2)
    upper, lower = (where[forest.simplices[rows[:, k]]].mean(axis=1) for k in (0, 2))
    nearest = cKDTree((a + b + c) / 3.0).query(0.5 * (upper + lower))[1]
    below = ((upper - lower) * np.cross(b - a, c - a)[nearest]).sum(axis=1) < 0.0
    return np.where(below[:, None], rows[:, [2, 3, 0, 1]], rows)


def _quality(forest: BisectionForest, changes: list[MeshChange], distance_mm: float, least_angle_deg: float | None) -> float:
    """Smallest dihedral angle of the leaves that refinement made, of all leaves where it made none.

    Raises
    ------
    InputError
        It is smaller than it may be.
    """
    if not changes:
        return smallest_dihedral_angle(forest.points, forest.simplices[forest.leaves()])
    split, made = (np.concatenate(parts) for parts in zip(*((c.parents, c.children.ravel()) for c in changes), strict=True))
    angle = smallest_dihedral_angle(forest.points, forest.simplices[made[forest.children[made] == LEAF]])
    least = least_angle_deg
    if least is None:
        least = LEAST_ANGLE * smallest_dihedral_angle(forest.points, forest.simplices[np.setdiff1d(split, made)])
    if angle < least:
        raise InputError(
            f"distance_mm is {distance_mm:g} mm, for which cells with a dihedral angle of {angle:.3g} degrees would be made, less than "
            f"{least:.3g}; choose a larger distance, or mend the mesh near the blade. The mesh is as it was"
        )
    return angle


def _needed(forest: BisectionForest, where: FloatArray, coarse: IntArray, distance_mm: float) -> float:
    """Estimate how many cells too coarse ones become at least: as many of the distance as cover the surface that crosses them."""
    corners = where[forest.simplices[coarse]]
    across = np.linalg.norm(np.ptp(corners, axis=1), axis=1)
    with np.errstate(over="ignore"):
        return float(np.sum((0.75 * across / distance_mm) ** 2))


def _too_fine(distance_mm: float) -> InputError:
    return InputError(
        f"distance_mm is {distance_mm:g} mm, for which the mesh would need more than {MOST_CELLS} cells or {ROUNDS} bisections; choose a "
        "larger one. The mesh is as it was"
    )


def _require_cuttable(forest: BisectionForest, where: FloatArray, distance_mm: float) -> None:
    if forest.dimension != 3:
        raise InputError("cutting needs a forest of tetrahedra, not of triangles")
    require_shape("positions", where, (forest.node_rows, 3))
    require_positive("distance_mm", distance_mm, "mm")
    used = where[forest.node_used]
    if not np.isfinite(used).all():
        raise InputError(f"positions of {int((~np.isfinite(used)).any(axis=1).sum())} of {len(used)} nodes are not finite")
    extent = float(np.ptp(used, axis=0).max())
    if distance_mm > extent:
        raise InputError(f"distance_mm is {distance_mm:g} mm, larger than the body of {extent:.4g} mm; choose a fraction of an element")
    bad = int(kernels.inverted(forest.arrays[0], forest.arrays[4], forest.n_cells, where))
    if bad >= 0:
        raise InputError(f"cell {bad} is inverted or has no volume where the blade passes; mend the mesh, or cut a state with less strain")
