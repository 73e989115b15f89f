"""Engines and sessions: what steps a deformable object in time, and how a loop drives it.

The protocols are those of lattices on the processor and on a GPU, and general enough for finite elements: nodes that rigid bodies move,
rigid indenters in contact that follow a pose, a velocity or a force, positions, forces, and a state that can be read and set. A session
keeps its indenters and the state of their contacts from step to step; a step that names no motion of theirs leaves them where they are,
still in contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Protocol, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.mechanics.contact.indenter_motion import IndenterMotion
from naibu.mechanics.contact.rigid_indenters import RigidIndenter


@dataclass(frozen=True, slots=True, eq=False)
class StepForces:
    """Forces of rigid bodies on the object in the steps of one call.

    Attributes
    ----------
    bodies : ndarray, shape (steps, bodies, 3)
        Of the bodies that move constrained nodes, mN.
    indenters : ndarray, shape (steps, indenters, 3)
        Of the indenters in contact, mN, friction and pull-off included.
    """

    bodies: FloatArray
    indenters: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 3)))


State = TypeVar("State")
Constraints = TypeVar("Constraints", contravariant=True)


class Session(Protocol[State, Constraints]):
    """An object in motion, stepped by a loop."""

    def constrain(self, constrained: Constraints, bodies: int = 0) -> None:
        """Constrain these nodes, and no others, from the next step on."""

    def press(self, indenters: Sequence[RigidIndenter]) -> None:
        """Bring these indenters, and no others, into play from the next step on, where they were made."""

    def step(self, velocity: ArrayLike = 0.0, motions: Sequence[IndenterMotion] = (), *, steps: int = 1) -> StepForces:
        """Take steps with velocities of the bodies of constrained nodes, and motions of the indenters; none: they stand still."""

    def positions(self, nodes: ArrayLike | None = None) -> FloatArray:
        """Return positions of nodes (k, 3), mm, by default of all."""

    def forces(self) -> StepForces:
        """Return the forces of the last call of `step`."""

    def state(self) -> State:
        """Return a copy of the state, contacts included."""

    def restore(self, state: State) -> None:
        """Go on from a state."""

    def close(self) -> None:
        """Release threads and device memory; the session is not stepped any more."""

    def __enter__(self) -> Self:
        """Return the session."""

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close it."""


class Engine(Protocol[State, Constraints]):
    """An object prepared for steps of one length by one method."""

    @property
    def step(self) -> float:
        """Length of a step, s."""

    def rest(self) -> State:
        """Return the object in the reference configuration, without any force."""

    def energy(self, state: State) -> float:
        """Return kinetic and stored energy, mN mm."""

    def session(
        self,
        state: State | None = None,
        constrained: Constraints | None = None,
        external_force: ArrayLike | None = None,
        indenters: Sequence[RigidIndenter] = (),
    ) -> Session[State, Constraints]:
        """Begin a session at a state, by default in the reference configuration."""
