"""Rigid transforms of points, rotations, and least-squares registration of corresponding points (:cite:t:`kabsch1976`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, length_of
from naibu.core.errors import InputError

ORTHOGONAL = 1e-6  # largest entry of R^T R - I of a matrix that is taken for a rotation
FILLING_STEPS = 30  # repetitions of a registration with missing coordinates; they converge linearly


@dataclass(frozen=True, slots=True, eq=False)
class RigidTransform:
    """Rigid transform ``x = rotation @ (X - centre) + position`` in two or three dimensions.

    Attributes
    ----------
    rotation : ndarray, shape (d, d)
        Rotation matrix.
    centre : ndarray, shape (d,)
        Centre of rotation, mm.
    position : ndarray, shape (d,)
        Image of the centre, mm; the translation where the centre is the origin.
    """

    rotation: FloatArray
    centre: FloatArray
    position: FloatArray

    @classmethod
    def of(cls, rotation: ArrayLike, translation: ArrayLike) -> RigidTransform:
        """Return ``x = rotation @ X + translation``.

        Raises
        ------
        InputError
            Shapes other than (d, d) and (d,) with d = 2 or 3, or a matrix that is not a rotation.
        """
        r, t = np.array(rotation, dtype=np.float64), np.array(translation, dtype=np.float64)
        if r.shape not in ((2, 2), (3, 3)) or t.shape != (len(r),):
            raise InputError(f"rotation and translation must have shapes (d, d) and (d,), d = 2 or 3, not {r.shape} and {t.shape}")
        if not (np.isfinite(t).all() and np.abs(r.T @ r - np.eye(len(r))).max() <= ORTHOGONAL and np.linalg.det(r) > 0.0):
            raise InputError(
                f"rotation must be an orthogonal matrix of determinant 1, translation finite; got {r.tolist()} and {t.tolist()}"
            )
        return cls(r, np.zeros(len(r)), t)

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> RigidTransform:
        """Return the transform of a homogeneous matrix (d + 1, d + 1), mm.

        Raises
        ------
        InputError
            Another shape, or a matrix that is not rigid.
        """
        m = np.asarray(matrix, dtype=np.float64)
        if m.shape not in ((3, 3), (4, 4)) or m[-1].tolist() != [0.0] * (len(m) - 1) + [1.0]:
            raise InputError(f"matrix of a rigid transform must be (3, 3) or (4, 4) with a last row of 0, ..., 0, 1; got {m.tolist()}")
        return cls.of(m[:-1, :-1], m[:-1, -1])

    @classmethod
    def identity(cls, dimension: int = 3) -> RigidTransform:
        """Return the identity."""
        return cls(np.eye(dimension), np.zeros(dimension), np.zeros(dimension))

    @property
    def translation(self) -> FloatArray:
        """Image of the origin (d,), mm: t of ``x = R X + t``."""
        return np.asarray(self.position - self.rotation @ self.centre)

    @property
    def matrix(self) -> FloatArray:
        """Homogeneous matrix (d + 1, d + 1), mm."""
        out = np.eye(len(self.rotation) + 1)
        out[:-1, :-1], out[:-1, -1] = self.rotation, self.translation
        return out

    @property
    def angle_deg(self) -> float:
        """Rotation angle, degrees, between 0 and 180."""
        r = self.rotation
        if len(r) == 2:
            return float(np.degrees(abs(np.arctan2(r[1, 0], r[0, 0]))))
        sine = 0.5 * np.linalg.norm((r - r.T)[[2, 0, 1], [1, 2, 0]])
        return float(np.degrees(np.arctan2(sine, 0.5 * (np.trace(r) - 1.0))))

    def applied(self, points: ArrayLike) -> FloatArray:
        """Return the images (..., d) of points (..., d), mm."""
        return np.asarray((np.asarray(points, dtype=np.float64) - self.centre) @ self.rotation.T + self.position)

    def displacement(self, points: ArrayLike) -> FloatArray:
        """Return the displacement (..., d) of points (..., d), mm."""
        p = np.asarray(points, dtype=np.float64)
        return np.asarray(self.applied(p) - p)

    def inverse(self) -> RigidTransform:
        """Return the inverse transform."""
        return RigidTransform(self.rotation.T, self.position, self.centre)

    def composed(self, first: RigidTransform) -> RigidTransform:
        """Return the transform that applies `first`, then this one."""
        return RigidTransform(self.rotation @ first.rotation, first.centre, self.applied(first.position))

    def moved(self, change: FloatArray) -> RigidTransform:
        """Return the transform after a further translation ``change[:3]``, mm, and rotation about `position` by ``change[3:]``, rad."""
        return RigidTransform(rotation_matrix(change[3:]) @ self.rotation, self.centre, self.position + change[:3])


def rotation_matrix(vector: FloatArray) -> FloatArray:
    """Return the rotation matrix (3, 3) of a rotation vector, rad, by Rodrigues' formula."""
    angle = length_of(vector)
    if angle == 0.0:
        return np.eye(3)
    k = _cross_matrix(vector / angle)
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k))


def rotation_between(start: FloatArray, stop: FloatArray) -> FloatArray:
    """Return the rotation matrix (3, 3) that takes one unit vector (3,) to another by the smallest angle."""
    across = np.cross(start, stop)
    sine = float(np.linalg.norm(across))
    if sine == 0.0:  # alike, or opposite: then about any axis across
        across = np.cross(start, np.eye(3)[np.argmin(np.abs(start))])
        sine = float(np.linalg.norm(across))
        return rotation_matrix(across * ((0.0 if start @ stop > 0.0 else np.pi) / sine))
    return rotation_matrix(across * (np.arctan2(sine, start @ stop) / sine))


def left_jacobian(vector: FloatArray) -> FloatArray:
    """Return the left Jacobian J (3, 3) of a rotation vector v, rad (:cite:p:`chirikjian2011`).

    To first order in d it is ``R(v + d) = R(J d) R(v)``.
    """
    angle = float(np.linalg.norm(vector))
    if angle < 1e-6:
        return np.asarray(np.eye(3) + 0.5 * _cross_matrix(vector))
    k = _cross_matrix(vector / angle)
    return np.asarray(np.eye(3) + (1.0 - np.cos(angle)) / angle * k + (1.0 - np.sin(angle) / angle) * (k @ k))


def _cross_matrix(vector: FloatArray) -> FloatArray:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def registration(points: FloatArray, measured: FloatArray) -> RigidTransform:
    """Return the rigid transform that maps points onto measured positions, some coordinates of which may be missing, by least squares.

    Missing coordinates are filled with those of the transformed points and the fit is repeated.

    Parameters
    ----------
    points : ndarray, shape (k, 3)
        mm.
    measured : ndarray, shape (k, 3)
        Corresponding positions, mm; NaN where a coordinate is missing.
    """
    seen = np.isfinite(measured)
    whole = seen.all(axis=1)
    transform = _kabsch(points[whole], measured[whole])
    if whole.all():
        return transform
    some = seen.any(axis=1)
    for _ in range(FILLING_STEPS):
        filled = np.where(seen, measured, transform.applied(points))
        transform = _kabsch(points[some], filled[some])
    return transform


def _kabsch(points: FloatArray, measured: FloatArray) -> RigidTransform:
    """Least-squares rigid transform of complete points; its centre is their mean."""
    centre, position = points.mean(axis=0), measured.mean(axis=0)
    u, _, vt = np.linalg.svd((measured - position).T @ (points - centre))
    return RigidTransform(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt, centre, position)
