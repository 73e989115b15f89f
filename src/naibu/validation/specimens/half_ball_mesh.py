"""Unstructured tetrahedra in a half ball: another mesh than the block-structured ones that models are made of."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.meshing.quality import scaled_jacobians

_GOLDEN = np.pi * (1.0 + 5.0**0.5)
_SWEEPS = 40
_ROUNDS = 300
_LEAST_QUALITY = 0.25  # scaled Jacobian: dihedral angles from about 14 degrees
_SHAKE = 0.08  # of the edge
_FLAT = 1e-9


def unstructured_half_ball(edge: float, *, seed: int = 0) -> Mesh:
    """Return linear tetrahedra in the half ball of radius 1 above z = 0.

    Points on spherical shells (Fibonacci lattices) are joined by Delaunay's triangulation and moved to the centroids of what surrounds
    them; flat tetrahedra, which Delaunay's criterion admits, are removed by moving their corners at random
    :cite:p:`edelsbrunner2000`.

    Parameters
    ----------
    edge : float
        Of the elements.
    seed : int
        Of the random moves.
    """
    random = np.random.default_rng(seed)
    points = _shells(edge)
    outer, base = np.linalg.norm(points, axis=1) > 1.0 - 1e-9, points[:, 2] < _FLAT
    for _ in range(_SWEEPS):
        points = points + 0.5 * np.where((outer | base)[:, None], 0.0, _centroids(points, _joined(points)) - points)
    cells = _joined(points)
    quality = scaled_jacobians(_mesh(points, cells))
    for _ in range(_ROUNDS):
        bad = quality < _LEAST_QUALITY
        if not bad.any():
            break
        corners = np.unique(cells[bad])
        moved = points.copy()
        moved[corners] += _SHAKE * edge * random.standard_normal((len(corners), 3))
        moved = _kept(moved, points, outer, base)
        again = _joined(moved)
        better = scaled_jacobians(_mesh(moved, again))
        if np.sum(better < _LEAST_QUALITY) <= bad.sum():
            points, cells, quality = moved, again, better
    return _mesh(points, cells)


def _shells(edge: float) -> FloatArray:
    """Return points (n, 3) about an edge apart, on half spheres about an edge apart, whose rims lie in the base."""
    count = round(1.0 / edge)
    found = [np.zeros((1, 3))]
    for k in range(1, count + 1):
        radius = k / count
        rim = max(6, round(2.0 * np.pi * radius / edge))
        turn = 2.0 * np.pi * (np.arange(rim) + 0.5 * (k % 2)) / rim
        found.append(radius * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(rim)]))
        inner = max(1, round(2.0 * np.pi * radius**2 / (edge**2 * np.sqrt(0.75)) - 0.5 * rim))
        i = np.arange(inner) + 0.5
        lowest = min(0.45 * edge / radius, 0.5)
        z = lowest + (1.0 - lowest) * i / inner
        flat, turn = np.sqrt(1.0 - z**2), _GOLDEN * i + k
        found.append(radius * np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z]))
    pole = int(np.argmax(found[-1][:, 2]))  # what lies deepest in a breast is its nipple
    found[-1][pole] = 0.0, 0.0, 1.0
    return np.vstack(found)


def _joined(points: FloatArray) -> IntArray:
    """Return Delaunay's tetrahedra (m, 4) of positive volume; flat ones in the base are left out."""
    cells = Delaunay(points).simplices.astype(np.int64)
    volumes = np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]])
    cells[volumes < 0.0] = cells[volumes < 0.0][:, [1, 0, 2, 3]]
    return np.asarray(cells[np.abs(volumes) > _FLAT])


def _centroids(points: FloatArray, cells: IntArray) -> FloatArray:
    """Return the mean centroid (n, 3) of the tetrahedra around every point, weighted by volume."""
    volumes = np.abs(np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]]))
    moments, weights = np.zeros_like(points), np.zeros(len(points))
    for corner in cells.T:
        np.add.at(moments, corner, volumes[:, None] * points[cells].mean(axis=1))
        np.add.at(weights, corner, volumes)
    return np.asarray(moments / weights[:, None])


def _kept(moved: FloatArray, points: FloatArray, outer: BoolArray, base: BoolArray) -> FloatArray:
    """Return moved points (n, 3) on the surfaces that they belong to; the pole and those of the rim stay."""
    moved[base, 2] = 0.0
    sphere = outer & ~base
    moved[sphere] /= np.linalg.norm(moved[sphere], axis=1)[:, None]
    fixed = (outer & base) | (points[:, 2] > 1.0 - _FLAT)
    moved[fixed] = points[fixed]
    return moved


def _mesh(points: FloatArray, cells: IntArray) -> Mesh:
    return Mesh(points, cells, "tetra", np.zeros(len(cells), dtype=np.int64), ("tissue",))
