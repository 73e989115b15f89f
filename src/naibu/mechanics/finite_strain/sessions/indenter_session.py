"""What the sessions of finite elements share: bodies that move nodes, rigid indenters, and the loop over steps.

They follow the protocol of `naibu.mechanics.contact.session_protocol`, as lattices do, so that a loop can drive either.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import Field, dataclass, field, replace
from types import TracebackType
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.contact.indenter_contacts import indenter_contacts
from naibu.mechanics.contact.indenter_motion import IndenterMotion
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.contact.session_protocol import StepForces
from naibu.mechanics.finite_strain.sessions.session_checks import checked_bodies, checked_velocities, require_state


class TouchedState(Protocol):
    """State of a body with its indenters."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def displacement(self) -> FloatArray:
        """Of the nodes (n, 3), mm."""

    @property
    def centres(self) -> FloatArray:
        """Positions of the indenters (k, 3), mm."""

    @property
    def rotations(self) -> FloatArray:
        """Their rotations (k, 3, 3) since they were made."""

    @property
    def anchors(self) -> tuple[FloatArray, ...]:
        """Frictional anchors (p, 3) of the points of every contact, mm."""


class TouchedModel(Protocol):
    """What a session needs of the engine that made it."""

    @property
    def points(self) -> FloatArray:
        """Nodes in the reference configuration (n, 3), mm."""

    @property
    def faces(self) -> IntArray:
        """Boundary faces that indenters may touch."""

    @property
    def step(self) -> float:
        """Length of a step, s."""

    @property
    def normal_stiffness(self) -> float:
        """Penalty of the contact, kPa/mm."""

    @property
    def tangential_stiffness(self) -> float:
        """Likewise along the faces."""


State = TypeVar("State", bound=TouchedState)
Model = TypeVar("Model", bound=TouchedModel)


@dataclass(slots=True, eq=False)
class IndenterSession(ABC, Generic[Model, State]):
    """A body of finite elements that a loop steps, with rigid indenters.

    Attributes
    ----------
    engine : QuasiStaticEngine or DynamicEngine
        The model.
    external_force : ndarray, shape (n, 3)
        Dead load, mN.
    reached : EquilibriumState or DynamicState
        State behind the last step.
    bodies : tuple of ndarray
        Nodes of each rigid body.
    indenters : tuple of RigidIndenter
        As they were made.
    """

    engine: Model
    external_force: FloatArray
    reached: State
    bodies: tuple[IntArray, ...] = ()
    indenters: tuple[RigidIndenter, ...] = ()
    _templates: tuple[Contact, ...] = ()
    _forces: StepForces = field(default_factory=lambda: StepForces(np.zeros((0, 0, 3))))

    def begun(self, state: State | None, constrained: Sequence[ArrayLike] | None, indenters: Sequence[RigidIndenter]) -> Self:
        """Return the session with nodes constrained, indenters in play, and at a state if one is given."""
        self.constrain(constrained or ())
        self.press(indenters)
        if state is not None:
            self.restore(state)
        return self

    def constrain(self, constrained: Sequence[ArrayLike], bodies: int = 0) -> None:
        """Constrain these nodes, and no others, from the next step on.

        Parameters
        ----------
        constrained : sequence of array_like
            Nodes of each rigid body.
        bodies : int
            Number of bodies, if some have no node at present.

        Raises
        ------
        InputError
            A node that does not exist, or that belongs to two bodies.
        """
        self.bodies = checked_bodies(constrained, len(self.engine.points), bodies)

    def press(self, indenters: Sequence[RigidIndenter]) -> None:
        """Bring these indenters, and no others, into play from the next step on, where they were made.

        Raises
        ------
        InputError
            An indenter with pull-off, or with a kinetic friction below the static one, which this contact has not.
        """
        engine = self.engine
        self._templates = indenter_contacts(
            indenters, engine.points, engine.faces, normal_stiffness=engine.normal_stiffness,
            tangential_stiffness=engine.tangential_stiffness,
        )  # fmt: skip
        self.indenters = tuple(indenters)
        centres = np.array([i.centre for i in indenters], dtype=float).reshape(-1, 3)
        anchors = tuple(c.local(self.reached.displacement, 0.0) for c in self._templates)
        self.reached = replace(self.reached, centres=centres, rotations=np.tile(np.eye(3), (len(centres), 1, 1)), anchors=anchors)

    def step(self, velocity: ArrayLike = 0.0, motions: Sequence[IndenterMotion] = (), *, steps: int = 1) -> StepForces:
        """Take steps.

        Parameters
        ----------
        velocity : array_like, shape (3,), (bodies, 3) or (steps, bodies, 3)
            Of the bodies of constrained nodes, mm/s.
        motions : sequence of IndenterMotion
            One for each indenter, or none: they stand still. In quasi-static sessions one of them may be a force.
        steps : int
            Number of steps; a pose is reached at the end of the last.

        Raises
        ------
        InputError
            Motions for another number of indenters, more forces among them than may be, or values of another shape.
        ConvergenceError
            No balance was found; the session stays at the last state.
        """
        self._check_motions(motions)
        speeds = np.broadcast_to(np.asarray(velocity, dtype=float), (steps, len(self.bodies), 3))
        duration = steps * self.engine.step
        along, spin = checked_velocities(self.indenters, motions, self.reached.centres, self.reached.rotations, duration)
        of_bodies, of_indenters = np.zeros((steps, len(self.bodies), 3)), np.zeros((steps, len(self.indenters), 3))
        for k, moving in enumerate(speeds):
            of_bodies[k], of_indenters[k] = self._advance(moving, along, spin, motions)
        self._forces = StepForces(of_bodies, of_indenters)
        return self._forces

    @abstractmethod
    def _check_motions(self, motions: Sequence[IndenterMotion]) -> None:
        """Refuse motions that these steps do not have."""

    @abstractmethod
    def _advance(
        self, moving: FloatArray, along: FloatArray, spin: FloatArray, motions: Sequence[IndenterMotion]
    ) -> tuple[FloatArray, FloatArray]:
        """Take one step with these velocities of bodies and indenters; return the forces of both, mN."""

    def positions(self, nodes: ArrayLike | None = None) -> FloatArray:
        """Return positions of nodes (k, 3), mm, by default of all."""
        x = self.engine.points + self.reached.displacement
        return x if nodes is None else np.asarray(x[np.asarray(nodes, dtype=np.int64)])

    def forces(self) -> StepForces:
        """Return the forces of the last call of `step`."""
        return self._forces

    def state(self) -> State:
        """Return the state, contacts included."""
        return self.reached

    def restore(self, state: State) -> None:
        """Go on from a state; of one without indenters the body only.

        Raises
        ------
        InputError
            A state of another mesh or of other indenters.
        """
        require_state(state.displacement, state.anchors, self.engine.points, self.indenters)
        if len(state.anchors) != len(self.indenters):
            own = self.reached
            state = replace(state, centres=own.centres, rotations=own.rotations, anchors=own.anchors)
        self.reached = state

    def close(self) -> None:
        """Release what the session holds."""

    def __enter__(self) -> Self:
        """Return the session."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close it."""
        self.close()

    def _places_of(self, at: State) -> tuple[tuple[RigidIndenter, ...], FloatArray, FloatArray, FloatArray]:
        """Return indenters, points of the faces (p, 3), mm, and centres and axes of the indenters in a state, for `safe_fraction`."""
        axes = np.array([i.geometry.axes @ r.T for i, r in zip(self.indenters, at.rotations, strict=True)]).reshape(-1, 3, 3)
        points = self._templates[0].positions(at.displacement) if self._templates else np.zeros((0, 3))
        return self.indenters, points, at.centres, axes
