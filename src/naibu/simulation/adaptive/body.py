"""Adaptive finite elements in motion: a session whose mesh is refined and coarsened as the body deforms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.contact.indenter_motion import IndenterForce, IndenterMotion, indenter_velocities
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.meshing.cutting.forest_cut import ForestCut
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.meshing.refinement.marking import Criterion
from naibu.simulation.adaptive.adaptive_mesh import AdaptiveMesh, MeshState
from naibu.simulation.adaptive.body_contact import BodyContact
from naibu.simulation.adaptive.conditions import Conditions


@dataclass(frozen=True, slots=True, eq=False)
class BodyState:
    """State of a body in motion on one mesh.

    Attributes
    ----------
    time : float
        s.
    displacement, velocity : ndarray, shape (n, d)
        mm and mm/s.
    history : ndarray, shape (m, h)
        History variables of the cells.
    """

    time: float
    displacement: FloatArray
    velocity: FloatArray
    history: FloatArray


class PreparedDynamics(Protocol):
    """Equations of motion on one mesh."""

    @property
    def mass(self) -> FloatArray:
        """Lumped masses (n,), kg."""

    @property
    def cell_mass(self) -> FloatArray:
        """Masses of the cells (m,), kg."""

    def at_rest(self) -> BodyState:
        """Return the reference configuration at rest."""

    def advanced(self, state: BodyState, force: FloatArray, steps: int) -> BodyState:
        """Return the state after steps under constant forces on the nodes (n, d), mN."""


@runtime_checkable
class TouchedDynamics(Protocol):
    """Equations of motion on one mesh that know contact with rigid indenters."""

    def touched(self, indenters: Sequence[RigidIndenter], state: BodyState) -> BodyContact:
        """Return the contact with indenters where they were made."""

    def touched_still(self, contact: BodyContact, before: FloatArray, state: BodyState) -> BodyContact:
        """Return on this mesh what a contact on another one, with the displacement `before` (n, 3), mm, has come to."""

    def pressed(
        self, state: BodyState, force: FloatArray, contact: BodyContact, along: FloatArray, spin: FloatArray
    ) -> tuple[BodyState, BodyContact, FloatArray]:
        """Take one step with velocities (k, 3), mm/s, and angular velocities, rad/s, of indenters; return also their forces (k, 3), mN."""


class Dynamics(Protocol):
    """A material, an integration method and its step: what moves, on any mesh."""

    @property
    def step(self) -> float:
        """Length of a step, s."""

    def prepared(self, mesh: Mesh, constrained: BoolArray) -> PreparedDynamics:
        """Return the equations of motion on a mesh with fixed components (n, d)."""


@dataclass(slots=True, eq=False)
class AdaptiveBody:
    """A body of finite elements in motion whose mesh is refined and coarsened as it deforms.

    Attributes
    ----------
    mesh : AdaptiveMesh
        Forest, criterion and present mesh.
    dynamics : Dynamics
        `LinearDynamics` or `HyperelasticDynamics`.
    conditions : Conditions
        Fixed nodes and loads.
    interval : int
        Steps between two adaptations.
    prepared : PreparedDynamics
        Equations of motion on the present mesh.
    state : BodyState
        Present state.
    contact : BodyContact or None
        Rigid indenters, where they are and what they exert.
    adaptations : int
        How many times the mesh changed.
    """

    mesh: AdaptiveMesh
    dynamics: Dynamics
    conditions: Conditions
    interval: int
    prepared: PreparedDynamics
    state: BodyState
    force: FloatArray
    contact: BodyContact | None = None
    adaptations: int = 0
    _since: int = 0
    _forces: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 3)))

    @classmethod
    def of(
        cls,
        mesh: Mesh,
        dynamics: Dynamics,
        conditions: Conditions,
        criterion: Criterion | None,
        *,
        indenters: Sequence[RigidIndenter] = (),
        max_level: int = 3,
        bisections: int = 3,
        interval: int = 20,
    ) -> AdaptiveBody:
        """Begin at rest, on the coarsest mesh.

        Parameters
        ----------
        mesh : Mesh
            Triangles (`LinearDynamics` only) or linear tetrahedra.
        dynamics : Dynamics
            `LinearDynamics` or `HyperelasticDynamics`.
        conditions : Conditions
            Fixed nodes and loads; bodies that move nodes are not known here.
        criterion : Criterion or None
            Where the mesh is refined and coarsened; None: nowhere.
        indenters : sequence of RigidIndenter
            See `press`.
        max_level, bisections : int
            See `naibu.simulation.adaptive.adaptive_mesh.AdaptiveMesh`.
        interval : int
            Steps between two adaptations.

        Raises
        ------
        InputError
            Cells that cannot be bisected, settings out of range, conditions with bodies that move nodes, or what `press` refuses.
        """
        if conditions.moved:
            raise InputError("conditions.moved must be empty: adaptive finite elements have fixed nodes and loads only")
        if interval < 1:
            raise InputError(f"interval must be at least 1 step, not {interval}")
        adaptive = AdaptiveMesh.of(mesh, criterion, max_level=max_level, bisections=bisections)
        prepared = dynamics.prepared(mesh, conditions.constrained(mesh.points))
        force = conditions.force(mesh, prepared.mass)
        body = cls(adaptive, dynamics, conditions, interval, prepared, prepared.at_rest(), force)
        if indenters:
            body.press(indenters)
        return body

    def press(self, indenters: Sequence[RigidIndenter]) -> None:
        """Bring these indenters, and no others, into play from the next step on, where they were made: contact with Coulomb friction.

        Raises
        ------
        InputError
            Equations of motion without contact (`LinearDynamics`), an indenter with pull-off, or one with two friction coefficients.
        """
        if indenters and not isinstance(self.prepared, TouchedDynamics):
            raise InputError(
                "dynamics of small strain have no contact: give HyperelasticDynamics, with the law 'linear_elastic' where strains are small"
            )
        self.contact = self.prepared.touched(indenters, self.state) if isinstance(self.prepared, TouchedDynamics) and indenters else None

    def step(self, steps: int = 1, motions: Sequence[IndenterMotion] = ()) -> BodyState:
        """Take steps, adapt the mesh after every `interval` of them, and return the state at their end.

        Parameters
        ----------
        steps : int
            How many.
        motions : sequence of IndenterMotion
            One for each indenter, or none, and they stand still: a pose, reached at the end of the last step, or a velocity.

        Raises
        ------
        InputError
            No step, motions for another number of indenters, or a force among them.
        ConvergenceError
            Steps that are too long: the explicit method diverged, or an element would be inverted.
        """
        if steps < 1:
            raise InputError(f"steps must be at least 1, not {steps}")
        along, spin = self._velocities(motions, steps * self.dynamics.step)
        forces, left = [np.zeros((0, len(along), 3))], steps
        while left:
            chunk = min(left, self.interval - self._since)
            forces.append(self._taken(chunk, along, spin))
            left, self._since = left - chunk, self._since + chunk
            if self._since == self.interval:
                self.adapt()
                self._since = 0
        self._forces = np.concatenate(forces)
        return self.state

    def indenter_forces(self) -> FloatArray:
        """Return the forces (steps, k, 3), mN, of the indenters on the body in the steps of the last call of `step`."""
        return self._forces

    def indenter_distance(self, positions: FloatArray) -> FloatArray:
        """Return the signed distance (q,), mm, of positions (q, 3), mm, from the nearest indenter where it is now.

        With `naibu.meshing.NearContact` it is a criterion that follows the indenters.
        """
        return np.full(len(positions), np.inf) if self.contact is None else self.contact.distance(positions)

    def _velocities(self, motions: Sequence[IndenterMotion], duration_s: float) -> tuple[FloatArray, FloatArray]:
        contact = self.contact
        count = 0 if contact is None else len(contact.indenters)
        if len(motions) not in (0, count):
            raise InputError(f"motions has {len(motions)} entries for {count} indenters; give one for each, or none")
        if any(isinstance(motion, IndenterForce) for motion in motions):
            raise InputError("motions has a force; indenters of adaptive finite elements follow poses and velocities")
        if contact is None:
            return np.zeros((0, 3)), np.zeros((0, 3))
        axes = np.array([i.geometry.axes @ r.T for i, r in zip(contact.indenters, contact.rotations, strict=True)])
        along, spin, _ = indenter_velocities(contact.indenters, motions, contact.centres, axes, duration_s)
        return along, spin

    def _taken(self, steps: int, along: FloatArray, spin: FloatArray) -> FloatArray:
        """Take steps on the present mesh; return the forces of the indenters (steps, k, 3), mN."""
        if self.contact is None or not isinstance(self.prepared, TouchedDynamics):
            self.state = self.prepared.advanced(self.state, self.force, steps)
            return np.zeros((steps, 0, 3))
        forces = np.zeros((steps, len(along), 3))
        for n in range(steps):
            self.state, self.contact, forces[n] = self.prepared.pressed(self.state, self.force, self.contact, along, spin)
        return forces

    def adapt(self) -> bool:
        """Refine and coarsen the mesh by the criterion; return whether it changed."""
        return self._follow(self.mesh.adapted(self._mesh_state()))

    def change(self, refine: ArrayLike = (), coarsen: ArrayLike = ()) -> bool:
        """Refine and coarsen cells of given numbers in the forest, whatever the criterion; return whether the mesh changed."""
        wanted = (np.asarray(cells, dtype=np.int64) for cells in (refine, coarsen))
        return self._follow(self.mesh.changed(self._mesh_state(), *wanted))

    def cut(self, blade: SweptBlade, distance_mm: float, *, earlier: SweptBlade | None = None) -> ForestCut:
        """Cut the body, as it is deformed now, along the surface that a blade has swept; the next step is that of the cut body.

        Displacements, velocities, history variables and regions are kept, and with them momentum; pieces that come loose move on as bodies
        of their own, and the mesh is refined and coarsened further.

        Parameters
        ----------
        blade : SweptBlade
            The surface; it may end inside the body.
        distance_mm : float
            See `naibu.meshing.cut_forest`.
        earlier : SweptBlade, optional
            Of a blade that goes on step by step; see `naibu.meshing.cut_forest`.

        Raises
        ------
        InputError
            Triangles, or what `naibu.meshing.cut_forest` refuses; the body is then as it was.
        """
        state, found = self.mesh.cut(self._mesh_state(), blade, distance_mm, earlier)
        self._follow(state)
        return found

    def constrain(self, conditions: Conditions) -> None:
        """Replace supports and loads from the next step on.

        Raises
        ------
        InputError
            Conditions with bodies that move nodes.
        """
        if conditions.moved:
            raise InputError("conditions.moved must be empty: adaptive finite elements have fixed nodes and loads only")
        self.conditions = conditions
        self._prepare()

    def positions(self) -> FloatArray:
        """Return the positions (n, d) of the vertices of the present mesh, mm."""
        return np.asarray(self.mesh.leaf.mesh.points + self.state.displacement)

    def _mesh_state(self) -> MeshState:
        state = self.state
        return MeshState(state.displacement, state.velocity, self.prepared.mass, self.prepared.cell_mass, state.history)

    def _follow(self, state: MeshState | None) -> bool:
        if state is None:
            return False
        before = self.state.displacement
        self.state = BodyState(self.state.time, state.displacement, state.velocity, state.history)
        self._prepare()
        if self.contact is not None and isinstance(self.prepared, TouchedDynamics):
            self.contact = self.prepared.touched_still(self.contact, before, self.state)
        self.adaptations += 1
        return True

    def _prepare(self) -> None:
        mesh = self.mesh.leaf.mesh
        self.prepared = self.dynamics.prepared(mesh, self.conditions.constrained(mesh.points))
        self.force = self.conditions.force(mesh, self.prepared.mass)
