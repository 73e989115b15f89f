"""Adaptive finite elements in motion: a session whose mesh is refined and coarsened as the body deforms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.cutting.forest_cut import ForestCut
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.meshing.refinement.marking import Criterion
from naibu.simulation.adaptive.adaptive_mesh import AdaptiveMesh, MeshState
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
    adaptations: int = 0
    _since: int = 0

    @classmethod
    def of(
        cls,
        mesh: Mesh,
        dynamics: Dynamics,
        conditions: Conditions,
        criterion: Criterion | None,
        *,
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
        max_level, bisections : int
            See `naibu.simulation.adaptive.adaptive_mesh.AdaptiveMesh`.
        interval : int
            Steps between two adaptations.

        Raises
        ------
        InputError
            Cells that cannot be bisected, settings out of range, or conditions with bodies that move nodes.
        """
        if conditions.moved:
            raise InputError("conditions.moved must be empty: adaptive finite elements have fixed nodes and loads only")
        if interval < 1:
            raise InputError(f"interval must be at least 1 step, not {interval}")
        adaptive = AdaptiveMesh.of(mesh, criterion, max_level=max_level, bisections=bisections)
        prepared = dynamics.prepared(mesh, conditions.constrained(mesh.points))
        force = conditions.force(mesh, prepared.mass)
        return cls(adaptive, dynamics, conditions, interval, prepared, prepared.at_rest(), force)

    def step(self, steps: int = 1) -> BodyState:
        """Take steps, adapt the mesh after every `interval` of them, and return the state at their end.

        Raises
        ------
        InputError
            No step.
        ConvergenceError
            Steps that are too long: the explicit method diverged, or an element would be inverted.
        """
        if steps < 1:
            raise InputError(f"steps must be at least 1, not {steps}")
        left = steps
        while left:
            chunk = min(left, self.interval - self._since)
            self.state = self.prepared.advanced(self.state, self.force, chunk)
            left, self._since = left - chunk, self._since + chunk
            if self._since == self.interval:
                self.adapt()
                self._since = 0
        return self.state

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
        self.state = BodyState(self.state.time, state.displacement, state.velocity, state.history)
        self._prepare()
        self.adaptations += 1
        return True

    def _prepare(self) -> None:
        mesh = self.mesh.leaf.mesh
        self.prepared = self.dynamics.prepared(mesh, self.conditions.constrained(mesh.points))
        self.force = self.conditions.force(mesh, self.prepared.mass)
