"""Point location in a mesh, and the interpolation operator of nodal values at points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array, identity
from scipy.spatial import cKDTree

from naibu.core.arrays import FloatArray, IntArray, as_points
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing._point_location_kernels import count_bins, list_bins, search_bins, search_nearest, weights_at
from naibu.meshing.quality import mean_edge_length

# A point outside a cell by this fraction of its size still counts as inside: rounding must not open gaps between neighbours.
_SLACK = 1e-9
# Nearest nodes of a point outside the mesh whose cells are candidates.
_NEAR_NODES = 8
_BLOCK = 256  # points located at a time
# Bins of the search grid for each cell at most: bounds memory on slender meshes.
_BINS_PER_CELL = 2.0


class Location(NamedTuple):
    """Cells and shape functions of n points in a mesh of k-node cells.

    Attributes
    ----------
    cells : ndarray, shape (n,), int64
        The cell that contains every point, or the nearest one.
    weights : ndarray, shape (n, k)
        Shape functions of the cell's nodes at the point; they sum to 1.
    distance_mm : ndarray, shape (n,)
        Distance from the mesh, mm; 0 inside.
    """

    cells: IntArray
    weights: FloatArray
    distance_mm: FloatArray


def locate(mesh: Mesh, points_mm: ArrayLike, *, tolerance_mm: float | None = None) -> Location:
    """Find the cell that contains every point, and its shape functions there.

    Parameters
    ----------
    mesh : Mesh
        Any mesh without inverted cells.
    points_mm : array_like, shape (n, d)
        Points, mm.
    tolerance_mm : float, optional
        Largest distance of a point outside the mesh; values there are extrapolated from the nearest cell, which is exact for linear fields.
        Default: a tenth of the mean edge length, enough for points between a curved body and its facets.

    Returns
    -------
    Location
        Cells, weights and distances.

    Raises
    ------
    InputError
        Points that are not (n, d) finite numbers, or that lie farther outside than the tolerance: the message lists them.
    """
    points = _checked(points_mm, mesh.dimension)
    if mesh.dimension < 3:
        return _in_simplices(mesh, points, tolerance_mm)
    found = np.full(len(points), -1, dtype=np.int64)
    local = np.zeros((len(points), 3))
    distance = np.zeros(len(points))
    _search(mesh, points, found, local)
    if len(outside := np.flatnonzero(found < 0)):
        found[outside], local[outside], distance[outside] = _nearest(mesh, points[outside])
        _refuse_far(points, distance, 0.1 * mean_edge_length(mesh) if tolerance_mm is None else tolerance_mm)
    weights = np.empty((len(points), mesh.cells.shape[1]))
    weights_at(mesh.cells.shape[1], local, weights)
    return Location(found, weights, distance)


def interpolation_operator(mesh: Mesh, points_mm: ArrayLike, *, tolerance_mm: float | None = None) -> csr_array:
    """Return the sparse interpolation matrix from nodal values to values at points.

    Parameters
    ----------
    mesh, points_mm, tolerance_mm
        See `locate`.

    Returns
    -------
    csr_array, shape (n, mesh.n_points)
        ``operator @ values`` interpolates values (mesh.n_points,) or (mesh.n_points, d) at the n points; every row sums to 1.

    Raises
    ------
    InputError
        See `locate`.
    """
    points = _checked(points_mm, mesh.dimension)
    if np.array_equal(points, mesh.points):  # as of a computed displacement: nothing to search
        return csr_array(identity(len(points), format="csr"))
    return operator_of(mesh, locate(mesh, points, tolerance_mm=tolerance_mm))


def operator_of(mesh: Mesh, location: Location) -> csr_array:
    """Return the interpolation matrix (n, mesh.n_points) of located points."""
    n, k = location.weights.shape
    columns = mesh.cells[location.cells].ravel()
    operator = csr_array((location.weights.ravel(), columns, np.arange(0, n * k + 1, k)), shape=(n, mesh.n_points))
    operator.sort_indices()
    return operator


def _in_simplices(mesh: Mesh, points: FloatArray, tolerance_mm: float | None) -> Location:
    """Locate points among triangles or lines: by brute force, a block of points at a time, as such meshes are small."""
    corners = mesh.points[mesh.cells]
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    edge = float(np.abs(corners[:, 1:] - corners[:, :1]).max(axis=2).mean())
    found, weights = np.empty(len(points), dtype=np.int64), np.empty((len(points), mesh.cells.shape[1]))
    for start in range(0, len(points), _BLOCK):
        here = points[start : start + _BLOCK]
        inner = np.einsum("pmd,mdk->pmk", here[:, None] - corners[None, :, 0], inverse)
        barycentric = np.concatenate([1.0 - inner.sum(axis=2, keepdims=True), inner], axis=2)
        cell = barycentric.min(axis=2).argmax(axis=1)
        found[start : start + _BLOCK], weights[start : start + _BLOCK] = cell, barycentric[np.arange(len(here)), cell]
    inside = np.clip(weights, 0.0, None)
    nearest = np.einsum("pk,pkd->pd", inside / inside.sum(axis=1, keepdims=True), corners[found])
    distance = np.where(weights.min(axis=1) < -_SLACK, np.linalg.norm(points - nearest, axis=1), 0.0)
    _refuse_far(points, distance, 0.1 * edge if tolerance_mm is None else tolerance_mm)
    return Location(found, weights, distance)


def _checked(points_mm: ArrayLike, dimension: int) -> FloatArray:
    """Return the points as (n, d) floats."""
    return np.ascontiguousarray(as_points("points_mm", points_mm, dimension))


def _search(mesh: Mesh, points: FloatArray, found: IntArray, local: FloatArray) -> None:
    """Fill `found` and `local` for the points inside, by a grid of bins that lists the cells touching each bin."""
    corners = mesh.points[mesh.cells]
    low, high = corners.min(axis=1), corners.max(axis=1)
    # Edges of quadratic cells may bulge a little out of the box of their nodes.
    margin = (0.1 if mesh.cell_type == "tetra10" else 1e-8) * (high - low).max(axis=1, keepdims=True)
    boxes = np.concatenate([low - margin, high + margin], axis=1)
    origin, reach = boxes[:, :3].min(axis=0), np.ptp(boxes[:, [0, 1, 2, 3, 4, 5]].reshape(-1, 3), axis=0)
    width = float(np.cbrt(reach.prod() / (_BINS_PER_CELL * mesh.n_cells)))
    dims = np.maximum(np.ceil(reach / width), 1).astype(np.int64)
    first = np.clip(((boxes[:, :3] - origin) / width).astype(np.int64), 0, dims - 1)
    last = np.clip(((boxes[:, 3:] - origin) / width).astype(np.int64), 0, dims - 1)
    counts = np.zeros(int(dims.prod()), dtype=np.int64)
    count_bins(first, last, dims, counts)
    starts = np.concatenate([[0], np.cumsum(counts)])
    members = np.empty(int(starts[-1]), dtype=np.int64)
    list_bins(first, last, dims, starts, members)
    inside = ((points >= origin) & (points <= origin + reach)).all(axis=1)
    at = np.clip(((points - origin) / width).astype(np.int64), 0, dims - 1)
    bins = np.where(inside, at[:, 0] + dims[0] * (at[:, 1] + dims[1] * at[:, 2]), -1)
    search_bins(mesh.points, mesh.cells, boxes, points, bins, starts, members, _SLACK, found, local)


def _nearest(mesh: Mesh, points: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return cell, reference point and distance (mm) of the nearest cell, among those around the nearest nodes."""
    n, k = mesh.cells.shape
    used, order = np.unique(mesh.cells, return_inverse=True)
    _, near = cKDTree(mesh.points[used]).query(points, k=min(_NEAR_NODES, len(used)))
    incidence = csr_array((np.ones(n * k), (order.ravel(), np.repeat(np.arange(n), k))), shape=(len(used), n))
    near = near.reshape(len(points), -1)
    query = csr_array((np.ones(near.size), near.ravel(), np.arange(0, near.size + 1, near.shape[1])), shape=(len(points), len(used)))
    around = (query @ incidence).tocsr()
    found, local, distance = np.zeros(len(points), dtype=np.int64), np.zeros((len(points), 3)), np.zeros(len(points))
    search_nearest(mesh.points, mesh.cells, points, around.indices.astype(np.int64), around.indptr.astype(np.int64), found, local, distance)
    return found, local, distance


def _refuse_far(points: FloatArray, distance: FloatArray, tolerance: float) -> None:
    """Raise an error that lists the points farther from the mesh than the tolerance (mm)."""
    far = np.flatnonzero(distance > tolerance)
    if len(far) == 0:
        return
    listed = "; ".join(f"{i} at {np.round(points[i], 3).tolist()} by {distance[i]:.3g} mm" for i in far[:8])
    more = f" and {len(far) - 8} more" if len(far) > 8 else ""
    raise InputError(
        f"{len(far)} of {len(points)} points lie more than {tolerance:.3g} mm outside the mesh: {listed}{more}; check the frame and unit "
        "of the points, leave these out, or raise tolerance_mm"
    )
