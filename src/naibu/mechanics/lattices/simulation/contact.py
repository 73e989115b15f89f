"""Pushing lattices: rigid indenters in contact, or displacements and forces of points :cite:p:`hirai2008` (chapter 4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.contact.indenter_motion import IndenterForce
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.lattices.cpu.contact.stepper import PASSES, ContactStepper, DrivenIndenter
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.cpu.scratch import Scratch
from naibu.mechanics.lattices.cpu.session import BALANCE
from naibu.mechanics.lattices.model.contact_state import begin_contact
from naibu.mechanics.lattices.model.lattice import Lattice
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState, checked_velocity, require_numbers

SNAP = 0.25  # a point nearer to a line of nodes than this fraction of the spacing stands on it (:cite:p:`hirai2008`, chapter 4.3)


@dataclass(frozen=True, slots=True, eq=False)
class ContactMotion:
    """Motion of a lattice in contact.

    Attributes
    ----------
    state : LatticeState
        After the last step, that of the contacts included: another push goes on from it.
    reaction : ndarray, shape (steps, indenters, 3)
        Forces of the indenters on the lattice, mN, friction and pull-off included: with them its momentum balances.
    speed : ndarray, shape (steps, indenters, 3)
        Velocities of the indenters, mm/s.
    passes : float
        Mean number of solutions in a step until its contacts were settled.
    unsettled : int
        Steps whose contacts did not settle within the allowed passes; each then keeps what the last one gave.
    """

    state: LatticeState
    reaction: FloatArray
    speed: FloatArray
    passes: float
    unsettled: int


def push(
    engine: LatticeEngine,
    state: LatticeState,
    indenters: Sequence[RigidIndenter],
    velocity: ArrayLike,
    *,
    steps: int | None = None,
    external_force: ArrayLike | None = None,
    passes: int = PASSES,
) -> ContactMotion:
    """Move rigid indenters on prescribed paths against a lattice: unilateral contact with Coulomb friction.

    Contact acts at the quadrature points of the faces. They stick to an indenter while their friction is below the static one, else slide
    against the kinetic one; pressure and friction follow from the solution at the end of the step, which is found again until all contacts
    agree with it. Faces that leave an indenter at less than V_t are pulled back by ``K_r gap + C_r speed``, but never by more than stops
    them.

    Parameters
    ----------
    engine : LatticeEngine
        Of the method ``"implicit"``, or ``"symplectic_euler"`` in double precision.
    state : LatticeState
        Where the steps begin; one in contact goes on with its contacts.
    indenters : sequence of RigidIndenter
        A floor is a plane that does not move.
    velocity : array_like, shape (steps, indenters, 3)
        mm/s; or what broadcasts to that where `steps` is given.
    steps : int
        Number of steps.
    external_force : array_like
        Constant forces on the nodes, mN, broadcast to (n, 3).
    passes : int
        Most solutions in a step.

    Raises
    ------
    InputError
        An engine of another method, an indenter that begins inside the object, shapes that do not fit, or NaN.
    """
    count = len(np.asarray(velocity)) if steps is None else steps
    path = checked_velocity(velocity, count, len(indenters))
    if path.shape[1] != len(indenters):
        raise InputError(f"velocity has {path.shape[1]} indenters, and there are {len(indenters)}")
    with engine.scratch() as scratch:
        stepper = _begun(engine, state, indenters, external_force, passes, scratch)
        reaction, none = np.zeros(path.shape), np.zeros((count, 0, 3))
        _, tries, unsettled = stepper.advance(none, path, np.zeros(path.shape), (none.copy(), reaction))
        return _motion(engine, stepper, reaction, path, tries / max(count, 1), unsettled)


def push_by_force(
    engine: LatticeEngine,
    state: LatticeState,
    indenters: Sequence[RigidIndenter],
    force: ArrayLike,
    *,
    driven: int,
    direction: ArrayLike,
    indenter_mass: float,
    speed: float = 0.0,
    external_force: ArrayLike | None = None,
    tolerance: float = BALANCE,
) -> ContactMotion:
    """Push a guided rigid indenter by a force; its speed and the lattice's reaction are found together in every step.

    Parameters
    ----------
    engine, state, indenters, external_force
        As in `push`.
    force : array_like, shape (steps,)
        Along `direction`, mN.
    driven : int
        Number of the indenter that the force drives; the others stay where they are.
    direction : array_like, shape (3,)
        In which it is guided.
    indenter_mass : float
        kg.
    speed : float
        At the start, mm/s.
    tolerance : float
        Of the indenter's balance, relative to the largest force.

    Raises
    ------
    InputError
        What `push` refuses, an indenter that is not there, or a mass that is not positive.
    """
    forces = np.atleast_1d(np.asarray(force, dtype=float))
    require_numbers(forces, "force")
    if not 0 <= driven < len(indenters):
        raise InputError(f"driven is {driven}; there are {len(indenters)} indenters, numbered from 0")
    along, inertia = IndenterForce(0.0, direction, indenter_mass).guide(), indenter_mass / engine.step
    allowed, count = tolerance * max(float(np.abs(forces).max(initial=0.0)), 1e-300), len(forces)
    body, tries, unsettled = DrivenIndenter(driven, along, inertia, speed, inertia), 0, 0
    path, reaction, none = np.zeros((count, len(indenters), 3)), np.zeros((count, len(indenters), 3)), np.zeros((1, 0, 3))
    with engine.scratch() as scratch:
        stepper = _begun(engine, state, indenters, external_force, PASSES, scratch)
        for n, applied in enumerate(forces):
            motion = (none, path[n : n + 1], np.zeros((1, len(indenters), 3)))
            _, passes, lost = body.advance(stepper, float(applied), allowed, motion, (none.copy(), reaction[n : n + 1]))
            tries, unsettled = tries + passes, unsettled + lost
        return _motion(engine, stepper, reaction, path, tries / max(count, 1), unsettled)


def _begun(
    engine: LatticeEngine,
    state: LatticeState,
    indenters: Sequence[RigidIndenter],
    external_force: ArrayLike | None,
    passes: int,
    scratch: Scratch,
) -> ContactStepper:
    if passes < 1:
        raise InputError(f"passes must be at least 1, not {passes}")
    surface = engine.surface()
    known = state.contact or begin_contact(engine.lattice, surface, indenters, state.position)
    if known.indenters != len(indenters):
        raise InputError(f"state is in contact with {known.indenters} indenters, and there are {len(indenters)}")
    base = engine.stepper(state, external_force, scratch)
    none = ConstrainedNodes.none()
    base.constrain((none.node, none.direction, none.weight, none.body), 0)
    return engine.in_contact(base, indenters, known, passes)


def _motion(
    engine: LatticeEngine, stepper: ContactStepper, reaction: FloatArray, speed: FloatArray, passes: float, unsettled: int
) -> ContactMotion:
    lattice = stepper.base if stepper.forces is None else stepper.forces.stepper
    engine.check(lattice, len(reaction))
    end = replace(engine.state(lattice), contact=stepper.contact)
    return ContactMotion(end, reaction, speed, passes, unsettled)


def hand_over(lattice: Lattice, face: str, points: ArrayLike, *, snap: float = SNAP) -> tuple[IntArray, FloatArray]:
    """Return the four nodes (p, 4) of the cell of a face that every point of a rigid body falls into, and their weights (p, 4).

    The weights are the areas opposite to the nodes, as fractions of the cell. A point within `snap` of the
    spacing from a line of nodes stands on it.

    Parameters
    ----------
    lattice : Lattice
        With nodes on a grid.
    face : str
        ``"-x"``, ``"+x"``, ``"-y"``, ``"+y"``, ``"-z"`` or ``"+z"``: the outermost layer of nodes on that side.
    points : array_like, shape (p, 3)
        Positions, mm; the component across the face is not used.
    snap : float
        Fraction of the spacing, below one half.

    Raises
    ------
    InputError
        An unknown face, NaN, or a point beside the face or over a hole in it.
    """
    if face not in ("-x", "+x", "-y", "+y", "-z", "+z"):
        raise InputError(f"faces are -x, +x, -y, +y, -z and +z, not {face!r}")
    if not 0.0 <= snap < 0.5:
        raise InputError(f"points can snap within less than half the spacing, not {snap:g}")
    across = "xyz".index(face[1])
    flat = [a for a in range(3) if a != across]
    given = np.atleast_2d(np.asarray(points, dtype=float))
    require_numbers(given, "points")
    low = lattice.points.min(axis=0)
    grid = np.rint((lattice.points - low) / lattice.spacing_mm).astype(np.int64)
    layer = grid[:, across] == (grid[:, across].max() if face[0] == "+" else 0)
    number = np.full(tuple(grid[:, flat].max(axis=0) + 1), -1)
    number[tuple(grid[layer][:, flat].T)] = np.flatnonzero(layer)
    place = (given - low)[:, flat] / lattice.spacing_mm
    nearest = np.rint(place)
    place = np.where(np.abs(place - nearest) < max(snap, 1e-9), nearest, place)
    outside = (place < 0).any(axis=1) | (place > np.array(number.shape) - 1).any(axis=1)
    if outside.any():
        raise InputError(f"{int(outside.sum())} of {len(given)} points lie beside the face {face}, point {int(np.argmax(outside))} first")
    cell = np.minimum(place.astype(np.int64), np.maximum(np.array(number.shape) - 2, 0))
    s, t = (place - cell).T
    corners = np.stack([number[tuple((np.minimum(cell + step, np.array(number.shape) - 1)).T)] for step in np.ndindex(2, 2)], axis=1)
    weights = np.stack([(1 - s) * (1 - t), (1 - s) * t, s * (1 - t), s * t], axis=1)
    if (corners[weights > 0.0] < 0).any():
        bad = int(np.argmax(((corners < 0) & (weights > 0.0)).any(axis=1)))
        raise InputError(f"point {bad} lies over a cell of the face {face} that lacks nodes; use nodes of the finest voxels there")
    return np.where(corners < 0, 0, corners), np.where(corners < 0, 0.0, weights)


def displacement_drive(
    lattice: Lattice, face: str, points: ArrayLike, body: int = 0, *, axes: Sequence[int] = (0, 1, 2)
) -> ConstrainedNodes:
    """Return how nodes move when the points of a rigid body hand their displacement over to them.

    A node takes on the fraction of the displacement that the weights of all points add up to, at most all of it.

    Parameters
    ----------
    lattice, face, points
        As in `hand_over`.
    body : int
        Number of the rigid body.
    axes : sequence of int
        Components that are handed over.

    Raises
    ------
    InputError
        What `hand_over` refuses.
    """
    corners, weights = hand_over(lattice, face, points)
    total = np.bincount(corners.ravel(), weights.ravel(), minlength=lattice.n_nodes)
    nodes = np.flatnonzero(total > 0.0)
    return ConstrainedNodes.of(nodes, body, axes=axes, weight=np.minimum(total[nodes], 1.0))


def force_drive(lattice: Lattice, face: str, points: ArrayLike, force: ArrayLike) -> FloatArray:
    """Return forces on the nodes (n, 3), mN, from a force on a rigid body that its points share equally and hand over.

    Parameters
    ----------
    lattice, face, points
        As in `hand_over`.
    force : array_like, shape (3,)
        mN.

    Raises
    ------
    InputError
        What `hand_over` refuses.
    """
    corners, weights = hand_over(lattice, face, points)
    total = np.bincount(corners.ravel(), weights.ravel() / len(corners), minlength=lattice.n_nodes)
    return np.asarray(total[:, None] * np.asarray(force, dtype=float))
