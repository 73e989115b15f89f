"""Steps of a lattice in contact with rigid indenters: stored state, indenters and the history of their contacts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from naibu._numba.intrinsics.packed_tuples import packed
from naibu._numba.thread_pool import STOP, start_workers, stop_workers
from naibu.core.arrays import AnyArray, FloatArray, IntArray
from naibu.mechanics.contact.indenter_geometry import GeometryArrays, packed_geometries
from naibu.mechanics.contact.indenter_motion import SHARE, step_parts
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.lattices.cpu.contact._kernels import contact_steps
from naibu.mechanics.lattices.cpu.contact._multipliers import COLUMNS
from naibu.mechanics.lattices.cpu.contact._operator import new_operator
from naibu.mechanics.lattices.cpu.contact._points import COLUMNS as POINT_COLUMNS
from naibu.mechanics.lattices.cpu.contact._points import RESULTS, new_room, rest_at
from naibu.mechanics.lattices.cpu.contact.explicit import ElementForces, no_elements
from naibu.mechanics.lattices.cpu.implicit._coarse_kernels import LATEST, TOUCHED
from naibu.mechanics.lattices.cpu.implicit._solver_parts import COARSE, POOL
from naibu.mechanics.lattices.cpu.implicit._step_parts import implicit_worker
from naibu.mechanics.lattices.cpu.scratch import KernelTuple, PackedArguments, solver_entries
from naibu.mechanics.lattices.cpu.stepper import IMPLICIT_CALL, MOST_ITERATIONS, ImplicitStepper, calls
from naibu.mechanics.lattices.model.contact_state import ContactState
from naibu.mechanics.lattices.model.contact_surface import ContactSurface

PASSES = 60  # solutions in a step, at most: in an impact in which points alternate between stick and slip, they approach slowly
SECANT_STEPS = 12  # of the speed of an indenter that a force drives
DEEP, ROUND = (
    0.5,
    0.9,
)  # of the radius of the largest sphere in an indenter: depth from which foundations are stiffer, of flat and round ones


@dataclass(slots=True, eq=False)
class ContactStepper:
    """A stepper with indenters.

    Attributes
    ----------
    base : ImplicitStepper
        State of the lattice, and what its nodes are constrained to.
    contact : ContactState
        Changed in place by the steps.
    surface : ContactSurface
        Faces that may touch.
    geometry : tuple
        Of the indenters, as the kernels read it.
    friction : ndarray, shape (k, 2)
        Static and kinetic coefficients.
    pull : ndarray, shape (k, 3)
        K_r, C_r and V_t of pull-off.
    form : ndarray, shape (k, 2)
        Curvature, 1/mm, and the depth, mm, from which foundations are stiffer.
    passes : int
        Most solutions in a step.
    indenters : tuple of RigidIndenter
        As they were made.
    divided : callable
        Returns a stepper of the same arrays whose steps are shorter by a whole number.
    forces : ElementForces
        Of the elements, where these are stepped explicitly; `base` then has the masses alone.
    alone : bool
        Whether no worker is asked in the next steps.
    points : tuple
        Nodes of the faces, inverse areas, shape functions and weights, and where those of each indenter begin.
    scratch : tuple
        Of the kernels.
    """

    base: ImplicitStepper
    contact: ContactState
    surface: ContactSurface
    geometry: GeometryArrays
    friction: FloatArray
    pull: FloatArray
    form: FloatArray
    passes: int
    indenters: tuple[RigidIndenter, ...]
    divided: Callable[[ImplicitStepper, int], ImplicitStepper]
    points: KernelTuple
    scratch: KernelTuple
    forces: ElementForces | None = None
    alone: bool = False
    _fastest: FloatArray = field(init=False)  # (k,), mm/s, at which no indenter passes through the surface in a step
    _finer: dict[int, ImplicitStepper] = field(default_factory=dict)
    _arguments: dict[int, tuple[KernelTuple, tuple[PackedArguments, FloatArray, IntArray, PackedArguments]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._fastest = SHARE / self.base.step * np.array([p.geometry.inradius for p in self.indenters])

    @classmethod
    def of(
        cls, base: ImplicitStepper, indenters: Sequence[RigidIndenter], contact: ContactState, surface: ContactSurface,
        divided: Callable[[ImplicitStepper, int], ImplicitStepper], passes: int = PASSES, forces: ElementForces | None = None,
    ) -> ContactStepper:  # fmt: skip
        """Put indenters beside a lattice; the contact state is copied."""
        friction = np.array([(p.static_friction, p.kinetic_friction) for p in indenters])
        pull = np.array([(p.pull_stiffness, p.pull_damping, p.pull_speed) for p in indenters])
        form = np.array([(g.curvature, (ROUND if g.curvature else DEEP) * g.inradius) for g in (p.geometry for p in indenters)])
        geometry, own = packed_geometries([p.geometry for p in indenters]), contact.copied()
        points = _points(surface, own)
        scratch = _scratch(len(surface.faces), len(indenters), len(own.mode), len(base.mass))
        stepper = cls(base, own, surface, geometry, friction, pull, form, passes, tuple(indenters), divided, points, scratch, forces)
        if not own.begun.all():
            corners, spread, *rest = points
            faces = (corners, spread, surface.foundation(base.step), *rest)
            rest_at(base.position, packed(*stepper._shapes()), packed(*faces), own.begun, packed(*own.history()))
            own.begun[:] = True
        stepper._look_everywhere()
        return stepper

    def advance(
        self, held_velocity: FloatArray, velocity: FloatArray, spin: FloatArray, reactions: tuple[FloatArray, FloatArray]
    ) -> tuple[int, int, int]:
        """Take len(velocity) steps; return iterations, passes and the steps whose contacts did not settle.

        A step in which an indenter would pass through the surface is taken in shorter ones.

        Parameters
        ----------
        held_velocity : ndarray, shape (steps, bodies, 3)
            Velocities of the bodies that move constrained nodes, mm/s.
        velocity, spin : ndarray, shape (steps, k, 3)
            Velocities, mm/s, and angular velocities, rad/s, of the indenters.
        reactions : tuple of ndarray
            Of the bodies and of the indenters, mN, of the shapes of their velocities; filled.
        """
        if not spin.any() and ((velocity * velocity).sum(axis=2) <= self._fastest**2).all():
            return self._taken(self.base, 1, held_velocity, velocity, spin, reactions)
        found = np.zeros(3, dtype=np.int64)
        for n in range(len(velocity)):
            parts = self._parts(velocity[n], spin[n])
            own = [np.repeat(motion[n : n + 1], parts, axis=0) for motion in (held_velocity, velocity, spin)]
            forces = (np.empty_like(own[0]), np.empty_like(own[1]))
            taken = self._taken(self._finer_by(parts), parts, own[0], own[1], own[2], forces)
            found += (taken[0], taken[1], min(taken[2], 1))
            for whole, pieces in zip(reactions, forces, strict=True):
                whole[n] = pieces.mean(axis=0)
        return int(found[0]), int(found[1]), int(found[2])

    def _parts(self, velocity: FloatArray, spin: FloatArray) -> int:
        """Parts of a step, a power of two, in each of which no indenter passes through the surface."""
        base, contact, duration = self.base, self.contact, self.base.step
        corners = base.position.reshape(3, -1)[:, self.points[0]].transpose(1, 2, 0)
        points = np.concatenate([corners.reshape(-1, 3), corners.mean(axis=1)])
        approach = duration * float(np.linalg.norm(base.velocity.reshape(3, -1), axis=0).max())
        return step_parts(self.indenters, points, contact.centres, contact.axes, duration * velocity, duration * spin, approach)

    def _finer_by(self, parts: int) -> ImplicitStepper:
        """Return the stepper whose steps are shorter by `parts`."""
        if parts == 1:
            return self.base
        if parts not in self._finer:
            self._finer[parts] = self.divided(self.base, parts)
        self._finer[parts].constrained = self.base.constrained
        return self._finer[parts]

    def _taken(
        self, base: ImplicitStepper, parts: int, held_velocity: FloatArray, velocity: FloatArray, spin: FloatArray,
        reactions: tuple[FloatArray, FloatArray],
    ) -> tuple[int, int, int]:  # fmt: skip
        """Take steps of a stepper that shares the state."""
        for values in reactions:
            values[:] = 0.0
        limits, found = (base.tolerance, MOST_ITERATIONS), np.zeros(3, dtype=np.int64)
        data, weight, control, own = self._arguments_of(base, parts)
        for now in calls(control, self.alone, len(velocity), IMPLICIT_CALL):
            start_workers(implicit_worker, control, data)
            motion, given = (held_velocity[now], velocity[now], spin[now]), (reactions[0][now], reactions[1][now])
            found += contact_steps(data, own, weight, motion, limits, given, self.passes)
        return int(found[0]), int(found[1]), int(found[2])

    def _arguments_of(self, base: ImplicitStepper, parts: int) -> tuple[PackedArguments, FloatArray, IntArray, PackedArguments]:
        """Return what the kernels read of a stepper that shares the state: its data, weights, the control of workers, and the contact."""
        known = self._arguments.get(parts)
        if known is None or known[0] is not base.constrained or known[1][2][STOP]:
            (operator, *own), contact = self.scratch, self.contact
            memory = base.scratch[1][COARSE][5][2]
            if len(memory) and (known is None or known[0] is not base.constrained):  # a run does not depend on those before it
                memory[[TOUCHED, LATEST]] = 0
            history = contact.history()
            corners, spread, *rest = self.points
            surface = (corners, spread, self.surface.foundation(base.step), *rest)
            vectors = tuple(np.zeros_like(base.position) for _ in range(4))
            together = not self.surface.resists_at_once(base.step, base.mass)
            scratch = (*own, contact.covered, together, contact.acceleration, contact.lasting)
            elements = no_elements() if self.forces is None else self.forces.arguments(parts)
            read = packed(self._shapes(), surface, history, scratch, vectors, elements)
            known = base.constrained, (*self._data_of(base, operator), read)
            self._arguments[parts] = known
        return known[1]

    def _data_of(self, base: ImplicitStepper, operator: KernelTuple) -> tuple[PackedArguments, FloatArray, IntArray]:
        """Return the data of a stepper, its weights and the control of its workers; those that divide steps have none."""
        if base is self.base:
            return base.contact_arguments(operator)
        (node, direction, weight, body), pool = base.constrained, base.scratch[1][POOL]
        return base.arguments(pool, operator, solver_entries(node, direction, body)), weight, pool[0]

    def close(self) -> None:
        """Stop the workers, until the next step."""
        for _, (_, _, control, _) in self._arguments.values():
            stop_workers(control)

    def _shapes(self) -> KernelTuple:
        """Return the indenters as the kernels read them."""
        return (self.geometry, self.contact.axes), self.contact.centres, self.friction, self.pull, self.form

    def _look_everywhere(self) -> None:
        """Forget how far indenters are from faces, and find the faces that hold something of a contact."""
        contact, (_, _, clear, moved, live) = self.contact, self.scratch[1]
        clear[:], moved[:] = -np.inf, 0.0
        some = (contact.mode > 0) | (contact.compression != 0.0) | contact.touched
        for k, (low, high) in enumerate(pairwise(contact.first)):
            live[k] = some[low:high].reshape(len(live[k]), -1).any(axis=1)

    def saved(self) -> tuple[AnyArray, ...]:
        """Return copies of all that steps change, for `put_back`."""
        return tuple(array.copy() for array in self._changing())

    def put_back(self, saved: tuple[AnyArray, ...]) -> None:
        """Undo the steps since `saved`."""
        for array, old in zip(self._changing(), saved, strict=True):
            array[...] = old
        self._look_everywhere()

    def _changing(self) -> tuple[AnyArray, ...]:
        base, contact = self.base, self.contact
        assert base.length is not None  # as of all implicit steps
        extension = base.extension if self.forces is None else self.forces.stepper.extension
        lattice = (base.position, base.velocity, extension, base.length)
        return (*lattice, *contact.history(), contact.centres, contact.axes, contact.covered, contact.acceleration, contact.lasting)


def _points(surface: ContactSurface, contact: ContactState) -> KernelTuple:
    """Return nodes of faces, inverse areas, shape functions, weights, and where those of each indenter begin."""
    rules = [surface.quadrature(int(own)) for own in contact.order]
    rule = np.concatenate([[0], np.cumsum([len(shape) for shape, _ in rules])]).astype(np.int64)
    shapes = np.ascontiguousarray(np.concatenate([shape for shape, _ in rules]))
    weights = np.concatenate([weight.ravel() for _, weight in rules])
    return np.ascontiguousarray(surface.nodes), surface.spread, shapes, weights, contact.first, rule


def _scratch(faces: int, indenters: int, points: int, pad: int) -> KernelTuple:
    """Return the scratch of `contact_steps`."""
    pairs = faces * indenters
    lists = (
        np.zeros(pairs, np.int64), np.zeros(pairs, np.int64), np.zeros((indenters, faces)), np.zeros(indenters),
        np.zeros((indenters, faces), np.bool_),
    )  # fmt: skip
    exerted = (np.zeros((points, POINT_COLUMNS)), np.zeros((points, RESULTS)))
    slots = min(4 * faces, pad)
    operator = new_operator(pairs, slots)
    nodal = (np.full(pad, -1, np.int64), np.zeros((slots, 3, 3)), np.zeros((COLUMNS, indenters, pad)))
    return operator, lists, exerted, np.zeros(points, np.bool_), *nodal, new_room()


@dataclass(slots=True, eq=False)
class DrivenIndenter:
    """An indenter that a force drives along a guide.

    Attributes
    ----------
    number : int
        Of the indenter.
    along : ndarray, shape (3,)
        Unit vector of the guide.
    inertia : float
        Mass over the step, kg/s.
    speed : float
        Along the guide, mm/s.
    slope : float
        Estimate of how its balance changes with its speed, kg/s; improved by every secant step.
    """

    number: int
    along: FloatArray
    inertia: float
    speed: float
    slope: float

    def advance(
        self, stepper: ContactStepper, applied: float, allowed: float, motion: tuple[FloatArray, FloatArray, FloatArray],
        reactions: tuple[FloatArray, FloatArray],
    ) -> tuple[int, int, int]:  # fmt: skip
        """Take one step under the force `applied`, mN, by the secant method, to a balance within `allowed`, mN.

        `motion` are the velocities that `ContactStepper.advance` takes, (1, ...) each; that of this indenter is filled.
        """
        saved = stepper.saved()

        def tried(value: float) -> tuple[tuple[int, int, int], float]:
            motion[1][0, self.number] = value * self.along
            found = stepper.advance(*motion, reactions)
            return found, float(reactions[1][0, self.number] @ self.along)

        value = self.speed
        found, reaction = tried(value)
        lack = self.inertia * (value - self.speed) + reaction - applied
        for _ in range(SECANT_STEPS):
            if abs(lack) <= allowed:
                break
            guess = value - lack / self.slope
            stepper.put_back(saved)
            found, reaction = tried(guess)
            new = self.inertia * (guess - self.speed) + reaction - applied
            self.slope = max((new - lack) / (guess - value), self.inertia) if guess != value else self.slope
            value, lack = guess, new
        self.speed = value
        return found
