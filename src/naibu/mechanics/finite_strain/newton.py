"""Equilibrium at one load: Newton's method with line search, and a relaxation for where it circles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.mechanics.contact.penalty_contact import ContactResponse
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows
from naibu.mechanics.linear_algebra.iterative import ApproximateFactorization
from naibu.mechanics.linear_algebra.protocols import Factorization, LinearSolver
from naibu.mechanics.linear_algebra.solver_selection import choose_solver

RELAXATION_ITERATIONS = 40
DRIFT = 100.0  # extents of the body
DRAG = 0.01  # stiffness of the drag at first, as a fraction of the mean diagonal of the tangent
_COARSE = 0.01  # relative tolerance of linear solves far from equilibrium, for solvers that can make use of it


@dataclass(slots=True, eq=False)
class Newton:
    """Equilibrium iterations for one problem; keeps the analysed linear solver from step to step."""

    problem: Problem
    settings: SolverSettings
    solver: LinearSolver | None = None
    iterations: int = 0
    drifts: bool = False  # whether the last step would have thrown the body away: nothing holds it

    def residual(self, u: FloatArray, anchors: tuple[FloatArray, ...], load: float) -> tuple[FloatArray, float, float]:
        """Return the out-of-balance force (n, 3) mN, a force scale mN, and the smallest det F."""
        _, internal, smallest = self.problem.assembler.forces(u)
        if not smallest > 0.0:
            return internal, np.inf, smallest
        contact = np.zeros_like(internal)
        for c, a in zip(self.problem.contacts, anchors, strict=True):
            response = c.evaluate(u, a, load)
            contact += c.scattered(response.force, len(u), response.orientation)
        return *self._balance(internal, contact), smallest

    def _balance(self, internal: FloatArray, contact: FloatArray) -> tuple[FloatArray, float]:
        r = internal - contact - self.problem.external_force
        constrained = self.problem.prescribed.constrained
        # the floor is a force that would strain the body by 1e-5: it counts where contacts open and nothing presses any more
        floor = 1e-5 * float(self.problem.assembler.parameters[:, 0].max()) * float(np.ptp(self.problem.points, axis=0).max()) ** 2
        scale = float(np.abs(contact).sum() + np.abs(r[constrained]).sum() + np.abs(self.problem.external_force).sum()) + floor
        r[constrained] = 0.0
        return r, scale

    def linearised(
        self, u: FloatArray, anchors: tuple[FloatArray, ...], load: float
    ) -> tuple[FloatArray, float, Factorization, list[ContactResponse]]:
        """Return residual, force scale, the factorized tangent (held rows and columns replaced by the identity) and contact responses.

        Raises
        ------
        ConvergenceError
            An inverted element, or a singular tangent.
        """
        residual, scale, matrix, responses = self._tangent(u, anchors, load)
        return residual, scale, self._factorized(matrix), responses

    def _tangent(
        self, u: FloatArray, anchors: tuple[FloatArray, ...], load: float, *, curvature: bool = True
    ) -> tuple[FloatArray, float, sp.bsr_matrix, list[ContactResponse]]:
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
        matrix = with_dirichlet_rows(matrix, p.prescribed.constrained, self.settings.anchor_stiffness + drag)
        if self.solver is None:
            self.solver = choose_solver(
                matrix, p.points, p.prescribed.constrained, symmetric=not p.unsymmetric, solver=self.settings.linear_solver
            )
        return self.solver.factorize(matrix)

    def solve(self, u: FloatArray, anchors: tuple[FloatArray, ...], load: float) -> tuple[FloatArray, float] | None:
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

    def relax(self, u: FloatArray, anchors: tuple[FloatArray, ...], load: float) -> tuple[FloatArray, float] | None:
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

    def _carried(self, u: FloatArray, anchors: tuple[FloatArray, ...], load: float) -> FloatArray:
        """Return `u` with the held nodes where `load` puts them, and the others moved along by the tangent at `u`.

        Moving the held nodes alone would flatten the elements next to them.
        """
        p = self.problem
        target = np.where(p.prescribed.constrained, load * p.prescribed.values, u)
        jump = target - u
        if np.abs(jump).max() <= 1e-9 * float(np.ptp(p.points, axis=0).max()):
            return target
        residual, _, matrix, _ = self._tangent(u, anchors, load)
        residual += (matrix @ jump.ravel()).reshape(-1, 3)
        residual[p.prescribed.constrained] = 0.0
        self.iterations += 1
        return np.asarray(target - solved(self._factorized(matrix), residual, _COARSE))

    def _line_search(
        self, u: FloatArray, step: FloatArray, anchors: tuple[FloatArray, ...], load: float, residual: FloatArray
    ) -> tuple[FloatArray, float, float] | None:
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


def solved(factorization: Factorization, residual: FloatArray, relative_tolerance: float) -> FloatArray:
    """Return the solution (n, 3) for a residual (n, 3), as coarse as `relative_tolerance` allows where the solver can make use of that."""
    b = residual.ravel()
    if isinstance(factorization, ApproximateFactorization):
        return factorization.solve(b, relative_tolerance).reshape(-1, 3)
    return factorization.solve(b).reshape(-1, 3)
