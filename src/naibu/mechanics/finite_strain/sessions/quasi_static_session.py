"""Quasi-static sessions of finite elements: a loop moves rigid indenters and bodies, and each step ends in equilibrium at finite strain.

There is no inertia: the length of a step only turns velocities into displacements, and an indenter driven by a force stands where the body
balances it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.contact.indenter_contacts import moving_contacts
from naibu.mechanics.contact.indenter_motion import IndenterForce, IndenterMotion, safe_fraction
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_strain.lip_assembly import going_on
from naibu.mechanics.finite_strain.penalties import with_normal_stiffness
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.sessions.indenter_session import IndenterSession
from naibu.mechanics.finite_strain.sessions.session_checks import dead_load
from naibu.mechanics.finite_strain.statics import LoadState, Solution, solve

IN_FEW_STEPS = SolverSettings(first_step=0.5, largest_step=1.0)
FORCE_TOLERANCE = 1e-4  # of the force of a driven indenter
FIRST_ADVANCE = 0.005  # of the extent of the body: how far a driven indenter is moved first
MOST_PARTS = 1000  # of a step, in which indenters that would pass through the object move little by little
FARTHEST = 1.0  # extents of the body


@dataclass(frozen=True, slots=True, eq=False)
class EquilibriumState:
    """Equilibrium of a body with its indenters.

    Attributes
    ----------
    displacement : ndarray, shape (n, 3)
        Of the nodes, mm.
    centres : ndarray, shape (k, 3)
        Positions of the indenters, mm.
    rotations : ndarray, shape (k, 3, 3)
        Their rotations since they were made.
    anchors : tuple of ndarray, shape (p, 3)
        Frictional anchors of their contacts, mm.
    normal_stiffness : tuple of ndarray, shape (p,)
        Penalties of the contacts, kPa/mm, as stiff as they had to be so far.
    lips : ndarray, shape (p, 3), optional
        Frictional anchors of the sides of cuts, mm; those at rest by default.
    """

    displacement: FloatArray
    centres: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    rotations: FloatArray = field(default_factory=lambda: np.zeros((0, 3, 3)))
    anchors: tuple[FloatArray, ...] = ()
    normal_stiffness: tuple[FloatArray, ...] = ()
    lips: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class QuasiStaticEngine:
    """A finite element model prepared for quasi-static steps.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Nodes in the reference configuration, mm.
    assembler : Assembler
        Elements and materials.
    faces : ndarray, shape (f, 3) or (f, 4), int64
        Boundary faces that indenters may touch.
    step : float
        Length of a step, s.
    normal_stiffness, tangential_stiffness : float
        Penalties of the contact, kPa/mm.
    settings : SolverSettings
        Load steps within a step, and tolerances.
    """

    points: FloatArray
    assembler: Assembler
    faces: IntArray
    step: float = 1.0
    normal_stiffness: float = 1000.0
    tangential_stiffness: float = 200.0
    settings: SolverSettings = IN_FEW_STEPS

    def rest(self) -> EquilibriumState:
        """Return the body in the reference configuration, without any force."""
        return EquilibriumState(np.zeros_like(self.points))

    def energy(self, state: EquilibriumState) -> float:
        """Return the strain energy, mN mm."""
        return float(going_on(self.assembler, state.lips).forces(state.displacement)[0])

    def session(
        self,
        state: EquilibriumState | None = None,
        constrained: Sequence[ArrayLike] | None = None,
        external_force: ArrayLike | None = None,
        indenters: Sequence[RigidIndenter] = (),
    ) -> QuasiStaticSession:
        """Begin a session at a state, by default in the reference configuration.

        Parameters
        ----------
        state : EquilibriumState, optional
            Of a session with the same indenters.
        constrained : sequence of array_like
            Nodes that move with each rigid body.
        external_force : array_like, shape (n, 3), optional
            Dead load, mN.
        indenters : sequence of RigidIndenter
            In contact, or about to be.

        Raises
        ------
        InputError
            As `QuasiStaticSession.constrain`, `press` and `restore`.
        """
        return QuasiStaticSession(self, dead_load(external_force, self.points), self.rest()).begun(state, constrained, indenters)


@dataclass(slots=True, eq=False)
class QuasiStaticSession(IndenterSession[QuasiStaticEngine, EquilibriumState]):
    """A body that a loop moves from equilibrium to equilibrium; made by `QuasiStaticEngine.session`. Its attributes: `IndenterSession`.

    At most one of its indenters is driven by a force. A step raises `ConvergenceError` where there is no equilibrium, or where the body
    does not balance the force.
    """

    def press(self, indenters: Sequence[RigidIndenter]) -> None:
        """Bring these indenters, and no others, into play from the next step on; see `IndenterSession.press`."""
        IndenterSession.press(self, indenters)
        self.reached = replace(self.reached, normal_stiffness=())

    def _check_motions(self, motions: Sequence[IndenterMotion]) -> None:
        if sum(isinstance(motion, IndenterForce) for motion in motions) > 1:
            raise InputError("motions drives several indenters by forces; only one can be driven by a force in a step")

    def _advance(
        self, moving: FloatArray, along: FloatArray, spin: FloatArray, motions: Sequence[IndenterMotion]
    ) -> tuple[FloatArray, FloatArray]:
        """Take one step to equilibrium; returns the forces of the bodies and of the indenters, mN."""
        ends = self.reached.centres + self.engine.step * along
        driven = [(k, motion) for k, motion in enumerate(motions) if isinstance(motion, IndenterForce)]
        solution = self._driven(driven[0][1], driven[0][0], moving, ends, spin) if driven else self._solved(moving, ends, spin)
        self.reached = _end_of(solution)
        of_indenters = np.array([solution.reactions[c.name] for c in solution.problem.contacts]).reshape(-1, 3)
        return self._body_forces(solution), of_indenters

    def _solved(self, velocity: FloatArray, ends: FloatArray, spin: FloatArray) -> Solution:
        """Equilibrium at the ends, reached in parts in which no indenter passes through the object."""
        at, left, duration = self.reached, 1.0, self.engine.step
        fastest = float(np.linalg.norm(velocity, axis=1).max(initial=0.0))
        for _ in range(MOST_PARTS):
            travel, turn, approach = ends - at.centres, left * duration * spin, left * duration * fastest
            fraction = safe_fraction(*self._places_of(at), travel, turn, approach)
            solution = self._part_solved(at, fraction * left * duration * velocity, at.centres + fraction * travel, fraction * turn)
            if fraction >= 1.0:
                return solution
            at, left = _end_of(solution), left * (1.0 - fraction)
        came = 100.0 * (1.0 - left)
        raise ConvergenceError(f"{MOST_PARTS} parts of a step bring the indenters only {came:.1f} % of their way; shorten the step")

    def _part_solved(self, at: EquilibriumState, moved: FloatArray, ends: FloatArray, turn: FloatArray) -> Solution:
        """Equilibrium when bodies have `moved` (bodies, 3), mm, and indenters have come to their ends and turned, from a state."""
        prescribed = PrescribedDisplacement.none(len(self.engine.points))
        for nodes, way in zip(self.bodies, moved, strict=True):
            if len(nodes):
                prescribed = prescribed.and_also(nodes, at.displacement[nodes] + way)
        prescribed = replace(prescribed, start=at.displacement)
        contacts = moving_contacts(self._templates, at.centres, at.rotations, ends - at.centres, turn)
        problem = Problem(self.engine.points, self.engine.assembler, contacts, prescribed, self.external_force)
        problem = with_normal_stiffness(problem, at.normal_stiffness)
        return solve(problem, settings=self.engine.settings, start=LoadState(0.0, at.displacement, at.anchors, lips=at.lips))

    def _driven(self, motion: IndenterForce, index: int, velocity: FloatArray, ends: FloatArray, spin: FloatArray) -> Solution:
        """Move an indenter along its guide to where the body balances its force."""
        guide, wanted = motion.guide(), float(motion.force)
        extent = float(np.ptp(self.engine.points, axis=0).max())
        tried: dict[float, Solution] = {}

        def excess(advance: float) -> float:
            placed = ends.copy()
            placed[index] += advance * guide
            tried[advance] = self._solved(velocity, placed, spin)
            return float(tried[advance].reactions[f"indenter {index}"] @ guide) - wanted

        here, reach = excess(0.0), FIRST_ADVANCE * extent
        sign, before = (1.0 if here < 0.0 else -1.0), 0.0
        while abs(here) > FORCE_TOLERANCE * max(abs(wanted), 1e-9) and sign * excess(sign * reach) < 0.0:
            before, reach = reach, 2.0 * reach
            if reach > FARTHEST * extent:
                raise ConvergenceError(f"the body does not balance {wanted:g} mN of indenter {index} within {before:.3g} mm of its guide")
        if abs(here) <= FORCE_TOLERANCE * max(abs(wanted), 1e-9):
            return tried[0.0]
        low, high = sorted((sign * before, sign * reach))
        root = float(brentq(excess, low, high, xtol=1e-6 * extent, rtol=1e-6))
        if root not in tried:
            excess(root)
        return tried[root]

    def _body_forces(self, solution: Solution) -> FloatArray:
        """Forces (bodies, 3), mN, of the bodies of constrained nodes on the object."""
        last = solution.states[-1]
        before = solution.states[-2].anchors if len(solution.states) > 1 else last.anchors
        rest = solution.problem.assembler.forces(last.displacement)[1] - self.external_force
        for contact, anchors in zip(solution.problem.contacts, before, strict=True):
            response = contact.evaluate(last.displacement, anchors, last.load)
            rest = rest - contact.scattered(response.force, len(rest), response.orientation)
        return np.array([rest[nodes].sum(axis=0) for nodes in self.bodies]).reshape(-1, 3)


def _end_of(solution: Solution) -> EquilibriumState:
    """Return the state at the end of a solution."""
    last, contacts = solution.states[-1], solution.problem.contacts
    centres = np.array([c.stop for c in contacts]).reshape(-1, 3)
    rotations = np.array([c.orientation(1.0) for c in contacts]).reshape(-1, 3, 3)
    return EquilibriumState(last.displacement, centres, rotations, last.anchors, last.normal_stiffness, last.lips)
