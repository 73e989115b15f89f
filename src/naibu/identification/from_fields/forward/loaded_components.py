"""The unknown displacement of loaded nodes: its Hessian at one point of the search, and conjugate gradients preconditioned by it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import ConvergenceError
from naibu.core.progress import report_progress
from naibu.identification.from_fields.forward.forward_model import Observed
from naibu.mechanics.linear_algebra.direct import direct_solver, pardiso_library
from naibu.mechanics.linear_algebra.protocols import Factorization
from naibu.mechanics.linear_algebra.saddle_point import SaddlePoint

if TYPE_CHECKING:
    from naibu.identification.from_fields.forward.sensitivities import Linearised

BLOCK = 256  # right-hand sides solved together
BOUNDARY_TOLERANCE, ROUGH_TOLERANCE = 1e-5, 1e-3  # relative residuals; the latter within a search: Hessians err by its square
DENSE = 1600  # components up to which their Hessian is made as a full matrix
EXACT_TRACE, PROBES = 1200, 64  # components up to which a trace is computed as it is; random vectors that estimate it beyond
SPARSE_COST = 0.2  # of that of a full matrix: what a sparse system costs at most
SPARSE_LIMIT = 40_000  # displacements: the factorization then takes a gigabyte
FIXED = 1e-13  # of the largest eigenvalue, from which measurements tell the motion of all patches of loaded nodes
BOUNDARY_ITERATIONS = 200
REFRESHED = 400  # loaded components up to which their Hessian is made anew at every point
WORTH = 1  # column iterations, over loaded components, with the Hessian of an earlier point, after which it is made anew
AN_ITERATION = 8  # columns: what an iteration costs beside that of its columns, as factors pass through memory once for all of them
AT_LEAST = 4  # iterations to expect of one of an earlier point of which no system tells
TRIED = 0.2  # of the cost of a new one, after which it is told from the residuals whether to go on with one of an earlier point


@dataclass(frozen=True, slots=True, eq=False)
class _Cholesky:
    """A full matrix, factorized."""

    factor: tuple[FloatArray, bool]

    def solve(self, b: FloatArray) -> FloatArray:
        """Return the solution (n, r)."""
        return np.asarray(sl.cho_solve(self.factor, b, check_finite=False))  # the check would cost as much as the solution


@dataclass(frozen=True, slots=True, eq=False)
class BoundaryPreconditioner:
    """The Hessian of the loaded components of one load case at one point of the search, factorized; it changes little with the moduli.

    Attributes
    ----------
    factor : Factorization
        Of the Hessian (n_b, n_b), 1/mm^2.
    informed : float
        Number of loaded components that the measurements, rather than the prior, determine.
    scale : float
        Of the Hessian against the factor's.
    """

    factor: Factorization
    informed: float
    scale: float = 1.0

    @classmethod
    def of(cls, at: Linearised, t: int) -> BoundaryPreconditioner:
        """Make it: from the response to every loaded component where these are few, else with equilibrium as a constraint.

        Raises
        ------
        ConvergenceError
            The measurements do not fix how the loaded nodes move.
        """
        o = at.model.observed[t]
        try:
            _require_fixed(at, t)
            factor: Factorization = _with_equilibrium(o, at.stiffness[t]) if is_sparse(o) else _of_responses(at, t)
        except np.linalg.LinAlgError as error:
            raise ConvergenceError(
                f"load case {o.load_case.name!r}: the measured field does not fix how the loaded nodes move as a whole"
            ) from error
        return cls(factor, len(o.unknown) - _trace_of_prior(factor, o.prior))

    def scaled(self, observed: Sequence[Observed], source: int, target: int) -> BoundaryPreconditioner:
        """Return the preconditioner of a load case `target` whose measurements differ from those of `source` in accuracy alone."""
        ratio = (observed[source].noise_mm / observed[target].noise_mm) ** 2
        return BoundaryPreconditioner(self.factor, self.informed, self.scale * ratio)


def _require_fixed(at: Linearised, t: int) -> None:
    """Refuse measurements that do not tell the motions of loaded nodes of which the prior says nothing: that of every patch as a whole.

    Raises
    ------
    LinAlgError
        They do not.
    """
    o = at.model.observed[t]
    patches, number = connected_components(o.prior, directed=False)
    none = [np.zeros((len(other.unknown), patches)) for other in at.model.observed]
    none[t] = np.eye(patches)[number]
    seen = np.asarray(o.operator @ at.forward(None, none)[t])
    told = np.linalg.eigvalsh(seen.T @ seen)
    if not told[0] > FIXED * told[-1]:
        raise np.linalg.LinAlgError("loaded nodes move without a change of the measurements")


def is_sparse(o: Observed) -> bool:
    """Whether the Hessian of the loaded components is not made as a full matrix."""
    return len(o.unknown) > DENSE and o.operator.shape[1] <= SPARSE_LIMIT and pardiso_library() is not None


def _cost(o: Observed) -> float:
    """Return what a preconditioner costs, in column iterations: about two solutions for each loaded component, as an iteration has."""
    return len(o.unknown) * (SPARSE_COST if is_sparse(o) else 1.0)


def _of_responses(at: Linearised, t: int) -> _Cholesky:
    """Return the Hessian (n_b, n_b) from the response to every loaded component, factorized."""
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
    full = 0.5 * (hessian + hessian.T) + o.prior.toarray()
    return _Cholesky(sl.cho_factor(full, overwrite_a=True))


@dataclass(frozen=True, slots=True, eq=False)
class WithEquilibrium:
    """A saddle-point system of all displacements, equilibrium of the others than the loaded ones being a constraint.

    Attributes
    ----------
    system : SaddlePoint
        Of n variables: displacements of the others than the loaded components, then the n_b sought ones.
    constraints : csr_matrix, shape (m, n)
        Forces on the others, mN/mm.
    every : csr_matrix, shape (n d, n)
        From the variables to the displacement of all nodes.
    others : ndarray, shape (m,), int64
        Numbers of the others than the loaded components among the n d.
    """

    system: SaddlePoint
    constraints: sp.csr_matrix
    every: sp.csr_matrix
    others: IntArray

    def solve(self, b: FloatArray) -> FloatArray:
        """Return the inverse of the Hessian of the sought displacements times b (n_b, r)."""
        right = np.zeros((self.every.shape[1], b.shape[1]))
        right[self.every.shape[1] - len(b) :] = b
        return self.system.solve(right)[self.every.shape[1] - len(b) :]

    def followed(self, o: Observed, force: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return the Hessian (r, r) of half the misfit in amounts of nodal forces (n d, r), mN, and how the sought displacements follow.

        These (n_b, r), mm, with a minus sign, are those of least misfit; None where solutions are not in equilibrium. Errors of them change
        the Hessian by their square.
        """
        right, n = -force[self.others], self.every.shape[1]
        moved = np.empty((n, force.shape[1]), order="F")
        for a in range(0, force.shape[1], BLOCK):
            part = right[:, a : a + BLOCK]
            moved[:, a : a + BLOCK] = self.system.solve(np.zeros((n, part.shape[1])), part)
        signs = np.random.default_rng(3).choice([-1.0, 1.0], size=force.shape[1])
        left = np.linalg.norm(self.constraints @ (moved @ signs) - right @ signs)
        if not left <= BOUNDARY_TOLERANCE * np.linalg.norm(right @ signs):
            return None
        u, sought = self.every @ moved, moved[n - len(o.unknown) :]
        hessian = u.T @ (o.information @ u) + sought.T @ (o.prior @ sought)
        return 0.5 * (hessian + hessian.T), -sought


def _with_equilibrium(o: Observed, stiffness: sp.bsr_matrix) -> WithEquilibrium:
    """Return the system in which all displacements are variables and equilibrium of the others than the loaded ones is a constraint.

    All its matrices have the pattern of the stiffness. It takes a fifth to a tenth of the time of the response to every loaded component.
    """
    n = o.operator.shape[1]
    others = np.setdiff1d(np.arange(n), o.loaded, assume_unique=True)
    of_others = sp.csr_matrix((np.ones(len(others)), (others, np.arange(len(others)))), shape=(n, len(others)))
    loaded = sp.csr_matrix((np.ones(len(o.loaded)), (o.loaded, np.arange(len(o.loaded)))), shape=(n, len(o.loaded)))
    every = sp.hstack([of_others, loaded @ o.basis]).tocsr()
    prior = sp.block_diag([sp.csr_matrix((len(others), len(others))), o.prior])
    quadratic, constraints = every.T @ o.information @ every + prior, (stiffness.tocsr()[others] @ every).tocsr()
    return WithEquilibrium(SaddlePoint(quadratic.tocsr(), constraints), constraints, every, others)


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


def _trace_of_prior(factor: Factorization, prior: sp.csr_matrix) -> float:
    """Return the trace of the prior times the inverse of the Hessian of n components, of many by random signs (:cite:p:`bekas2007`).

    The error, a few components, is far below the spread of chi squared.
    """
    n = prior.shape[0]
    if n <= EXACT_TRACE:
        return float(np.sum(prior.multiply(factor.solve(np.eye(n)))))
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(n, PROBES))
    return float(np.sum((prior @ signs) * factor.solve(signs))) / PROBES


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
    anew : float
        What all of them cost, in column iterations.
    spent : int
        Column iterations that were solved with them at other points than that at which they were made, `AN_ITERATION` for each besides.
    pace : float
        Iterations in which the last system that was solved with them at another point lost a factor e of its residual; 0 before one.
    """

    made: list[BoundaryPreconditioner | None]
    informed: list[float | None]
    anew: float
    spent: int = 0
    pace: float = 0.0

    @classmethod
    def none(cls, observed: Sequence[Observed]) -> KeptPreconditioners:
        """Return the state before a first one."""
        return cls([None] * len(observed), [None] * len(observed), sum(_cost(o) for o in observed))

    def copied(self) -> KeptPreconditioners:
        """Return the same for other points, which do not change these."""
        return KeptPreconditioners(list(self.made), list(self.informed), self.anew, self.spent, self.pace)

    def forget(self) -> None:
        """Have all made anew on their next use."""
        self.made[:], self.spent, self.pace = [None] * len(self.made), 0, 0.0

    def is_due(self, columns: int, tolerance: float) -> bool:
        """Whether they have cost, or would cost in a system of so many columns of all load cases together, more than those made anew."""
        iterations = max(AT_LEAST, -self.pace * np.log(tolerance))
        return bool(max((columns + AN_ITERATION * len(self.made)) * iterations, self.spent) > WORTH * self.anew)

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
    """Solutions and residuals (n_b, r) of every load case, after how many iterations, and whether these brought what was asked for.

    `pace` is in how many iterations the residual lost a factor e.
    """

    solution: list[FloatArray]
    residual: list[FloatArray]
    iterations: int
    complete: bool = True
    pace: float = 0.0


def conjugate_gradients(
    product: Callable[[list[FloatArray]], list[FloatArray]],
    precondition: Callable[[list[FloatArray]], list[FloatArray]],
    right: list[FloatArray],
    tolerance: float = BOUNDARY_TOLERANCE,
    near: Sequence[FloatArray] | None = None,
    anew: float = np.inf,
) -> Solved:
    """Solve independent systems of several load cases, every column by its own iteration, all advanced together, from solutions `near`.

    Where residuals tell that what is left costs more than a preconditioner made `anew`, in column iterations, it ends incomplete.

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
    p, rz, cost = [np.zeros_like(b) for b in right], [np.ones(b.shape[1]) for b in right], _Cost(anew)
    for iteration in range(BOUNDARY_ITERATIONS):
        norms = [np.linalg.norm(a, axis=0) for a in r]
        left = np.flatnonzero(np.any([norm > limit for norm, limit in zip(norms, target, strict=True)], axis=0))
        pace = cost.pace(iteration, norms, target)
        if not len(left):  # all columns are solved in every load case
            return Solved(x, r, iteration, pace=pace)
        if cost.is_beyond(iteration, len(right) * (len(left) + AN_ITERATION)):
            return Solved(x, r, iteration, complete=False, pace=pace)
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


@dataclass(slots=True)
class _Cost:
    """What iterations cost, in those of a column, beside a preconditioner made `anew`: what is left is told from what was gained."""

    anew: float
    first: float = 0.0
    left: float = 0.0  # e-folds of the residual that is farthest from its target
    spent: float = 0.0

    def pace(self, iteration: int, norms: list[FloatArray], target: list[FloatArray]) -> float:
        """Note residuals (r,) after so many iterations; returns in how many of them the worst one lost a factor e."""
        ratios = [norm[limit > 0.0] / limit[limit > 0.0] for norm, limit in zip(norms, target, strict=True)]
        self.left = float(np.log(max(max((float(ratio.max(initial=0.0)) for ratio in ratios), default=0.0), 1e-300)))
        if iteration == 0:
            self.first = self.left
        gained = self.first - self.left
        return iteration / gained if gained > 0.0 else np.inf if iteration else 0.0

    def is_beyond(self, iteration: int, of_next: int) -> bool:
        """Whether it is better to end here, before an iteration that costs `of_next`."""
        gained = self.first - self.left
        remaining = iteration * self.left / gained if gained > 0.0 else np.inf
        tried = self.spent >= TRIED * self.anew
        self.spent += of_next
        return tried and (remaining * of_next > WORTH * self.anew or remaining > BOUNDARY_ITERATIONS - iteration)


def in_blocks(factor: Factorization, right: FloatArray) -> FloatArray:
    """Return the solution (n, r) for many columns, of `BLOCK` after `BLOCK` of them, which bounds the memory."""
    if right.shape[1] <= BLOCK:
        return factor.solve(right)
    return np.concatenate([factor.solve(right[:, a : a + BLOCK]) for a in range(0, right.shape[1], BLOCK)], axis=1)
