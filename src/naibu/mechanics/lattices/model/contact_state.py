"""State of the contact of a lattice with rigid indenters, at the quadrature points of its faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from naibu.core.arrays import AnyArray, BoolArray, FloatArray, Int8Array, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.lattices.model.contact_surface import ContactSurface, contact_faces
from naibu.mechanics.lattices.model.lattice import Lattice

TOUCH_MM = 1e-6  # gap below which a point counts as touching at the start


@dataclass(frozen=True, slots=True, eq=False)
class ContactState:
    """State of the contact between a lattice and its indenters.

    The points are the quadrature points of all faces, those of the first indenter first, then face by face.

    Attributes
    ----------
    order : ndarray, shape (indenters,), int64
        Quadrature order of the faces for each indenter.
    first : ndarray, shape (indenters + 1,), int64
        Where the points of each indenter begin, and how many there are.
    mode : ndarray, shape (p,), int8
        0 free, 1 sticking, 2 sliding.
    touched : ndarray, shape (p,), bool
        Whether the point ever touched the indenter, so that pull-off acts when it leaves slowly.
    compression, extension : ndarray, shape (p,)
        Of the foundation of each point (see `ContactSurface`), and of its Voigt part, mm.
    friction : ndarray, shape (p, 3)
        Traction of friction on the lattice, kPa.
    multiplier : ndarray, shape (indenters, n)
        Pressure at the nodes, kPa, that the foundation between them need not carry.
    covered : ndarray, shape (indenters, n)
        Fraction of what lies around the nodes that the indenters covered in the last step.
    thickness : ndarray, shape (indenters, f)
        Of the foundations of the faces, in lengths of the elements behind them.
    centres : ndarray, shape (indenters, 3)
        Reference points of the indenters, mm.
    axes : ndarray, shape (indenters, 3, 3)
        Axes of the indenters, in rows.
    begun : ndarray, shape (p,), bool
        Whether the compression counts; the others are compressed, when steps begin, by what the indenters cover then, and exert nothing.
    acceleration : ndarray, shape (3, n)
        Mean acceleration of the nodes in the last step, mm/s2, from which the next one begins.
    lasting : ndarray, shape (1,)
        How much of that before lasted in the last step, from 0 to 1.
    """

    order: IntArray
    first: IntArray
    mode: Int8Array
    touched: BoolArray
    compression: FloatArray
    extension: FloatArray
    friction: FloatArray
    multiplier: FloatArray
    covered: FloatArray
    thickness: FloatArray
    centres: FloatArray
    axes: FloatArray
    begun: BoolArray
    acceleration: FloatArray
    lasting: FloatArray

    @property
    def indenters(self) -> int:
        """Number of indenters."""
        return len(self.centres)

    def history(self) -> tuple[AnyArray, ...]:
        """Return what steps change at the points, nodes and faces, in the order of the attributes."""
        points = (self.mode, self.touched, self.compression, self.extension, self.friction)
        return (*points, self.multiplier, self.thickness)

    def copied(self) -> ContactState:
        """Return a copy of all arrays."""
        return replace(self, **{field.name: getattr(self, field.name).copy() for field in fields(self)})


def check_outside(
    lattice: Lattice, indenters: Sequence[RigidIndenter], position: FloatArray | None = None, resting: Sequence[RigidIndenter] = ()
) -> None:
    """Check that indenters begin outside of a lattice; those in `resting` carry it already, and it may have sunk into them a little.

    Raises
    ------
    InputError
        No indenter, or one that begins inside the object.
    """
    if not indenters:
        raise InputError("indenters is empty; give at least a floor")
    points = lattice.points if position is None else position
    middles = points[lattice.elements].mean(axis=1)  # a small indenter may lie between the nodes
    at = np.concatenate([points[np.unique(contact_faces(lattice))], middles])
    for k, indenter in enumerate(indenters):
        if any(indenter is other for other in resting):
            continue
        inside = indenter.gap(at)
        if inside.min() < -TOUCH_MM:
            deepest = at[int(np.argmin(inside))]
            raise InputError(
                f"indenters[{k}], a {indenter.geometry.name}, begins inside the object: ({deepest[0]:.4g}, {deepest[1]:.4g}, "
                f"{deepest[2]:.4g}) mm lies {-inside.min():.4g} mm deep in it; move it back by that"
            )


def begin_contact(
    lattice: Lattice,
    surface: ContactSurface,
    indenters: Sequence[RigidIndenter],
    position: FloatArray | None = None,
    resting: Sequence[RigidIndenter] = (),
) -> ContactState:
    """Return the contact of a lattice with indenters before anything moves: points on an indenter's surface touch it, the others are free.

    Parameters
    ----------
    lattice : Lattice
        Nodes and elements.
    surface : ContactSurface
        Its faces.
    indenters : sequence of RigidIndenter
        Floors included.
    position : ndarray, shape (n, 3)
        Of the nodes, mm; by default those of the reference configuration.
    resting : sequence of RigidIndenter
        Those of them that were in contact before.

    Raises
    ------
    InputError
        What `check_outside` refuses.
    """
    check_outside(lattice, indenters, position, resting)
    points = lattice.points if position is None else position
    order = np.array([surface.order(p.geometry) for p in indenters], dtype=np.int64)
    gaps = []
    for indenter, own in zip(indenters, order, strict=True):
        shape, _ = surface.quadrature(int(own))
        gaps.append(indenter.gap(np.einsum("qk,fki->fqi", shape, points[surface.nodes]).reshape(-1, 3)))
    gap, first = np.concatenate(gaps), np.cumsum([0, *(len(g) for g in gaps)]).astype(np.int64)
    touched, none, at_node = gap < TOUCH_MM, np.zeros(len(gap)), np.zeros((len(indenters), lattice.n_nodes))
    centres, axes = np.array([p.centre for p in indenters], dtype=float), np.array([p.geometry.axes for p in indenters], dtype=float)
    begun, traction = np.zeros(len(gap), dtype=bool), np.zeros((len(gap), 3))
    thickness = np.array([surface.thickness(p.geometry) for p in indenters])
    return ContactState(
        order, first, touched.astype(np.int8), touched, none, none.copy(), traction, at_node, at_node.copy(), thickness, centres, axes,
        begun, np.zeros((3, lattice.n_nodes)), np.zeros(1),
    )  # fmt: skip
