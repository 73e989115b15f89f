"""State of a lattice, its constraints, and the largest stable explicit step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.lattices.model.coefficients import explicit_coefficients
from naibu.mechanics.lattices.model.contact_state import ContactState
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters

Method = Literal["implicit", "euler", "symplectic_euler"]
STEP_S = 2e-3


@dataclass(frozen=True, slots=True, eq=False)
class LatticeState:
    """State of a lattice: positions, velocities and history variables of its elements.

    Attributes
    ----------
    position : ndarray, shape (n, 3)
        mm.
    velocity : ndarray, shape (n, 3)
        mm/s.
    extension : ndarray, shape (m,)
        How much longer than at rest the Voigt part of every element is, y = Z - a L, mm.
    length : ndarray, shape (m,)
        Lengths of the elements that the extensions have followed so far, mm; by default the distances of the nodes. They lag behind where
        the implicit method limited what rotation adds, and catch up.
    contact : ContactState, optional
        Of the indenters that touch the lattice, so that friction and pull-off go on as they were.
    """

    position: FloatArray
    velocity: FloatArray
    extension: FloatArray
    length: FloatArray | None = None
    contact: ContactState | None = None

    @classmethod
    def at_rest(cls, lattice: Lattice) -> LatticeState:
        """Return a lattice at rest, without any force."""
        return cls(lattice.points.copy(), np.zeros_like(lattice.points), np.zeros(lattice.n_elements))


@dataclass(frozen=True, slots=True, eq=False)
class ConstrainedNodes:
    """Constrained components of nodes, which follow rigid bodies.

    Attributes
    ----------
    node : ndarray, shape (h,), int64
        Nodes; one occurs once for each direction in which it is constrained.
    direction : ndarray, shape (h, 3)
        Unit vectors, orthogonal where they belong to one node.
    weight : ndarray, shape (h,)
        Fraction of the body's velocity that the node takes on.
    body : ndarray, shape (h,), int64
        Number of the body.
    """

    node: IntArray
    direction: FloatArray
    weight: FloatArray
    body: IntArray

    @classmethod
    def none(cls) -> ConstrainedNodes:
        """Constrain nothing."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))

    @classmethod
    def of(cls, nodes: ArrayLike, body: int = 0, *, axes: Sequence[int] = (0, 1, 2), weight: ArrayLike = 1.0) -> ConstrainedNodes:
        """Constrain nodes along axes of the frame by a body, with a weight, or one a node."""
        chosen = np.atleast_1d(np.asarray(nodes, dtype=np.int64))
        fraction = np.broadcast_to(np.asarray(weight, dtype=float), chosen.shape)
        k = len(axes)
        return cls(
            np.repeat(chosen, k), np.tile(np.eye(3)[list(axes)], (len(chosen), 1)), np.repeat(fraction, k), np.full(k * len(chosen), body)
        )

    def __add__(self, other: ConstrainedNodes) -> ConstrainedNodes:
        """Constrain what either constrains."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in ("node", "direction", "weight", "body"))
        return ConstrainedNodes(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Result of a run of steps.

    Attributes
    ----------
    state : LatticeState
        After the last step.
    reaction : ndarray, shape (steps, bodies, 3)
        Forces that the bodies exert on the lattice, mN: with them its momentum balances.
    iterations : float
        Mean number of iterations of the solver in a step.
    held_back : int
        Steps in which the stretching by rotation was limited so that the energy does not grow; other than zero for steps of large turns.
    """

    state: LatticeState
    reaction: FloatArray
    iterations: float = 0.0
    rotation_limited: int = 0


def checked_velocity(velocity: ArrayLike, steps: int, bodies: int) -> FloatArray:
    """Return velocities of bodies (steps, bodies, 3), mm/s.

    Raises
    ------
    InputError
        No number of steps, values that cannot be broadcast, or NaN.
    """
    if steps < 0:
        raise InputError(f"the number of steps must not be negative, not {steps}")
    given = np.asarray(velocity, dtype=float)
    bodies = max(bodies, given.shape[-2] if given.ndim >= 2 else 0)
    try:
        # in the order of rows, whatever that of what is given: kernels are compiled for each order
        path = np.array(np.broadcast_to(given, (steps, bodies, 3)), order="C")
    except ValueError:
        raise InputError(
            f"velocities of shape {given.shape} do not fit {steps} steps of {bodies} bodies: give (steps, bodies, 3)"
        ) from None
    require_numbers(path, "velocity")
    return path


def require_numbers(values: FloatArray, what: str) -> None:
    """Check that all values are finite.

    Raises
    ------
    InputError
        Some are not; the message counts them.
    """
    wrong = ~np.isfinite(values)
    if wrong.any():
        at = tuple(int(k) for k in np.argwhere(wrong)[0])
        raise InputError(f"{what} holds {int(wrong.sum())} NaN or infinite values, the first at {at}; leave them out or fill them")


def followed_lengths(lattice: Lattice, state: LatticeState) -> FloatArray:
    """Return the lengths that the extensions followed (m,), mm: by default the distances of the nodes."""
    if state.length is not None:
        return state.length
    i, j = lattice.elements.T
    return np.asarray(np.linalg.norm(state.position[j] - state.position[i], axis=1))


def require_no_contact(state: LatticeState) -> None:
    """Refuse a state in contact, whose indenters would be left out.

    Raises
    ------
    InputError
        It is in contact.
    """
    if state.contact is not None:
        raise InputError(
            f"state is in contact with {state.contact.indenters} indenters, which these steps leave out; go on by a session or "
            "`push`, or drop the contact: dataclasses.replace(state, contact=None)"
        )


def require_constrained(constrained: ConstrainedNodes, n_nodes: int) -> None:
    """Check constrained nodes.

    Raises
    ------
    InputError
        A node that is not there, directions that are not of unit length, or two that are not orthogonal at one node.
    """
    if not len(constrained.node):
        return
    if constrained.node.min() < 0 or constrained.node.max() >= n_nodes:
        raise InputError(
            f"constrained nodes have the numbers {constrained.node.min()} to {constrained.node.max()}, the lattice has 0 to {n_nodes - 1}"
        )
    require_numbers(constrained.direction, "the direction of constrained nodes")
    if np.abs(np.linalg.norm(constrained.direction, axis=1) - 1.0).max() > 1e-6:
        raise InputError("the directions of constrained nodes must be of unit length; divide them by their norm")
    order = np.argsort(constrained.node, kind="stable")
    node, direction = constrained.node[order], constrained.direction[order]
    for apart in range(1, min(4, len(node))):
        together = node[apart:] == node[:-apart]
        cosine = np.abs((direction[apart:] * direction[:-apart]).sum(axis=1))[together]
        if len(cosine) and cosine.max() > 1e-6:
            bad = int(node[apart:][together][int(np.argmax(cosine))])
            raise InputError(f"node {bad} is constrained twice in directions that are not orthogonal; hold each component by one body only")


def explicit_step_limit(lattice: Lattice, parameters: LatticeParameters) -> float:
    """Return a step, s, up to which explicit steps are stable for small motions; a bound, reached within about a factor of two.

    From Gershgorin's bound of the damping and of the stiffness of all elements at a node, and the elements' own times (C1 + C2) / K.
    """
    a, b, _, g = explicit_coefficients(parameters)
    ends = lattice.elements.ravel()
    damping, stiffness = (np.bincount(ends, np.repeat(2.0 * c, 2)) / lattice.node_mass for c in (a, b))
    fastest = 0.5 * damping.max() + np.sqrt(0.25 * damping.max() ** 2 + stiffness.max())
    slowest = float(g.max())
    return float(2.0 / max(fastest, slowest, 1e-300))
