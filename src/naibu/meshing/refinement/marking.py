# mypy: disallow-untyped-decorators=False
"""Criteria of refinement and coarsening: stretch of edges, nearness of a contact, bending of the surface, estimated errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from naibu._numba.compilation import njit
from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.meshing.refinement.forest import BisectionForest, LeafMesh


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Leaves to bisect, and leaves whose last bisection may be undone.

    Attributes
    ----------
    refine, coarsen : ndarray, shape (m,), bool
        In the order of `LeafMesh.cells`.
    """

    refine: BoolArray
    coarsen: BoolArray

    def __or__(self, other: Marks) -> Marks:
        """Refine what either refines, and coarsen what both coarsen."""
        return Marks(self.refine | other.refine, self.coarsen & other.coarsen)


class Criterion(Protocol):
    """What decides where a mesh is refined and coarsened."""

    def marks(self, forest: BisectionForest, leaf: LeafMesh, displacement: FloatArray) -> Marks:
        """Return the marks of the leaves, of a displacement (n, d), mm, of the vertices of `leaf`."""


@dataclass(frozen=True, slots=True)
class EdgeStretch:
    """Refine cells with an edge whose length L exceeds that at rest, L0, by a factor :cite:p:`hirai2008` (chapter 4.2).

    Attributes
    ----------
    refine_above : float
        Cells with an edge of a larger L / L0 are refined.
    coarsen_below : float
        Cells all of whose edges have a smaller L / L0 may be coarsened; the gap to `refine_above` keeps cells from being refined and
        coarsened in turn.
    compression : bool
        Whether shortening by the same factor counts alike.
    surface_only : bool
        Whether only cells with a face on the boundary are refined.

    Raises
    ------
    InputError
        Not 1 <= coarsen_below < refine_above.
    """

    refine_above: float = 1.05
    coarsen_below: float = 1.02
    compression: bool = False
    surface_only: bool = False

    def __post_init__(self) -> None:
        _require_hysteresis("coarsen_below", self.coarsen_below, "refine_above", self.refine_above, 1.0)

    def marks(self, forest: BisectionForest, leaf: LeafMesh, displacement: FloatArray) -> Marks:
        """Return the marks of the leaves; see `Criterion`."""
        stretch = edge_stretches(leaf.mesh.points, leaf.mesh.cells, displacement, self.compression)
        refine = stretch > self.refine_above
        if self.surface_only:
            refine &= (forest.neighbours[leaf.cells] < 0).any(axis=1)
        return Marks(refine, stretch < self.coarsen_below)


@dataclass(frozen=True, slots=True)
class NearContact:
    """Refine cells that come near a body.

    Attributes
    ----------
    distance : callable
        Signed distance (k,), mm, of positions (k, d), mm, from the body's surface.
    within_mm : float
        Cells that reach nearer than this are refined.
    beyond_mm : float
        Cells that do not reach nearer than this may be coarsened.

    Raises
    ------
    InputError
        Not 0 <= within_mm < beyond_mm.
    """

    distance: Callable[[FloatArray], FloatArray]
    within_mm: float
    beyond_mm: float

    def __post_init__(self) -> None:
        _require_hysteresis("within_mm", self.within_mm, "beyond_mm", self.beyond_mm, 0.0)

    def marks(self, forest: BisectionForest, leaf: LeafMesh, displacement: FloatArray) -> Marks:
        """Return the marks of the leaves; see `Criterion`."""
        corners = (leaf.mesh.points + displacement)[leaf.mesh.cells]
        centre = corners.mean(axis=1)
        reach = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
        gap = self.distance(centre) - reach
        return Marks(gap < self.within_mm, gap > self.beyond_mm)


@dataclass(frozen=True, slots=True)
class SurfaceBending:
    """Refine cells at the boundary where the deformation bends it: where the angle between neighbouring faces changes.

    Attributes
    ----------
    refine_above, coarsen_below : float
        Change of the angle between the normals of two faces that share an edge (a vertex, in 2-D) from that at rest, rad.

    Raises
    ------
    InputError
        Not 0 <= coarsen_below < refine_above.
    """

    refine_above: float
    coarsen_below: float

    def __post_init__(self) -> None:
        _require_hysteresis("coarsen_below", self.coarsen_below, "refine_above", self.refine_above, 0.0)

    def marks(self, forest: BisectionForest, leaf: LeafMesh, displacement: FloatArray) -> Marks:
        """Return the marks of the leaves; see `Criterion`."""
        across = forest.neighbours[leaf.cells] < 0
        cell, place = np.nonzero(across)
        number = np.full(forest.node_rows, -1)
        number[leaf.nodes] = np.arange(len(leaf.nodes))
        corners = number[forest.simplices[leaf.cells[cell]]]
        k = corners.shape[1]
        keep = np.array([[j for j in range(k) if j != i] for i in range(k)])[place]
        faces, opposite = np.take_along_axis(corners, keep, axis=1), corners[np.arange(len(cell)), place]
        first, second = _adjacent(faces)
        points = leaf.mesh.points
        angles = [_angle(_normals(p, faces, opposite), first, second) for p in (points, points + displacement)]
        change = np.zeros(len(leaf.cells))
        for side in (first, second):
            np.maximum.at(change, cell[side], np.abs(angles[1] - angles[0]))
        return Marks(change > self.refine_above, change < self.coarsen_below)


@dataclass(frozen=True, slots=True)
class AnyOf:
    """Refine where one of several criteria refines, and coarsen where all coarsen.

    Attributes
    ----------
    criteria : tuple of Criterion
        At least one.
    """

    criteria: tuple[Criterion, ...]

    def marks(self, forest: BisectionForest, leaf: LeafMesh, displacement: FloatArray) -> Marks:
        """Return the marks of the leaves; see `Criterion`."""
        marks = self.criteria[0].marks(forest, leaf, displacement)
        for criterion in self.criteria[1:]:
            marks = marks | criterion.marks(forest, leaf, displacement)
        return marks


def doerfler_marks(indicators: ArrayLike, fraction: float = 0.5) -> BoolArray:
    """Return the smallest set of cells (m,) that holds a fraction of the sum of the squared indicators :cite:p:`doerfler1996`.

    Parameters
    ----------
    indicators : array_like, shape (m,)
        Error indicators of the cells, none negative.
    fraction : float
        In (0, 1].

    Raises
    ------
    InputError
        A fraction outside of (0, 1], or indicators that are negative or not finite.
    """
    eta = np.asarray(indicators, dtype=float)
    if not 0.0 < fraction <= 1.0:
        raise InputError(f"fraction must be above 0 and at most 1, not {fraction:g}")
    if eta.ndim != 1 or not (np.isfinite(eta) & (eta >= 0.0)).all():
        raise InputError("indicators must be numbers (m,) that are finite and not negative")
    order = np.argsort(-eta, kind="stable")
    sums = np.cumsum(eta[order] ** 2)
    marked = np.zeros(len(eta), dtype=bool)
    if len(eta) and sums[-1] > 0.0:
        marked[order[: int(np.searchsorted(sums, fraction * sums[-1] * (1.0 - 1e-12))) + 1]] = True
    return marked


@njit(cache=True)
def edge_stretches(points, cells, displacement, compression):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the largest L / L0 (m,) of the edges of every cell, or L0 / L where that is larger and `compression` counts."""
    out = np.zeros(len(cells))
    for c in range(len(cells)):
        for i in range(cells.shape[1]):
            for j in range(i):
                p, q = cells[c, i], cells[c, j]
                before, after = 0.0, 0.0
                for a in range(points.shape[1]):
                    d = points[q, a] - points[p, a]
                    e = d + displacement[q, a] - displacement[p, a]
                    before += d * d
                    after += e * e
                ratio = after / before
                if compression and ratio < 1.0:
                    ratio = 1.0 / max(ratio, 1e-300)
                out[c] = max(out[c], ratio)
    return np.sqrt(out)


def _require_hysteresis(low_name: str, low: float, high_name: str, high: float, least: float) -> None:
    if not least <= low < high:
        raise InputError(f"{low_name} must be at least {least:g} and below {high_name}, not {low:g} with {high_name} {high:g}")


def _adjacent(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return the pairs of faces (f, d) that share a ridge; where more than two do, neighbours in the order of the faces."""
    d = faces.shape[1]
    ridges = np.sort(np.concatenate([np.delete(faces, i, axis=1) for i in range(d)]), axis=1)
    owner = np.tile(np.arange(len(faces)), d)
    order = np.lexsort(ridges.T)
    same = (np.diff(ridges[order], axis=0) == 0).all(axis=1)
    return owner[order[:-1][same]], owner[order[1:][same]]


def _normals(points: FloatArray, faces: IntArray, opposite: IntArray) -> FloatArray:
    """Return the unit normals (f, d) that point away from the opposite vertex of the cell."""
    edges = points[faces[:, 1:]] - points[faces[:, :1]]
    normal = np.cross(edges[:, 0], edges[:, 1]) if points.shape[1] == 3 else edges[:, 0] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    inward = ((points[opposite] - points[faces[:, 0]]) * normal).sum(axis=1) > 0.0
    normal[inward] *= -1.0
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def _angle(normals: FloatArray, first: IntArray, second: IntArray) -> FloatArray:
    sine = np.linalg.norm(normals[first] - normals[second], axis=1) / 2.0
    return np.asarray(2.0 * np.arcsin(np.minimum(sine, 1.0)))
