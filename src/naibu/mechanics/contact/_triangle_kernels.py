# mypy: disallow-untyped-decorators=False
"""Numba kernels of closest points on triangles, found in a tree of bounding boxes :cite:p:`ericson2005`."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, IntArray

Triple = tuple[float, float, float]

STACK = 128  # depth of a tree of more triangles than fit in memory
_TIE = 1e-9  # fraction of a squared distance within which two triangles are as near as each other: they meet in the closest point


@njit(cache=True)
def fit_boxes(positions: FloatArray, triangles: IntArray, order: IntArray, start: IntArray, boxes: FloatArray) -> None:
    """Fill the boxes (nodes, 6), low and high corner, of a complete tree; node k has the triangles order[start[k, 0] : start[k, 1]]."""
    nodes = len(start)
    for k in range(nodes - 1, -1, -1):
        if 2 * k + 1 < nodes:
            for a in range(3):
                boxes[k, a] = min(boxes[2 * k + 1, a], boxes[2 * k + 2, a])
                boxes[k, 3 + a] = max(boxes[2 * k + 1, 3 + a], boxes[2 * k + 2, 3 + a])
            continue
        boxes[k, :3], boxes[k, 3:] = np.inf, -np.inf
        for t in range(start[k, 0], start[k, 1]):
            for corner in range(3):
                for a in range(3):
                    value = positions[triangles[order[t], corner], a]
                    boxes[k, a] = min(boxes[k, a], value)
                    boxes[k, 3 + a] = max(boxes[k, 3 + a], value)


@njit(cache=True)
def _dot(a: Triple, b: Triple) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _minus(a: Triple, b: Triple) -> Triple:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True)
def _weights(p: Triple, a: Triple, b: Triple, c: Triple) -> Triple:
    """Return the barycentric weights of the point of a triangle that is closest to p (Ericson, Real-Time Collision Detection, 5.1.5)."""
    ab, ac, ap, bp, cp = _minus(b, a), _minus(c, a), _minus(p, a), _minus(p, b), _minus(p, c)
    d1, d2, d3, d4, d5, d6 = _dot(ab, ap), _dot(ac, ap), _dot(ab, bp), _dot(ac, bp), _dot(ab, cp), _dot(ac, cp)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        return 1.0, 0.0, 0.0
    if d3 >= 0.0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        share = d1 / (d1 - d3)
        return 1.0 - share, share, 0.0
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        share = d2 / (d2 - d6)
        return 1.0 - share, 0.0, share
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        share = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 0.0, 1.0 - share, share
    v, w = vb / (va + vb + vc), vc / (va + vb + vc)
    return 1.0 - v - w, v, w


@njit(cache=True)
def _gap(p: Triple, box: FloatArray) -> float:
    """Return the squared distance of a point from a box."""
    total = 0.0
    for a in range(3):
        lack = max(box[a] - p[a], p[a] - box[3 + a], 0.0)
        total += lack * lack
    return total


@njit(cache=True)
def _normal(a: Triple, b: Triple, c: Triple) -> Triple:
    u, w = _minus(b, a), _minus(c, a)
    n = (u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0])
    size = max(np.sqrt(_dot(n, n)), 1e-300)
    return n[0] / size, n[1] / size, n[2] / size


@njit(cache=True)
def _at(positions: FloatArray, node: int) -> Triple:
    return positions[node, 0], positions[node, 1], positions[node, 2]


@njit(cache=True)
def closest_point(
    p: Triple, positions: FloatArray, triangles: IntArray, order: IntArray, start: IntArray, boxes: FloatArray,
    stack: IntArray, direction: FloatArray,
) -> tuple[float, int, Triple]:  # fmt: skip
    """Return the signed distance of a point, the closest triangle and the weights of its corners; `direction` (3,) points away from it.

    Of triangles that meet in the closest point the one whose plane is farthest from the point tells on which side it is.
    """
    nodes = len(start)
    best, faced, depth = np.inf, -1.0, 1
    signed, triangle, weights = np.inf, -1, (0.0, 0.0, 0.0)
    stack[0] = 0
    while depth:
        depth -= 1
        node = stack[depth]
        if _gap(p, boxes[node]) > best * (1.0 + _TIE):
            continue
        left = 2 * node + 1
        if left < nodes:
            left_last = _gap(p, boxes[left]) <= _gap(p, boxes[left + 1])  # the nearer child is looked into first
            stack[depth], stack[depth + 1] = (left + 1, left) if left_last else (left, left + 1)
            depth += 2
            continue
        for t in range(start[node, 0], start[node, 1]):
            corner = triangles[order[t]]
            a, b, c = _at(positions, corner[0]), _at(positions, corner[1]), _at(positions, corner[2])
            u, v, w = _weights(p, a, b, c)
            away = (
                p[0] - u * a[0] - v * b[0] - w * c[0], p[1] - u * a[1] - v * b[1] - w * c[1], p[2] - u * a[2] - v * b[2] - w * c[2],
            )  # fmt: skip
            square = _dot(away, away)
            if square > best * (1.0 + _TIE):
                continue
            normal = _normal(a, b, c)
            height = _dot(away, normal)
            if square < best * (1.0 - _TIE) or abs(height) > faced:
                faced, distance = abs(height), np.sqrt(square)
                side = 1.0 if height >= 0.0 else -1.0
                signed, triangle, weights = side * distance, order[t], (u, v, w)
                for axis in range(3):
                    direction[axis] = side * away[axis] / distance if distance > 1e-12 else normal[axis]
                best = min(best, square)
    return signed, triangle, weights


@njit(cache=True, nogil=True)
def closest(
    points: FloatArray, positions: FloatArray, triangles: IntArray, order: IntArray, start: IntArray, boxes: FloatArray,
    signed: FloatArray, triangle: IntArray, weights: FloatArray, direction: FloatArray,
) -> None:  # fmt: skip
    """Fill for every point (k, 3) the signed distance, the closest triangle, the weights of its corners and the direction away from it."""
    stack = np.empty(STACK, dtype=np.int64)
    for k in range(len(points)):
        signed[k], triangle[k], found = closest_point(_at(points, k), positions, triangles, order, start, boxes, stack, direction[k])
        weights[k, 0], weights[k, 1], weights[k, 2] = found
