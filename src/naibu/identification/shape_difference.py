"""How far captured points and forces lie from computed ones: S_shape and S_force of the report, and their gradients (spec L6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from naibu.core.errors import InputError
from naibu.identification import _hull_kernels as kernels
from naibu.mechanics.lattice import Lattice

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_FACES = (  # corners of a cube, numbered x fastest, counter-clockwise seen from outside, and the way outwards
    ((0, 4, 6, 2), (-1, 0, 0)),
    ((1, 3, 7, 5), (1, 0, 0)),
    ((0, 1, 5, 4), (0, -1, 0)),
    ((2, 6, 7, 3), (0, 1, 0)),
    ((0, 2, 3, 1), (0, 0, -1)),
    ((4, 5, 7, 6), (0, 0, 1)),
)
_LEAF = 4  # triangles in a leaf of the tree, at most


@dataclass(frozen=True, slots=True, eq=False)
class Hull:
    """The triangulated surface of a lattice, and a tree of its triangles that serves all deformed positions.

    Attributes
    ----------
    triangles : ndarray, shape (t, 3), int64
        Masses, counter-clockwise seen from outside.
    order : ndarray, shape (t,), int64
        Triangles in the order of the leaves.
    start : ndarray, shape (nodes, 2), int64
        First and past-the-last place in `order` of every node of a complete binary tree.
    """

    triangles: Integers
    order: Integers
    start: Integers

    @classmethod
    def of(cls, triangles: ArrayLike, positions: ArrayLike) -> Hull:
        """Build the tree of triangles (t, 3) from positions at rest (n, 3), mm."""
        corners, points = np.array(triangles, dtype=np.int64), np.asarray(positions, dtype=float)
        centre = points[corners].mean(axis=1)
        levels = max(int(np.ceil(np.log2(max(len(corners) / _LEAF, 1.0)))), 0)
        order, start = np.arange(len(corners)), np.zeros((2 ** (levels + 1) - 1, 2), dtype=np.int64)
        start[0, 1] = len(corners)
        for node in range(2**levels - 1):
            low, high = start[node]
            mine = order[low:high]
            axis = int(np.argmax(np.ptp(centre[mine], axis=0)))
            order[low:high] = mine[np.argsort(centre[mine, axis], kind="stable")]
            middle = (low + high) // 2
            start[2 * node + 1], start[2 * node + 2] = (low, middle), (middle, high)
        return cls(corners, order, start)


@dataclass(frozen=True, slots=True, eq=False)
class Closest:
    """Where k points lie beside a surface.

    Attributes
    ----------
    signed : ndarray, shape (k,)
        Distance, mm; positive outside.
    triangle : ndarray, shape (k,), int64
        The closest triangle.
    weights : ndarray, shape (k, 3)
        Barycentric weights of its corners in the closest point.
    direction : ndarray, shape (k, 3)
        Unit vectors; the closest point plus `signed` times this is the point. Where the surface moves by u, `signed` changes by
        ``-direction . u``.
    """

    signed: Array
    triangle: Integers
    weights: Array
    direction: Array


@dataclass(frozen=True, slots=True, eq=False)
class ShapeDifference:
    """The report's S_shape at one time.

    Attributes
    ----------
    total : float
        Sum of the distances that count, mm.
    gradient : ndarray, shape (n, 3)
        Derivative of `total` with respect to the positions of the masses.
    distance : ndarray, shape (k,)
        Of every captured point, mm.
    counted : ndarray, shape (k,), bool
        Which distances count: those not below the sensor's error.
    """

    total: float
    gradient: Array
    distance: Array
    counted: NDArray[np.bool_]


def hull_of(lattice: Lattice) -> Hull:
    """Return the outer faces of a lattice's cubes as triangles.

    Raises
    ------
    InputError
        A lattice without cubes, such as one made from tetrahedra.
    """
    at = np.rint((lattice.points - lattice.points.min(axis=0)) / lattice.spacing_mm).astype(np.int64)
    ends = at[lattice.elements]
    reach = np.abs(ends[:, 1] - ends[:, 0])
    diagonal = (reach > 0).all(axis=1) & (reach.max(axis=1) == reach.min(axis=1))
    if not diagonal.any():
        raise InputError(
            "the lattice has no space diagonals, hence no cubes whose faces could be its surface; give its triangles to Hull.of"
        )
    cubes, which = np.unique(ends[diagonal].min(axis=1), axis=0, return_index=True)
    sizes = reach[diagonal].max(axis=1)[which]
    filled = np.zeros(at.max(axis=0) + 2, dtype=bool)  # an empty layer behind the last cubes, which index -1 finds too
    for size in np.unique(sizes):
        steps = np.array(list(np.ndindex(size, size, size)))
        filled[tuple((cubes[sizes == size][:, None, :] + steps).reshape(-1, 3).T)] = True
    shape = tuple(at.max(axis=0) + 1)
    number = np.full(shape, -1, dtype=np.int64)
    number[tuple(at.T)] = np.arange(len(at))
    corner_steps = np.array([(a, b, c) for c in (0, 1) for b in (0, 1) for a in (0, 1)])
    corners = number[tuple((cubes[:, None, :] + sizes[:, None, None] * corner_steps).reshape(-1, 3).T)].reshape(-1, 8)
    triangles = []
    for face, way in _FACES:
        # the finest voxel beyond the middle of the face
        beyond = cubes + np.where(np.array(way) > 0, sizes[:, None], np.where(np.array(way) < 0, -1, sizes[:, None] // 2))
        open_face = ~filled[tuple(beyond.T)]
        a, b, c, d = corners[open_face][:, face].T
        triangles += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    return Hull.of(np.concatenate(triangles), lattice.points)


def closest_points(points: ArrayLike, hull: Hull, positions: ArrayLike) -> Closest:
    """Return the closest points of a deformed surface, exactly.

    Parameters
    ----------
    points : array_like, shape (k, 3)
        mm.
    hull : Hull
        The surface.
    positions : array_like, shape (n, 3)
        Deformed positions of its masses, mm.

    Raises
    ------
    InputError
        Points of another shape, or NaN.
    """
    asked = checked_points(points, "points")
    deformed = np.ascontiguousarray(positions, dtype=float)
    if np.isnan(deformed).any():
        raise InputError(f"{int(np.isnan(deformed).any(axis=1).sum())} masses have positions that are NaN; the computed motion blew up")
    boxes = np.empty((len(hull.start), 6))
    kernels.fit_boxes(deformed, hull.triangles, hull.order, hull.start, boxes)
    k = len(asked)
    found = Closest(np.empty(k), np.zeros(k, dtype=np.int64), np.empty((k, 3)), np.empty((k, 3)))
    kernels.closest(
        asked, deformed, hull.triangles, hull.order, hull.start, boxes, found.signed, found.triangle, found.weights, found.direction
    )
    return found


def checked_points(points: ArrayLike, what: str) -> Array:
    """Return points as an array (k, 3).

    Raises
    ------
    InputError
        Another shape, or NaN.
    """
    asked = np.ascontiguousarray(points, dtype=float)
    if asked.ndim != 2 or asked.shape[1] != 3:
        raise InputError(f"{what} must have the shape (k, 3), not {asked.shape}")
    lost = ~np.isfinite(asked).all(axis=1)
    if lost.any():
        raise InputError(f"{int(lost.sum())} of {len(asked)} {what} hold NaN, the first is number {int(np.argmax(lost))}; leave them out")
    return asked


def shape_difference(points: ArrayLike, hull: Hull, positions: ArrayLike, *, threshold_mm: float = 0.5) -> ShapeDifference:
    """Return S_shape of captured points: the sum of their distances from the deformed surface.

    Parameters
    ----------
    points, hull, positions
        As for `closest_points`.
    threshold_mm : float
        The sensor's error: smaller distances are not counted.

    Raises
    ------
    InputError
        As `closest_points`, or a threshold that is negative.
    """
    if not threshold_mm >= 0.0:
        raise InputError(f"the sensor's error must not be negative, not {threshold_mm:g} mm")
    found = closest_points(points, hull, positions)
    distance = np.abs(found.signed)
    counted = distance >= threshold_mm
    gradient = np.zeros(np.shape(positions))
    push = -(np.sign(found.signed) * counted)[:, None] * found.direction
    np.add.at(gradient, hull.triangles[found.triangle], found.weights[:, :, None] * push[:, None, :])
    return ShapeDifference(float(distance[counted].sum()), gradient, distance, counted)


def force_difference(measured: ArrayLike, computed: ArrayLike) -> tuple[float, Array]:
    """Return S_force, the sum over samples (and sensors) of ``|F_measured - F_computed|``, mN, and its derivative by the computed forces.

    Parameters
    ----------
    measured, computed : array_like, shape (samples, ..., 3)
        Forces at the same times, mN.

    Raises
    ------
    InputError
        Unequal time bases, or NaN.
    """
    seen, ours = np.asarray(measured, dtype=float), np.asarray(computed, dtype=float)
    if seen.shape != ours.shape:
        raise InputError(
            f"the measured forces have shape {seen.shape}, the computed ones {ours.shape}: unequal time bases; resample one to the "
            "other's times"
        )
    for name, values in (("measured", seen), ("computed", ours)):
        if not np.isfinite(values).all():
            raise InputError(f"the {name} forces hold {int((~np.isfinite(values)).sum())} NaN or infinite values; leave these samples out")
    lack = ours - seen
    size = np.linalg.norm(lack, axis=-1)
    return float(size.sum()), np.divide(lack, size[..., None], out=np.zeros_like(lack), where=size[..., None] > 0.0)
