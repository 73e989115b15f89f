"""Fronts of earlier cuts, found in the mesh itself, and the surface over which a new cut goes on from them.

Where a cut ends inside a body, the faces of its two sides meet at edges around which the body goes all the way: two faces of its boundary
lie on each other there. Such a front lies within a cell of where the blade ended, so that a blade that begins where the last one ended
would leave a ligament thinner than a cell, whose sides hang together.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.meshing.cutting._crossing_kernels import distances
from naibu.meshing.cutting.swept_blade import FLAT, SweptBlade
from naibu.meshing.refinement.forest import BisectionForest

REACH = 0.75  # of the longest edge around a vertex of a front: fronts were found to lag behind the end of the blade by 0.52 of it at most
AHEAD = 0.7  # cosine of the angle between the way to the blade and the direction in which an earlier cut would go on
BESIDE = 1  # rows of edges beside those that are met, which are so too: fronts are jagged
FOLDED = 1e-8  # 1 - cosine of the angle between the two faces of a front
AROUND = 2.0  # longest edges: radius in which the cut parts the cells around a front where it goes on from it
MOST = 0.5  # of the area of the earlier cut within that radius
PARTS = 4  # of an edge of a front, which a rim that is bent between its ends is followed with


@dataclass(frozen=True, slots=True, eq=False)
class EarlierFronts:
    """Fronts of earlier cuts near a blade.

    Attributes
    ----------
    vertices : ndarray, shape (k,), int64
        Vertices of fronts that are nearer to the blade than most of a cell.
    cell_mm : ndarray, shape (k,)
        Longest edge of the cells around each of them.
    way : SweptBlade or None
        The surface straight to the blade from those fronts near which it begins or ends, and from those that would run into it.
    joined_mm : float
        Length of these.
    passed : ndarray, shape (k,), bool
        Where the blade passes through the earlier cut: nothing is left between the two.
    """

    vertices: IntArray
    cell_mm: FloatArray
    way: SweptBlade | None
    joined_mm: float
    passed: BoolArray


def front_edges(forest: BisectionForest) -> tuple[IntArray, IntArray]:
    """Return the edges (e, 2), by vertices, at which cuts of a forest end inside it, and a vertex (e,) of a face behind each."""
    faces = _face_vertices(forest, forest.boundary_faces()[0])
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    apex = faces[:, [2, 0, 1]].ravel()
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, apex = edges[order], apex[order]
    first = np.flatnonzero(np.concatenate([[True], (np.diff(edges, axis=0) != 0).any(axis=1)])) if len(edges) else np.empty(0, np.int64)
    pair = first[np.diff(np.append(first, len(edges))) == 2]
    start, end = forest.points[edges[pair]].transpose(1, 0, 2)
    along = _unit(end - start)
    towards = []
    for beside in (apex[pair], apex[pair + 1]):
        arm = forest.points[beside] - start
        towards.append(_unit(arm - (arm * along).sum(axis=1)[:, None] * along))
    front = pair[(towards[0] * towards[1]).sum(axis=1) > 1.0 - FOLDED]
    return edges[front], apex[front]


def fronts_near(forest: BisectionForest, blade: SweptBlade, where: FloatArray) -> EarlierFronts:
    """Return the fronts near a blade, and the way from them to it; vertices are where they are while it passes, (node_rows, 3)."""
    edges, behind = front_edges(forest)
    vertices = np.unique(edges)
    if not len(vertices):
        return EarlierFronts(vertices, np.empty(0), None, 0.0, np.empty(0, dtype=bool))
    gap, longest = np.empty(len(vertices)), _longest_edge(forest, vertices, where)
    distances(np.ascontiguousarray(where[vertices]), *blade.arrays, gap)
    near = gap <= REACH * longest
    vertices, longest = vertices[near], longest[near]
    known = np.isin(edges, vertices).all(axis=1)
    passed = _passed(forest, blade, where, vertices, longest)
    edges, behind = edges[known], behind[known]
    if not len(edges):
        return EarlierFronts(vertices, longest, None, 0.0, passed)
    low, high = where[vertices].min(axis=0) - longest.max(), where[vertices].max(axis=0) + longest.max()
    triangles, rim = (_within(part, low, high) for part in (blade.points[blade.triangles], _rim(blade)))
    at_rim = np.linalg.norm(_nearest(rim, where[vertices]) - where[vertices], axis=1) <= longest
    ahead = _ahead(triangles, where[edges], where[behind], AROUND * longest.max())
    met = np.union1d(vertices[at_rim], edges[ahead])
    for _ in range(BESIDE):
        met = np.union1d(met, edges[np.isin(edges, met).any(axis=1)])
    chosen = edges[np.isin(edges, met).any(axis=1)]
    ends = _lengthened(forest, chosen, where, vertices, REACH * longest)
    return EarlierFronts(
        vertices, longest, _way(triangles, np.concatenate([where[chosen], ends])),
        float(np.linalg.norm(where[chosen[:, 1]] - where[chosen[:, 0]], axis=1).sum()), passed,
    )  # fmt: skip


def bridges(forest: BisectionForest, fronts: EarlierFronts, faces: IntArray) -> IntArray:
    """Return the vertices (b,) of earlier fronts near a blade at which the body still hangs together between them and the cut made now.

    Near them there are fronts still, and the cells around join most of what the earlier cut had parted. Where they do not, the front is
    that of a spur: as cuts of one blade may differ by the distance that they keep from it, so may an earlier one branch off the new one, or
    go through it by a little. Where the blade passes through the earlier cut, as where two cross that end at one depth, nothing is between.

    Parameters
    ----------
    forest : BisectionForest
        Behind the cut.
    fronts : EarlierFronts
        Of before the cut.
    faces : ndarray, shape (f, 4), int64
        Cell and place of the faces of the cut, on both sides.
    """
    left = forest.points[np.unique(front_edges(forest)[0])] if len(fronts.vertices) else np.empty((0, 3))
    if not len(left):
        return fronts.vertices[:0]
    closed = cKDTree(left).query(forest.points[fronts.vertices])[0] <= fronts.cell_mm
    closed &= ~fronts.passed
    vertices, radius = fronts.vertices[closed], AROUND * fronts.cell_mm[closed]
    leaves = forest.leaves()
    around = cKDTree(forest.points[forest.simplices[leaves]].mean(axis=1)).query_ball_point(forest.points[vertices], radius)
    if not len(vertices):
        return vertices
    lips, corners, area = _earlier_lips(forest, faces, cKDTree(forest.points[vertices]), radius.max())
    beside = cKDTree(forest.points[corners].mean(axis=1)).query_ball_point(forest.points[vertices], radius)
    joined = [_joined(forest, leaves[cells], lips[rows], area[rows]) for cells, rows in zip(around, beside, strict=True)]
    return np.asarray(vertices[np.array(joined, dtype=bool)])


def _passed(forest: BisectionForest, blade: SweptBlade, where: FloatArray, vertices: IntArray, cell_mm: FloatArray) -> BoolArray:
    """Whether the sides of earlier cuts lie on both sides of the blade around vertices of fronts (k,), and beside it, not beyond its rim.

    A cut that the blade goes on from, or along, lies within `REACH` of cells (k,), mm, of it.
    """
    if not len(vertices):
        return np.empty(0, dtype=bool)
    radius = AROUND * cell_mm
    none = np.empty((0, 4), dtype=np.int64)
    middle = where[_earlier_lips(forest, none, cKDTree(forest.points[vertices]), radius.max())[1]].mean(axis=1)
    if not len(middle):
        return np.zeros(len(vertices), dtype=bool)
    low, high = middle.min(axis=0) - radius.max(), middle.max(axis=0) + radius.max()
    foot, at_rim = (_nearest(_within(part, low, high), middle) for part in (blade.points[blade.triangles], _rim(blade)))
    beside = np.linalg.norm(foot - at_rim, axis=1) > FOLDED * blade.extent_mm
    height = np.where(beside, ((middle - foot) * blade.normals_near(middle)).sum(axis=1), 0.0)
    around = cKDTree(middle).query_ball_point(where[vertices], radius)
    reached = np.array([[height[rows].min(initial=0.0), height[rows].max(initial=0.0)] for rows in around])
    passed = (reached[:, 0] < -REACH * cell_mm) & (reached[:, 1] > REACH * cell_mm)
    if not passed.any():
        return np.asarray(passed)
    return np.asarray(cKDTree(where[vertices[passed]]).query(where[vertices])[0] <= radius)  # between two cuts that cross at a small angle


def _earlier_lips(forest: BisectionForest, faces: IntArray, near: cKDTree, radius: float) -> tuple[IntArray, IntArray, FloatArray]:
    """Pairs of cells (p, 2) on both sides of cuts but the last one, of faces (f, 4), and the vertices and areas of the smaller faces."""
    boundary = forest.boundary_faces()[0]
    new = np.concatenate([faces[:, :2], faces[:, 2:]]) @ [4, 1]
    boundary = boundary[~np.isin(boundary @ [4, 1], new)]
    vertices = _face_vertices(forest, boundary)
    corners = forest.points[vertices]
    close = near.query(corners.mean(axis=1))[0] <= radius
    boundary, vertices, corners = boundary[close], vertices[close], corners[close]
    middle, normal = corners.mean(axis=1), np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    area = np.linalg.norm(normal, axis=1)
    around = cKDTree(middle).query_ball_point(middle, size)
    one = np.repeat(np.arange(len(middle)), [len(found) for found in around])
    two = np.fromiter(itertools.chain.from_iterable(around), dtype=np.int64)
    # the middle of the smaller face, `two`, lies in the larger one: bisection keeps them nested
    kept = (one != two) & (area[two] <= (1.0 + FOLDED) * area[one])
    one, two = one[kept], two[kept]
    a, b, c = corners[one].transpose(1, 0, 2)
    share = np.stack([(np.cross(q - p, middle[two] - p) * normal[one]).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))])
    apart = np.abs(((middle[two] - a) * normal[one]).sum(axis=1)) / area[one]
    lie = (share >= 0.0).all(axis=0) & (apart <= FOLDED * size[one])
    one, two = one[lie], two[lie]
    return np.stack([boundary[one, 0], boundary[two, 0]], axis=1), vertices[two], area[two]


def _joined(forest: BisectionForest, cells: IntArray, lips: IntArray, area: FloatArray) -> bool:
    """Whether faces among cells (c,) join most of the pairs of cells (p, 2), by areas (p,)."""
    cells = np.sort(cells)
    across = forest.neighbours[cells].astype(np.int64)
    place = np.minimum(np.searchsorted(cells, across), len(cells) - 1)
    one, corner = np.nonzero(cells[place] == across)
    two = place[one, corner]
    graph = sp.coo_matrix((np.ones(len(one), dtype=np.int8), (one, two)), shape=(len(cells), len(cells)))
    label = connected_components(graph, directed=False)[1]
    ends = np.minimum(np.searchsorted(cells, lips), len(cells) - 1)
    known = (cells[ends] == lips).all(axis=1)
    same = label[ends[known, 0]] == label[ends[known, 1]]
    return bool(area[known][same].sum() > MOST * area[known].sum())


def _ahead(blade: FloatArray, edges: FloatArray, behind: FloatArray, radius: float) -> BoolArray:
    """Whether the nearest points of triangles (t, 3, 3) lie ahead of fronts (e, 2, 3), whose faces end at points (e, 3) behind them.

    Where an earlier cut would go on is the mean over fronts within a radius: single faces lean to all sides.
    """
    middle, along = edges.mean(axis=1), _unit(edges[:, 1] - edges[:, 0])
    back = behind - middle
    back = _unit(back - (back * along).sum(axis=1)[:, None] * along)
    around = cKDTree(middle).query_ball_point(middle, radius)
    back = _unit(np.stack([back[rows][back[rows] @ own > 0.0].sum(axis=0) for own, rows in zip(back, around, strict=True)]))
    return np.asarray((_unit(_nearest(blade, middle) - middle) * back).sum(axis=1) < -AHEAD)


def _lengthened(forest: BisectionForest, chosen: IntArray, where: FloatArray, vertices: IntArray, reach: FloatArray) -> FloatArray:
    """Edges (e, 2, 3) straight on from where fronts end at the surface of the body, which may recede between a front and the blade."""
    ends = chosen[:, [[0, 1], [1, 0]]].reshape(-1, 2)  # from and to
    ends = ends[np.bincount(front_edges(forest)[0].ravel(), minlength=len(where))[ends[:, 1]] == 1]
    start, end = where[ends].transpose(1, 0, 2)
    return np.stack([end, end + reach[np.searchsorted(vertices, ends[:, 1]), None] * _unit(end - start)], axis=1)


def _way(blade: FloatArray, edges: FloatArray) -> SweptBlade | None:
    """Triangles between edges of fronts (e, 2, 3) and the nearest points of triangles (t, 3, 3)."""
    if not len(edges):
        return None
    at = np.linspace(0.0, 1.0, PARTS + 1)[:, None]
    rows = (edges[:, :1] + at * (edges[:, 1:] - edges[:, :1])).reshape(-1, 3)
    points, number = np.unique(rows, axis=0, return_inverse=True)
    number = number.reshape(-1, PARTS + 1)
    a, b = number[:, :-1].ravel(), number[:, 1:].ravel()
    triangles = np.concatenate([np.stack([a, b, b + len(points)], axis=1), np.stack([a, b + len(points), a + len(points)], axis=1)])
    points = np.concatenate([points, _nearest(blade, points)])
    sides = points[triangles[:, 1:]] - points[triangles[:, :1]]
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    kept = area > FLAT * float(np.ptp(points, axis=0).max()) ** 2
    return SweptBlade(points, triangles[kept].astype(np.int64)) if kept.any() else None


def _within(corners: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Triangles (t, 3, 3) whose boxes reach into another."""
    return np.asarray(corners[((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=1)])


def _rim(blade: SweptBlade) -> FloatArray:
    """Corners (r, 3, 3) of triangles without area, the edges that only one triangle of a surface has."""
    points, number = np.unique(blade.points, axis=0, return_inverse=True)
    edges = np.sort(number.reshape(-1)[blade.triangles][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    return np.asarray(points[edges[count == 1]][:, [0, 1, 1]])


def _nearest(corners: FloatArray, points: FloatArray) -> FloatArray:
    """Nearest points (k, 3) of triangles (t, 3, 3)."""
    best, foot = np.full(len(points), np.inf), np.full(points.shape, np.inf)

    def offer(found: FloatArray, there: BoolArray | bool = True) -> None:
        gap = np.linalg.norm(points - found, axis=1)
        nearer = there & (gap < best)
        best[nearer], foot[nearer] = gap[nearer], found[nearer]

    for a, b, c in corners:
        for start, end in ((a, b), (b, c), (c, a)):
            way = end - start
            offer(start + np.clip((points - start) @ way / max(way @ way, np.finfo(float).tiny), 0.0, 1.0)[:, None] * way)
        at = (points - a) @ np.linalg.pinv(np.stack([b - a, c - a]))
        offer(a + at @ np.stack([b - a, c - a]), (at >= 0.0).all(axis=1) & (at.sum(axis=1) <= 1.0))
    return foot


def _longest_edge(forest: BisectionForest, vertices: IntArray, where: FloatArray) -> FloatArray:
    """Longest edge (k,) of the leaves around each of the sorted vertices."""
    corners = forest.simplices[forest.leaves()].astype(np.int64)
    corners = corners[np.isin(corners, vertices).any(axis=1)]
    first, second = np.triu_indices(4, 1)
    longest = np.linalg.norm(where[corners[:, first]] - where[corners[:, second]], axis=2).max(axis=1, initial=0.0)
    out = np.zeros(forest.node_rows)
    np.maximum.at(out, corners.ravel(), np.repeat(longest, 4))
    return np.asarray(out[vertices])


def _face_vertices(forest: BisectionForest, faces: IntArray) -> IntArray:
    """Vertices (f, 3) of faces (f, 2), cell and place, in any order."""
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
    return np.asarray(forest.simplices[faces[:, 0]].astype(np.int64)[np.arange(len(faces))[:, None], others[faces[:, 1]]])


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1), np.finfo(float).tiny)[:, None])
