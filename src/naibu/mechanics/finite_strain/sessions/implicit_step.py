"""One nonlinear step of backward Euler: the balance of momentum of a hyperelastic body in contact, and Newton's method for it.

The balance is ``M (u - u_0 - h v_0) / h^2 + f(u + tau (u - u_0) / h) = g``; tau is the time of a Voigt viscosity, and g what indenters and
external forces exert :cite:p:`wriggers2006`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray, Int32Array
from naibu.core.errors import ConvergenceError
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows

HALVINGS = 6  # of a Newton step that inverts an element or goes too far
ACCEPTED = 5.0  # tolerances: residual of a step that has used up its iterations
DAMPED_ITERATIONS = 40
LEAST_LESS = 0.1  # of the decrease of the work on a step that the tangent promises, which must come
SHIFT, GROWTH, LARGEST_SHIFT = 1e-3, 4.0, 10.0  # of the mean diagonal of the tangent: first, from one to the next, and at most

LinearSolve = Callable[[sp.bsr_matrix, FloatArray], FloatArray]  # a matrix and a right side (n, 3) to the solution (n, 3)


@dataclass(frozen=True, slots=True, eq=False)
class ImplicitStep:
    """A step of backward Euler.

    Attributes
    ----------
    assembler : Assembler
        Elements and materials; the sides of cuts keep the normals that they have when the step begins.
    mass : ndarray, shape (n,)
        Lumped masses, kg.
    duration : float
        h, s.
    displacement, velocity : ndarray, shape (n, 3)
        u_0 and v_0, mm and mm/s.
    external_force : ndarray, shape (n, 3)
        mN.
    constrained : ndarray, shape (n, 3), bool
        Components that are prescribed.
    contacts, anchors, positions : tuple
        Contacts at the end of the step, the frictional anchors of their points, mm, and the places of these points in the pattern of the
        assembler.
    tolerance : float
        Residual, as a fraction of internal and external forces, at which the step ends.
    floor : float
        Residual that counts as none, mN.
    iterations : int
        Newton iterations at most.
    retardation_s : float
        tau, s.
    lips : ndarray, shape (p, 3), optional
        Frictional anchors of the sides of cuts when the step begins, mm.
    """

    assembler: Assembler
    mass: FloatArray
    duration: float
    displacement: FloatArray
    velocity: FloatArray
    external_force: FloatArray
    constrained: BoolArray
    contacts: tuple[Contact, ...] = ()
    anchors: tuple[FloatArray, ...] = ()
    positions: tuple[Int32Array, ...] = ()
    tolerance: float = 1e-3
    floor: float = 0.0
    iterations: int = 10
    retardation_s: float = 0.0
    lips: FloatArray | None = None
    inertial: FloatArray = field(init=False)  # where the nodes would come to without forces, mm

    def __post_init__(self) -> None:
        object.__setattr__(self, "inertial", self.displacement + self.duration * self.velocity)
        object.__setattr__(self, "assembler", self.assembler.in_step(self.displacement, self.lips))

    def solved(self, u: FloatArray, linear: LinearSolve) -> FloatArray:
        """Return the displacement (n, 3) near `u`, whose constrained components are as prescribed, that balances momentum.

        Raises
        ------
        ConvergenceError
            An inverted element, a singular matrix, or too many iterations.
        """
        residual, allowed = self.residual(u)
        for _ in range(self.iterations):
            if float(np.abs(residual).sum()) <= allowed:
                return u
            u, residual, allowed = self._searched(u, -linear(self.tangent(u), residual), residual)
        if float(np.abs(residual).sum()) > ACCEPTED * allowed:
            raise ConvergenceError(f"no balance within {self.iterations} iterations")
        return u

    def damped(self, u: FloatArray, linear: LinearSolve) -> FloatArray:
        """Return a balance as `solved` does, also where a tangent is indefinite: by the method of Levenberg and Marquardt.

        Where a step does not let the residual do less work, as the tangent promises, inertia is added to the tangent, as that of a shorter
        time: the iterations follow the force downhill until the tangent can be trusted again :cite:p:`nocedal2006`.

        Raises
        ------
        ConvergenceError
            An inverted element at `u`, or too many iterations.
        """
        residual, allowed = self.residual(u)
        shift = 0.0
        for _ in range(DAMPED_ITERATIONS):
            if float(np.abs(residual).sum()) <= allowed:
                return u
            tangent, after = self.tangent(u), None
            inertia = self._inertia_like(tangent)
            while after is None:
                step = -linear(self._with_inertia(tangent, shift * inertia), residual)
                after = self._downhill(u, step, residual, shift * float((inertia[:, None] * step**2).sum()))
                if after is None:
                    shift = max(GROWTH * shift, SHIFT)
                    if shift > LARGEST_SHIFT:
                        raise ConvergenceError("no direction reduces the residual")
            u, residual, allowed = after
            shift = shift / GROWTH if shift > SHIFT else 0.0
        raise ConvergenceError(f"no balance within {DAMPED_ITERATIONS} damped iterations")

    def _inertia_like(self, tangent: sp.bsr_matrix) -> FloatArray:
        """Return stiffnesses (n,), mN/mm, in proportion to the masses, in the mean those of the diagonal of a tangent."""
        diagonal = tangent.diagonal().reshape(-1, 3)[~self.constrained.any(axis=1)]
        return self.mass * (float(diagonal.mean()) / float(self.mass.mean())) if len(diagonal) else np.zeros_like(self.mass)

    def _with_inertia(self, tangent: sp.bsr_matrix, inertia: FloatArray) -> sp.bsr_matrix:
        """Return a tangent with stiffnesses (n,), mN/mm, on its diagonal."""
        if not inertia.any():
            return tangent
        out = tangent.copy()
        out.data[self.assembler.pattern.diagonal()] += inertia[:, None, None] * np.eye(3)
        return with_dirichlet_rows(out, self.constrained)

    def _downhill(
        self, u: FloatArray, step: FloatArray, residual: FloatArray, of_inertia: float
    ) -> tuple[FloatArray, FloatArray, float] | None:
        """Return the end of the largest part of a step on which the residual does less work, and the residual there; None without one.

        The inertia in the tangent lets a work `of_inertia` be left, mN mm.
        """
        before = abs(float((residual * step).sum()))
        for part in (1.0, 0.5, 0.25):
            trial = u + part * step
            try:
                after, allowed = self.residual(trial)
            except ConvergenceError:
                continue
            if abs(float((after * step).sum())) < before - LEAST_LESS * part * max(before - of_inertia, 0.0):
                return trial, after, allowed
        return None

    def residual(self, u: FloatArray) -> tuple[FloatArray, float]:
        """Return the out-of-balance force (n, 3) and how much of it is allowed, mN.

        Raises
        ------
        ConvergenceError
            An inverted element.
        """
        _, internal, smallest = self.assembler.forces(self.deforming(u))
        if not smallest > 0.0:
            raise ConvergenceError(f"an element is inverted (det F = {smallest:.3g})")
        contact = np.zeros_like(internal)
        for c, anchor in zip(self.contacts, self.anchors, strict=True):
            response = c.evaluate(u, anchor, 1.0)
            contact += c.scattered(response.force, len(u), response.orientation)
        return self.balance(u, internal, contact)

    def balance(self, u: FloatArray, internal: FloatArray, contact: FloatArray) -> tuple[FloatArray, float]:
        """Return the out-of-balance force (n, 3) of internal and contact forces (n, 3), and how much of it is allowed, mN."""
        residual = internal + (self.mass / self.duration**2)[:, None] * (u - self.inertial) - self.external_force - contact
        residual[self.constrained] = 0.0
        return residual, self.tolerance * float(np.abs(internal).sum() + np.abs(self.external_force).sum()) + self.floor

    def tangent(self, u: FloatArray) -> sp.bsr_matrix:
        """Return the matrix of a Newton step, mN/mm; see `NearbyContact.response` for what it leaves out."""
        pattern = self.assembler.pattern
        blocks = self.assembler.evaluate(self.deforming(u))[2]
        blocks *= 1.0 + self.retardation_s / self.duration
        for c, anchor, places in zip(self.contacts, self.anchors, self.positions, strict=True):
            c.add_stiffness(c.evaluate(u, anchor, 1.0, curvature=False), pattern, places, blocks)
        blocks[pattern.diagonal()] += (self.mass / self.duration**2)[:, None, None] * np.eye(3)
        return with_dirichlet_rows(pattern.matrix(blocks), self.constrained)

    def deforming(self, u: FloatArray) -> FloatArray:
        """Return the displacement (n, 3), mm, whose stress is that of the viscous body at `u`."""
        return u if self.retardation_s == 0.0 else u + self.retardation_s / self.duration * (u - self.displacement)

    def _searched(self, u: FloatArray, step: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return ``u + a step`` with the largest a of 1, 1/2, ... at which the residual does less work on the step, and the residual."""
        before = abs(float((residual * step).sum()))
        for k in range(HALVINGS):
            trial = u + 0.5**k * step
            try:
                after, allowed = self.residual(trial)
            except ConvergenceError:
                continue
            if abs(float((after * step).sum())) < before:
                return trial, after, allowed
        raise ConvergenceError("no step along the Newton direction reduces the residual")
