"""Motion of hyperelastic bodies of linear tetrahedra: explicit and implicit Euler steps, with viscosity :cite:p:`simo1987`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, require_positive
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import Material
from naibu.mechanics.finite_strain.viscoelasticity import HistoryVariables, PronySeries, ViscoelasticBody
from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows
from naibu.mechanics.linear_algebra.solver_selection import choose_solver
from naibu.simulation.adaptive.body import BodyState

_MAX_NEWTON = 15


@dataclass(frozen=True, slots=True)
class HyperelasticDynamics:
    """A hyperelastic body and how it is integrated in time.

    Attributes
    ----------
    materials : tuple of Material
        One for each region.
    density : float
        kg/mm^3.
    step : float
        s.
    method : str
        ``"backward_euler"``, implicit, which also damps, or ``"symplectic_euler"``, explicit.
    retardation_s : float
        Time tau of a Voigt viscosity, s: forces are those of the displacement ``u + tau v``.
    relaxation : PronySeries, optional
        Relaxation of the whole stress, in Maxwell branches.
    tolerance : float
        Residual of the implicit step, as a fraction of the sum of all nodal forces.

    Raises
    ------
    InputError
        Values that are not positive, or an unknown method.
    """

    materials: tuple[Material, ...]
    density: float
    step: float
    method: Literal["backward_euler", "symplectic_euler"] = "backward_euler"
    retardation_s: float = 0.0
    relaxation: PronySeries | None = None
    tolerance: float = 1e-8

    def __post_init__(self) -> None:
        for name, unit in (("density", "kg/mm^3"), ("step", "s"), ("tolerance", "")):
            require_positive(name, getattr(self, name), unit)
        if self.method not in ("backward_euler", "symplectic_euler"):
            raise InputError(f"method is 'backward_euler' or 'symplectic_euler', not {self.method!r}")
        if not (np.isfinite(self.retardation_s) and self.retardation_s >= 0.0):
            raise InputError(f"retardation_s must not be negative, not {self.retardation_s:g} s")

    def prepared(self, mesh: Mesh, constrained: BoolArray) -> HyperelasticMotion:
        """Return the equations of motion on a mesh of tetrahedra with fixed components (n, 3).

        Raises
        ------
        InputError
            Other cells, or a region without a material.
        """
        if mesh.cell_type != "tetra":
            raise InputError(f"hyperelastic dynamics needs linear tetrahedra, not {mesh.cell_type!r} cells")
        assembler = Assembler.from_materials(elements(mesh, "standard"), mesh.regions, list(self.materials))
        viscous = None if self.relaxation is None else ViscoelasticBody.of(assembler, self.relaxation, relaxing="all")
        cell_mass = self.density * assembler.elements.weights[:, 0]
        mass = np.bincount(mesh.cells.ravel(), np.repeat(cell_mass / 4.0, 4), minlength=mesh.n_points).astype(np.float64)
        return HyperelasticMotion(self, mesh.points, assembler, viscous, constrained, mass, cell_mass)


@dataclass(frozen=True, slots=True, eq=False)
class HyperelasticMotion:
    """Equations of motion of a hyperelastic body on one mesh; the history are the stresses of its Maxwell branches."""

    dynamics: HyperelasticDynamics
    points: FloatArray
    assembler: Assembler
    viscous: ViscoelasticBody | None
    constrained: BoolArray
    mass: FloatArray
    cell_mass: FloatArray

    def at_rest(self) -> BodyState:
        """Return the reference configuration at rest."""
        zero = np.zeros_like(self.points)
        branches = 0 if self.viscous is None else 1 + len(self.viscous.weights)
        return BodyState(0.0, zero, zero, np.zeros((len(self.cell_mass), 9 * branches)))

    def advanced(self, state: BodyState, force: FloatArray, steps: int) -> BodyState:
        """Return the state after steps under constant forces on the nodes (n, 3), mN.

        Raises
        ------
        ConvergenceError
            A step inverts an element, or Newton's method does not converge.
        """
        u, v, history, step = state.displacement, state.velocity, state.history, self.dynamics.step
        advance = self._explicit if self.dynamics.method == "symplectic_euler" else self._implicit
        for _ in range(steps):
            past = self._branches(history)
            assembler = self.assembler if self.viscous is None or past is None else self.viscous.step(past, step)
            u, v = advance(assembler, u, v, force)
            if self.viscous is not None and past is not None:
                history = _flat(self.viscous.updated(past, u, step))
        return BodyState(state.time + steps * step, u, v, history)

    def energy(self, state: BodyState) -> float:
        """Return kinetic energy plus that of the instantaneous law, mN mm."""
        return 0.5 * float((self.mass * (state.velocity**2).sum(axis=1)).sum()) + self.assembler.forces(state.displacement)[0]

    def _explicit(self, assembler: Assembler, u: FloatArray, v: FloatArray, force: FloatArray) -> tuple[FloatArray, FloatArray]:
        _, internal, smallest = assembler.forces(u + self.dynamics.retardation_s * v)
        if not smallest > 0.0:
            raise ConvergenceError(f"the explicit steps of {self.dynamics.step:g} s diverged: take shorter ones, or 'backward_euler'")
        v = np.where(self.constrained, 0.0, v + self.dynamics.step * (force - internal) / self.mass[:, None])
        return u + self.dynamics.step * v, v

    def _implicit(self, assembler: Assembler, u: FloatArray, v: FloatArray, force: FloatArray) -> tuple[FloatArray, FloatArray]:
        step, lag = self.dynamics.step, self.dynamics.retardation_s / self.dynamics.step
        pattern = assembler.pattern
        diagonal = pattern.positions(np.arange(len(u))[:, None])[:, 0, 0]
        inertia = self.mass[:, None] / step**2
        end, solver = u.copy(), None
        for _ in range(_MAX_NEWTON):
            _, internal, blocks, smallest = assembler.evaluate(end + lag * (end - u))
            if not smallest > 0.0:
                break
            pull = inertia * (end - u - step * v)
            residual = np.where(self.constrained, 0.0, pull + internal - force)
            scale = float(np.abs(internal).sum() + np.abs(force).sum() + np.abs(inertia * step * v).sum())
            if float(np.abs(residual).sum()) <= self.dynamics.tolerance * scale:
                return end, np.where(self.constrained, 0.0, (end - u) / step)
            blocks *= 1.0 + lag
            blocks[diagonal] += inertia[:, :, None] * np.eye(3)
            matrix = with_dirichlet_rows(pattern.matrix(blocks), self.constrained)
            if solver is None:
                solver = choose_solver(matrix, self.points, self.constrained, symmetric=True)
            end = end - solver.factorize(matrix).solve(residual.ravel()).reshape(-1, 3)
        raise ConvergenceError(f"the implicit step of {step:g} s did not converge in {_MAX_NEWTON} iterations: take shorter steps")

    def _branches(self, history: FloatArray) -> HistoryVariables | None:
        if self.viscous is None:
            return None
        stresses = np.moveaxis(history.reshape(len(history), -1, 1, 3, 3), 1, 0)
        return HistoryVariables(np.ascontiguousarray(stresses[0]), np.ascontiguousarray(stresses[1:]))


def _flat(history: HistoryVariables) -> FloatArray:
    stresses = np.concatenate([history.elastic[None], history.branches])
    return np.ascontiguousarray(np.moveaxis(stresses, 0, 1).reshape(stresses.shape[1], -1))
