"""The least principal stretch of tetrahedra: the smallest root of a cubic in closed form :cite:p:`smith1961`."""

import math

import numpy as np

from naibu._numba.compilation import njit


@njit(cache=True)
def least_of_cells(positions, cells, inverse, watched, place):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the least principal stretch of cells (m, 4), and set the place (3,) of that cell; `watched` where none is below that.

    Of inverted cells it is negative. `inverse` (m, 3, 3) holds the inverses of the matrices of edges at rest.
    """
    least, found = watched, -1
    edges, f = np.empty((3, 3)), np.empty((3, 3))
    for cell in range(len(cells)):
        for k in range(3):
            for a in range(3):
                edges[k, a] = positions[cells[cell, k + 1], a] - positions[cells[cell, 0], a]
        squares = 0.0
        for i in range(3):
            for a in range(3):
                f[i, a] = inverse[cell, i, 0] * edges[0, a] + inverse[cell, i, 1] * edges[1, a] + inverse[cell, i, 2] * edges[2, a]
                squares += f[i, a] * f[i, a]
        volume = (
            f[0, 0] * (f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1])
            + f[0, 1] * (f[1, 2] * f[2, 0] - f[1, 0] * f[2, 2])
            + f[0, 2] * (f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0])
        )
        if 2.0 * volume >= least * squares:  # the product of the two other stretches is at most half of the sum of all squares
            continue
        stretch = _least_stretch(f, squares)
        stretch = -stretch if volume < 0.0 else stretch
        if stretch < least:
            least, found = stretch, cell
    if found >= 0:
        for a in range(3):
            place[a] = 0.0
            for k in range(4):
                place[a] += 0.25 * positions[cells[found, k], a]
    return least


@njit(cache=True)
def _least_stretch(f, squares):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the least singular value of a matrix (3, 3) whose squares have a sum."""
    third = squares / 3.0
    xx = f[0, 0] * f[0, 0] + f[0, 1] * f[0, 1] + f[0, 2] * f[0, 2] - third
    yy = f[1, 0] * f[1, 0] + f[1, 1] * f[1, 1] + f[1, 2] * f[1, 2] - third
    zz = f[2, 0] * f[2, 0] + f[2, 1] * f[2, 1] + f[2, 2] * f[2, 2] - third
    xy = f[0, 0] * f[1, 0] + f[0, 1] * f[1, 1] + f[0, 2] * f[1, 2]
    xz = f[0, 0] * f[2, 0] + f[0, 1] * f[2, 1] + f[0, 2] * f[2, 2]
    yz = f[1, 0] * f[2, 0] + f[1, 1] * f[2, 1] + f[1, 2] * f[2, 2]
    spread = math.sqrt((xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if spread <= 1e-12 * third:
        return math.sqrt(third)
    half = 0.5 * (xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz))
    ratio = min(max(half / spread**3, -1.0), 1.0)
    return math.sqrt(max(third + 2.0 * spread * math.cos((math.acos(ratio) + 2.0 * math.pi) / 3.0), 0.0))
