"""Shape and force misfit of the report, S_shape and S_force :cite:p:`hirai2008` (chapter 4.3), with their gradients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.contact import _triangle_kernels as kernels
from naibu.mechanics.contact.triangle_tree import TriangleTree


@dataclass(frozen=True, slots=True, eq=False)
class Closest:
    """Closest points of a surface for k points, with signed distances.

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

    signed: FloatArray
    triangle: IntArray
    weights: FloatArray
    direction: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ShapeDifference:
    """Shape misfit S_shape of the report at one time.

    Attributes
    ----------
    total : float
        Sum of the distances that count, mm.
    gradient : ndarray, shape (n, 3)
        Derivative of `total` with respect to the positions of the nodes.
    distance : ndarray, shape (k,)
        Of every captured point, mm.
    counted : ndarray, shape (k,), bool
        Which distances count: those not below the sensor's error.
    """

    total: float
    gradient: FloatArray
    distance: FloatArray
    counted: BoolArray


def closest_points(points: ArrayLike, hull: TriangleTree, positions: ArrayLike) -> Closest:
    """Return the closest points of a deformed surface, exactly.

    Parameters
    ----------
    points : array_like, shape (k, 3)
        mm.
    hull : TriangleTree
        The surface.
    positions : array_like, shape (n, 3)
        Deformed positions of its nodes, mm.

    Raises
    ------
    InputError
        Points of another shape, or NaN.
    """
    asked = checked_points(points, "points")
    deformed = np.ascontiguousarray(positions, dtype=float)
    if np.isnan(deformed).any():
        raise InputError(f"{int(np.isnan(deformed).any(axis=1).sum())} nodes have positions that are NaN; the computed motion diverged")
    boxes = hull.boxes(deformed)
    k = len(asked)
    found = Closest(np.empty(k), np.zeros(k, dtype=np.int64), np.empty((k, 3)), np.empty((k, 3)))
    kernels.closest(
        asked, deformed, hull.triangles, hull.order, hull.start, boxes, found.signed, found.triangle, found.weights, found.direction
    )
    return found


def checked_points(points: ArrayLike, what: str) -> FloatArray:
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


def shape_difference(points: ArrayLike, hull: TriangleTree, positions: ArrayLike, *, threshold_mm: float = 0.5) -> ShapeDifference:
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


def force_difference(measured: ArrayLike, computed: ArrayLike) -> tuple[float, FloatArray]:
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
