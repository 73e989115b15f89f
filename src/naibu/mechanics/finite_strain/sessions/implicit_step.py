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
