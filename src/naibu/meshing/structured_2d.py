"""Structured meshes in one and two dimensions: intervals of lines, and rectangles of triangles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from naibu.core.arrays import require_positive
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh

DIAGONALS = ("alternating", "one_way")


def interval(length_mm: float, divisions: int) -> Mesh:
    """Mesh the interval from 0 to `length_mm` with lines of equal length, numbered from left to right.

    Parameters
    ----------
    length_mm : float
        Length, mm.
    divisions : int
        Number of lines.

    Raises
    ------
    InputError
        A length that is not positive, or no division.
    """
    require_positive("length_mm", length_mm)
    if divisions < 1:
        raise InputError(f"divisions must be at least 1, not {divisions}")
    nodes = np.arange(divisions + 1)
    return Mesh.from_arrays(np.linspace(0.0, length_mm, divisions + 1)[:, None], np.stack([nodes[:-1], nodes[1:]], axis=1), "line")


def rectangle(size_mm: Sequence[float], divisions: Sequence[int], *, diagonals: str = "alternating", centred: bool = True) -> Mesh:
    """Mesh a rectangle that stands on y = 0; node (i, j) has number ``i + (nx + 1) j``.

    Parameters
    ----------
    size_mm : sequence of 2 floats
        Width and height, mm.
    divisions : sequence of 2 ints
        Cells across and upwards; each is split into two triangles.
    diagonals : {"alternating", "one_way"}
        Diagonals that alternate between neighbouring cells, or all from lower left to upper right.
    centred : bool
        Whether x = 0 is the middle or the left side.

    Raises
    ------
    InputError
        A size or a number of divisions that is not positive, or an unknown value of `diagonals`.
    """
    (width, height), (nx, ny) = size_mm, divisions
    if not (np.isfinite([width, height]).all() and min(width, height) > 0.0) or min(nx, ny) < 1:
        raise InputError(f"size_mm and divisions must be positive, not {list(size_mm)} and {list(divisions)}")
    if diagonals not in DIAGONALS:
        raise InputError(f"diagonals must be {' or '.join(map(repr, DIAGONALS))}, not {diagonals!r}")
    x = np.linspace(0.0, width, nx + 1) - (0.5 * width if centred else 0.0)
    gx, gy = np.meshgrid(x, np.linspace(0.0, height, ny + 1))
    i, j = (a.ravel() for a in np.meshgrid(np.arange(nx), np.arange(ny)))
    a = i + (nx + 1) * j
    b, c, d = a + 1, a + nx + 2, a + nx + 1
    rising = np.stack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)], axis=1)
    falling = np.stack([np.stack([a, b, d], axis=1), np.stack([b, c, d], axis=1)], axis=1)
    turn = (i + j) % 2 == 1 if diagonals == "alternating" else np.zeros(len(i), dtype=bool)
    cells = np.where(turn[:, None, None], falling, rising).reshape(-1, 3)
    return Mesh.from_arrays(np.stack([gx.ravel(), gy.ravel()], axis=1), cells, "triangle")
