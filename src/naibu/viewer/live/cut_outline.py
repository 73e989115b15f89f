"""The outline of cuts: where the two sides of a cut meet the surface, seen also while the cut is closed."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from naibu.core.arrays import BoolArray, FloatArray, IntArray

NEIGHBOURS = 12  # triangles among which that of the other side is sought
CLOSE = 1e-6  # of the extent: places at rest that are one


def cut_outline(points: FloatArray, faces: IntArray) -> IntArray:
    """Return the edges (e, 2) in which the surface meets the two sides of cuts, each side with edges of its own.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Nodes at rest, mm; cuts have doubled them.
    faces : ndarray, shape (f, 3), int
        Triangles of the surface, counterclockwise seen from outside.
    """
    side = sides_of_cuts(points, faces)
    if not side.any():
        return np.zeros((0, 2), dtype=np.int64)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    of_cut = np.tile(side, 3)
    unique, number = np.unique(edges, axis=0, return_inverse=True)
    count = np.bincount(number)
    cut = np.bincount(number, of_cut)
    return np.asarray(unique[(cut > 0) & (cut < count)])


def sides_of_cuts(points: FloatArray, faces: IntArray) -> BoolArray:
    """Return which triangles (f,) lie on others at rest that look the other way: those of the two sides of cuts."""
    corners = points[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1)
    within = CLOSE * float(np.ptp(points, axis=0).max())
    keys = np.round(points / within).astype(np.int64)
    _, place, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    candidates = np.flatnonzero((count[place.ravel()][faces] > 1).any(axis=1) & (size > 0.0))
    found = np.zeros(len(faces), dtype=bool)
    if len(candidates) < 2:
        return found
    unit = normal[candidates] / size[candidates, None]
    centre = corners[candidates].mean(axis=1)
    _, near = cKDTree(centre).query(centre, k=min(NEIGHBOURS, len(candidates)))
    opposite = np.einsum("ci,cki->ck", unit, unit[near]) < -0.999
    other = corners[candidates][near]  # (c, k, 3, 3)
    flat = np.abs(np.einsum("cki,ci->ck", other[:, :, 0] - centre[:, None], unit)) < 1e3 * within
    inside = np.ones_like(opposite)
    for a in range(3):
        along = other[:, :, (a + 1) % 3] - other[:, :, a]
        across = np.cross(along, centre[:, None] - other[:, :, a])
        inside &= np.einsum("cki,cki->ck", across, unit[near]) >= -within * np.linalg.norm(along, axis=2)
    found[candidates] = (opposite & flat & inside).any(axis=1)
    return found
