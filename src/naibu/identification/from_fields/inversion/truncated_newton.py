"""Inexact Gauss-Newton steps for many zones: conjugate gradients with adjoints, no Jacobian is formed (:cite:p:`dembo1982`).

A product with the Hessian takes one forward and one adjoint solve for each load case, with existing factors. The preconditioner is the
penalty's Hessian plus a fraction of the data's mean diagonal for the moduli, and the Hessian of the loaded components for these.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray
from naibu.identification.from_fields.forward.sensitivities import Linearised
from naibu.identification.from_fields.inversion.gauss_newton import LONGEST_STEP, Objective, Step
from naibu.mechanics.linear_algebra.direct import direct_solver

Parts = list[FloatArray]
FORCING = 0.1  # conjugate gradients end when the residual of a step has fallen to this fraction
MAX_ITERATIONS = 150
DATA_FRACTION = 0.1  # of the mean diagonal of the data's Hessian in the preconditioner: most of its eigenvalues are far below


def truncated_step(
    at: Linearised,
    objective: Objective,
    near: list[FloatArray] | None = None,
    *,
    forcing: float = FORCING,
    max_iterations: int = MAX_ITERATIONS,
) -> Step:
    """Return an inexact Gauss-Newton step of all moduli and loaded components, with no use for a response `near`."""
    theta = at.point.theta
    of_moduli, of_loaded = at.gradient()
    gradient = [of_moduli + objective.slope(theta), *of_loaded]
    free = objective.free(theta, gradient[0])
    system = RegularizedSystem(at, objective.curvature(theta), free)
    step, residual = conjugate_gradients(
        system.product, system.preconditioned, system.masked([-g for g in gradient]), forcing, max_iterations
    )
    longest = float(np.abs(step[0]).max())
    if longest > LONGEST_STEP:
        step = [LONGEST_STEP / longest * s for s in step]
    promise = 0.5 * sum(float(r @ s - g @ s) for g, r, s in zip(gradient, residual, step, strict=True))
    return Step(step[0], step[1:], promise)


class RegularizedSystem:
    """The Hessian of the data plus a penalty's at one point, as products, with its preconditioner.

    Parameters
    ----------
    at : Linearised
        The point.
    curvature : csr_matrix, shape (2 count, 2 count)
        Hessian of the penalty.
    free : ndarray, shape (2 count,), bool
        Logarithms that may move.
    """

    def __init__(self, at: Linearised, curvature: sp.csr_matrix, free: BoolArray | None = None) -> None:
        at.renew_if_due(1)
        self.at, self.curvature = at, curvature
        self.free = np.ones(curvature.shape[0], dtype=bool) if free is None else free
        matrix = sp.bsr_matrix(curvature + sp.diags(DATA_FRACTION * self._data_diagonal()), blocksize=(1, 1))
        matrix.sort_indices()
        self._factor = direct_solver(matrix, symmetric=True).factorize(matrix)

    def _data_diagonal(self) -> FloatArray:
        """Return the mean diagonal of the data's Hessian for both kinds of logarithms, repeated (2 count,); by one random probe."""
        n = self.at.model.zones.count
        signs = np.random.default_rng(0).choice([-1.0, 1.0], size=n)
        probes = np.zeros((2 * n, 2))
        probes[:n, 0], probes[n:, 1] = signs, signs
        moved = self.at.forward(probes, None)
        seen = [o.operator @ u for o, u in zip(self.at.model.observed, moved, strict=True)]
        mean = sum((s**2).sum(axis=0) for s in seen) / n
        return np.repeat(mean, n)

    def masked(self, v: Parts) -> Parts:
        """Return vectors without the logarithms that may not move."""
        return [np.where(self.free if v[0].ndim == 1 else self.free[:, None], v[0], 0.0), *v[1:]]

    def product(self, v: Parts) -> Parts:
        """Return the Hessian times (theta, b_1, ..., b_T), one vector each or several as columns."""
        theta, loaded = self.at.product(*_as_columns(v))
        products = [theta.reshape(v[0].shape) + self.curvature @ v[0]]
        return self.masked([*products, *(b.reshape(x.shape) for b, x in zip(loaded, v[1:], strict=True))])

    def preconditioned(self, r: Parts) -> Parts:
        """Return about what the inverse of the Hessian makes of vectors."""
        loaded = self.at.preconditioned(_as_columns(r)[1])
        return self.masked([self._factor.solve(r[0]), *(b.reshape(x.shape) for b, x in zip(loaded, r[1:], strict=True))])


def _as_columns(v: Parts) -> tuple[FloatArray, Parts]:
    """Return the moduli's part and those of the loaded components as matrices, a vector as one column."""
    columns = [p.reshape(len(p), -1) for p in v]
    return columns[0], columns[1:]


def conjugate_gradients(
    product: Callable[[Parts], Parts], precondition: Callable[[Parts], Parts], right: Parts, forcing: float, max_iterations: int
) -> tuple[Parts, Parts]:
    """Return solution and residual once the residual, in the preconditioner's norm, has fallen to the fraction `forcing`.

    Every part of `right` may have columns: these have their own iterations, which are advanced together.
    """
    x, r = [np.zeros_like(b) for b in right], list(right)
    z = precondition(r)
    p, rz = z, _dot(r, z)
    enough = forcing**2 * rz
    for _ in range(max_iterations):
        open_ = rz > enough
        if not open_.any():
            break
        q = product(p)
        a = np.where(open_, rz / np.where(open_, _dot(p, q), 1.0), 0.0)
        x = [u + a * v for u, v in zip(x, p, strict=True)]
        r = [u - a * v for u, v in zip(r, q, strict=True)]
        z = precondition(r)
        new = _dot(r, z)
        p = [u + np.where(open_, new / np.where(open_, rz, 1.0), 0.0) * v for u, v in zip(z, p, strict=True)]
        rz = np.where(open_, new, rz)
    return x, r


def _dot(a: Parts, b: Parts) -> FloatArray:
    """Return the scalar products of columns; by einsum, because threads of BLAS cost more than they save here."""
    return np.asarray(sum(np.einsum("i...,i...->...", p, q) for p, q in zip(a, b, strict=True)))
