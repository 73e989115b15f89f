"""Dynamic sessions of finite elements: nonlinear implicit Euler steps with rigid indenters, for bodies that are touched in real time.

A step solves the balance of momentum of backward Euler, M (u - u_0 - h v_0) / h^2 + f(u) = g, by a few Newton iterations whose linear
systems are solved by stabilised biconjugate gradients with the LU factors of an earlier matrix :cite:p:`courtecuisse2010`; a step that does
not converge, as where an indenter stops at once, is taken in halves. Backward Euler damps motions that are faster than a step; where the
indenters rest, the body settles in the equilibrium of `naibu.mechanics.finite_strain.statics`, with the same elements, law and contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Self

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, Int32Array, IntArray, require_positive, require_shape
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.rigid_transform import rotation_matrix
from naibu.mechanics.contact.contact_surfaces import Friction, rigid_contact
from naibu.mechanics.contact.indenter_motion import IndenterForce, IndenterMotion
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.contact.session_protocol import StepForces
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_strain.session_checks import checked_bodies, checked_velocities, require_one_friction, require_state
from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows
from naibu.mechanics.linear_algebra.protocols import LinearSolver
from naibu.mechanics.linear_algebra.recycled_lu import RecycledLU

HALVINGS = 6  # of a Newton step that inverts an element or goes too far
SUBDIVISIONS = 5  # of a step that does not converge: halves, quarters, ...
ACCEPTED = 5.0  # tolerances: residual of a step that has used up its iterations


@dataclass(frozen=True, slots=True, eq=False)
class DynamicState:
    """State of a body in motion, with its indenters.

    Attributes
    ----------
    displacement : ndarray, shape (n, 3)
        Of the nodes, mm.
    velocity : ndarray, shape (n, 3)
        mm/s.
    centres : ndarray, shape (k, 3)
        Positions of the indenters, mm.
    rotations : ndarray, shape (k, 3, 3)
        Their rotations since they were made.
    anchors : tuple of ndarray, shape (p, 3)
        Frictional anchors of their contacts, mm.
    """

    displacement: FloatArray
    velocity: FloatArray
    centres: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    rotations: FloatArray = field(default_factory=lambda: np.zeros((0, 3, 3)))
    anchors: tuple[FloatArray, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class DynamicEngine:
    """A finite element model prepared for implicit dynamic steps.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Nodes in the reference configuration, mm.
    assembler : Assembler
        Elements and materials.
    mass : ndarray, shape (n,)
        Lumped masses, kg.
    faces : ndarray, shape (f, 3) or (f, 4), int64
        Boundary faces that indenters may touch.
    step : float
        Length of a step, s.
    normal_stiffness, tangential_stiffness : float
        Penalties of the contact, kPa/mm.
    iterations : int
        Newton iterations of a step at most.
    tolerance : float
        A step ends before where the residual is below this fraction of the forces.

    Raises
    ------
    InputError
        Masses for another number of nodes, or that are not positive; a step, penalty or tolerance that is not positive.
    """

    points: FloatArray
    assembler: Assembler
    mass: FloatArray
    faces: IntArray
    step: float = 1.0 / 60.0
    normal_stiffness: float = 1000.0
    tangential_stiffness: float = 200.0
    iterations: int = 10
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        require_shape("mass", self.mass, (len(self.points),))
        for name in ("step", "normal_stiffness", "tangential_stiffness", "iterations", "tolerance"):
            require_positive(name, float(getattr(self, name)))
        if not self.mass.min() > 0.0:
            raise InputError(f"mass must be positive at every node, not {self.mass.min():g} kg; remove nodes that no element uses")

    def rest(self) -> DynamicState:
        """Return the body in the reference configuration, at rest."""
        return DynamicState(np.zeros_like(self.points), np.zeros_like(self.points))

    def energy(self, state: DynamicState) -> float:
        """Return kinetic and strain energy, mN mm."""
        kinetic = 0.5 * float((self.mass * (state.velocity**2).sum(axis=1)).sum())
        return kinetic + float(self.assembler.forces(state.displacement)[0])

    def session(
        self,
        state: DynamicState | None = None,
        constrained: Sequence[ArrayLike] | None = None,
        external_force: ArrayLike | None = None,
        indenters: Sequence[RigidIndenter] = (),
    ) -> DynamicSession:
        """Begin a session at a state, by default at rest in the reference configuration.

        Parameters
        ----------
        state : DynamicState, optional
            Of a session with the same indenters.
        constrained : sequence of array_like
            Nodes that move with each rigid body.
        external_force : array_like, shape (n, 3), optional
            Dead load, mN.
        indenters : sequence of RigidIndenter
            In contact, or about to be.

        It raises what `DynamicSession.constrain`, `press` and `restore` raise.
        """
        load = np.broadcast_to(np.asarray(0.0 if external_force is None else external_force, dtype=float), self.points.shape)
        session = DynamicSession(self, load, self.rest())
        session.constrain(constrained or ())
        session.press(indenters)
        if state is not None:
            session.restore(state)
        return session


@dataclass(slots=True, eq=False)
class DynamicSession:
    """A body in motion that a loop steps; made by `DynamicEngine.session`.

    Attributes
    ----------
    engine : DynamicEngine
        The model.
    external_force : ndarray, shape (n, 3)
        Dead load, mN.
    reached : DynamicState
        State behind the last step.
    bodies : tuple of ndarray
        Nodes of each rigid body.
    indenters : tuple of RigidIndenter
        As they were made.
    """

    engine: DynamicEngine
    external_force: FloatArray
    reached: DynamicState
    bodies: tuple[IntArray, ...] = ()
    indenters: tuple[RigidIndenter, ...] = ()
    _templates: tuple[Contact, ...] = ()
    _constrained: BoolArray = field(init=False)
    _positions: tuple[Int32Array, ...] = ()
    _diagonal: IntArray = field(init=False)
    _solver: LinearSolver | None = None
    _forces: StepForces = field(default_factory=lambda: StepForces(np.zeros((0, 0, 3))))

    def __post_init__(self) -> None:
        self._constrained = np.zeros(self.engine.points.shape, dtype=bool)
        pattern = self.engine.assembler.pattern
        rows = np.repeat(np.arange(pattern.n_points), np.diff(pattern.indptr))
        self._diagonal = np.flatnonzero(pattern.indices == rows)

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
        self._constrained = np.zeros(self.engine.points.shape, dtype=bool)
        for nodes in self.bodies:
            self._constrained[nodes] = True
        self._solver = None

    def press(self, indenters: Sequence[RigidIndenter]) -> None:
        """Bring these indenters, and no others, into play from the next step on, where they were made.

        Raises
        ------
        InputError
            An indenter with pull-off, or with a kinetic friction below the static one, which this contact has not.
        """
        require_one_friction(indenters)
        self.indenters = tuple(indenters)
        engine = self.engine
        self._templates = tuple(
            rigid_contact(
                f"indenter {k}", engine.points, engine.faces, i.geometry, start=i.centre, stop=i.centre,
                friction=Friction(i.static_friction, engine.tangential_stiffness), normal_stiffness=engine.normal_stiffness,
            )
            for k, i in enumerate(indenters)
        )  # fmt: skip
        self._positions = tuple(engine.assembler.pattern.positions(c.nodes) for c in self._templates)
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
            Poses or velocities, one for each indenter, or none: they stand still.
        steps : int
            Number of steps; a pose is reached at the end of the last.

        Raises
        ------
        InputError
            Motions for another number of indenters, a force among them, or values of another shape.
        ConvergenceError
            A step inverts an element however it is shortened; the session stays at the last state.
        """
        if any(isinstance(motion, IndenterForce) for motion in motions):
            raise InputError("motions has a force; indenters of dynamic finite elements follow poses and velocities")
        speeds = np.broadcast_to(np.asarray(velocity, dtype=float), (steps, len(self.bodies), 3))
        duration = steps * self.engine.step
        along, spin = checked_velocities(self.indenters, motions, self.reached.centres, self.reached.rotations, duration)
        of_bodies, of_indenters = np.zeros((steps, len(self.bodies), 3)), np.zeros((steps, len(self.indenters), 3))
        for k, moving in enumerate(speeds):
            of_bodies[k], of_indenters[k] = self._advance(moving, along, spin)
        self._forces = StepForces(of_bodies, of_indenters)
        return self._forces

    def positions(self, nodes: ArrayLike | None = None) -> FloatArray:
        """Return positions of nodes (k, 3), mm, by default of all."""
        x = self.engine.points + self.reached.displacement
        return x if nodes is None else np.asarray(x[np.asarray(nodes, dtype=np.int64)])

    def forces(self) -> StepForces:
        """Return the forces of the last call of `step`."""
        return self._forces

    def state(self) -> DynamicState:
        """Return the state, contacts included."""
        return self.reached

    def restore(self, state: DynamicState) -> None:
        """Go on from a state.

        Raises
        ------
        InputError
            A state of another mesh or of other indenters.
        """
        require_state(state.displacement, state.anchors, self.engine.points, self.indenters)
        same = len(state.anchors) == len(self.indenters)
        self.reached = state if same else replace(self.reached, displacement=state.displacement, velocity=state.velocity)

    def close(self) -> None:
        """Release the factors."""
        self._solver = None

    def __enter__(self) -> Self:
        """Return the session."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close it."""
        self.close()

    def _advance(self, moving: FloatArray, along: FloatArray, spin: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Take one step, in halves where it does not converge; returns the mean forces of the bodies and of the indenters, mN."""
        before = self.reached
        for level in range(SUBDIVISIONS):
            parts = 2**level
            h = self.engine.step / parts
            found = []
            for _ in range(parts):
                contacts = self._contacts(h, along, spin)
                u = self._balanced(h, moving, contacts)
                if u is None:
                    break
                found.append(self._accepted(h, u, contacts, spin))
            else:
                bodies, indenters = (np.mean(forces, axis=0) for forces in zip(*found, strict=True))
                return bodies, indenters
            self.reached = before
        raise ConvergenceError(
            f"a step of {self.engine.step:g} s finds no balance of momentum, in {parts} parts neither; move the indenter more slowly, "
            "or less deep"
        )

    def _balanced(self, h: float, moving: FloatArray, contacts: tuple[Contact, ...]) -> FloatArray | None:
        """Return the displacement (n, 3) that balances momentum after a time `h`; None where Newton's method does not find it.

        The first guess is that the motion goes on as it was; where that fails, as where an indenter stops at once, the last position.
        """
        start = self.reached
        inertial = start.displacement + h * start.velocity
        for guess in (inertial, start.displacement):
            target = np.where(self._constrained, start.displacement, guess)
            for nodes, speed in zip(self.bodies, moving, strict=True):
                target[nodes] = start.displacement[nodes] + h * speed
            try:
                return self._newton(h, target, inertial, contacts)
            except ConvergenceError:
                continue
        return None

    def _newton(self, h: float, u: FloatArray, inertial: FloatArray, contacts: tuple[Contact, ...]) -> FloatArray:
        """Return the solution of one step near `u`, whose constrained nodes are where they belong.

        Raises
        ------
        ConvergenceError
            An inverted element, a singular matrix, or too many iterations.
        """
        residual, scale = self._residual(h, u, inertial, contacts)
        for _ in range(self.engine.iterations):
            if float(np.abs(residual).sum()) <= self.engine.tolerance * scale:
                return u
            matrix = self._tangent(h, u, contacts)
            u, residual, scale = self._searched(h, u, -self._solved(matrix, residual), inertial, contacts, residual)
        if float(np.abs(residual).sum()) > ACCEPTED * self.engine.tolerance * scale:
            raise ConvergenceError(f"no balance within {self.engine.iterations} iterations")
        return u

    def _residual(self, h: float, u: FloatArray, inertial: FloatArray, contacts: tuple[Contact, ...]) -> tuple[FloatArray, float]:
        """Return the out-of-balance force (n, 3) and a scale of the forces, mN."""
        _, internal, smallest = self.engine.assembler.forces(u)
        if not smallest > 0.0:
            raise ConvergenceError(f"an element is inverted (det F = {smallest:.3g})")
        contact = np.zeros_like(internal)
        for c, anchor in zip(contacts, self.reached.anchors, strict=True):
            response = c.evaluate(u, anchor, 1.0)
            contact += c.scattered(response.force, len(u), response.orientation)
        return self._balance(h, u, inertial, internal, contact)

    def _balance(
        self, h: float, u: FloatArray, inertial: FloatArray, internal: FloatArray, contact: FloatArray
    ) -> tuple[FloatArray, float]:
        engine = self.engine
        residual = internal + (engine.mass / h**2)[:, None] * (u - inertial) - self.external_force - contact
        residual[self._constrained] = 0.0
        # the floor is a force that would strain the body by 1e-5
        floor = 1e-5 * float(engine.assembler.parameters[:, 0].max()) * float(np.ptp(engine.points, axis=0).max()) ** 2
        return residual, float(np.abs(internal).sum() + np.abs(self.external_force).sum()) + floor / engine.tolerance

    def _tangent(self, h: float, u: FloatArray, contacts: tuple[Contact, ...]) -> sp.bsr_matrix:
        """Return the matrix of a Newton step, mN/mm."""
        pattern = self.engine.assembler.pattern
        blocks = self.engine.assembler.evaluate(u)[2]
        for c, anchor, positions in zip(contacts, self.reached.anchors, self._positions, strict=True):
            c.add_stiffness(c.evaluate(u, anchor, 1.0), pattern, positions, blocks)
        blocks[self._diagonal] += (self.engine.mass / h**2)[:, None, None] * np.eye(3)
        return with_dirichlet_rows(pattern.matrix(blocks), self._constrained)

    def _solved(self, matrix: sp.bsr_matrix, residual: FloatArray) -> FloatArray:
        if self._solver is None:
            self._solver = RecycledLU(matrix)
        return self._solver.factorize(matrix).solve(residual.ravel()).reshape(-1, 3)

    def _searched(
        self, h: float, u: FloatArray, step: FloatArray, inertial: FloatArray, contacts: tuple[Contact, ...], residual: FloatArray
    ) -> tuple[FloatArray, FloatArray, float]:
        """Return ``u + a step`` with the largest a of 1, 1/2, ... at which the residual does less work on the step, and the residual."""
        before = abs(float((residual * step).sum()))
        for k in range(HALVINGS):
            trial = u + 0.5**k * step
            try:
                after, scale = self._residual(h, trial, inertial, contacts)
            except ConvergenceError:
                continue
            if abs(float((after * step).sum())) < before:
                return trial, after, scale
        raise ConvergenceError("no step along the Newton direction reduces the residual")

    def _accepted(self, h: float, u: FloatArray, contacts: tuple[Contact, ...], spin: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Keep the end of a step; returns the forces of the bodies and of the indenters, mN."""
        engine, start = self.engine, self.reached
        responses = [c.evaluate(u, a, 1.0) for c, a in zip(contacts, start.anchors, strict=True)]
        velocity = (u - start.displacement) / h
        rest = engine.assembler.forces(u)[1] - self.external_force + engine.mass[:, None] * (velocity - start.velocity) / h
        of_indenters = np.zeros((len(contacts), 3))
        for k, (contact, response) in enumerate(zip(contacts, responses, strict=True)):
            of_indenters[k] = response.orientation @ response.force.sum(axis=0)
            rest = rest - contact.scattered(response.force, len(u), response.orientation)
        centres = np.array([c.stop for c in contacts]).reshape(-1, 3)
        turned = [rotation_matrix(h * w) @ r if w.any() else r for w, r in zip(spin, start.rotations, strict=True)]
        anchors = tuple(c.next_anchors(r) for c, r in zip(contacts, responses, strict=True))
        self.reached = DynamicState(u, velocity, centres, np.array(turned).reshape(-1, 3, 3), anchors)
        return np.array([rest[nodes].sum(axis=0) for nodes in self.bodies]).reshape(-1, 3), of_indenters

    def _contacts(self, h: float, along: FloatArray, spin: FloatArray) -> tuple[Contact, ...]:
        """Contacts whose bodies move from where they are for a time `h`."""
        out, state = [], self.reached
        for k, template in enumerate(self._templates):
            start = state.centres[k]
            tilt = h * spin[k] if spin[k].any() else None
            out.append(replace(template, start=start, stop=start + h * along[k], rotation=state.rotations[k], tilt=tilt))
        return tuple(out)
