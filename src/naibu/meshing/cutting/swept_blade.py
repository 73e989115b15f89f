"""The surface that the edge of a blade sweeps, as triangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform
from naibu.meshing.cutting._crossing_kernels import nearest_triangles

FLAT = 1e-12  # of the square of the extent: area of a triangle that is left out
MOST_TRIANGLES = 100_000


@dataclass(frozen=True, slots=True, eq=False)
class SweptBlade:
    """Triangulated surface that the edge of a blade has passed through.

    Attributes
    ----------
    points : ndarray, shape (v, 3)
        Positions of the edge's vertices in all poses, mm.
    triangles : ndarray, shape (t, 3), int64
        Point numbers, consistently oriented.
    """

    points: FloatArray
    triangles: IntArray

    @property
    def arrays(self) -> tuple[FloatArray, IntArray, FloatArray, FloatArray]:
        """What the kernels read: points, triangles, and the lowest and highest corners (t, 3) of the boxes of the triangles."""
        corners = self.points[self.triangles]
        return self.points, self.triangles, corners.min(axis=1), corners.max(axis=1)

    def __add__(self, other: SweptBlade) -> SweptBlade:
        """Return both surfaces."""
        return SweptBlade(np.concatenate([self.points, other.points]), np.concatenate([self.triangles, other.triangles + len(self.points)]))

    def normals_near(self, points: FloatArray) -> FloatArray:
        """Return the unit normals (k, 3) of the triangles nearest to points (k, 3), mm, from where these are counterclockwise."""
        nearest = np.empty(len(points), dtype=np.int64)
        nearest_triangles(np.ascontiguousarray(points), *self.arrays, nearest)
        a, b, c = self.points[self.triangles[nearest]].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        return np.asarray(normal / np.linalg.norm(normal, axis=1)[:, None])

    @property
    def extent_mm(self) -> float:
        """Largest edge of the box around the surface, mm."""
        return float(np.ptp(self.points, axis=0).max())

    @property
    def area_mm2(self) -> float:
        """Area of the surface, mm2."""
        a, b, c = self.points[self.triangles].transpose(1, 0, 2)
        return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def swept_blade(edges: ArrayLike) -> SweptBlade:
    """Return the surface between successive positions of a blade's edge.

    Parameters
    ----------
    edges : array_like, shape (p, e, 3)
        Position of the e vertices of the edge, a polyline, in each of p poses, mm; at least two of each.

    Raises
    ------
    InputError
        Another shape, NaN, or an edge that sweeps no area: it does not move, or moves along itself.
    """
    positions = np.asarray(edges, dtype=float)
    if positions.ndim != 3 or positions.shape[2] != 3 or min(positions.shape[:2]) < 2:
        raise InputError(f"edges must have shape (poses, vertices, 3) with at least two poses and two vertices, not {positions.shape}")
    bad = np.argwhere(~np.isfinite(positions))
    if len(bad):
        raise InputError(f"edges has a value that is not finite in pose {bad[0][0]}, vertex {bad[0][1]}; remove the pose or mend it")
    p, e = positions.shape[:2]
    if 2 * (p - 1) * (e - 1) > MOST_TRIANGLES:
        raise InputError(f"edges has {p} poses of {e} vertices, whose surface has more than {MOST_TRIANGLES} triangles; give fewer")
    corner = np.arange(p * e).reshape(p, e)
    a, b, c, d = (x.ravel() for x in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int64)
    points = positions.reshape(-1, 3)
    sides = points[triangles[:, 1:]] - points[triangles[:, :1]]
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    kept = area > FLAT * float(np.ptp(points, axis=0).max()) ** 2
    if not kept.any():
        raise InputError("the blade sweeps no area: its edge stands still or moves along itself; give poses that move it sideways")
    return SweptBlade(points, triangles[kept])


def blade_poses(edge: ArrayLike, poses: Sequence[RigidTransform]) -> FloatArray:
    """Return positions (p, e, 3), mm, of an edge (e, 3) carried by rigid poses.

    Raises
    ------
    InputError
        No pose, or an edge that is no polyline in three dimensions.
    """
    vertices = np.asarray(edge, dtype=float)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) < 2:
        raise InputError(f"edge must have shape (e, 3) with at least two vertices, not {vertices.shape}")
    if not poses:
        raise InputError("poses is empty; give at least two")
    return np.stack([pose.applied(vertices) for pose in poses])
