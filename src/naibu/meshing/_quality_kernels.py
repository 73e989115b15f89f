"""Kernel: the smallest angle between faces of tetrahedra."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit


@njit(cache=True)
def largest_cosine(points, cells):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the cosine of the smallest angle between two faces of the tetrahedra."""
    normal, largest = np.empty((4, 3)), -1.0
    for c in range(len(cells)):
        for f in range(4):  # inwards or outwards alike: by corners f + 1, f + 2, f + 3, of alternating orientation
            p, q, r = points[cells[c, (f + 1) % 4]], points[cells[c, (f + 2) % 4]], points[cells[c, (f + 3) % 4]]
            ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
            vx, vy, vz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            scale = (1.0 - 2.0 * (f % 2)) / max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-300)
            normal[f, 0], normal[f, 1], normal[f, 2] = scale * nx, scale * ny, scale * nz
        for f in range(4):
            for g in range(f):
                cosine = -(normal[f, 0] * normal[g, 0] + normal[f, 1] * normal[g, 1] + normal[f, 2] * normal[g, 2])
                largest = max(largest, cosine)
    return largest
