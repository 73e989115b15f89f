"""Dynamic sessions of finite elements: nonlinear implicit Euler steps with rigid indenters, for bodies that are touched in real time.

A step solves the balance of momentum of backward Euler (`naibu.mechanics.finite_strain.sessions.implicit_step`) by a few Newton
iterations whose linear systems are solved by stabilised biconjugate gradients with the LU factors of an earlier matrix
:cite:p:`courtecuisse2010`. A step that does not converge, as where an indenter stops at once, is taken in halves, and one in which an
indenter would pass through the body in shorter ones, by conservative advancement :cite:p:`ericson2005`. Backward Euler damps motions that
are faster than a step; where the indenters rest, the body settles in the equilibrium of `naibu.mechanics.finite_strain.statics`, with the
same elements, law and contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, Int32Array, IntArray, require_positive, require_shape
from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.contact.indenter_contacts import moving_contacts, turned
from naibu.mechanics.contact.indenter_motion import IndenterForce, IndenterMotion, parts_of_approach, slow_enough
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_strain.lip_assembly import (
    LipMultipliers,
    lips_of,
    multipliers_behind,
    with_friction,
    with_multipliers,
    with_secant,
)
from naibu.mechanics.finite_strain.penalties import node_shear_moduli, relative_penetrations, stiff_enough, with_less_penetration
from naibu.mechanics.finite_strain.sessions.implicit_step import ImplicitStep
from naibu.mechanics.finite_strain.sessions.indenter_session import IndenterSession
from naibu.mechanics.finite_strain.sessions.session_checks import dead_load
from naibu.mechanics.linear_algebra.protocols import LinearSolver
from naibu.mechanics.linear_algebra.recycled_factors import NEWTON_TOLERANCE, RecycledFactors

SUBDIVISIONS = 5  # of a step that does not converge: halves, quarters, ...
PENETRATION = 0.01  # of the edge of a face, to which the penalties limit how deep indenters go into it, as in statics
MOST_RAISES = 6  # of the penalties in a step
DIRECT_ITERATIONS = 5  # of Newton's method with friction: steps that it balances take fewer
RUBBING_ITERATIONS = 40  # of Newton's method without friction, and with its secant, which converges slowly


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
    normal_stiffness : tuple of ndarray, shape (p,)
        Penalties of the contacts, kPa/mm, as stiff as they had to be so far; empty: those of the engine.
    lips : ndarray, shape (p, 3), optional
        Frictional anchors of the sides of cuts, mm; those at rest by default.
    multipliers : LipMultipliers, optional
        Pressures across the sides of cuts, and along their steps, which go on from step to step where penalties would yield to those in a
        nearly incompressible body between walls.
    """

    displacement: FloatArray
    velocity: FloatArray
    centres: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    rotations: FloatArray = field(default_factory=lambda: np.zeros((0, 3, 3)))
    anchors: tuple[FloatArray, ...] = ()
    normal_stiffness: tuple[FloatArray, ...] = ()
    lips: FloatArray | None = None
    multipliers: LipMultipliers | None = None


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
        Penalties of the contact, kPa/mm; on elements for which the normal one is too soft it is raised as in statics.
    iterations : int
        Newton iterations of a step at most.
    tolerance : float
        A step ends before where the residual is below this fraction of the forces.
    divisions : int
        How often a step is tried that Newton's method does not solve: whole, in two parts, in four, and so on.

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
    divisions: int = SUBDIVISIONS
    _extent: float = field(init=False)
    _modulus: float = field(init=False)
    _shear: FloatArray = field(init=False)  # moduli of the elements at every node

    def __post_init__(self) -> None:
        require_shape("mass", self.mass, (len(self.points),))
        for name in ("step", "normal_stiffness", "tangential_stiffness", "iterations", "tolerance", "divisions"):
            require_positive(name, float(getattr(self, name)))
        if not self.mass.min() > 0.0:
            raise InputError(f"mass must be positive at every node, not {self.mass.min():g} kg; remove nodes that no element uses")
        object.__setattr__(self, "_extent", float(np.ptp(self.points, axis=0).max()))
        object.__setattr__(self, "_modulus", float(self.assembler.parameters[:, 0].max()))
        object.__setattr__(self, "_shear", node_shear_moduli(self.assembler))

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
        return DynamicSession(self, dead_load(external_force, self.points), self.rest()).begun(state, constrained, indenters)


@dataclass(slots=True, eq=False)
class DynamicSession(IndenterSession[DynamicEngine, DynamicState]):
    """A body in motion that a loop steps; made by `DynamicEngine.session`. `IndenterSession` has its attributes.

    Its indenters follow poses and velocities.
    """

    _constrained: BoolArray = field(init=False)
    _positions: tuple[Int32Array, ...] = ()
    _solver: LinearSolver | None = None

    def __post_init__(self) -> None:
        self._constrained = np.zeros(self.engine.points.shape, dtype=bool)

    def constrain(self, constrained: Sequence[ArrayLike], bodies: int = 0) -> None:
        """Constrain these nodes, and no others, from the next step on; see `IndenterSession.constrain`."""
        IndenterSession.constrain(self, constrained, bodies)
        self._constrained = np.zeros(self.engine.points.shape, dtype=bool)
        for nodes in self.bodies:
            self._constrained[nodes] = True
        self._solver = None

    def press(self, indenters: Sequence[RigidIndenter]) -> None:
        """Bring these indenters, and no others, into play from the next step on; see `IndenterSession.press`."""
        IndenterSession.press(self, indenters)
        self._templates = stiff_enough(self._templates, self.engine._shear)
        self.reached = replace(self.reached, normal_stiffness=())
        self._positions = tuple(self.engine.assembler.pattern.positions(c.nodes) for c in self._templates)

    def close(self) -> None:
        """Release the factors."""
        self._solver = None

    def _check_motions(self, motions: Sequence[IndenterMotion]) -> None:
        if any(isinstance(motion, IndenterForce) for motion in motions):
            raise InputError("motions has a force; indenters of dynamic finite elements follow poses and velocities")

    def _advance(
        self, moving: FloatArray, along: FloatArray, spin: FloatArray, motions: Sequence[IndenterMotion]
    ) -> tuple[FloatArray, FloatArray]:
        """Take one step, in parts where it does not converge or is too fast; returns the mean forces of bodies and indenters, mN."""
        before, first = self.reached, self._parts(moving, along, spin)
        for level in range(self.engine.divisions):
            parts = first * 2**level
            h = self.engine.step / parts
            found = []
            for _ in range(parts):
                contacts, u = self._settled(h, moving, self._contacts(h, along, spin))
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

    def _parts(self, moving: FloatArray, along: FloatArray, spin: FloatArray) -> int:
        """Parts of a step, a power of two, in each of which no indenter passes through the body."""
        h, at = self.engine.step, self.reached
        moves = h * at.velocity
        for nodes, speed in zip(self.bodies, moving, strict=True):
            moves[nodes] = h * speed
        if slow_enough(self.indenters, h * along, h * spin, float(np.sqrt((moves**2).sum(axis=1).max()))):
            return 1
        indenters, points, centres, axes = self._places_of(at)
        carried = self._templates[0].positions(at.displacement + moves) - points
        return parts_of_approach(indenters, points, carried, centres, axes, h * along, h * spin)

    def _settled(self, h: float, moving: FloatArray, contacts: tuple[Contact, ...]) -> tuple[tuple[Contact, ...], FloatArray | None]:
        """Return contacts stiff enough, and the displacement (n, 3) that balances momentum after a time `h`, or None."""
        u = self._balanced(h, moving, contacts)
        for _ in range(MOST_RAISES):
            stiffer = None if u is None else with_less_penetration(contacts, self._depths(contacts, u), PENETRATION)
            if stiffer is None:
                break
            contacts = stiffer
            u = self._balanced(h, moving, contacts)
        return contacts, u

    def _depths(self, contacts: tuple[Contact, ...], u: FloatArray) -> list[FloatArray]:
        """Return how deep indenters go into the faces at every point (p,) of every contact, as fractions of the edge of the face."""
        return relative_penetrations(contacts, u, 1.0)

    def _balanced(self, h: float, moving: FloatArray, contacts: tuple[Contact, ...]) -> FloatArray | None:
        """Return the displacement (n, 3) that balances momentum after a time `h`; None where Newton's method does not find it.

        The first guess is that the motion goes on as it was; where that fails, as where an indenter stops at once, the last position.
        """
        start, step = self.reached, self._implicit_step(h, contacts)
        for guess in (step.inertial, start.displacement):
            target = np.where(self._constrained, start.displacement, guess)
            for nodes, speed in zip(self.bodies, moving, strict=True):
                target[nodes] = start.displacement[nodes] + h * speed
            found = self._rubbing(step, target) if step.assembler.unsymmetric else self._found(step, target)
            if found is not None:
                return found
        return None

    def _found(self, step: ImplicitStep, guess: FloatArray) -> FloatArray | None:
        try:
            return step.solved(guess, self._solved)
        except ConvergenceError:
            return None

    def _rubbing(self, step: ImplicitStep, guess: FloatArray) -> FloatArray | None:
        """Return the balance of a step whose sides of cuts rub.

        Newton's method converges in a few iterations or not at all. With the symmetric secant of friction it takes more of them and fails
        more rarely.
        """
        found = self._found(replace(step, iterations=min(DIRECT_ITERATIONS, step.iterations)), guess)
        if found is None:
            found = self._found(self._with_secant(step), guess)
        return self._by_way_of_no_friction(step, guess) if found is None else found

    def _by_way_of_no_friction(self, step: ImplicitStep, guess: FloatArray) -> FloatArray | None:
        """Return the balance of a step whose sides of cuts rub, by way of the one without friction, whose pressures are nearly its own.

        Newton's method fails where many pairs close, and begin to slip, at once: when a loaded body is cut, none of them presses yet.
        """
        smooth = replace(step, assembler=with_friction(step.assembler, 0.0), iterations=RUBBING_ITERATIONS)
        found = self._found(smooth, guess)
        return None if found is None else self._found(self._with_secant(step), found)

    def _with_secant(self, step: ImplicitStep) -> ImplicitStep:
        """Return the step with the secant of friction in its tangent."""
        return replace(step, assembler=with_secant(step.assembler, self.reached.lips), iterations=RUBBING_ITERATIONS)

    def _implicit_step(self, h: float, contacts: tuple[Contact, ...]) -> ImplicitStep:
        engine, start = self.engine, self.reached
        # the floor is a force that would strain the body by 1e-5
        floor = 1e-5 * engine._modulus * engine._extent**2
        return ImplicitStep(
            self._assembler(), engine.mass, h, start.displacement, start.velocity, self.external_force, self._constrained, contacts,
            start.anchors, self._positions, engine.tolerance, floor, engine.iterations, lips=start.lips,
        )  # fmt: skip

    def _solved(self, matrix: sp.bsr_matrix, residual: FloatArray) -> FloatArray:
        if self._solver is None:
            self._solver = RecycledFactors(matrix, relative_tolerance=NEWTON_TOLERANCE)
        return self._solver.factorize(matrix).solve(residual.ravel()).reshape(-1, 3)

    def _accepted(self, h: float, u: FloatArray, contacts: tuple[Contact, ...], spin: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Keep the end of a step; returns the forces of the bodies and of the indenters, mN."""
        engine, start = self.engine, self.reached
        responses = [c.evaluate(u, a, 1.0) for c, a in zip(contacts, start.anchors, strict=True)]
        velocity = (u - start.displacement) / h
        internal = self._assembler().in_step(start.displacement, start.lips).forces(u)[1]
        rest = internal - self.external_force + engine.mass[:, None] * (velocity - start.velocity) / h
        of_indenters = np.zeros((len(contacts), 3))
        for k, (contact, response) in enumerate(zip(contacts, responses, strict=True)):
            of_indenters[k] = response.orientation @ response.force.sum(axis=0)
            rest = rest - contact.scattered(response.force, len(u), response.orientation)
        anchors = tuple(c.next_anchors(r) for c, r in zip(contacts, responses, strict=True))
        self.reached = self._behind(h, u, contacts, spin, anchors)
        return np.array([rest[nodes].sum(axis=0) for nodes in self.bodies]).reshape(-1, 3), of_indenters

    def _behind(
        self, h: float, u: FloatArray, contacts: tuple[Contact, ...], spin: FloatArray, anchors: tuple[FloatArray, ...]
    ) -> DynamicState:
        """Return the state at the end of a step."""
        start = self.reached
        centres = np.array([c.stop for c in contacts]).reshape(-1, 3)
        penalties = tuple(c.normal_stiffness for c in contacts)
        moved, turns = (u - start.displacement) / h, turned(start.rotations, h * spin)
        own, slipped = self._assembler().in_step(start.displacement, start.lips), None
        for lips in lips_of(own):
            slipped = lips.anchors_behind(u) if lips.friction > 0.0 else None
        return DynamicState(u, moved, centres, turns, anchors, penalties, slipped, multipliers_behind(own, u))

    def _assembler(self) -> Assembler:
        """Return the assembler of the next step: the sides of cuts press as they did at the end of the last one."""
        return with_multipliers(self.engine.assembler, self.reached.multipliers)

    def _contacts(self, h: float, along: FloatArray, spin: FloatArray) -> tuple[Contact, ...]:
        """Contacts whose bodies move from where they are for a time `h`."""
        state = self.reached
        templates = self._templates
        if state.normal_stiffness:
            pairs = zip(templates, state.normal_stiffness, strict=True)
            templates = tuple(replace(c, normal_stiffness=penalty) for c, penalty in pairs)
        return moving_contacts(templates, state.centres, state.rotations, h * along, h * spin)
