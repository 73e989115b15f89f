"""Interfaces with duplicated nodes, at which the two sides of a mesh may slide or separate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from naibu.core.arrays import IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh


def split_at_plane(mesh: Mesh, z_mm: float, *, tolerance_mm: float | None = None) -> tuple[Mesh, IntArray]:
    """Split a mesh along a horizontal plane of nodes; the cells above get nodes of their own.

    Parameters
    ----------
    mesh : Mesh
        Mesh whose cells do not cross the plane.
    z_mm : float
        Height of the plane, mm.
    tolerance_mm : float, optional
        Nodes within it lie on the plane; default: a millionth of the diagonal of the mesh.

    Returns
    -------
    split : Mesh
        The n points of `mesh`, then one copy for every node of the plane. Cells below keep their nodes; cells above use the copies.
    pairs : ndarray, shape (k, 2), int64
        Coinciding nodes: lower, upper.

    Raises
    ------
    InputError
        No node lies on the plane, a cell crosses it, or one side of it is empty.
    """
    limit = 1e-6 * float(np.linalg.norm(np.ptp(mesh.points, axis=0))) if tolerance_mm is None else tolerance_mm
    height = mesh.points[:, 2] - z_mm
    height = np.where(np.abs(height) <= limit, 0.0, height)
    lowest, highest = height[mesh.cells].min(axis=1), height[mesh.cells].max(axis=1)
    if len(crossing := np.flatnonzero((lowest < 0) & (highest > 0))):
        raise InputError(
            f"cell {int(crossing[0])} crosses z = {z_mm:g} mm ({len(crossing)} cells do); mesh the body with a layer boundary there"
        )
    above = highest > 0
    low, high = (np.unique(mesh.cells[side]) for side in (~above, above))
    shared = np.intersect1d(low, high)
    if len(shared) == 0:
        reach = f"{mesh.points[:, 2].min():g} to {mesh.points[:, 2].max():g} mm"
        raise InputError(f"no cells meet at z = {z_mm:g} mm: the mesh reaches from z = {reach}; give the height of an inner layer boundary")
    copies = mesh.n_points + np.arange(len(shared), dtype=np.int64)
    number = np.arange(mesh.n_points, dtype=np.int64)
    number[shared] = copies
    cells = np.where(above[:, None], number[mesh.cells], mesh.cells)
    split = replace(mesh, points=np.concatenate([mesh.points, mesh.points[shared]]), cells=cells)
    return split, np.stack([shared, copies], axis=1)
