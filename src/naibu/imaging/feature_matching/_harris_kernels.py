# mypy: disallow-untyped-decorators=False
"""Numba kernels for `naibu.imaging.feature_matching.harris` :cite:p:`harris1988`: the two responses, and their local maxima."""

from __future__ import annotations

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray, BoolArray, IntArray


@njit(cache=True, parallel=True)
def respond(tensor: AnyArray, plane: bool, k: float, out: AnyArray) -> None:
    """Fill out (nz, ny, nx) with ``det M - k tr(M)^2``, or with ``det M / tr M`` where k is negative, of M (6, nz, ny, nx).

    The entries of M are xx, yy, zz, xy, xz, yz; in a plane only x and y count.
    """
    _, nz, ny, nx = tensor.shape
    for row in prange(nz * ny):
        z, y = row // ny, row % ny
        for x in range(nx):
            a, b, d = np.float64(tensor[0, z, y, x]), np.float64(tensor[1, z, y, x]), np.float64(tensor[3, z, y, x])
            det, trace = a * b - d * d, a + b
            if not plane:
                c, e, f = np.float64(tensor[2, z, y, x]), np.float64(tensor[4, z, y, x]), np.float64(tensor[5, z, y, x])
                det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
                trace += c
            if k >= 0.0:
                out[z, y, x] = det - k * trace * trace
            elif trace > 0.0:
                out[z, y, x] = det / trace
            else:
                out[z, y, x] = 0.0


@njit(cache=True)
def peaks(response: AnyArray, allowed: BoolArray, least: float, found: IntArray) -> int:
    """Fill found (m, 3) with the indices x, y, z of local maxima above `least`, and return their number."""
    nz, ny, nx = response.shape
    n = 0
    for z in range(nz):
        for y in range(ny):
            for x in range(nx):
                value = response[z, y, x]
                if not (value > least and allowed[z, y, x]):
                    continue
                highest = True
                for dz in range(-1, 2):
                    for dy in range(-1, 2):
                        for dx in range(-1, 2):
                            k, j, i = z + dz, y + dy, x + dx
                            if k < 0 or j < 0 or i < 0 or k >= nz or j >= ny or i >= nx:
                                continue
                            other = response[k, j, i]
                            # of equal neighbours the first one stays
                            first = dz < 0 or (dz == 0 and (dy < 0 or (dy == 0 and dx < 0)))
                            if other > value or (other == value and first):
                                highest = False
                if highest and n < len(found):
                    found[n, 0], found[n, 1], found[n, 2] = x, y, z
                    n += 1
    return n


@njit(cache=True)
def thin_out(points: AnyArray, reach: float, count: int, keep: BoolArray) -> None:
    """Mark in keep (n,) the points (n, 3), given strongest first, that are further than `reach` from all kept before, up to count."""
    n = len(points)
    low = np.array([points[:, a].min() for a in range(3)])
    high = np.array([points[:, a].max() for a in range(3)])
    cells = np.array([min(int((high[a] - low[a]) / reach) + 1, 512) for a in range(3)])
    size = np.array([max(reach, (high[a] - low[a]) / cells[a] * 1.000001) for a in range(3)])
    head = np.full(cells[0] * cells[1] * cells[2], -1, dtype=np.int64)
    following = np.full(n, -1, dtype=np.int64)
    at = np.empty(3, dtype=np.int64)
    kept = 0
    for p in range(n):
        if kept == count:
            return
        for a in range(3):
            at[a] = min(int((points[p, a] - low[a]) / size[a]), cells[a] - 1)
        free = True
        for i in range(max(at[0] - 1, 0), min(at[0] + 2, cells[0])):
            for j in range(max(at[1] - 1, 0), min(at[1] + 2, cells[1])):
                for k in range(max(at[2] - 1, 0), min(at[2] + 2, cells[2])):
                    q = head[(i * cells[1] + j) * cells[2] + k]
                    while q >= 0 and free:
                        distance = 0.0
                        for a in range(3):
                            distance += (points[p, a] - points[q, a]) ** 2
                        free = distance > reach * reach
                        q = following[q]
        if free:
            keep[p] = True
            kept += 1
            bin_ = (at[0] * cells[1] + at[1]) * cells[2] + at[2]
            following[p] = head[bin_]
            head[bin_] = p
