"""Motion of linear viscoelastic bodies on adaptive meshes: three-element (Jeffreys) solids by explicit and implicit methods."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, require_positive
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.linear_simplices import lumped_mass
from naibu.mechanics.small_strain.dynamics import simulate_motion
from naibu.mechanics.small_strain.implicit_integrators import MotionState
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.mechanics.small_strain.rheology import Rheology
from naibu.mechanics.small_strain.supports import Support
from naibu.simulation.adaptive.body import BodyState


@dataclass(frozen=True, slots=True)
class LinearDynamics:
    """A linear viscoelastic body and how it is integrated in time.

    Attributes
    ----------
    material : Rheology
        Three-element solid, of all cells; see `naibu.mechanics.Rheology`.
    density : float
        kg/mm^3.
    step : float
        s.
    method : str
        As of `naibu.mechanics.simulate_motion`: implicit (``"sdirk2"``, ``"backward_euler"``, ``"generalized_alpha"``) or explicit
        (``"rk4"``, ``"rkf45"``).

    Raises
    ------
    InputError
        A density or a step that is not positive.
    """

    material: Rheology
    density: float
    step: float
    method: str = "sdirk2"

    def __post_init__(self) -> None:
        require_positive("density", self.density, "kg/mm^3")
        require_positive("step", self.step, "s")

    def prepared(self, mesh: Mesh, constrained: BoolArray) -> LinearMotion:
        """Return the equations of motion on a mesh with fixed components (n, d)."""
        body = LinearBody.of(mesh)
        along = enumerate(constrained.T)
        supports = tuple(Support(f"axis {axis}", np.flatnonzero(held), (axis,)) for axis, held in along if held.any())
        return LinearMotion(self, body, supports, lumped_mass(body.simplices, self.density), self.density * body.simplices.measures)


@dataclass(frozen=True, slots=True, eq=False)
class LinearMotion:
    """Equations of motion of a linear body on one mesh; the history are the internal strains, trace and tensor."""

    dynamics: LinearDynamics
    body: LinearBody
    supports: tuple[Support, ...]
    mass: FloatArray
    cell_mass: FloatArray

    def at_rest(self) -> BodyState:
        """Return the reference configuration at rest."""
        zero, d = np.zeros_like(self.body.points), self.body.points.shape[1]
        return BodyState(0.0, zero, zero, np.zeros((len(self.cell_mass), 1 + d * d)))

    def advanced(self, state: BodyState, force: FloatArray, steps: int) -> BodyState:
        """Return the state after steps under constant forces on the nodes (n, d), mN."""
        d = self.body.points.shape[1]
        trace, strain = state.history[:, 0].copy(), state.history[:, 1:].reshape(-1, d, d).copy()
        start = MotionState(state.time, state.displacement, state.velocity, trace, strain, np.zeros_like(state.velocity), 0.0)
        step = self.dynamics.step
        end = simulate_motion(
            self.body, self.dynamics.material, self.dynamics.density, self.supports, [state.time, state.time + steps * step],
            step=step * (1.0 + 1e-9), method=self.dynamics.method, load=force, initial=start,
        ).final  # fmt: skip
        history = np.concatenate([end.trace[:, None], end.strain.reshape(len(trace), -1)], axis=1)
        return BodyState(end.time, end.displacement, end.velocity, history)
