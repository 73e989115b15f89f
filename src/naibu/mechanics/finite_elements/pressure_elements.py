"""Finite elements whose mean dilatations have pressures of their own, for iterations with an earlier tangent.

The volumetric part of a group of points with the volume V and the mean dilatation theta stiffens as ``K / 2 V (log theta)^2``, with the
bulk modulus K at small strain. Here the stress ``tau = K log theta`` is an unknown beside the displacement, as in the mixed methods of
:cite:t:`simo1985`: the forces are ``f(u) - sum_e (K_e log theta_e - tau_e) V_e d(log theta_e)/du``, which are f(u) where both agree. A step
of a quasi-Newton method with the tangent A and the derivatives B = V d(log theta)/du of an earlier position is then::

    A du = -(r + B^T (K log theta - tau)),    d tau = K / V B du + (K log theta - tau)

so that tau follows the displacement linearly. Its error is that of the change of A and B, not K times as much: with displacements alone
the volume changes of second order meet the full bulk modulus, and the tangent of nearly incompressible solids is of use once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.finite_elements._pressure_kernels import (
    add_group_forces,
    along_group_derivatives,
    dilatation_derivatives,
    forces_with_pressures,
)
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.hyperelasticity import small_strain_bulk_moduli


@dataclass(frozen=True, slots=True, eq=False)
class PressureElements:
    """Elements of an assembler, with a pressure for each group of points that shares a dilatation.

    Attributes
    ----------
    assembler : Assembler
        Elements and materials.
    start : ndarray, shape (m + 1,), int64
        Group e has the points ``start[e]`` to ``start[e + 1]``.
    connectivity : ndarray, shape (m, k), int64
        Nodes of every group.
    local : ndarray, shape (p, c), int64
        Those of its group's nodes on which a point depends.
    gradients : ndarray, shape (p, 3, c)
        Gradients of their shape functions, 1/mm.
    weights : ndarray, shape (p,)
        Volumes of the points, mm3.
    cells : ndarray, shape (p,), int64
        Their cells, which name their materials.
    bulk : ndarray, shape (m,)
        Mean bulk moduli at small strain, kPa.
    volume : ndarray, shape (m,)
        Volumes of the groups, mm3.
    """

    assembler: Assembler
    start: IntArray
    connectivity: IntArray
    local: IntArray
    gradients: FloatArray
    weights: FloatArray
    cells: IntArray
    bulk: FloatArray
    volume: FloatArray

    @classmethod
    def of(cls, assembler: Assembler) -> PressureElements:
        """Return the elements of an assembler; where it shares no dilatation, every point has a pressure."""
        e = assembler.elements
        group, point = np.nonzero(e.weights > 0.0)
        weights, cells = e.weights[group, point], e.cell_of_point[group, point]
        used = np.any(e.gradients[group, point] != 0.0, axis=2)
        local = np.argsort(~used, axis=1, kind="stable")[:, : int(used.sum(axis=1).max())]
        gradients = np.take_along_axis(e.gradients[group, point], local[:, :, None], axis=1).transpose(0, 2, 1)
        owner = group if e.shared_dilatation else np.arange(len(group))
        connectivity = e.connectivity if e.shared_dilatation else e.connectivity[group]
        count = np.bincount(owner, minlength=len(connectivity))
        volume = np.asarray(np.bincount(owner, weights, minlength=len(connectivity)), dtype=float)
        of_cell = small_strain_bulk_moduli(assembler.law_codes, assembler.parameters)
        bulk = np.bincount(owner, weights * of_cell[cells], minlength=len(connectivity)) / volume
        start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
        return cls(
            assembler, start, np.ascontiguousarray(connectivity), np.ascontiguousarray(local), np.ascontiguousarray(gradients), weights,
            cells, bulk, volume,
        )  # fmt: skip

    def forces(self, displacement: FloatArray, pressure: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return the internal forces (n, 3), mN, ``K log theta - tau`` (m,), kPa, and the smallest det F.

        Parameters
        ----------
        displacement : ndarray, shape (n, 3)
            mm.
        pressure : ndarray, shape (m,)
            tau, kPa; positive where it pulls.
        """
        force, mismatch, a = np.zeros(displacement.shape), np.empty(len(self.bulk)), self.assembler
        smallest = forces_with_pressures(
            self.start, self.connectivity, self.local, self.gradients, self.weights, self.cells, a.law_codes, a.parameters, self.bulk,
            np.ascontiguousarray(displacement), pressure, force, mismatch,
        )  # fmt: skip
        a.add_contact_of_lips(displacement, force)
        return force, mismatch, float(smallest)

    def dilatation(self, displacement: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log(theta) (m,) and its derivatives times the volumes, B (m, k, 3), mm2, at a displacement (n, 3), mm."""
        log_theta, derivative = np.empty(len(self.bulk)), np.empty((*self.connectivity.shape, 3))
        dilatation_derivatives(
            self.start, self.connectivity, self.local, self.gradients, self.weights, np.ascontiguousarray(displacement), log_theta,
            derivative,
        )  # fmt: skip
        return log_theta, derivative

    def add_pressures(self, derivative: FloatArray, pressure: FloatArray, force: FloatArray) -> None:
        """Add ``B^T pressure`` to forces (n, 3), mN."""
        add_group_forces(self.connectivity, derivative, pressure, force)

    def pressure_change(self, derivative: FloatArray, step: FloatArray, mismatch: FloatArray) -> FloatArray:
        """Return the change (m,), kPa, of the pressures in a quasi-Newton step (n, 3), mm."""
        out = np.empty(len(self.bulk))
        along_group_derivatives(self.connectivity, derivative, step, out)
        return np.asarray(self.bulk / self.volume * out + mismatch)
