# mypy: disallow-untyped-decorators=False
"""Transfer of cell and nodal values between the meshes before and after a refinement or a coarsening.

All functions change their arrays in place where these are long enough, and return longer copies where they are not: so the cost is that of
what changed. Rows are the numbers of cells and vertices in the forest.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray
from naibu.meshing.refinement.forest import BisectionForest, MeshChange


def transferred_cells(forest: BisectionForest, change: MeshChange, values: FloatArray, *, extensive: bool = False) -> FloatArray:
    """Return the values of cells (c, ...) after a change: children inherit them, restored parents have the mean of their children.

    Parameters
    ----------
    forest : BisectionForest
        After the change.
    change : MeshChange
        What `BisectionForest.refine` or `coarsen` returned.
    values : ndarray, shape (c, ...)
        One row for every cell number before the change; changed in place, or copied where it is too short.
    extensive : bool
        Whether they are sums over a cell, such as its mass: children then have half of them, and parents the sum.
    """
    out = _long_enough(values, forest.cell_rows)
    rows = out.reshape(len(out), -1)
    inherited, joined = (0.5, 1.0) if extensive else (1.0, 0.5)
    (_inherit if change.refined else _join)(rows, change.parents, change.children, inherited if change.refined else joined)
    return out


def transferred_nodes(forest: BisectionForest, change: MeshChange, values: FloatArray) -> FloatArray:
    """Return the values of vertices (n, ...) after a change: new vertices have the mean of the ends of their edge, others keep theirs.

    Parameters
    ----------
    forest : BisectionForest
        After the change.
    change : MeshChange
        What `BisectionForest.refine` or `coarsen` returned.
    values : ndarray, shape (n, ...)
        One row for every vertex number before the change; changed in place, or copied where it is too short.
    """
    out = _long_enough(values, forest.node_rows)
    if change.refined:
        _interpolate(out.reshape(len(out), -1), change.nodes, change.ends)
    return out


def transferred_motion(
    forest: BisectionForest, change: MeshChange, mass: FloatArray, velocity: FloatArray, cell_mass: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return lumped masses (n,), kg, and velocities (n, d), mm/s, after a change; mass and momentum are conserved.

    Half the mass of a new vertex comes from each end of its edge, whose velocities it averages. A vertex that is removed gives each end
    half of its mass and of its momentum.

    Parameters
    ----------
    forest : BisectionForest
        After the change.
    change : MeshChange
        What `BisectionForest.refine` or `coarsen` returned.
    mass, velocity : ndarray, shapes (n,) and (n, d)
        One row for every vertex number before the change; changed in place, or copied where they are too short.
    cell_mass : ndarray, shape (c,)
        Mass of every cell, kg, transferred before by `transferred_cells` as an extensive value.
    """
    m, v = _long_enough(mass, forest.node_rows), _long_enough(velocity, forest.node_rows)
    if change.refined:
        share = 2.0 / (forest.dimension + 1)  # of a child, which has half the mass of its parent
        _split_masses(m, v, cell_mass, change.nodes, change.ends, change.children, change.patches, share)
    else:
        _join_masses(m, v, change.nodes, change.ends)
    return m, v


def _long_enough(values: FloatArray, rows: int) -> FloatArray:
    if len(values) >= rows:
        return values
    out = np.zeros((max(rows, 2 * len(values)), *values.shape[1:]))
    out[: len(values)] = values
    return out


@njit(cache=True)
def _inherit(values, parents, children, factor):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(len(parents)):
        for side in range(2):
            for a in range(values.shape[1]):
                values[children[i, side], a] = factor * values[parents[i], a]


@njit(cache=True)
def _join(values, parents, children, factor):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(len(parents)):
        for a in range(values.shape[1]):
            values[parents[i], a] = factor * (values[children[i, 0], a] + values[children[i, 1], a])


@njit(cache=True)
def _interpolate(values, nodes, ends):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(len(nodes)):
        for a in range(values.shape[1]):
            values[nodes[i], a] = 0.5 * (values[ends[i, 0], a] + values[ends[i, 1], a])


@njit(cache=True)
def _split_masses(mass, velocity, cell_mass, nodes, ends, children, patches, share):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(len(nodes)):
        mass[nodes[i]] = 0.0
    for i in range(len(children)):
        mass[nodes[patches[i]]] += share * cell_mass[children[i, 0]]
    for i in range(len(nodes)):
        z, p, q = nodes[i], ends[i, 0], ends[i, 1]
        mass[p] -= 0.5 * mass[z]
        mass[q] -= 0.5 * mass[z]
        for a in range(velocity.shape[1]):
            velocity[z, a] = 0.5 * (velocity[p, a] + velocity[q, a])


@njit(cache=True)
def _join_masses(mass, velocity, nodes, ends):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(len(nodes)):
        z = nodes[i]
        for e in range(2):
            p = ends[i, e]
            whole = mass[p] + 0.5 * mass[z]
            for a in range(velocity.shape[1]):
                velocity[p, a] = (mass[p] * velocity[p, a] + 0.5 * mass[z] * velocity[z, a]) / whole
            mass[p] = whole
        mass[z] = 0.0
