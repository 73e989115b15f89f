"""Smoothed aggregation :cite:p:`vanek1996` of block matrices in single precision, as a preconditioner of conjugate gradients.

A cycle smooths by block Gauss-Seidel sweeps, forward before and backward after the coarse correction, so that it is symmetric. What depends
on the pattern alone (order, aggregates, patterns of all products) is made once; the values of the levels are made for every matrix.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import reverse_cuthill_mckee
from threadpoolctl import threadpool_limits

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.mechanics.linear_algebra.multigrid import _aggregation_kernels as aggregation
from naibu.mechanics.linear_algebra.multigrid import _cycle_kernels as cycle
from naibu.mechanics.linear_algebra.row_chunks import RowChunks

Single = NDArray[np.float32]
Blocks = tuple[NDArray[np.int64], NDArray[np.int32], Single]  # compressed rows: where they begin, columns, values

COARSEST = 800  # unknowns, up to which a level is factorized
MOST_LEVELS = 12
DEPENDENT = 1e-5  # relative, below which a mode counts as a combination of others within its aggregate
LANCZOS_STEPS = 10
DAMPING = 4.0 / 3.0  # over the largest eigenvalue: the smoothing of the prolongation


@dataclass(slots=True, eq=False)
class Coarsening:
    """What the pattern of a level and its modes make of the next: aggregates, and the patterns of the products.

    Attributes
    ----------
    label : ndarray, shape (n,)
        The aggregate of each node; -1 without one.
    tentative : ndarray, shape (n, d, k), float32
        Modes, orthonormal within every aggregate.
    prolongation, product, coarse : tuple of ndarrays
        Patterns (where rows begin, columns) of P, A P and P^T A P.
    restriction : tuple of ndarrays
        Pattern of P^T, and where its blocks are stored in P.
    modes : ndarray, shape (n_coarse, k, k)
        Modes of the coarse level.
    """

    label: NDArray[np.int64]
    tentative: Single
    prolongation: tuple[NDArray[np.int64], NDArray[np.int32]]
    product: tuple[NDArray[np.int64], NDArray[np.int32]]
    coarse: tuple[NDArray[np.int64], NDArray[np.int32]]
    restriction: tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int64]]
    modes: FloatArray

    @classmethod
    def of(cls, indptr: NDArray[np.int64], indices: NDArray[np.int32], modes: FloatArray) -> Coarsening | None:
        """Return the coarsening of a level with `modes` (n, d, k); None where no node can move."""
        label, count = aggregation.aggregates(indptr, indices, ~modes.any(axis=(1, 2)))
        if count == 0:
            return None
        nodes, start = aggregation.members(label, count)
        tentative, coefficients = aggregation.orthonormal_modes(modes, nodes, start, DEPENDENT)
        own = np.concatenate([[0], np.cumsum(label >= 0)])
        prolongation = aggregation.reached(indptr, indices, own, label[label >= 0].astype(np.int32), count)
        product = aggregation.reached(indptr, indices, *prolongation, count)
        r_start, r_rows, where = aggregation.transposed(*prolongation, count)
        coarse = aggregation.reached(r_start, r_rows, *product, count)
        return cls(label, tentative.astype(np.float32), prolongation, product, coarse, (r_start, r_rows, where), coefficients)


class Pattern:
    """The pattern of a level with all that is made of it once.

    Parameters
    ----------
    indptr, indices : ndarray
        Compressed rows; columns are sorted, every row has its diagonal.
    modes : ndarray, shape (n, d, k)
        Near null space.
    levels : int
        How many may be made, this one included.
    """

    def __init__(self, indptr: NDArray[np.int64], indices: NDArray[np.int32], modes: FloatArray, levels: int = MOST_LEVELS) -> None:
        self.indptr, self.indices = indptr, indices
        n, self.d, _ = modes.shape
        self.chunks = RowChunks(indptr)
        rows = np.repeat(np.arange(n), np.diff(indptr))
        bounds = np.asarray(self.chunks.bounds)
        chunk = np.searchsorted(bounds, np.arange(n), side="right") - 1
        before = np.bincount(rows, indices < bounds[chunk][rows], n)
        self.low = indptr[:-1] + before.astype(np.int64)
        self.diagonal = np.flatnonzero(indices == rows)
        self.coarsening: Coarsening | None = None
        self.next: Pattern | None = None
        if n * self.d > COARSEST and levels > 1:
            self.coarsening = Coarsening.of(indptr, indices, modes)
        if self.coarsening is not None:
            if len(self.coarsening.modes) > n // 2:  # no aggregates to speak of: another level would not be coarser
                self.coarsening = None
            else:
                self.next = Pattern(*self.coarsening.coarse, self.coarsening.modes, levels - 1)


class Level:
    """A matrix of the hierarchy with its smoother, and the coarser level.

    Parameters
    ----------
    pattern : Pattern
        Its pattern.
    blocks : ndarray, shape (n_blocks, d, d), float32
        Its values.

    Raises
    ------
    ConvergenceError
        The coarsest matrix is not positive definite.
    """

    def __init__(self, pattern: Pattern, blocks: Single) -> None:
        self.pattern, self.blocks = pattern, blocks
        self.zeros = (0,) * pattern.d
        n = len(pattern.diagonal)
        self.next: Level | None = None
        if pattern.next is None:
            self.inverse = _dense_inverse(pattern, blocks) if n * pattern.d <= 4 * COARSEST else None
        self.inverses = np.empty((n, pattern.d, pattern.d), np.float32)
        self.added = np.empty((n, pattern.d), np.float32)
        pattern.chunks.run(
            cycle.diagonal_inverses, pattern.indptr, pattern.indices, blocks, pattern.diagonal, self.added, self.inverses,
            sizes=(self.zeros,),
        )  # fmt: skip
        if pattern.next is not None and pattern.coarsening is not None:
            self._coarsen(pattern.coarsening, pattern.next)
        self.b = np.zeros((n, pattern.d), np.float32)
        self.x, self.work = np.zeros_like(self.b), np.zeros_like(self.b)

    def _coarsen(self, made: Coarsening, coarser: Pattern) -> None:
        p, chunks, indptr, indices = self.pattern, self.pattern.chunks, self.pattern.indptr, self.pattern.indices
        self.of_mode = (0,) * coarser.d
        sizes = (self.zeros, self.of_mode)
        own = np.concatenate([[0], np.cumsum(made.label >= 0)])
        labelled = made.label >= 0
        t = own, made.label[labelled].astype(np.int32), made.tentative[labelled]
        p_start, p_columns = made.prolongation
        prolonging = np.empty((len(p_columns), p.d, coarser.d), np.float32)
        chunks.run(aggregation.add_blocks, indptr, indices, self.blocks, *t, p_start, p_columns, prolonging, sizes=sizes)
        factor = np.float32(DAMPING / self.largest_eigenvalue())
        chunks.run(aggregation.smooth, p_start, p_columns, prolonging, made.label, made.tentative, self.inverses, factor, sizes=sizes)
        ap_start, ap_columns = made.product
        product = np.empty((len(ap_columns), p.d, coarser.d), np.float32)
        chunks.run(
            aggregation.add_blocks, indptr, indices, self.blocks, p_start, p_columns, prolonging, ap_start, ap_columns, product, sizes=sizes
        )
        r_start, r_rows, where = made.restriction
        blocks = np.empty((len(coarser.indices), coarser.d, coarser.d), np.float32)
        RowChunks(r_start).run(
            aggregation.upper_galerkin, r_start, r_rows, where, prolonging, ap_start, ap_columns, product, *made.coarse, blocks, sizes=sizes
        )
        mean = np.float32(np.einsum("ikk->", blocks[coarser.diagonal]) / max(coarser.d * len(coarser.diagonal), 1))
        aggregation.mirror(*made.coarse, blocks, mean)
        self.prolongation: Blocks = p_start, p_columns, prolonging
        self.restriction: Blocks = r_start, r_rows, np.ascontiguousarray(prolonging[where].transpose(0, 2, 1))
        self.next = Level(coarser, blocks)

    def largest_eigenvalue(self) -> float:
        """Return the largest eigenvalue of D^-1 A, D the diagonal of the sweeps, by Lanczos' method :cite:p:`lanczos1950`."""
        p = self.pattern
        n = len(p.diagonal)
        diagonal = self.blocks[p.diagonal] + self.added[:, :, None] * np.eye(p.d, dtype=np.float32)
        v = np.random.default_rng(0).standard_normal((n, p.d)).astype(np.float32)
        dv = np.einsum("iab,ib->ia", diagonal, v)
        scale = np.sqrt(float(np.vdot(v, dv)))
        v, dv = v / scale, dv / scale
        old_v, old_dv, beta = np.zeros_like(v), np.zeros_like(v), 0.0
        alphas, betas = [], []
        for _ in range(min(LANCZOS_STEPS, n * p.d)):
            dw = np.empty_like(v)
            p.chunks.run(cycle.product, p.indptr, p.indices, self.blocks, v, dw, sizes=(self.zeros, self.zeros))
            w = np.einsum("iab,ib->ia", self.inverses, dw)
            alpha = float(np.vdot(v, dw))
            w -= np.float32(alpha) * v + np.float32(beta) * old_v
            dw -= np.float32(alpha) * dv + np.float32(beta) * old_dv
            alphas.append(alpha)
            beta = float(np.sqrt(max(np.vdot(w, dw), 0.0)))
            betas.append(beta)
            if beta <= 1e-5 * abs(alpha):
                break
            old_v, old_dv, v, dv = v, dv, w / np.float32(beta), dw / np.float32(beta)
        found = scipy.linalg.eigvalsh_tridiagonal(np.array(alphas), np.array(betas[:-1]))
        return float(found[-1])

    def solve(self) -> None:
        """Set `x` to the correction of one cycle for the residual `b`."""
        p = self.pattern
        if self.next is None and self.inverse is not None:
            self.x[:] = (self.inverse @ self.b.ravel()).reshape(self.b.shape)
            return
        sizes = (self.zeros,)
        p.chunks.run(
            cycle.forward_sweep, p.indices, self.blocks, p.low, p.diagonal, self.inverses, self.b, self.x, sizes=sizes
        )  # fmt: skip
        if self.next is not None:
            p.chunks.run(cycle.remainder, p.indptr, p.indices, self.blocks, p.low, p.diagonal, self.added, self.x, self.work, sizes=sizes)
            coarse = self.next
            coarse.pattern.chunks.run(cycle.product, *self.restriction, self.work, coarse.b, sizes=(self.of_mode, self.zeros))
            coarse.solve()
            p.chunks.run(cycle.add_product, *self.prolongation, coarse.x, self.x, sizes=(self.zeros, self.of_mode))
        self.work[:] = self.x
        p.chunks.run(
            cycle.backward_sweep, p.indptr, p.indices, self.blocks, self.inverses, self.added, self.b, self.work, self.x,
            sizes=sizes,
        )  # fmt: skip


def _dense_inverse(pattern: Pattern, blocks: Single) -> Single:
    size = len(pattern.diagonal) * pattern.d
    whole = sp.bsr_matrix((blocks.astype(float), pattern.indices, pattern.indptr), shape=(size, size)).toarray()
    unused = np.flatnonzero(np.diagonal(whole) == 0.0)
    whole[unused, unused] = 1.0
    with threadpool_limits(1, user_api="blas"):  # on a busy machine its threads wait for each other longer than they compute
        try:
            factor = scipy.linalg.cho_factor(whole, lower=True, overwrite_a=True)
        except np.linalg.LinAlgError as error:
            raise ConvergenceError("the matrix is not positive definite; are all rigid-body motions constrained?") from error
        return np.asarray(scipy.linalg.cho_solve(factor, np.eye(size)), dtype=np.float32)


class SmoothedAggregation:
    """Hierarchies for the matrices of one pattern.

    Parameters
    ----------
    matrix : bsr_matrix, shape (n d, n d)
        One of them; its pattern is symmetric.
    modes : ndarray, shape (n d, k)
        Near null space: rigid-body modes, zero at constrained components.
    """

    def __init__(self, matrix: sp.bsr_matrix, modes: FloatArray) -> None:
        self._given = matrix.indptr, matrix.indices
        d = matrix.blocksize[0]
        n = matrix.shape[0] // d
        numbered = np.arange(1, len(matrix.indices) + 1)
        graph = sp.csr_matrix((numbered, matrix.indices, matrix.indptr), shape=(n, n))
        self._order = np.asarray(reverse_cuthill_mckee(graph, symmetric_mode=True), dtype=np.int64)  # neighbours stand close in memory
        ordered = graph[self._order][:, self._order]
        ordered.sort_indices()
        self._source = np.asarray(ordered.data) - 1
        per_node = modes.reshape(n, d, -1)[self._order]
        self._pattern = Pattern(ordered.indptr.astype(np.int64), ordered.indices.astype(np.int32), per_node)

    def fits(self, matrix: sp.bsr_matrix) -> bool:
        """Whether a matrix has the pattern of this one; the arrays of the pattern, which assemblies share, are compared first."""
        same = (mine is its or np.array_equal(mine, its) for mine, its in zip(self._given, (matrix.indptr, matrix.indices), strict=True))
        return all(same)

    def hierarchy(self, matrix: sp.bsr_matrix) -> Hierarchy:
        """Return the hierarchy of a matrix.

        Raises
        ------
        ConvergenceError
            The coarsest matrix is not positive definite.
        """
        p = self._pattern
        blocks = np.empty(matrix.data.shape, np.float32)
        p.chunks.run(_rows_copied, p.indptr, matrix.data, self._source, blocks, sizes=((0,) * p.d,))
        return Hierarchy(Level(p, blocks), self._order)


def _rows_copied(indptr: Any, blocks: Any, source: Any, out: Any, start: int, stop: int, zeros: tuple[int, ...]) -> None:
    cycle.copied(blocks, source, out, indptr[start], indptr[stop], zeros)


@dataclass(frozen=True, slots=True, eq=False)
class Hierarchy:
    """The levels of one matrix.

    Attributes
    ----------
    finest : Level
        Its nodes are in the order of `order`.
    order : ndarray, shape (n,)
        Nodes of the matrix.
    """

    finest: Level
    order: NDArray[np.int64]

    def correction(self, residual: FloatArray) -> FloatArray:
        """Return the corrections (n d, r) of one V-cycle for residuals (n d, r)."""
        d = self.finest.pattern.d
        out = np.empty(residual.shape)
        for column in range(residual.shape[1]):
            size = float(np.abs(residual[:, column]).max()) or 1.0  # the range of single precision is short
            nodal = residual[:, column].reshape(-1, d)
            self.finest.b[:] = nodal[self.order] / size
            self.finest.solve()
            found = np.empty_like(nodal)
            found[self.order] = self.finest.x
            out[:, column] = size * found.ravel()
        return out
