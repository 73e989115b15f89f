"""Surfaces of scanners made ready to be cut: what is mended, and what is refused."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from naibu.core.arrays import FloatArray, IntArray, as_points
from naibu.core.errors import InputError
from naibu.meshing.cutting.surfaces._surface_kernels import link

SMALLEST_HEIGHT = 1e-9  # of the extent: flatter triangles are left out


class LinkedSurface(NamedTuple):
    """Points (n, 3), mm, triangles (t, 3), neighbours (t, 3) across the edge opposite to each corner, and sentences on what was mended."""

    points: FloatArray
    triangles: IntArray
    neighbours: IntArray
    repairs: tuple[str, ...]


def linked_surface(points: ArrayLike, triangles: ArrayLike) -> LinkedSurface:
    """Link the triangles of a surface, which may be open; see `SurfaceCutter` for what is mended and refused."""
    p, t = as_points("points", points, 3, least=3), np.asarray(triangles)
    if t.ndim != 2 or t.shape[1] != 3 or not len(t) or not np.issubdtype(t.dtype, np.integer):
        raise InputError(f"triangles must be whole numbers of shape (t, 3) with t > 0, not {t.dtype} of shape {t.shape}")
    t = t.astype(np.int64)
    if t.min() < 0 or t.max() >= len(p):
        raise InputError(f"triangles refer to points {t.min()} to {t.max()}, but the surface has points 0 to {len(p) - 1}")
    repairs: list[str] = []
    p, t = _merged(p, t, repairs)
    t = _without_flat(p, t, repairs)
    neighbours, seams = _linked(t)
    if seams:
        turned = _turned(t)
        if (turned != t).any():
            repairs.append(f"{int((turned != t).any(axis=1).sum())} triangles were turned so that neighbours agree on the outside")
        t = turned
        neighbours, seams = _linked(t)
    if seams:
        repairs.append(f"the surface was opened along {seams} edges that more than two triangles share, or that have one side only")
    p, t = _single_fans(p, t, neighbours, repairs)
    return LinkedSurface(p, t, neighbours, tuple(repairs))


def _merged(points: FloatArray, triangles: IntArray, repairs: list[str]) -> tuple[FloatArray, IntArray]:
    """Merge equal points, which formats without shared points have, and drop those that no triangle uses."""
    used = points[triangles.ravel()] + 0.0
    kept, inverse = np.unique(used, axis=0, return_inverse=True)
    if len(kept) < len(np.unique(triangles)):
        repairs.append(f"{len(np.unique(triangles)) - len(kept)} points that lie where another does were merged")
    return kept, inverse.reshape(-1, 3).astype(np.int64)


def _without_flat(points: FloatArray, triangles: IntArray, repairs: list[str]) -> IntArray:
    a, b, c = points[triangles].transpose(1, 0, 2)
    area2 = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    side = np.sqrt(np.max([((a - b) ** 2).sum(1), ((b - c) ** 2).sum(1), ((c - a) ** 2).sum(1)], axis=0))
    flat = area2 <= SMALLEST_HEIGHT * float(np.ptp(points, axis=0).max()) * side
    whole = triangles[~flat]
    _, first = np.unique(np.sort(whole, axis=1), axis=0, return_index=True)
    if flat.any():
        repairs.append(f"{int(flat.sum())} triangles without area were left out")
    if len(first) < len(whole):
        repairs.append(f"{len(whole) - len(first)} triangles that occur twice were left out")
    if not len(first):
        raise InputError("the surface has no triangle with an area; export it again")
    return np.ascontiguousarray(whole[np.sort(first)])


def _linked(triangles: IntArray) -> tuple[IntArray, int]:
    ends = np.sort(np.stack([triangles[:, [1, 2, 0]].ravel(), triangles[:, [2, 0, 1]].ravel()]), axis=0)
    keys = ends[0] * (int(triangles.max()) + 1) + ends[1]
    neighbours = np.full(triangles.shape, -1, dtype=np.int64)
    return neighbours, int(link(triangles, np.argsort(keys, kind="stable"), keys, neighbours))


def _turned(triangles: IntArray) -> IntArray:
    """Turn triangles so that the two of each edge run along it in opposite directions, as far as the surface has two sides."""
    tails, heads = triangles[:, [1, 2, 0]].ravel(), triangles[:, [2, 0, 1]].ravel()
    keys = np.minimum(tails, heads) * (int(triangles.max()) + 1) + np.maximum(tails, heads)
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.concatenate([[True], np.diff(keys[order]) != 0]))
    pair = starts[np.diff(np.concatenate([starts, [len(order)]])) == 2]
    one, two = order[pair], order[pair + 1]
    same = tails[one] == tails[two]
    n = len(triangles)
    first, second = one // 3, two // 3
    # every triangle twice, as it is and turned: the neighbours that agree hang together
    rows = np.concatenate([np.where(same, first, first), np.where(same, first + n, first + n)])
    columns = np.concatenate([np.where(same, second + n, second), np.where(same, second, second + n)])
    _, label = connected_components(coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * n, 2 * n)), directed=False)
    _, body = connected_components(coo_array((np.ones(len(first)), (first, second)), shape=(n, n)), directed=False)
    _, lead = np.unique(body, return_index=True)
    turned = label[:n] != label[lead][body]
    count = np.bincount(body, turned, minlength=len(lead)) * 2 > np.bincount(body)
    turned ^= count[body]
    return np.where(turned[:, None], triangles[:, [0, 2, 1]], triangles)


def _single_fans(points: FloatArray, triangles: IntArray, neighbours: IntArray, repairs: list[str]) -> tuple[FloatArray, IntArray]:
    """Give vertices whose triangles do not hang together by edges a copy for each group."""
    t, i = np.nonzero(neighbours >= 0)
    u = neighbours[t, i]
    rows, columns = [], []
    for k in (1, 2):
        v = triangles[t, (i + k) % 3]
        rows.append(3 * t + (i + k) % 3)
        columns.append(3 * u + (triangles[u] == v[:, None]).argmax(axis=1))
    n = triangles.size
    graph = coo_array((np.ones(2 * len(t)), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    if count == len(points):
        return points, triangles
    repairs.append(f"{count - len(points)} vertices at which the surface only touches itself were doubled")
    _, first = np.unique(label, return_index=True)
    return points[triangles.ravel()[first]], label.reshape(-1, 3).astype(np.int64)
