"""Pushing lattices: by rigid bodies with friction and pull-off, or by points that four masses share (spec L4, L5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from naibu._numba.simd import aligned
from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.contact.indenter_geometry import packed_geometries
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import Lattice
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState, checked_velocity, require_numbers
from naibu.mechanics.lattices.simulation._contact_kernels import PASSES, contact_steps

SNAP = 0.25  # a point nearer to a line of masses than this share of the spacing stands on it (equation 5 of the ICAT 2007 paper)
_TOUCH_MM = 1e-6
SLOW = 1e-5  # spacings a step: masses that slide more slowly stick


@dataclass(frozen=True, slots=True, eq=False)
class ContactState:
    """Which masses touch which body.

    Attributes
    ----------
    nodes : ndarray, shape (c,), int64
        Masses that may touch.
    mode : ndarray, shape (c, bodies), int64
        0 free, 1 sticking, 2 sliding.
    friction : ndarray, shape (c, bodies, 3)
        Friction on sliding masses, mN.
    touched : ndarray, shape (c, bodies), bool
        Whether the mass ever touched the body, so that leaving it slowly is held back by pull-off.
    places : ndarray, shape (bodies, 3)
        Centres of the bodies, mm.
    """

    nodes: IntArray
    mode: IntArray
    friction: FloatArray
    touched: BoolArray
    places: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ContactMotion:
    """What a push gave.

    Attributes
    ----------
    state : LatticeState
        After the last step.
    contact : ContactState
        Likewise; both together continue the push.
    reaction : ndarray, shape (steps, bodies, 3)
        Forces of the bodies on the lattice, mN, friction and pull-off included: with them its momentum balances.
    speed : ndarray, shape (steps, bodies, 3)
        Velocities of the bodies, mm/s.
    passes : float
        Mean number of solutions in a step until its contacts were settled.
    unsettled : int
        Steps whose contacts did not settle within the allowed passes; each then keeps what the last one gave.
    """

    state: LatticeState
    contact: ContactState
    reaction: FloatArray
    speed: FloatArray
    passes: float
    unsettled: int


def begin_contact(
    lattice: Lattice, indenters: Sequence[RigidIndenter], state: LatticeState | None = None, nodes: ArrayLike | None = None
) -> ContactState:
    """Return the contact of a lattice with bodies before anything moved: masses on a body's surface stick to it, the others are free.

    Parameters
    ----------
    lattice : Lattice
        Masses and elements.
    indenters : sequence of Indenter
        Bodies, floors included.
    state : LatticeState
        Where the masses are; at rest by default.
    nodes : array_like
        Masses that may touch; by default those on the surface, all where the lattice names none.

    Raises
    ------
    InputError
        No body, or one that begins inside the object.
    """
    if not indenters:
        raise InputError("there is no body to push with; give at least a floor")
    if nodes is None:
        chosen = np.flatnonzero(lattice.surface_node) if lattice.surface_node.any() else np.arange(lattice.n_nodes)
    else:
        chosen = np.asarray(nodes, dtype=np.int64)
    points = lattice.points if state is None else state.position
    gaps = np.stack([indenter.gap(points[chosen]) for indenter in indenters], axis=1)
    middles = points[lattice.elements].mean(axis=1)  # a small body may lie between the masses
    for k, indenter in enumerate(indenters):
        inside = np.append(gaps[:, k], indenter.gap(middles))
        if inside.min() < -_TOUCH_MM:
            at = np.concatenate([points[chosen], middles])[int(np.argmin(inside))]
            raise InputError(
                f"body {k}, a {indenter.geometry.name}, begins inside the object: ({at[0]:.4g}, {at[1]:.4g}, {at[2]:.4g}) mm lies "
                f"{-inside.min():.4g} mm deep in it; move it back by that"
            )
    mode = np.where(gaps < _TOUCH_MM, [2 if p.static_friction == 0.0 else 1 for p in indenters], 0).astype(np.int64)
    shape = (len(chosen), len(indenters))
    return ContactState(chosen, mode, np.zeros((*shape, 3)), mode > 0, np.array([p.centre for p in indenters], dtype=float))


def push(
    engine: LatticeEngine,
    state: LatticeState,
    indenters: Sequence[RigidIndenter],
    velocity: ArrayLike,
    *,
    steps: int | None = None,
    contact: ContactState | None = None,
    external_force: ArrayLike | None = None,
    passes: int = PASSES,
) -> ContactMotion:
    """Move bodies on prescribed paths against a lattice (spec L5).

    Masses cannot enter a body. They stick to it while their tangential force is below the static friction, else slide against the
    kinetic one; both follow from the forces of the same step, which is solved again until all contacts agree with its solution.
    Masses that leave a
    body at less than V_t are held back by ``K_r gap + C_r speed``, but never by more than stops them.

    Parameters
    ----------
    engine : LatticeEngine
        Of the implicit method.
    state : LatticeState
        Where the steps begin.
    indenters : sequence of Indenter
        Bodies; a floor is a plane that does not move.
    velocity : array_like, shape (steps, bodies, 3)
        mm/s; or what broadcasts to that where `steps` is given.
    steps : int
        Number of steps.
    contact : ContactState
        What an earlier push ended with; by default that of bodies at their places.
    external_force : array_like
        Constant forces on the masses, mN, broadcast to (n, 3).
    passes : int
        Most solutions in a step.

    Raises
    ------
    InputError
        An explicit engine, a body that begins inside the object, shapes that do not fit, or NaN.
    """
    if engine.method != "implicit":
        raise InputError(f"contact needs method='implicit', which is stable when masses stop at a body; the engine has {engine.method!r}")
    if passes < 1:
        raise InputError(f"a step needs at least one pass, not {passes}")
    count = len(np.asarray(velocity)) if steps is None else steps
    path = checked_velocity(velocity, count, len(indenters))
    if path.shape[1] != len(indenters):
        raise InputError(f"there are velocities for {path.shape[1]} bodies, and {len(indenters)} bodies")
    known = contact or begin_contact(engine.lattice, indenters, state)
    if known.mode.shape[1] != len(indenters):
        raise InputError(f"the contact is that of {known.mode.shape[1]} bodies, and there are {len(indenters)}")
    x, v, y = engine.stored(state)
    lengths = engine.stored_lengths(state)
    external = aligned((0,), float)
    if external_force is not None:
        force = np.broadcast_to(np.asarray(external_force, dtype=float), engine.lattice.points.shape)
        require_numbers(force, "external_force")
        external = engine.by_component(force, float)
    memory = (known.mode.copy(), known.friction.copy(), known.touched.copy())
    places = known.places.copy()
    reaction = np.zeros(path.shape)
    blocks, tables = engine.kernel
    bodies = _stored_bodies(indenters, places, known.nodes)
    limit = (passes, SLOW * engine.lattice.spacing_mm / engine.step)
    with engine.scratch() as (work, inner):
        _, tries, unsettled = contact_steps(
            blocks, tables, x, v, y, lengths, engine.mass, external, work, inner, bodies, memory, path, engine.step,
            (engine.tolerance, 20_000), reaction, limit,
        )  # fmt: skip
    end = replace(engine.read(x, v, y), length=lengths[engine.blocks.lane])
    return ContactMotion(end, ContactState(known.nodes, *memory, places), reaction, path, tries / max(count, 1), int(unsettled))


def _stored_bodies(indenters: Sequence[RigidIndenter], places: FloatArray, nodes: IntArray) -> tuple[Any, ...]:
    geometries = [p.geometry for p in indenters]
    shapes = (packed_geometries(geometries), np.array([shape.axes for shape in geometries], dtype=float))
    friction = np.array([(p.static_friction, p.kinetic_friction) for p in indenters])
    pull = np.array([(p.pull_stiffness, p.pull_damping, p.pull_speed) for p in indenters])
    return shapes, places, friction, pull, nodes


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
    contact: ContactState | None = None,
    external_force: ArrayLike | None = None,
    tolerance: float = 1e-3,
) -> ContactMotion:
    """Push a guided rigid body by a force; its speed and the lattice's reaction are found together in every step (spec L5).

    Parameters
    ----------
    engine, state, indenters, contact, external_force
        As in `push`.
    force : array_like, shape (steps,)
        Along `direction`, mN.
    driven : int
        Number of the body that the force drives; the others stay where they are.
    direction : array_like, shape (3,)
        In which it is guided.
    indenter_mass : float
        kg.
    speed : float
        At the start, mm/s.
    tolerance : float
        Of the body's balance, relative to the largest force.

    Raises
    ------
    InputError
        What `push` refuses, a body that is not there, or a mass that is not positive.
    """
    along = np.array(direction, dtype=float)
    forces = np.atleast_1d(np.asarray(force, dtype=float))
    require_numbers(forces, "force")
    if not (np.isfinite(along).all() and np.linalg.norm(along) > 0.0):
        raise InputError("the direction of the driven body must have a length")
    if not 0 <= driven < len(indenters):
        raise InputError(f"body {driven} is not among the {len(indenters)} bodies")
    if not (np.isfinite(indenter_mass) and indenter_mass > 0.0):
        raise InputError(f"the mass of the driven body must be positive, not {indenter_mass:g} kg")
    along /= np.linalg.norm(along)
    known = contact or begin_contact(engine.lattice, indenters, state)
    allowed, inertia = tolerance * max(float(np.abs(forces).max()), 1e-300), indenter_mass / engine.step
    slope, reactions, speeds, tries, unsettled = inertia, [], [], 0.0, 0

    def tried(value: float) -> tuple[ContactMotion, float]:
        path = np.zeros((1, len(indenters), 3))
        path[0, driven] = value * along
        motion = push(engine, state, indenters, path, contact=known, external_force=external_force)
        return motion, float(motion.reaction[0, driven] @ along)

    for applied in forces:
        value = speed
        motion, reaction = tried(value)
        lack = inertia * (value - speed) + reaction - applied
        for _ in range(12):
            if abs(lack) <= allowed:
                break
            guess = value - lack / slope
            motion, reaction = tried(guess)
            new = inertia * (guess - speed) + reaction - applied
            slope = max((new - lack) / (guess - value), inertia) if guess != value else slope
            value, lack = guess, new
        state, known, speed = motion.state, motion.contact, value
        reactions.append(motion.reaction[0])
        speeds.append(motion.speed[0])
        tries, unsettled = tries + motion.passes, unsettled + motion.unsettled
    return ContactMotion(state, known, np.array(reactions), np.array(speeds), tries / max(len(forces), 1), unsettled)


def hand_over(lattice: Lattice, face: str, points: ArrayLike, *, snap: float = SNAP) -> tuple[IntArray, FloatArray]:
    """Return the four masses (p, 4) of the cell of a face that every point of a rigid body falls into, and their weights (p, 4) (spec L4).

    The weights are the areas opposite to the masses, as shares of the cell. A point within `snap` of the
    spacing from a line of masses stands on it.

    Parameters
    ----------
    lattice : Lattice
        With masses on a grid.
    face : str
        ``"-x"``, ``"+x"``, ``"-y"``, ``"+y"``, ``"-z"`` or ``"+z"``: the outermost layer of masses on that side.
    points : array_like, shape (p, 3)
        Positions, mm; the component across the face is not used.
    snap : float
        Share of the spacing, below one half.

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
        raise InputError(f"point {bad} lies over a cell of the face {face} that lacks masses; use masses of the finest voxels there")
    return np.where(corners < 0, 0, corners), np.where(corners < 0, 0.0, weights)


def displacement_drive(
    lattice: Lattice, face: str, points: ArrayLike, body: int = 0, *, axes: Sequence[int] = (0, 1, 2)
) -> ConstrainedNodes:
    """Return how masses move when the points of a rigid body hand their displacement over to them (spec L4).

    A mass takes on the share of the displacement that the weights of all points add up to, at most all of it.

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
    """Return forces on the masses (n, 3), mN, from a force on a rigid body that its points share equally and hand over (spec L4).

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
