"""What a cut makes of a surface: pieces, lips, distance from the tool's path, and the groove beneath it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from naibu.core.arrays import BoolArray, FloatArray, IntArray, require_positive
from naibu.core.errors import InputError
from naibu.meshing.cutting.surfaces._search_kernels import distances_from_edges, distances_from_path
from naibu.meshing.cutting.surfaces._surface_kernels import SurfaceArrays
from naibu.meshing.cutting.surfaces.surface_input import LinkedSurface

PARTS = 8  # of an edge at whose ends its distance from the path is measured

NEAR = 1.25  # distances: within this of where the path begins or ends over the surface, so may the cut

FOLDED = 1e-6  # difference of the directions of two lips that are one line

ToolPath = tuple[FloatArray, FloatArray, BoolArray]


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceCut:
    """A cut surface, and how it comes from the one before.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        mm; those of the surface before come first.
    triangles : ndarray, shape (t, 3), int64
        Counterclockwise seen from outside.
    parents : ndarray, shape (t,), int64
        Triangle of the surface before that each is a part of; where an edge was swapped, that of one of the two.
    ends : ndarray, shape (n, 2), int64
        Ends of the edge that a point divides, -1 for others.
    share : ndarray, shape (n,)
        Of that edge from its first end to the point: one half where triangles were bisected, another where no edge led on and the cut
        divided one; 0 for other points.
    source : ndarray, shape (n,), int64
        Point that each was copied from when the cut passed it, itself for others.
    piece : ndarray, shape (t,), int64
        Piece that each triangle belongs to, the one of the largest area first.
    lips : ndarray, shape (l, 2), int64
        Edges of triangles along the cut, in the triangles' direction.
    cut_edges : ndarray, shape (c, 2, 3)
        Edges that were cut, in the order of the cut, mm.
    paths : tuple
        For each contact of the tool: its path on the surface (m, 3), mm, the tip (m, 3), mm, and whether it was over the surface (m,).
    deviation_mm : float
        Largest distance of the cut from the path of the tool on the surface; 0 if there is no cut.
    mean_deviation_mm : float
        Mean distance of the cut from the path, mm.
    missed_mm : float
        Length of the path over the surface with no cut within the distance: nowhere did an edge lead on there; mm.
    bridges : ndarray, shape (b, 3)
        Where the two sides of the cut still hang together although the path goes on: the cut stops inside the surface, or does not reach
        the boundary over which the path leaves, mm.
    repairs : tuple of str
        What was mended of the surface before.
    """

    points: FloatArray
    triangles: IntArray
    parents: IntArray
    ends: IntArray
    share: FloatArray
    source: IntArray
    piece: IntArray
    lips: IntArray
    cut_edges: FloatArray
    paths: tuple[ToolPath, ...]
    deviation_mm: float
    mean_deviation_mm: float
    missed_mm: float
    bridges: FloatArray
    repairs: tuple[str, ...]

    @property
    def n_pieces(self) -> int:
        """Number of pieces."""
        return int(self.piece.max()) + 1

    @property
    def areas_mm2(self) -> FloatArray:
        """Areas of the pieces, mm2."""
        return np.bincount(self.piece, triangle_areas(self.points, self.triangles)).astype(np.float64)

    @property
    def length_mm(self) -> float:
        """Length of the cut, mm."""
        return float(np.linalg.norm(self.cut_edges[:, 1] - self.cut_edges[:, 0], axis=1).sum())

    @property
    def on_surface(self) -> bool:
        """Whether the tool came over the surface."""
        return any(bool(over.any()) for _, _, over in self.paths)

    @property
    def roots(self) -> IntArray:
        """Point (n,) that each point and its copies come from: the same for points of two lips that met."""
        roots = self.source.copy()
        while (roots != roots[roots]).any():
            roots = roots[roots]
        return roots

    @property
    def normals(self) -> FloatArray:
        """Unit normals (n, 3) weighted by areas, the same for points of two lips that met; zero where they cancel."""
        a, b, c = self.points[self.triangles].transpose(1, 0, 2)
        vector, roots = np.cross(b - a, c - a), self.roots
        out = np.zeros_like(self.points)
        for k in range(3):
            np.add.at(out, roots[self.triangles[:, k]], vector)
        size = np.linalg.norm(out, axis=1, keepdims=True)
        return np.asarray(np.divide(out, size, out=np.zeros_like(out), where=size > 1e-300)[roots])


@dataclass(frozen=True, slots=True, eq=False)
class Groove:
    """Walls and floor line of a groove.

    Attributes
    ----------
    points : ndarray, shape (n + f, 3)
        Those of the cut surface, then the points of the floor at the tips of the tool, mm.
    triangles : ndarray, shape (w, 3), int64
        Walls, from the lips down to the floor.
    area_mm2 : float
        Of the walls.
    """

    points: FloatArray
    triangles: IntArray
    area_mm2: float


def triangle_areas(points: FloatArray, triangles: IntArray) -> FloatArray:
    """Return areas (t,), mm2."""
    a, b, c = points[triangles].transpose(1, 0, 2)
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def cut_result(
    before: LinkedSurface, s: SurfaceArrays, edges: IntArray, paths: Sequence[ToolPath], closed: Sequence[bool], distance_mm: float
) -> SurfaceCut:
    """Return what the arrays of a cutter hold, without their room; `closed` are the paths that end where they begin."""
    n, t = int(s.n[0]), int(s.n[1])
    triangles, neighbours = s.triangles[:t].copy(), s.neighbours[:t]
    rows, corner = np.nonzero(neighbours >= 0)
    graph = coo_array((np.ones(len(rows)), (rows, neighbours[rows, corner])), shape=(t, t))
    count, label = connected_components(graph, directed=False)
    points = s.rest[:n].copy()
    order = np.argsort(-np.bincount(label, triangle_areas(points, triangles), minlength=count), kind="stable")
    rank = np.empty(count, dtype=np.int64)
    rank[order] = np.arange(count)
    rows, corner = np.nonzero(neighbours == -2)
    lips = np.stack([triangles[rows, (corner + 1) % 3], triangles[rows, (corner + 2) % 3]], axis=1)
    cut_edges = s.position[edges]
    within = max([distance_mm, *np.linalg.norm(cut_edges[:, 1] - cut_edges[:, 0], axis=1)]) * NEAR
    bridges = _bridges(points, lips, paths, closed, within)
    return SurfaceCut(
        points, triangles, s.parent[:t].copy(), s.ends[:n].copy(), s.share[:n].copy(), s.source[:n].copy(), rank[label], lips, cut_edges,
        tuple(paths), *_deviations(cut_edges, paths), _missed(cut_edges, paths, distance_mm), bridges, before.repairs,
    )  # fmt: skip


def _bridges(points: FloatArray, lips: IntArray, paths: Sequence[ToolPath], closed: Sequence[bool], within_mm: float) -> FloatArray:
    """Ends of the cut inside the surface but for the nearest to each inside end of the path, and where the path leaves without the cut.

    Inside, the lips of a cut turn back on themselves; on the boundary one begins and the other ends.
    """
    before, behind = (np.full(len(points), -1) for _ in range(2))
    behind[lips[:, 0]], before[lips[:, 1]] = lips[:, 1], lips[:, 0]
    nodes = np.flatnonzero((before >= 0) & (behind >= 0))
    one, two = (_directions(points, nodes, other[nodes]) for other in (before, behind))
    tips = points[nodes[np.linalg.norm(one - two, axis=1) < FOLDED]]
    rim, missing = points[(before >= 0) != (behind >= 0)], []
    for (way, _, over), loop in zip(paths, closed, strict=True):
        for end in (0,) if loop else (0, -1):  # what closes a loop ends on its own lip
            gaps = np.linalg.norm(tips - way[end], axis=1)
            if over[end] and gaps.min(initial=np.inf) <= within_mm:
                tips = np.delete(tips, int(gaps.argmin()), axis=0)
        turns = np.flatnonzero(over[1:] != over[:-1])
        for place in way[turns + over[turns + 1]]:  # the first or last point over the surface
            if np.linalg.norm(rim - place, axis=1).min(initial=np.inf) > within_mm:
                missing.append(place)
    return np.concatenate([tips, np.reshape(missing, (-1, 3))])


def _directions(points: FloatArray, nodes: IntArray, others: IntArray) -> FloatArray:
    way = points[others] - points[nodes]
    return np.asarray(way / np.linalg.norm(way, axis=1, keepdims=True))


def _deviations(edges: FloatArray, paths: Sequence[ToolPath]) -> tuple[float, float]:
    """Largest and mean distance (over its length) of the cut from the path, mm."""
    if not len(edges):
        return 0.0, 0.0
    share = np.linspace(0.0, 1.0, PARTS + 1)[:, None, None]
    places = ((1.0 - share) * edges[:, 0] + share * edges[:, 1]).reshape(-1, 3)
    gap = np.full(len(places), np.inf)
    for points, _, _ in paths:
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        gap = np.minimum(gap, distances_from_path(np.ascontiguousarray(points), length, places))
    weights = np.full(PARTS + 1, 1.0 / PARTS)
    weights[[0, -1]] *= 0.5  # the trapezoidal rule
    mean = weights @ gap.reshape(PARTS + 1, -1)
    return float(gap.max()), float(np.average(mean, weights=np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)))


def _missed(edges: FloatArray, paths: Sequence[ToolPath], distance_mm: float) -> float:
    missed = 0.0
    numbers = np.arange(2 * len(edges)).reshape(-1, 2)
    for points, _, over in paths:
        step = np.linalg.norm(np.diff(points, axis=0), axis=1)
        inside = np.flatnonzero(over[1:] & over[:-1])
        gap = distances_from_edges(np.ascontiguousarray(edges.reshape(-1, 3)), numbers, np.ascontiguousarray(points[inside]))
        missed += float(step[inside][gap > distance_mm].sum())
    return missed


def groove(cut: SurfaceCut, depth_mm: float | None = None) -> Groove:
    """Return the groove that the tool leaves: walls from both lips of the cut down to floor points at the tips of the tool.

    Where the cut ends inside the surface, the floor rises to its end. Points on both lips that met share their floor point.

    Parameters
    ----------
    cut : SurfaceCut
        The surface.
    depth_mm : float, optional
        Depth of the floor below the surface, mm, in place of the tips.

    Raises
    ------
    InputError
        There is no cut, or the depth is not positive.
    """
    if not len(cut.lips):
        raise InputError("the surface was not cut, so that there is no groove; check the path and the reach of the tool")
    nodes, place = np.unique(cut.lips, return_inverse=True)
    spots, first, spot = np.unique(np.round(cut.points[nodes], 9), axis=0, return_index=True, return_inverse=True)
    spot = spot.ravel()
    if depth_mm is None:
        paths = [(points[over], tips[over]) for points, tips, over in cut.paths]
        surface, tips = (np.concatenate([p[k] for p in paths]) for k in (0, 1))
        floor = np.stack([_tip(surface, tips, q) for q in spots])
    else:
        floor = spots - require_positive("depth_mm", depth_mm, "mm") * cut.normals[nodes[first]]
    ending = np.bincount(spot, minlength=len(spots)) == 1  # both lips meet in one point
    number = np.where(ending[spot], nodes, len(cut.points) + spot)[place.reshape(-1, 2)]
    a, b = cut.lips.T
    walls = np.concatenate([np.stack([b, a, number[:, 0]], axis=1), np.stack([b, number[:, 0], number[:, 1]], axis=1)])
    distinct = (walls[:, 0] != walls[:, 1]) & (walls[:, 1] != walls[:, 2]) & (walls[:, 2] != walls[:, 0])
    points = np.concatenate([cut.points, floor])
    return Groove(points, walls[distinct], float(triangle_areas(points, walls[distinct]).sum()))


def _tip(surface: FloatArray, tips: FloatArray, q: FloatArray) -> FloatArray:
    """Tip of the tool when it was nearest to a point of the surface."""
    a, e = surface[:-1], np.diff(surface, axis=0)
    f = np.clip(((q - a) * e).sum(axis=1) / np.maximum((e * e).sum(axis=1), 1e-300), 0.0, 1.0)[:, None]
    k = int((((q - a - f * e) ** 2).sum(axis=1)).argmin())
    return np.asarray((1.0 - f[k]) * tips[k] + f[k] * tips[k + 1])
