"""Equilibrium at one load: Newton's method with line search, and a relaxation for where it circles."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray

from naibu.core.errors import ConvergenceError
from naibu.mechanics.assembly import Assembler
from naibu.mechanics.contact import PLANE, Contact, ContactResponse
from naibu.mechanics.linear_solvers import ApproximateFactorization, Factorization, LinearSolver, choose_solver
from naibu.mechanics.supports import Prescribed

Array = NDArray[np.float64]
RELAXATION_ITERATIONS = 40
DRIFT = 100.0  # extents of the body
DRAG = 0.01  # stiffness of the drag at first, as a fraction of the mean diagonal of the tangent
_COARSE = 0.01  # relative tolerance of linear solves far from equilibrium, for solvers that can make use of it


@dataclass(frozen=True, slots=True)
class SolverSettings:
    """How to follow the load path.

    Attributes
    ----------
    first_step, largest_step, smallest_step : float
        Fractions of the whole load.
    tolerance : float
        Newton's method ends when the residual force has fallen below this fraction of the contact and support forces.
    max_iterations : int
        Newton iterations of one load step before it is halved.
    anchor_stiffness : float
        Weak springs to the ground on every node, as a fraction of the mean diagonal of the tangent; they only keep a body that nothing
        holds yet from drifting.
    """

    first_step: float = 0.05
    largest_step: float = 0.12
    smallest_step: float = 1e-3
    tolerance: float = 1e-7
    max_iterations: int = 16
    anchor_stiffness: float = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """A body, what it is made of, what holds and presses it.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Nodes in the free state, mm.
    assembler : Assembler
        Elements and materials; its pattern must hold the contacts' couplings (`block_pattern` with their nodes).
    contacts : tuple of Contact
        Rigid bodies and interfaces.
    prescribed : Prescribed
        Given displacements.
    external_force : ndarray, shape (n, 3)
        Dead load, mN, present from the beginning (weight).
    """

    points: Array
    assembler: Assembler
    contacts: tuple[Contact, ...]
    prescribed: Prescribed
    external_force: Array
    _positions: tuple[NDArray[np.int32], ...] = field(default=())

    def __post_init__(self) -> None:
        if not self._positions and self.contacts:
            object.__setattr__(self, "_positions", tuple(self.assembler.pattern.positions(c.nodes) for c in self.contacts))

    @property
    def unsymmetric(self) -> bool:
        """Whether Coulomb friction makes the tangent unsymmetric."""
        curved = any(c.surface.kind != PLANE for c in self.contacts)  # friction turns with the normal
        return curved or any(not c.bonded and float(c.friction_coefficient.min()) < 100.0 for c in self.contacts)

    def with_changes(self, *, assembler: Assembler | None = None, contacts: tuple[Contact, ...] | None = None) -> Problem:
        """Return the problem with other parameters or bodies (same nodes)."""
        return replace(self, assembler=assembler or self.assembler, contacts=contacts if contacts is not None else self.contacts)


@dataclass(slots=True, eq=False)
class Newton:
    """Equilibrium iterations for one problem; keeps the analysed linear solver from step to step."""

    problem: Problem
    settings: SolverSettings
    solver: LinearSolver | None = None
    iterations: int = 0
    drifts: bool = False  # whether the last step would have thrown the body away: nothing holds it

    def residual(self, u: Array, anchors: tuple[Array, ...], load: float) -> tuple[Array, float, float]:
        """Return the out-of-balance force (n, 3) mN, a force scale mN, and the smallest det F."""
        _, internal, smallest = self.problem.assembler.forces(u)
        if not smallest > 0.0:
            return internal, np.inf, smallest
        contact = np.zeros_like(internal)
        for c, a in zip(self.problem.contacts, anchors, strict=True):
            response = c.evaluate(u, a, load)
            contact += c.scattered(response.force, len(u), response.orientation)
        return *self._balance(internal, contact), smallest

    def _balance(self, internal: Array, contact: Array) -> tuple[Array, float]:
        r = internal - contact - self.problem.external_force
        held = self.problem.prescribed.held
        # the floor is a force that would strain the body by 1e-5: it counts where contacts open and nothing presses any more
        floor = 1e-5 * float(self.problem.assembler.parameters[:, 0].max()) * float(np.ptp(self.problem.points, axis=0).max()) ** 2
        scale = float(np.abs(contact).sum() + np.abs(r[held]).sum() + np.abs(self.problem.external_force).sum()) + floor
        r[held] = 0.0
        return r, scale

    def linearised(self, u: Array, anchors: tuple[Array, ...], load: float) -> tuple[Array, float, Factorization, list[ContactResponse]]:
        """Return residual, force scale, the factorized tangent (held rows and columns replaced by the identity) and contact responses.

        Raises
        ------
        ConvergenceError
            An inverted element, or a singular tangent.
        """
        residual, scale, matrix, responses = self._tangent(u, anchors, load)
        return residual, scale, self._factorized(matrix), responses

    def _tangent(
        self, u: Array, anchors: tuple[Array, ...], load: float, *, curvature: bool = True
    ) -> tuple[Array, float, sp.bsr_matrix, list[ContactResponse]]:
        """Return residual, force scale, the tangent of all nodes, held or not, and contact responses."""
        p = self.problem
        _, internal, blocks, smallest = p.assembler.evaluate(u)
        if not smallest > 0.0:
            raise ConvergenceError(f"an element is inverted (det F = {smallest:.3g})")
        contact = np.zeros_like(internal)
        responses = []
        for c, a, positions in zip(p.contacts, anchors, p._positions, strict=True):
            response = c.evaluate(u, a, load, curvature=curvature)
            contact += c.scattered(response.force, len(u), response.orientation)
            c.add_stiffness(response, p.assembler.pattern, positions, blocks)
            responses.append(response)
        residual, scale = self._balance(internal, contact)
        return residual, scale, p.assembler.pattern.matrix(blocks), responses

    def _factorized(self, matrix: sp.bsr_matrix, drag: float = 0.0) -> Factorization:
        p = self.problem
        matrix = constrained(matrix, p.prescribed.held, self.settings.anchor_stiffness + drag)
        if self.solver is None:
            self.solver = choose_solver(matrix, p.points, p.prescribed.held.ravel(), symmetric=not p.unsymmetric)
        return self.solver.factorize(matrix)

    def solve(self, u: Array, anchors: tuple[Array, ...], load: float) -> tuple[Array, float] | None:
        """Return displacement and relative residual in equilibrium, starting from `u`; None where the iteration fails."""
        struggles, previous = 0, 0.0
        extent = float(np.ptp(self.problem.points, axis=0).max())
        try:
            u = self._carried(u, anchors, load)
            for _ in range(self.settings.max_iterations):
                residual, scale, matrix, _ = self._tangent(u, anchors, load)
                norm = float(np.abs(residual).sum())
                if norm <= self.settings.tolerance * scale:
                    return u, norm / scale
                self.iterations += 1
                step = -solved(self._factorized(matrix), residual, self._forcing(norm, previous, scale))
                self.drifts = float(np.abs(step).max()) > DRIFT * extent
                found = self._line_search(u, step, anchors, load, residual)
                struggles += found is None or found[1] < 0.15
                if found is None or struggles > 2 or np.abs(step).max() > extent:
                    return None  # a shorter load step costs less than a long fight
                u, previous = found[0], norm
                if found[2] <= self.settings.tolerance:
                    return u, found[2]
        except ConvergenceError:
            return None
        return None

    def relax(self, u: Array, anchors: tuple[Array, ...], load: float) -> tuple[Array, float] | None:
        """Return displacement and relative residual in equilibrium, followed from `u` through a motion with drag; None where it stays away.

        A contact point that slips over an edge jumps to another equilibrium, which Newton's method circles without end. Pseudo-transient
        continuation (Kelley and Keyes 1998, SIAM J. Numer. Anal. 35:508) moves there: the drag falls with the residual.
        """
        norms: list[float] = []
        try:
            u = self._carried(u, anchors, load)
            for _ in range(RELAXATION_ITERATIONS):
                residual, scale, matrix, _ = self._tangent(u, anchors, load, curvature=False)
                norm = float(np.abs(residual).sum())
                if norm <= self.settings.tolerance * scale:
                    return u, norm / scale
                norms.append(norm)
                self.iterations += 1
                step = -solved(self._factorized(matrix, DRAG * min(norm / norms[0], 1.0)), residual, _COARSE)
                if len(norms) > 2 and norm > 0.8 * norms[-3]:
                    step *= 0.5  # points that stick and slip in turn: meet in the middle
                for _ in range(6):
                    if self.residual(u + step, anchors, load)[2] > 0.0:
                        break
                    step *= 0.5
                u = u + step
        except ConvergenceError:
            return None
        return None

    def _forcing(self, norm: float, previous: float, scale: float) -> float:
        """Relative tolerance of a linear solve: coarse while Newton's method is far away, and never finer than the end needs."""
        hoped = 0.5 * (norm / previous) ** 1.5 if previous else _COARSE
        return min(_COARSE, max(hoped, 0.3 * self.settings.tolerance * scale / norm, 1e-9))

    def _carried(self, u: Array, anchors: tuple[Array, ...], load: float) -> Array:
        """Return `u` with the held nodes where `load` puts them, and the others moved along by the tangent at `u`.

        Moving the held nodes alone would flatten the elements next to them.
        """
        p = self.problem
        target = np.where(p.prescribed.held, load * p.prescribed.values, u)
        jump = target - u
        if np.abs(jump).max() <= 1e-9 * float(np.ptp(p.points, axis=0).max()):
            return target
        residual, _, matrix, _ = self._tangent(u, anchors, load)
        residual += (matrix @ jump.ravel()).reshape(-1, 3)
        residual[p.prescribed.held] = 0.0
        self.iterations += 1
        return np.asarray(target - solved(self._factorized(matrix), residual, _COARSE))

    def _line_search(
        self, u: Array, step: Array, anchors: tuple[Array, ...], load: float, residual: Array
    ) -> tuple[Array, float, float] | None:
        """Return ``u + a step``, a in (0, 1] and the relative residual there; None where all invert elements.

        It ends where the residual's work on the step has fallen enough.

        The work ``r . step`` vanishes at equilibrium along the step. Unlike the norm of r it may be trusted when points change their
        contact status.
        """
        before = float((residual * step).sum())  # not a BLAS dot product: the threads of some wait for milliseconds
        low, high, a = 0.0, 1.0, 1.0
        work_low = before
        best = None
        for _ in range(9):
            trial = u + a * step
            r, scale, smallest = self.residual(trial, anchors, load)
            if not smallest > 0.0:
                high = a
                a = 0.5 * (low + a)
                continue
            work = float((r * step).sum())
            best = trial, a, float(np.abs(r).sum()) / scale
            if abs(work) <= 0.5 * abs(before) or (a == 1.0 and work * before > 0.0):
                return best
            if work * before > 0.0:
                low, work_low = a, work
                a = 0.5 * (a + high)
            else:
                high = a
                guess = low + (a - low) * work_low / (work_low - work)
                a = min(max(guess, low + 0.1 * (a - low)), low + 0.9 * (a - low))
        return best


def solved(factorization: Factorization, residual: Array, relative_tolerance: float) -> Array:
    """Return the solution (n, 3) for a residual (n, 3), as coarse as `relative_tolerance` allows where the solver can make use of that."""
    b = residual.ravel()
    if isinstance(factorization, ApproximateFactorization):
        return factorization.solve(b, relative_tolerance).reshape(-1, 3)
    return factorization.solve(b).reshape(-1, 3)


def constrained(matrix: sp.bsr_matrix, held: NDArray[np.bool_], anchor_stiffness: float = 0.0) -> sp.bsr_matrix:
    """Return `matrix` with held rows and columns replaced by a scaled identity, and weak springs on the diagonal.

    Changes the blocks of `matrix` in place.
    """
    _constrain(matrix.indptr, matrix.indices, matrix.data, held, anchor_stiffness)
    return matrix


@njit(cache=True)
def _constrain(indptr, indices, blocks, held, anchor_stiffness):  # type: ignore[no-untyped-def]  # pragma: no cover
    n, d = held.shape
    mean = 0.0
    for i in range(n):
        for at in range(indptr[i], indptr[i + 1]):
            if indices[at] == i:
                for a in range(d):
                    mean += blocks[at, a, a] / (d * n)
    for i in range(n):
        for at in range(indptr[i], indptr[i + 1]):
            j = indices[at]
            for a in range(d):
                for b in range(d):
                    if held[i, a] or held[j, b]:
                        blocks[at, a, b] = mean if (i == j and a == b) else 0.0
                    elif i == j and a == b:
                        blocks[at, a, b] += anchor_stiffness * mean
