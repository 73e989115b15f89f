"""Separation of a tetrahedral mesh along faces: nodes are duplicated so that cells hold together by uncut faces only.

Around every node of a cut face, cells that are joined by uncut faces keep one node; each other group of cells gets a copy. So no cell hangs
on another by a mere edge or node, cuts may end inside the body (the nodes of the front have one group), and cuts may cross.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError

LOCAL_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])  # face k is opposite to node k, counterclockwise from outside


@dataclass(frozen=True, slots=True, eq=False)
class FacePairs:
    """Interior faces of a tetrahedral mesh.

    Attributes
    ----------
    cells : ndarray, shape (f, 2), int64
        The two cells that share each face.
    opposite : ndarray, shape (f, 2), int64
        Local number of the node opposite to the face in each of them.
    """

    cells: IntArray
    opposite: IntArray


def face_pairs(cells: IntArray) -> FacePairs:
    """Return the interior faces of tetrahedra (m, 4).

    Raises
    ------
    InputError
        A face that more than two cells share.
    """
    faces = np.sort(cells[:, LOCAL_FACES].reshape(-1, 3), axis=1)
    order = np.lexsort(faces.T)
    same = (faces[order[1:]] == faces[order[:-1]]).all(axis=1)
    if (same[1:] & same[:-1]).any():
        bad = faces[order[1:-1][same[1:] & same[:-1]][0]]
        raise InputError(f"more than two cells share the face with nodes {bad.tolist()}; at most two can: remove duplicate cells")
    first, second = order[:-1][same], order[1:][same]
    return FacePairs(np.stack([first // 4, second // 4], axis=1), np.stack([first % 4, second % 4], axis=1))


def separated(cells: IntArray, pairs: FacePairs, cut: BoolArray, n_points: int) -> tuple[IntArray, IntArray]:
    """Return cells (m, 4) whose nodes are duplicated along cut faces, and of every node (n',) the old node that it stands for.

    Parameters
    ----------
    cells : ndarray, shape (m, 4), int64
        Tetrahedra.
    pairs : FacePairs
        Their interior faces.
    cut : ndarray, shape (f,), bool
        Which of them are cut.
    n_points : int
        Number of nodes; they keep their numbers, copies follow.
    """
    touched = np.zeros(n_points, dtype=bool)
    corners = cells[pairs.cells[cut, 0]][np.arange(int(cut.sum()))[:, None], LOCAL_FACES[pairs.opposite[cut, 0]]]
    touched[corners.ravel()] = True
    around = touched[cells]
    number = np.full(cells.shape, -1, dtype=np.int64)
    number[around] = np.arange(int(around.sum()))
    kept = ~cut & touched[cells[pairs.cells[:, 0]]].any(axis=1)
    joins = _joined_corners(cells, number, FacePairs(pairs.cells[kept], pairs.opposite[kept]))
    size = int(around.sum())
    graph = sp.coo_matrix((np.ones(len(joins), dtype=np.int8), (joins[:, 0], joins[:, 1])), shape=(size, size))
    groups, group = connected_components(graph, directed=False)
    node_of_corner = cells[around]
    node_of_group = np.full(groups, -1, dtype=np.int64)
    first_group = np.full(n_points, -1, dtype=np.int64)
    node_of_group[group] = node_of_corner
    first_group[node_of_group[::-1]] = np.arange(groups)[::-1]
    copies = np.flatnonzero(first_group[node_of_group] != np.arange(groups))
    new_number = node_of_group.copy()
    new_number[copies] = n_points + np.arange(len(copies))
    out = cells.copy()
    out[around] = new_number[group]
    return out, np.concatenate([np.arange(n_points), node_of_group[copies]]).astype(np.int64)


def _joined_corners(cells: IntArray, number: IntArray, kept: FacePairs) -> IntArray:
    """Pairs (j, 2) of corners at one node that an uncut face joins; corners are numbered by `number` (m, 4), -1 elsewhere."""
    rows = np.arange(len(kept.cells))[:, None]
    left = LOCAL_FACES[kept.opposite[:, 0]]
    nodes = cells[kept.cells[:, 0]][rows, left]
    of_left = number[kept.cells[:, 0]][rows, left]
    other, numbers = cells[kept.cells[:, 1]], number[kept.cells[:, 1]]
    at = (other[:, None, :] == nodes[:, :, None]).argmax(axis=2)
    of_right = numbers[rows, at]
    found = of_left >= 0
    return np.stack([of_left[found], of_right[found]], axis=1)


def pieces(volumes: FloatArray, pairs: FacePairs, cut: BoolArray) -> IntArray:
    """Return the number of the piece of every cell (m,): cells that uncut faces join, the piece of the largest volume first."""
    n_cells = len(volumes)
    joined = pairs.cells[~cut]
    graph = sp.coo_matrix((np.ones(len(joined), dtype=np.int8), (joined[:, 0], joined[:, 1])), shape=(n_cells, n_cells))
    count, label = connected_components(graph, directed=False)
    rank = np.empty(count, dtype=np.int64)
    rank[np.argsort(-np.bincount(label, volumes), kind="stable")] = np.arange(count)
    return rank[label]


def smallest_dihedral_angle(points: FloatArray, cells: IntArray) -> float:
    """Return the smallest angle between two faces of a tetrahedron, degrees."""
    corners = points[cells]
    normals = np.stack([np.cross(corners[:, f[1]] - corners[:, f[0]], corners[:, f[2]] - corners[:, f[0]]) for f in LOCAL_FACES], axis=1)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    cosines = -np.einsum("mik,mjk->mij", normals, normals)[:, *np.triu_indices(4, 1)]
    return float(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)).min()))
