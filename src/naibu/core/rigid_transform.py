"""Rigid poses of an object in a scan, and the least-squares registration of points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.rotation import rotation_matrix


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Rigid pose of the object in a loaded scan: ``x = rotation @ (X - centre) + position``."""

    rotation: FloatArray
    centre: FloatArray
    position: FloatArray

    def applied(self, points: FloatArray) -> FloatArray:
        """Return points (k, 3) of the object's frame in the scan's."""
        return (points - self.centre) @ self.rotation.T + self.position

    def undone(self, points: FloatArray) -> FloatArray:
        """Return points (k, 3) of the scan in the object's frame."""
        return (points - self.position) @ self.rotation + self.centre

    def moved(self, change: FloatArray) -> Pose:
        """Return the pose after a translation ``change[:3]``, mm, and a rotation vector ``change[3:]``, rad."""
        return Pose(rotation_matrix(change[3:]) @ self.rotation, self.centre, self.position + change[:3])


def registration(points: FloatArray, measured: FloatArray) -> Pose:
    """Return the rigid motion that brings `points` (k, 3) closest to `measured` (k, 3), of which single coordinates may be missing.

    Missing coordinates are filled with the moved points and the fit repeated, which converges to the least-squares pose.
    """
    seen = np.isfinite(measured)
    whole = seen.all(axis=1)
    pose = _kabsch(points[whole], measured[whole])
    some = seen.any(axis=1)
    for _ in range(30):
        filled = np.where(seen, measured, pose.applied(points))
        pose = _kabsch(points[some], filled[some])
    return pose


def _kabsch(points: FloatArray, measured: FloatArray) -> Pose:
    """Least-squares rigid motion of complete points (Kabsch 1976; report ch. 3.5)."""
    centre, position = points.mean(axis=0), measured.mean(axis=0)
    u, _, vt = np.linalg.svd((measured - position).T @ (points - centre))
    return Pose(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt, centre, position)
