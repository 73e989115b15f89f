"""Motion of hyperelastic bodies of linear tetrahedra: explicit and implicit Euler steps, with viscosity :cite:p:`simo1987`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray, require_positive
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import Material
from naibu.mechanics.finite_strain.penalties import relative_penetrations, with_less_penetration
from naibu.mechanics.finite_strain.sessions.implicit_step import ImplicitStep
from naibu.mechanics.finite_strain.viscoelasticity import HistoryVariables, PronySeries, ViscoelasticBody
from naibu.mechanics.linear_algebra.protocols import LinearSolver
from naibu.mechanics.linear_algebra.recycled_factors import NEWTON_TOLERANCE, RecycledFactors
from naibu.mechanics.linear_algebra.solver_selection import choose_solver
from naibu.simulation.adaptive.body import BodyState
from naibu.simulation.adaptive.body_contact import BodyContact
from naibu.simulation.cuts.cut_sides import with_sides_of_cuts

_MAX_NEWTON = 15
_SUBDIVISIONS = 5  # of a step in contact that does not converge: halves, quarters, ...
_PENETRATION = 0.01  # of the edge of a face, to which the penalties limit how deep indenters go into it
_MOST_RAISES = 6  # of the penalties in a step


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
    normal_stiffness, tangential_stiffness : float
        Penalties of contact with indenters, kPa/mm. Implicit steps make the normal one stiffer where indenters would go deeper into a face
        than 1 % of its edge.

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
    normal_stiffness: float = 1000.0
    tangential_stiffness: float = 200.0

    def __post_init__(self) -> None:
        units = {"density": "kg/mm^3", "step": "s", "tolerance": "", "normal_stiffness": "kPa/mm", "tangential_stiffness": "kPa/mm"}
        for name, unit in units.items():
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
        if self.relaxation is None and self.method == "backward_euler":
            assembler = with_sides_of_cuts(assembler, mesh)
        viscous = None if self.relaxation is None else ViscoelasticBody.of(assembler, self.relaxation, relaxing="all")
        cell_mass = self.density * assembler.elements.weights[:, 0]
        mass = np.bincount(mesh.cells.ravel(), np.repeat(cell_mass / 4.0, 4), minlength=mesh.n_points).astype(np.float64)
        return HyperelasticMotion(self, mesh, assembler, viscous, constrained, mass, cell_mass)


@dataclass(frozen=True, slots=True, eq=False)
class HyperelasticMotion:
    """Equations of motion of a hyperelastic body on one mesh; the history are the stresses of its Maxwell branches."""

    dynamics: HyperelasticDynamics
    mesh: Mesh
    assembler: Assembler
    viscous: ViscoelasticBody | None
    constrained: BoolArray
    mass: FloatArray
    cell_mass: FloatArray
    _solvers: dict[bool, LinearSolver] = field(default_factory=dict)  # of symmetric matrices, and of those with friction

    def at_rest(self) -> BodyState:
        """Return the reference configuration at rest."""
        zero = np.zeros_like(self.mesh.points)
        branches = 0 if self.viscous is None else 1 + len(self.viscous.weights)
        return BodyState(0.0, zero, zero, np.zeros((len(self.cell_mass), 9 * branches)))

    def advanced(self, state: BodyState, force: FloatArray, steps: int) -> BodyState:
        """Return the state after steps under constant forces on the nodes (n, 3), mN.

        Raises
        ------
        ConvergenceError
            A step inverts an element, or Newton's method does not converge.
        """
        for _ in range(steps):
            state = self._after(state, force, self.dynamics.step)
        return state

    def touched(self, indenters: Sequence[RigidIndenter], state: BodyState) -> BodyContact:
        """Return the contact with indenters where they were made.

        Raises
        ------
        InputError
            What `naibu.mechanics.contact.indenter_contacts.indenter_contacts` refuses.
        """
        return BodyContact.of(indenters, self.mesh, self.assembler.pattern, state.displacement, self._penalties())

    def touched_still(self, contact: BodyContact, before: FloatArray, state: BodyState) -> BodyContact:
        """Return on this mesh what a contact on another one, with the displacement `before` (n, 3), mm, has come to."""
        return contact.on(self.mesh, self.assembler.pattern, before, state.displacement, self._penalties())

    def pressed(
        self, state: BodyState, force: FloatArray, contact: BodyContact, along: FloatArray, spin: FloatArray
    ) -> tuple[BodyState, BodyContact, FloatArray]:
        """Take one step with velocities and angular velocities (k, 3), mm/s and rad/s, of indenters; return their forces (k, 3), mN, too.

        It is divided where an indenter would pass through the body, or where an implicit step does not converge.

        Raises
        ------
        ConvergenceError
            It does not converge in shorter steps either.
        """
        h = self.dynamics.step
        approach = h * float(np.sqrt((state.velocity**2).sum(axis=1).max()))
        first, levels = contact.parts(state.displacement, h * along, h * spin, approach), self._levels()
        for level in range(levels):
            parts, total = first * 2**level, np.zeros_like(along)
            now, touch = state, contact
            try:
                for _ in range(parts):
                    now, touch, exerted = self._part(now, touch, force, h / parts, along, spin)
                    total += exerted / parts
            except ConvergenceError:
                if level == levels - 1:
                    raise
            else:
                return now, touch, total
        raise AssertionError("the last level returns or raises")

    def _part(
        self, state: BodyState, contact: BodyContact, force: FloatArray, h: float, along: FloatArray, spin: FloatArray
    ) -> tuple[BodyState, BodyContact, FloatArray]:
        """Return state and contact after a part of a step, and the forces of the indenters (k, 3), mN."""
        contacts, turn = contact.moving(h * along, h * spin), h * spin
        after = self._after(state, force, h, contacts, contact)
        for _ in range(_MOST_RAISES if self.dynamics.method == "backward_euler" else 0):
            stiffer = with_less_penetration(contacts, relative_penetrations(contacts, after.displacement, 1.0), _PENETRATION)
            if stiffer is None:
                break
            contacts = stiffer
            after = self._after(state, force, h, contacts, contact)
        at = after if self.dynamics.method == "backward_euler" else state  # where the forces of the step were taken
        responses = [c.evaluate(at.displacement, a, 1.0) for c, a in zip(contacts, contact.anchors, strict=True)]
        exerted = np.array([r.orientation @ r.force.sum(axis=0) for r in responses]).reshape(-1, 3)
        return after, contact.behind(contacts, responses, turn), exerted

    def energy(self, state: BodyState) -> float:
        """Return kinetic energy plus that of the instantaneous law, mN mm."""
        return 0.5 * float((self.mass * (state.velocity**2).sum(axis=1)).sum()) + self.assembler.forces(state.displacement)[0]

    def _levels(self) -> int:
        """How often a step in contact may be halved."""
        return _SUBDIVISIONS if self.dynamics.method == "backward_euler" else 1

    def _penalties(self) -> tuple[float, float]:
        return self.dynamics.normal_stiffness, self.dynamics.tangential_stiffness

    def _after(
        self, state: BodyState, force: FloatArray, h: float, contacts: tuple[Contact, ...] = (), touch: BodyContact | None = None
    ) -> BodyState:
        """Return the state after a step of length h, s."""
        past = self._branches(state.history)
        assembler = self.assembler if self.viscous is None or past is None else self.viscous.step(past, h)
        anchors, places, bodies = ((), (), ()) if touch is None else (touch.anchors, touch.positions, touch.indenters)
        floor = self.dynamics.tolerance * float(np.abs(self.mass[:, None] * state.velocity).sum()) / h
        step = ImplicitStep(
            assembler, self.mass, h, state.displacement, state.velocity, force, self.constrained, contacts, anchors, places,
            self.dynamics.tolerance, floor, _MAX_NEWTON, self.dynamics.retardation_s,
        )  # fmt: skip
        if self.dynamics.method == "symplectic_euler":
            u = self._explicit(step, state)
        else:
            try:
                u = step.solved(state.displacement.copy(), partial(self._solved, all(i.static_friction == 0.0 for i in bodies)))
            except ConvergenceError as error:
                raise ConvergenceError(f"the implicit step of {h:g} s did not converge: {error}; take shorter steps") from None
        v = np.where(self.constrained, 0.0, (u - state.displacement) / h)
        history = state.history
        if self.viscous is not None and past is not None:
            history = _flat(self.viscous.updated(past, u, h))
        return BodyState(state.time + h, u, v, history)

    def _explicit(self, step: ImplicitStep, state: BodyState) -> FloatArray:
        """Return the displacement after an explicit step, by the forces at its beginning."""
        u, v = state.displacement, state.velocity
        _, internal, smallest = step.assembler.forces(u + self.dynamics.retardation_s * v)
        if not smallest > 0.0:
            raise ConvergenceError(f"the explicit steps of {self.dynamics.step:g} s diverged: take shorter ones, or 'backward_euler'")
        total = step.external_force - internal
        for c, anchor in zip(step.contacts, step.anchors, strict=True):
            response = c.evaluate(u, anchor, 1.0)
            total = total + c.scattered(response.force, len(u), response.orientation)
        return np.where(self.constrained, u, u + step.duration * (v + step.duration * total / self.mass[:, None]))

    def _solved(self, symmetric: bool, matrix: sp.bsr_matrix, residual: FloatArray) -> FloatArray:
        if symmetric not in self._solvers:
            chosen = (
                choose_solver(matrix, self.mesh.points, self.constrained, symmetric=True)
                if symmetric
                else RecycledFactors(matrix, relative_tolerance=NEWTON_TOLERANCE)
            )
            self._solvers[symmetric] = chosen
        return self._solvers[symmetric].factorize(matrix).solve(residual.ravel()).reshape(-1, 3)

    def _branches(self, history: FloatArray) -> HistoryVariables | None:
        if self.viscous is None:
            return None
        stresses = np.moveaxis(history.reshape(len(history), -1, 1, 3, 3), 1, 0)
        return HistoryVariables(np.ascontiguousarray(stresses[0]), np.ascontiguousarray(stresses[1:]))


def _flat(history: HistoryVariables) -> FloatArray:
    stresses = np.concatenate([history.elastic[None], history.branches])
    return np.ascontiguousarray(np.moveaxis(stresses, 0, 1).reshape(stresses.shape[1], -1))
