"""How rigid bodies move the nodes that are tied to them, or to which their points hand displacement or force over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.lattices.model.contact_state import TOUCH_MM, check_outside
from naibu.mechanics.lattices.model.lattice import Lattice
from naibu.mechanics.lattices.model.state import ConstrainedNodes
from naibu.mechanics.lattices.simulation.contact import displacement_drive, force_drive


@dataclass(frozen=True, slots=True, eq=False)
class FacePoints:
    """Points of a rigid body on a face of a lattice, which hand its motion over by bilinear weights :cite:p:`hirai2008` (chapter 4.3).

    Attributes
    ----------
    face : str
        ``"-x"`` to ``"+z"``, as in `naibu.mechanics.lattices.simulation.contact.hand_over`.
    positions : ndarray, shape (k, 3)
        At the start, mm.
    """

    face: str
    positions: FloatArray

    def shares(self, lattice: Lattice) -> FloatArray:
        """Return which part of the force of the body every node (n,) takes; they sum to one."""
        return force_drive(lattice, self.face, self.positions, [1.0, 0.0, 0.0])[:, 0]


class TiedBody(Protocol):
    """A body of a study."""

    @property
    def name(self) -> str:
        """For messages."""

    @property
    def indenter(self) -> RigidIndenter:
        """Its shape and place."""

    @property
    def points(self) -> FacePoints | None:
        """Points that hand its motion over; None where it moves all nodes that it touches."""

    @property
    def by_force(self) -> bool:
        """Whether a force moves it, so that it constrains nothing."""


def tied_nodes(lattice: Lattice, bodies: Sequence[TiedBody]) -> tuple[IntArray, ...]:
    """Return the nodes that are tied to every body: those on its surface at the start, and on no earlier body's.

    Raises
    ------
    InputError
        A body that touches no node, or starts inside the object.
    """
    return tuple(np.unique(own.node) for own in tied_constraints(lattice, bodies))


def tied_constraints(lattice: Lattice, bodies: Sequence[TiedBody]) -> tuple[ConstrainedNodes, ...]:
    """Return which nodes every body moves, and how far, but those that an earlier one moves.

    Raises
    ------
    InputError
        A body that touches no node or starts inside the object, or points beside a face or over a hole in it.
    """
    free = np.ones(lattice.n_nodes, dtype=bool)
    found = []
    for k, body in enumerate(bodies):
        check_outside(lattice, [body.indenter])
        touched = np.abs(body.indenter.gap(lattice.points)) < TOUCH_MM
        if not touched.any():
            nearest = float(body.indenter.gap(lattice.points).min())
            raise InputError(
                f"{body.name} touches no node, the nearest is {nearest:.4g} mm away: a body can be tied to what it touches at the start"
            )
        if body.points is None:
            own = ConstrainedNodes.of(np.flatnonzero(touched & free), k)
        else:
            own = displacement_drive(lattice, body.points.face, body.points.positions, k)
            kept = np.flatnonzero(free[own.node]) if not body.by_force else np.zeros(0, dtype=np.int64)
            own = ConstrainedNodes(own.node[kept], own.direction[kept], own.weight[kept], own.body[kept])
        found.append(own)
        free[own.node] = False
    return tuple(found)
