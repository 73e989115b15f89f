"""Dense displacement from scattered points by linear interpolation in Delaunay simplices :cite:p:`hirai2008` (chapter 1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import Delaunay, QhullError, cKDTree

from naibu.core.arrays import FloatArray, IntArray, as_points
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform
from naibu.core.volume import Volume
from naibu.imaging.feature_matching._delaunay_kernels import fill_simplices
from naibu.imaging.feature_matching.relaxation_labelling import PotentialMatches
from naibu.imaging.preprocessing.resampling import positions

Outside = Literal["nan", "nearest", "affine"]
# measure of a simplex, as a fraction of the mean one, below which it is flat but for rounding; its voxels belong to neighbours
FLAT = 1e-9


def sparse_displacement(
    matches: PotentialMatches, rigid: RigidTransform | None = None, *, rotation_only: bool = False
) -> DisplacementField:
    """Return the displacement of matched points.

    Parameters
    ----------
    matches : PotentialMatches
        Pairs of points.
    rigid : RigidTransform, optional
        The points are then in the registered frame, ``R x1 + tau``, and the rigid motion is not part of the displacement. By default they
        are at ``x1``, and the displacement is the whole ``x2 - x1``.
    rotation_only : bool
        Remove the rotation and keep the translation, as (1.25) of the report does: points at ``R x1``.

    Returns
    -------
    DisplacementField
        ``u = x2 - (R x1 + tau)`` at the points; the report's ``D = R x1 + tau - x2`` has the opposite sign.

    Raises
    ------
    InputError
        `rotation_only` without `rigid`.
    """
    if rigid is None:
        if rotation_only:
            raise InputError("rotation_only removes the rotation of rigid from the displacement: give the rigid motion")
        return DisplacementField.from_arrays(matches.reference_mm, matches.deformed_mm - matches.reference_mm)
    start = matches.reference_mm @ rigid.rotation.T if rotation_only else rigid.applied(matches.reference_mm)
    return DisplacementField.from_arrays(start, matches.deformed_mm - start)


def elevation_angle(vectors: ArrayLike) -> FloatArray:
    """Return the elevation (n,), rad, of displacements (n, 3), mm, from the xz-plane: ``asin(u_y / |u|)``; zero for zero vectors."""
    u = np.asarray(vectors, dtype=float)
    length = np.linalg.norm(u, axis=1)
    return np.asarray(np.arcsin(np.clip(np.divide(u[:, 1], length, out=np.zeros(len(u)), where=length > 0), -1.0, 1.0)))


@dataclass(frozen=True, slots=True, eq=False)
class Triangulation:
    """Delaunay simplices of the points of a field.

    Attributes
    ----------
    points_mm : ndarray, shape (n, 3)
        Points, mm.
    simplices : ndarray, shape (m, d + 1), int64
        Tetrahedra, or triangles where all points lie in the one slice of a volume.
    """

    points_mm: FloatArray
    simplices: IntArray


def triangulated(points_mm: ArrayLike, grid: Volume) -> Triangulation:
    """Return the Delaunay tetrahedra of points, or triangles where the grid is one slice.

    Parameters
    ----------
    points_mm : array_like, shape (n, 3)
        Points, mm.
    grid : Volume
        Its axes and its number of slices; values do not matter.

    Raises
    ------
    InputError
        Points of another shape or not finite, too few of them, or points that span no simplex.
    """
    p = as_points("points_mm", points_mm, 3)
    d = 2 if grid.shape[0] == 1 else 3
    what = "triangle" if d == 2 else "tetrahedron"
    if len(p) < d + 1:
        raise InputError(f"{len(p)} points make no {what}: {d + 1} matches or more are needed; loosen the thresholds of the matching")
    index = grid.to_index(p)[:, :d] * grid.spacing_mm[:d]
    try:
        cells = Delaunay(index).simplices
    except QhullError as error:
        raise InputError(f"the {len(p)} points span no {what}: they lie in one {'line' if d == 2 else 'plane'}") from error
    return Triangulation(p, np.asarray(cells, dtype=np.int64))


def dense_from_sparse(field: DisplacementField, grid: Volume, *, outside: Outside = "nan") -> DisplacementField:
    """Return the displacement at every voxel by linear interpolation in the Delaunay simplices of points (1.11, 1.12, 1.27).

    Parameters
    ----------
    field : DisplacementField
        Displacement at points, mm; invalid points are left out.
    grid : Volume
        Voxels of the result; a volume of one slice is an image, with triangles.
    outside : {"nan", "nearest", "affine"}
        At voxels outside the convex hull of the points: NaN, the displacement of the nearest point, or the least-squares affine motion of
        all points. `valid` is true inside the hull only.

    Returns
    -------
    DisplacementField
        Displacement, mm; its quality is 1 inside the hull.

    Raises
    ------
    InputError
        Points that span no simplex, an unknown `outside`, or a hull without a voxel in it.
    """
    if outside not in ("nan", "nearest", "affine"):
        raise InputError(f"outside must be 'nan', 'nearest' or 'affine', not {outside!r}")
    # of coincident points Qhull keeps one without saying which
    p, u = _merged(field.points[field.valid], field.vectors[field.valid])
    net = triangulated(p, grid)
    d = net.simplices.shape[1] - 1
    index = grid.to_index(p)[:, :d]
    corners = index[net.simplices]
    edges = corners[:, 1:] - corners[:, :1]
    measures = np.abs(np.linalg.det(edges))
    real = measures > FLAT * measures.mean()
    corners, cells = corners[real], net.simplices[real]
    inverses = np.swapaxes(np.linalg.inv(edges[real]), 1, 2)
    vectors, inside = np.full((*grid.shape, 3), np.nan), np.zeros(grid.shape, dtype=bool)
    fill_simplices(np.ascontiguousarray(corners), np.ascontiguousarray(inverses), u[cells], vectors, inside)
    if not inside.any():
        raise InputError("no voxel of the grid lies among the points of the field: check that both are in one frame, in mm")
    if outside != "nan":
        beyond = positions(grid)[~inside]
        vectors[~inside] = u[cKDTree(p).query(beyond)[1]] if outside == "nearest" else _affine(p, u, beyond)
    return DisplacementField.on_grid(grid, vectors, valid=inside, quality=np.where(inside, 1.0, np.nan))


def _merged(points: FloatArray, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points without duplicates, each with the mean of its vectors."""
    unique, where = np.unique(points, axis=0, return_inverse=True)
    if len(unique) == len(points):
        return points, vectors
    count = np.bincount(where.ravel())
    return unique, np.stack([np.bincount(where.ravel(), v) / count for v in vectors.T], axis=1)


def _affine(points: FloatArray, vectors: FloatArray, at: FloatArray) -> FloatArray:
    """Return the least-squares affine fit to vectors at points, evaluated at other points (k, d)."""
    middle = points.mean(axis=0)
    columns = np.column_stack([np.ones(len(points)), points - middle])
    found = np.linalg.lstsq(columns, vectors, rcond=None)[0]
    return np.asarray(np.column_stack([np.ones(len(at)), at - middle]) @ found)
