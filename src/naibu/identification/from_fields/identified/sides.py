"""Sides of a body of cells on a grid, which are held, moved or loaded by plates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.surface import boundary_nodes

SIDE = 0.25  # of the shortest edge of cells: nodes this near to an end of the body are on that side
SIDES = ("x-", "x+", "y-", "y+", "z-", "z+")


def nodes_of_side(mesh: Mesh, axes: FloatArray, side: str) -> BoolArray:
    """Return the nodes (n,) at one end of a body, along the axis of its cells that is nearest to x, y or z of the scan.

    Parameters
    ----------
    mesh : Mesh
        Cells of a grid.
    axes : ndarray, shape (3, 3)
        Axes of the grid of cells in the frame of the scan, in columns.
    side : {"x-", "x+", "y-", "y+", "z-", "z+"}
        Axis and end.

    Raises
    ------
    InputError
        A side that is none of x-, x+, y-, y+, z-, z+.
    """
    if side not in SIDES:
        raise InputError(f"side {side!r} is not known; use one of {', '.join(SIDES)}")
    world = np.eye(3)["xyz".index(side[0])] * (1.0 if side[1] == "+" else -1.0)
    along = axes.T @ world
    axis = int(np.argmax(np.abs(along)))
    height = mesh.points @ (axes[:, axis] * np.sign(along[axis]))
    edge = float(np.ptp(height[mesh.cells], axis=1).min())
    return np.asarray(height > height.max() - SIDE * edge)


def loaded_nodes(mesh: Mesh, axes: FloatArray, sides: Sequence[str]) -> BoolArray:
    """Return the nodes (n,) at which unknown forces act: those of some sides, or of the whole surface where none is named.

    Raises
    ------
    InputError
        A side that does not exist.
    """
    loaded = np.zeros(mesh.n_points, dtype=bool)
    for side in sides:
        loaded |= nodes_of_side(mesh, axes, side)
    if not sides:
        loaded[boundary_nodes(mesh)] = True
    return loaded
