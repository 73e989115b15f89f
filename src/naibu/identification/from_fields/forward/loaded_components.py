"""The unknown displacement of loaded nodes: its Hessian at one point of the search, and conjugate gradients preconditioned by it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.core.progress import report_progress
from naibu.identification.from_fields.forward.forward_model import Observed
from naibu.mechanics.linear_algebra.direct import direct_solver
from naibu.mechanics.linear_algebra.protocols import Factorization

if TYPE_CHECKING:
    from naibu.identification.from_fields.forward.sensitivities import Linearised

BLOCK = 256  # right-hand sides solved together
BOUNDARY_TOLERANCE, ROUGH_TOLERANCE = 1e-5, 1e-3  # relative residuals; the latter within a search: Hessians err by its square
EXACT_TRACE, PROBES = 1200, 64  # components up to which a trace is computed as it is; random vectors that estimate it beyond
BOUNDARY_ITERATIONS = 200
REFRESHED = 400  # loaded components up to which their Hessian is made anew at every point
WORTH = 1  # column iterations, over loaded components, with the Hessian of an earlier point, after which it is made anew
AN_ITERATION = 8  # columns: what an iteration costs beside that of its columns, as factors pass through memory once for all of them
AT_ONCE = 4  # iterations from which so many columns cost more with the Hessian of an earlier point than one made anew


@dataclass(frozen=True, slots=True, eq=False)
class BoundaryPreconditioner:
    """The Hessian of the loaded components of one load case at one point of the search, factorized; it changes little with the moduli.

    Attributes
    ----------
    factor : tuple
        Cholesky factor (n_b, n_b), 1/mm^2, as SciPy's.
    informed : float
        Number of loaded components that the measurements, rather than the prior, determine.
    scale : float
        Of the Hessian against the factor's.
    """

    factor: tuple[FloatArray, bool]
    informed: float
    scale: float = 1.0

    @classmethod
    def of(cls, at: Linearised, t: int) -> BoundaryPreconditioner:
        """Make it from the response to every loaded component."""
        o = at.model.observed[t]
        factor, border, n_b = at.point.factors[t], at.border(t), len(o.unknown)
        hessian = np.empty((n_b, n_b))
        for start in range(0, n_b, BLOCK):
            report_progress(at.model.progress, "finding how the body follows its surface", done=start, total=n_b)
            stop = min(start + BLOCK, n_b)
            force = border[start:stop].T.toarray()
            force[o.loaded] = 0.0
            moved = -factor.solve(force)
            moved[o.loaded] = o.basis[:, start:stop].toarray()
            pull = np.asarray(o.information @ moved)
            inner = pull.copy()
            inner[o.loaded] = 0.0
            answer = factor.solve(inner)
            answer[o.loaded] = 0.0
            hessian[:, start:stop] = o.basis.T @ pull[o.loaded] - border @ answer
        hessian = 0.5 * (hessian + hessian.T)
        full = hessian + o.prior.toarray()
        try:
            cholesky = sl.cho_factor(full, overwrite_a=True)
        except np.linalg.LinAlgError as error:
            raise ConvergenceError(
                f"load case {o.load_case.name!r}: the measured field does not fix how the loaded nodes move as a whole"
            ) from error
        return cls(cholesky, n_b - _trace_of_prior(cholesky, o.prior))

    def scaled(self, observed: Sequence[Observed], source: int, target: int) -> BoundaryPreconditioner:
        """Return the preconditioner of a load case `target` whose measurements differ from those of `source` in accuracy alone."""
        ratio = (observed[source].noise_mm / observed[target].noise_mm) ** 2
        return BoundaryPreconditioner(self.factor, self.informed, self.scale * ratio)

    def unscaled(self, b: FloatArray) -> FloatArray:
        """Return the solution (n_b, r) with the factor, before it is divided by `scale`."""
        return np.asarray(sl.cho_solve(self.factor, b, check_finite=False))  # the check would cost as much as the solution


def local_preconditioner(o: Observed) -> Factorization:
    """Return the Hessian (n_b, n_b) of the loaded components with all other nodes at rest, factorized, 1/mm^2.

    It is sparse, and its inverse is up to some ten times too large for motions that reach far into the body: for a few columns that takes
    fewer solutions than to make a `BoundaryPreconditioner`.

    Raises
    ------
    ConvergenceError
        Measurements next to the loaded nodes do not fix how these move as a whole.
    """
    at_rest = sp.bsr_matrix(o.basis.T @ o.information[o.loaded][:, o.loaded] @ o.basis + o.prior, blocksize=(1, 1))
    at_rest.sort_indices()
    return direct_solver(at_rest, symmetric=True).factorize(at_rest)


def _trace_of_prior(cholesky: tuple[FloatArray, bool], prior: sp.csr_matrix) -> float:
    """Return the trace of the prior times the inverse of the Hessian of n components, of many by random signs (:cite:p:`bekas2007`).

    The error, a few components, is far below the spread of chi squared; the inverse would take twice as long as the factor.
    """
    n = prior.shape[0]
    if n <= EXACT_TRACE:
        return float(np.sum(prior.multiply(sl.cho_solve(cholesky, np.eye(n)))))
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(n, PROBES))
    return float(np.sum((prior @ signs) * sl.cho_solve(cholesky, signs))) / PROBES


def alike(one: Observed, other: Observed) -> bool:
    """Whether two load cases are measured at the same points and loaded at the same nodes, and differ in accuracy alone."""
    same = one.operator.shape == other.operator.shape and np.array_equal(one.loaded, other.loaded)
    if not same or not np.array_equal(one.operator.indices, other.operator.indices):
        return False
    return bool(np.allclose(one.operator.data * one.noise_mm, other.operator.data * other.noise_mm, rtol=1e-6, atol=0.0))


@dataclass(slots=True, eq=False)
class KeptPreconditioners:
    """Preconditioners of all load cases, kept from one point of the search to the next while that costs less than to make them anew.

    Attributes
    ----------
    made : list of BoundaryPreconditioner or None
        Those there are.
    informed : list of float or None
        Number of loaded components that the measurements determine, from the last one made; None before a first one.
    spent : int
        Column iterations that were solved with them at other points than that at which they were made, `AN_ITERATION` for each besides.
    """

    made: list[BoundaryPreconditioner | None]
    informed: list[float | None]
    spent: int = 0

    @classmethod
    def none(cls, load_cases: int) -> KeptPreconditioners:
        """Return the state before a first one."""
        return cls([None] * load_cases, [None] * load_cases)

    def copied(self) -> KeptPreconditioners:
        """Return the same for other points, which do not change these."""
        return KeptPreconditioners(list(self.made), list(self.informed), self.spent)

    def forget(self) -> None:
        """Have all made anew on their next use."""
        self.made[:], self.spent = [None] * len(self.made), 0

    def keep(self, t: int, found: BoundaryPreconditioner) -> None:
        """Keep the one of load case `t`."""
        self.made[t], self.informed[t] = found, found.informed

    def keep_all(self, others: KeptPreconditioners) -> None:
        """Keep those that were made of the same load cases under another law."""
        for t, found in enumerate(others.made):
            if found is not None:
                self.keep(t, found)


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Solutions and residuals (n_b, r) of every load case, and after how many iterations."""

    solution: list[FloatArray]
    residual: list[FloatArray]
    iterations: int


def conjugate_gradients(
    product: Callable[[list[FloatArray]], list[FloatArray]],
    precondition: Callable[[list[FloatArray]], list[FloatArray]],
    right: list[FloatArray],
    tolerance: float = BOUNDARY_TOLERANCE,
    near: Sequence[FloatArray] | None = None,
) -> Solved:
    """Solve independent systems of several load cases, every column by its own iteration, all advanced together, from solutions `near`.

    Raises
    ------
    ConvergenceError
        A residual does not fall to the fraction `tolerance` within `BOUNDARY_ITERATIONS`.
    """

    def dot(a: list[FloatArray], b: list[FloatArray]) -> list[FloatArray]:
        return [np.einsum("ij,ij->j", p, q) for p, q in zip(a, b, strict=True)]

    if near is None:
        x, r = [np.zeros_like(b) for b in right], [b.copy() for b in right]
    else:
        x = [a.copy() for a in near]
        r = [b - a for b, a in zip(right, product(x), strict=True)]
    target = [tolerance * np.linalg.norm(b, axis=0) for b in right]
    p, rz = [np.zeros_like(b) for b in right], [np.ones(b.shape[1]) for b in right]
    for iteration in range(BOUNDARY_ITERATIONS):
        above = [np.linalg.norm(a, axis=0) > limit for a, limit in zip(r, target, strict=True)]
        left = np.flatnonzero(np.any(above, axis=0))  # columns that are not solved in every load case
        if not len(left):
            return Solved(x, r, iteration)
        open_ = [a[:, left] for a in r]
        z = precondition(open_)
        new = dot(open_, z)
        directions = []
        for t, (one, product_rz) in enumerate(zip(z, new, strict=True)):
            directions.append(one + p[t][:, left] * (product_rz / np.maximum(rz[t][left], 1e-300) if iteration else 0.0))
        q = product(directions)
        for t, curvature in enumerate(dot(directions, q)):
            alpha = new[t] / np.where(curvature > 0.0, curvature, np.inf)
            x[t][:, left] += alpha * directions[t]
            r[t][:, left] -= alpha * q[t]
            p[t][:, left], rz[t][left] = directions[t], new[t]
    raise ConvergenceError(f"the displacement of the loaded nodes did not converge in {BOUNDARY_ITERATIONS} conjugate gradient iterations")
