"""State of the contact of a lattice with rigid indenters: which nodes stick, slide, or once touched which indenter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.lattices.model.lattice import Lattice

TOUCH_MM = 1e-6  # gap below which a node counts as touching at the start


@dataclass(frozen=True, slots=True, eq=False)
class ContactState:
    """State of the contact between a lattice and its indenters.

    Attributes
    ----------
    nodes : ndarray, shape (c,), int64
        Nodes that may touch.
    mode : ndarray, shape (c, indenters), int64
        0 free, 1 sticking, 2 sliding.
    friction : ndarray, shape (c, indenters, 3)
        Friction on sliding nodes, mN.
    touched : ndarray, shape (c, indenters), bool
        Whether the node ever touched the indenter, so that pull-off acts when it leaves slowly.
    centres : ndarray, shape (indenters, 3)
        Reference points of the indenters, mm.
    axes : ndarray, shape (indenters, 3, 3)
        Axes of the indenters, in rows.
    """

    nodes: IntArray
    mode: IntArray
    friction: FloatArray
    touched: BoolArray
    centres: FloatArray
    axes: FloatArray


def begin_contact(
    lattice: Lattice, indenters: Sequence[RigidIndenter], position: FloatArray | None = None, nodes: ArrayLike | None = None
) -> ContactState:
    """Return the contact of a lattice with indenters before anything moves: nodes on an indenter's surface touch it, the others are free.

    Parameters
    ----------
    lattice : Lattice
        Nodes and elements.
    indenters : sequence of RigidIndenter
        Floors included.
    position : ndarray, shape (n, 3)
        Of the nodes, mm; by default those of the reference configuration.
    nodes : array_like
        Nodes that may touch; by default those on the surface, all where the lattice names none.

    Raises
    ------
    InputError
        No indenter, or one that begins inside the object.
    """
    if not indenters:
        raise InputError("indenters is empty; give at least a floor")
    if nodes is None:
        chosen = np.flatnonzero(lattice.surface_node) if lattice.surface_node.any() else np.arange(lattice.n_nodes)
    else:
        chosen = np.asarray(nodes, dtype=np.int64)
    points = lattice.points if position is None else position
    gaps = np.stack([indenter.gap(points[chosen]) for indenter in indenters], axis=1)
    middles = points[lattice.elements].mean(axis=1)  # a small indenter may lie between the nodes
    for k, indenter in enumerate(indenters):
        inside = np.append(gaps[:, k], indenter.gap(middles))
        if inside.min() < -TOUCH_MM:
            at = np.concatenate([points[chosen], middles])[int(np.argmin(inside))]
            raise InputError(
                f"indenters[{k}], a {indenter.geometry.name}, begins inside the object: ({at[0]:.4g}, {at[1]:.4g}, {at[2]:.4g}) mm lies "
                f"{-inside.min():.4g} mm deep in it; move it back by that"
            )
    mode = np.where(gaps < TOUCH_MM, [2 if p.static_friction == 0.0 else 1 for p in indenters], 0).astype(np.int64)
    centres, axes = np.array([p.centre for p in indenters], dtype=float), np.array([p.geometry.axes for p in indenters], dtype=float)
    return ContactState(chosen, mode, np.zeros((*mode.shape, 3)), mode > 0, centres, axes)
