"""Rotations in three dimensions."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray


def rotation_matrix(vector: FloatArray) -> FloatArray:
    """Return the rotation matrix (3, 3) of a rotation vector, rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    k = _cross_matrix(vector / angle)
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k))


def left_jacobian(vector: FloatArray) -> FloatArray:
    """Return J (3, 3): a change d of a rotation vector turns what it has rotated by a further ``J d`` (Chirikjian 2011, eq. 10.86)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-6:
        return np.asarray(np.eye(3) + 0.5 * _cross_matrix(vector))
    k = _cross_matrix(vector / angle)
    return np.asarray(np.eye(3) + (1.0 - np.cos(angle)) / angle * k + (1.0 - np.sin(angle) / angle) * (k @ k))


def _cross_matrix(vector: FloatArray) -> FloatArray:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
