"""Kernels: springs and masses of the part of a surface that has changed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, IntArray
from naibu.meshing.cutting.surfaces._surface_kernels import corner, fan


class SpringArrays(NamedTuple):
    """Springs by the numbers of the edges, and masses of the vertices, with room to grow."""

    ends: IntArray  # (e, 2)
    length: FloatArray  # (e,) at rest, mm
    stiffness: FloatArray  # (e,) mN/mm
    damping: FloatArray  # (e,) mN s/mm
    mass: FloatArray  # (v,) kg
    edge_stamp: IntArray  # (e,)
    vertex_stamp: IntArray  # (v,)
    around: IntArray  # (512,)
    last_stamp: IntArray  # (1,)


@njit(cache=True)
def _area(s, t):  # type: ignore[no-untyped-def]  # pragma: no cover
    p, a, b, c = s.rest, s.triangles[t, 0], s.triangles[t, 1], s.triangles[t, 2]
    ux, uy, uz = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
    vx, vy, vz = p[c, 0] - p[a, 0], p[c, 1] - p[a, 1], p[c, 2] - p[a, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return 0.5 * np.sqrt(nx * nx + ny * ny + nz * nz)


@njit(cache=True)
def _set_spring(s, k, t, j, modulus, ratio, printed):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the spring on the edge opposite to corner j."""
    e, u = s.sides[t, j], s.neighbours[t, j]
    a, b = s.triangles[t, (j + 1) % 3], s.triangles[t, (j + 2) % 3]
    x, y, z = s.rest[b, 0] - s.rest[a, 0], s.rest[b, 1] - s.rest[a, 1], s.rest[b, 2] - s.rest[a, 2]
    length2 = x * x + y * y + z * z
    k.ends[e, 0], k.ends[e, 1], k.length[e] = min(a, b), max(a, b), np.sqrt(length2)
    k.stiffness[e] = modulus * (_area(s, t) + (_area(s, u) if u >= 0 else 0.0)) / length2
    critical = 2.0 * np.sqrt(k.stiffness[e] * (k.mass[a] + k.mass[b]))
    k.damping[e] = critical / k.length[e] if printed else ratio * critical


@njit(cache=True)
def update(s, k, modulus, density, ratio, printed):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set masses and springs around the triangles that have changed, and empty their list."""
    k.last_stamp[0] += 1
    stamp = k.last_stamp[0]
    for h in range(s.n[4]):
        for i in range(3):
            v = s.triangles[s.touched[h], i]
            if k.vertex_stamp[v] != stamp:
                k.vertex_stamp[v], k.mass[v] = stamp, 0.0
                for g in range(fan(s, v, k.around)[0]):
                    k.mass[v] += density / 3.0 * _area(s, k.around[g])
    for h in range(s.n[4]):
        s.marked[s.touched[h]] = 0
        for i in range(3):
            v = s.triangles[s.touched[h], i]
            if k.vertex_stamp[v] == stamp:
                k.vertex_stamp[v] = 0  # the springs of each vertex once
                for g in range(fan(s, v, k.around)[0]):
                    t = k.around[g]
                    for j in range(1, 3):
                        at = (corner(s, t, v) + j) % 3
                        if k.edge_stamp[s.sides[t, at]] != stamp:
                            k.edge_stamp[s.sides[t, at]] = stamp
                            _set_spring(s, k, t, at, modulus, ratio, printed)
    s.n[4] = 0
