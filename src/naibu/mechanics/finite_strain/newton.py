"""Equilibrium at one load: Newton's method with line search, and pseudo-transient continuation where it does not converge.

Linear systems far from convergence are solved coarsely by iterative solvers, with the forcing terms of :cite:t:`eisenstat1996`; the line
search looks for a zero of the work of the residual on the step; pseudo-transient continuation is that of :cite:t:`kelley1998`, with
steps of implicit Euler that are solved for, not only linearised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.mechanics.contact.penalty_contact import ContactResponse
from naibu.mechanics.finite_elements.hyperelasticity import largest_poisson_ratio
from naibu.mechanics.finite_strain.nearby_contact import ContactTangent, add_contact, add_contact_forces
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows
from naibu.mechanics.linear_algebra.iterative import ApproximateFactorization
from naibu.mechanics.linear_algebra.protocols import Factorization, LinearSolver
from naibu.mechanics.linear_algebra.solver_selection import choose_solver

PSEUDO_TRANSIENT_ITERATIONS = 200  # in all; a body that snaps through takes 60 to 200
STEP_ITERATIONS = 10  # of Newton's method within a step in pseudo-time
RIGID_MOTION = 100.0  # extents of the body: a longer Newton step is a rigid-body motion that nothing constrains
FIRST_DRAG = 0.02  # viscosity over the first step in pseudo-time, as a fraction of the mean diagonal of the tangent
MOST_DRAG = 1e3  # likewise; a step so short hardly moves the body
PATIENCE = 4  # iterations in which the residual of a step in pseudo-time must fall to half of the first
CALM = 2  # steps in pseudo-time after a failed one that do not grow
NEAR = 0.1  # of the residual before an iteration, below which that after it can be lowered further with the same tangent
SAME_TANGENT = 4  # iterations with it
WORTHWHILE = 0.3  # of the residual, below which an iteration with the same tangent must bring it
_COARSE = 0.01  # relative tolerance of linear solves far from equilibrium, for solvers that can make use of it


@dataclass(frozen=True, slots=True, eq=False)
class Drag:
    """Viscous force of a step of implicit Euler in pseudo-time.

    Attributes
    ----------
    start : ndarray, shape (n, 3)
        Displacement where the step begins, mm.
    stiffness : float
        Viscosity over the length of the step, mN/mm.
    """

    start: FloatArray
    stiffness: float

    def force(self, u: FloatArray) -> FloatArray:
        """Return the force (n, 3), mN, against the way to the displacement `u` (n, 3), mm."""
        return self.stiffness * (u - self.start)


@dataclass(slots=True, eq=False)
class Newton:
    """Newton's method for one problem; keeps the analysed linear solver from step to step.

    Attributes
    ----------
    problem : Problem
        What is solved.
    settings : SolverSettings
        Tolerances.
    solver : LinearSolver or None
        The linear solver; chosen at the first linearisation where it is None.
    iterations : int
        Iterations so far.
    rigid_motion : bool
        Whether the last Newton step was so long that a rigid-body motion must be unconstrained.
    continued : int
        How often pseudo-transient continuation has found an equilibrium.
    restless : ndarray, shape (n, 3), or None
        By how much the body moved, mm, in the last pseudo-transient continuation, if it came to no rest.
    """

    problem: Problem
    settings: SolverSettings
    solver: LinearSolver | None = None
    iterations: int = 0
    rigid_motion: bool = False
    continued: int = 0
    restless: FloatArray | None = None

    def residual(self, u: FloatArray, anchors: tuple[FloatArray, ...], load: float) -> tuple[FloatArray, float, float]:
        """Return the out-of-balance force (n, 3) mN, a force scale mN, and the smallest det F."""
        _, internal, smallest = self.problem.assembler.forces(u)
        if not smallest > 0.0:
            return internal, np.inf, smallest
        contact = np.zeros_like(internal)
        for c, a in zip(self.problem.contacts, anchors, strict=True):
            add_contact_forces(c, a, u, load, contact)
        return *self._balance(internal, contact), smallest

    def unbalanced(self, u: FloatArray, anchors: tuple[FloatArray, ...], load: float) -> float:
        """Return the out-of-balance force relative to the contact and support forces; infinite where elements are inverted."""
        residual, scale, smallest = self.residual(u, anchors, load)
        return float(np.abs(residual).sum()) / scale if smallest > 0.0 else np.inf

    def _balance(self, internal: FloatArray, contact: FloatArray) -> tuple[FloatArray, float]:
        r = internal - contact - self.problem.external_force
        constrained = self.problem.prescribed.constrained
        # the floor is a force that would strain the body by 1e-5; it matters where contacts open and no load remains
        floor = 1e-5 * float(self.problem.assembler.parameters[:, 0].max()) * float(np.ptp(self.problem.points, axis=0).max()) ** 2
        scale = float(np.abs(contact).sum() + np.abs(r[constrained]).sum() + np.abs(self.problem.external_force).sum()) + floor
        r[constrained] = 0.0
        return r, scale

    def linearised(
        self, u: FloatArray, anchors: tuple[FloatArray, ...], load: float
    ) -> tuple[FloatArray, float, Factorization, list[ContactResponse]]:
        """Return residual, force scale, the factorized tangent and contact responses.

        Rows and columns of constrained components are replaced by those of a scaled identity.

        Raises
        ------
        ConvergenceError
            An inverted element, or a singular tangent.
        """
        residual, scale, matrix = self._tangent(u, anchors, load)
        responses = [c.evaluate(u, a, load) for c, a in zip(self.problem.contacts, anchors, strict=True)]
        return residual, scale, self._factorized(matrix), responses

    def adjoint(self, u: FloatArray, anchors: tuple[FloatArray, ...], load: float, derivatives: FloatArray) -> FloatArray:
        """Return the solutions (n, 3, k) of the transposed tangent for derivatives (n, 3, k) of quantities by the displacement.

        Raises
        ------
        ConvergenceError
            An inverted element, or a singular tangent.
        """
        matrix = self._tangent(u, anchors, load)[2]
        rhs = np.where(self.problem.prescribed.constrained[:, :, None], 0.0, derivatives)
        factorization = self._factorized(matrix.T.tobsr((3, 3)) if self.problem.unsymmetric else matrix)
        return np.asarray(factorization.solve(np.ascontiguousarray(rhs.reshape(-1, rhs.shape[2]))).reshape(rhs.shape))

    def _tangent(
        self, u: FloatArray, anchors: tuple[FloatArray, ...], load: float, *, curvature: bool = True
    ) -> tuple[FloatArray, float, sp.bsr_matrix]:
        """Return residual, force scale, and the tangent of all nodes, constrained or not."""
        p = self.problem
        _, internal, blocks, smallest = p.assembler.evaluate(u)
        if not smallest > 0.0:
            raise ConvergenceError(f"an element is inverted (det F = {smallest:.3g})")
        contact = np.zeros_like(internal)
        for c, a, positions in zip(p.contacts, anchors, p._positions, strict=True):
            add_contact(c, a, u, load, contact, ContactTangent(p.assembler.pattern, positions, blocks, curvature))
        residual, scale = self._balance(internal, contact)
        return residual, scale, p.assembler.pattern.matrix(blocks)

    def _factorized(self, matrix: sp.bsr_matrix, pseudo_stiffness: float = 0.0) -> Factorization:
        p = self.problem
        matrix = with_dirichlet_rows(matrix, p.prescribed.constrained, self.settings.anchor_stiffness + pseudo_stiffness)
        if self.solver is None:
            body = p.assembler
            self.solver = choose_solver(
                matrix, p.points, p.prescribed.constrained, symmetric=not p.unsymmetric, solver=self.settings.linear_solver,
                poisson_ratio=None if p.contacts else largest_poisson_ratio(body.law_codes, body.parameters),
            )  # fmt: skip
        return self.solver.factorize(matrix)

    def solve(self, u: FloatArray, anchors: tuple[FloatArray, ...], load: float) -> tuple[FloatArray, float] | None:
        """Return displacement (n, 3) mm and relative residual in equilibrium, starting from `u`; None where Newton's method fails."""
        poor, previous, tolerance = 0, 0.0, self.settings.tolerance_at(load)
        extent = float(np.ptp(self.problem.points, axis=0).max())
        try:
            u = self._predicted(u, anchors, load)
            for _ in range(self.settings.max_iterations):
                residual, scale, matrix = self._tangent(u, anchors, load)
                norm = float(np.abs(residual).sum())
                if norm <= tolerance * scale:
                    return u, norm / scale
                self.iterations += 1
                tangent = self._factorized(matrix)
                step = -solved(tangent, residual, self._forcing(norm, previous, scale, tolerance))
                longest = float(np.abs(step).max())
                self.rigid_motion = longest > RIGID_MOTION * extent
                found = self.line_search(u, step, anchors, load, residual) if longest <= extent else None
                poor += found is None or found[1] < 0.15
                if found is None or poor > 2:
                    return None  # a shorter load step costs less than many poor iterations
                u, previous, left = found[0], norm, found[2]
                if left > tolerance and left < NEAR * norm / scale:
                    u, left = self._with_same_tangent(tangent, u, left, anchors, load)
                if left <= tolerance:
                    return u, left
        except ConvergenceError:
            return None
        return None

    def _with_same_tangent(
        self, tangent: Factorization, u: FloatArray, left: float, anchors: tuple[FloatArray, ...], load: float
    ) -> tuple[FloatArray, float]:
        """Return displacement (n, 3) mm and relative residual after iterations with a tangent of before, as long as they pay.

        Near equilibrium a factorization costs as much as several of them :cite:p:`kelley1995`.
        """
        residual, before = self.residual(u, anchors, load)[0], left
        for _ in range(SAME_TANGENT):
            trial = u - solved(tangent, residual, NEAR)
            residual, scale, smallest = self.residual(trial, anchors, load)
            now = float(np.abs(residual).sum()) / scale
            if not (smallest > 0.0 and now < WORTHWHILE * left):
                break
            u, left = trial, now
            if left <= self.settings.tolerance_at(load):
                break
        self.iterations += left < before  # all of them replace one
        return u, left

    def pseudo_transient(self, u: FloatArray, anchors: tuple[FloatArray, ...], load: float) -> tuple[FloatArray, float] | None:
        """Return displacement (n, 3) mm and relative residual in equilibrium by pseudo-transient continuation; None where it fails.

        A body that slips off a plate, folds at an edge or buckles snaps through to another equilibrium, on the way to which Newton's method
        cycles. Slowed down by a viscous drag it follows a path of which every step of implicit Euler has a solution if it is short enough;
        the steps grow with success until the drag vanishes :cite:p:`kelley1998`. It is not tried where the settings forbid it.
        """
        drag, failed, calm, budget = FIRST_DRAG, 0.0, 0, self.iterations + PSEUDO_TRANSIENT_ITERATIONS
        before, self.restless = u, None
        if not self.settings.pseudo_transient:
            return None
        try:
            u = self._predicted(u, anchors, load)
            while self.iterations < budget and drag < MOST_DRAG:
                begun = self.iterations
                found = self._pseudo_step(u, anchors, load, drag)
                if found is None:
                    drag, failed, calm = 4.0 * drag, drag, CALM
                    continue
                u, residual = found
                if residual <= self.settings.tolerance_at(load):
                    self.continued += 1
                    return u, residual
                calm -= 1
                if calm <= 0:
                    taken = self.iterations - begun
                    drag *= 0.25 if taken <= 4 and 0.25 * drag > failed else 0.5 if taken < 7 else 1.0
                    failed = 0.0 if drag < failed else failed
        except ConvergenceError:
            return None
        self.restless = u - before
        return None

    def _pseudo_step(self, start: FloatArray, anchors: tuple[FloatArray, ...], load: float, drag: float) -> tuple[FloatArray, float] | None:
        """Return displacement (n, 3) mm and relative residual (without the drag) after a step in pseudo-time; None where it is too long."""
        u, viscous = start, None
        norms: list[float] = []
        for _ in range(STEP_ITERATIONS):
            residual, scale, matrix = self._tangent(u, anchors, load)
            mean = float(matrix.diagonal().mean())  # contact changes it
            if viscous is None:
                viscous = Drag(start, drag * mean)
            unbalanced = residual + viscous.force(u)
            norm, static = float(np.abs(unbalanced).sum()), float(np.abs(residual).sum())
            if norm <= max(self.settings.tolerance_at(load) * scale, _COARSE * static):
                return u, static / scale
            norms.append(norm)
            if len(norms) == PATIENCE and norm > 0.5 * norms[0]:
                return None
            self.iterations += 1
            step = -solved(self._factorized(matrix, viscous.stiffness / mean), unbalanced, _COARSE)
            found = self.line_search(u, step, anchors, load, unbalanced, viscous)
            if found is None:
                return None
            u = found[0]
        return None

    def _forcing(self, norm: float, previous: float, scale: float, tolerance: float) -> float:
        """Relative tolerance of a linear solve: coarse far from convergence, and never finer than the last iteration needs."""
        expected = 0.5 * (norm / previous) ** 1.5 if previous else _COARSE
        return min(_COARSE, max(expected, 0.3 * tolerance * scale / norm, 1e-9))

    def _predicted(self, u: FloatArray, anchors: tuple[FloatArray, ...], load: float) -> FloatArray:
        """Return the predictor: the constrained nodes displaced as `load` prescribes, the others by the tangent at `u`.

        Displacing the constrained nodes alone would flatten the elements next to them.
        """
        p = self.problem
        target = np.where(p.prescribed.constrained, p.prescribed.at(load), u)
        jump = target - u
        if np.abs(jump).max() <= 1e-9 * float(np.ptp(p.points, axis=0).max()):
            return target
        residual, _, matrix = self._tangent(u, anchors, load)
        residual += (matrix @ jump.ravel()).reshape(-1, 3)
        residual[p.prescribed.constrained] = 0.0
        self.iterations += 1
        return np.asarray(target - solved(self._factorized(matrix), residual, _COARSE))

    def line_search(
        self, u: FloatArray, step: FloatArray, anchors: tuple[FloatArray, ...], load: float, residual: FloatArray, drag: Drag | None = None
    ) -> tuple[FloatArray, float, float] | None:
        """Return ``u + a step``, a in (0, 1] and the relative residual there; None where all invert elements.

        The search ends where the residual's work on the step, ``r . step``, has fallen enough: it vanishes at equilibrium along the step
        and, unlike the norm of r, is reliable when points change their contact status.
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
            if drag is not None:
                r = r + drag.force(trial)
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
    """Return the solution (n, 3) for a residual (n, 3); iterative solvers stop at `relative_tolerance`."""
    b = residual.ravel()
    if isinstance(factorization, ApproximateFactorization):
        return factorization.solve(b, relative_tolerance).reshape(-1, 3)
    return factorization.solve(b).reshape(-1, 3)
