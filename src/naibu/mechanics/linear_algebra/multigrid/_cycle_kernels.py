"""Kernels of multigrid cycles for matrices of small blocks: products, Gauss-Seidel sweeps and transfers, each for a range of rows.

Vectors have shape (n, d). A tuple of d zeros tells the compiler the size of the blocks, so that it unrolls the loops. Rows of a chunk are
swept in their order, and chunks beside one another: values of other chunks are those of before. With half the magnitudes of the blocks
between chunks added to the diagonal, the sweeps make a positive definite preconditioner whatever the chunks (:cite:p:`baker2011`, l1
smoothers).
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit


@njit(cache=True, nogil=True)
def subtract(indices, blocks, begin, end, x, total, of_row, of_column):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Subtract from `total` the products of the blocks begin..end with their part of x."""
    for at in range(begin, end):
        j = indices[at]
        for a in range(len(of_row)):
            s = total[a]
            for b in range(len(of_column)):
                s -= blocks[at, a, b] * x[j, b]
            total[a] = s


@njit(cache=True, nogil=True)
def add_product(indptr, indices, blocks, x, y, start, stop, of_row, of_column):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the matrix times x to rows of y."""
    total = np.empty(len(of_row), y.dtype)
    for i in range(start, stop):
        total[:] = 0.0
        subtract(indices, blocks, indptr[i], indptr[i + 1], x, total, of_row, of_column)
        for a in range(len(of_row)):
            y[i, a] -= total[a]


@njit(cache=True, nogil=True)
def product(indptr, indices, blocks, x, y, start, stop, of_row, of_column):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set rows of y to those of the matrix times x."""
    y[start:stop] = 0.0
    add_product(indptr, indices, blocks, x, y, start, stop, of_row, of_column)


@njit(cache=True, nogil=True)
def forward_sweep(indices, blocks, low, diagonal, inverse, b, x, start, stop, zeros):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set x to the first forward sweep from zero over the rows of one chunk."""
    d = len(zeros)
    total = np.empty(d, x.dtype)
    for i in range(start, stop):
        for a in range(d):
            total[a] = b[i, a]
        subtract(indices, blocks, low[i], diagonal[i], x, total, zeros, zeros)
        _set(inverse, i, total, x, zeros)


@njit(cache=True, nogil=True)
def _set(inverse, i, total, x, zeros):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set a row of x to the inverse of the diagonal block times `total`."""
    d = len(zeros)
    for a in range(d):
        s = inverse[i, a, 0] * total[0]
        for b in range(1, d):
            s += inverse[i, a, b] * total[b]
        x[i, a] = s


@njit(cache=True, nogil=True)
def remainder(indptr, indices, blocks, low, diagonal, added, x, r, start, stop, zeros):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set r to the residual after `forward_sweep`: what the blocks that it did not use make of x."""
    d = len(zeros)
    total = np.empty(d, x.dtype)
    for i in range(start, stop):
        for a in range(d):
            total[a] = added[i, a] * x[i, a]
        subtract(indices, blocks, indptr[i], low[i], x, total, zeros, zeros)
        subtract(indices, blocks, diagonal[i] + 1, indptr[i + 1], x, total, zeros, zeros)
        for a in range(d):
            r[i, a] = total[a]


@njit(cache=True, nogil=True)
def backward_sweep(  # type: ignore[no-untyped-def]  # pragma: no cover
    indptr, indices, blocks, inverse, added, b, before, x, start, stop, zeros
):
    """Sweep x backwards over the rows of one chunk; `before` is x of before, used for other chunks."""
    d = len(zeros)
    total = np.empty(d, x.dtype)
    for i in range(stop - 1, start - 1, -1):
        for a in range(d):
            total[a] = b[i, a] + added[i, a] * x[i, a]
        for at in range(indptr[i + 1] - 1, indptr[i] - 1, -1):  # backwards in memory, too
            j = indices[at]
            if j == i:
                continue
            values = x if start <= j < stop else before
            for a in range(d):
                s = total[a]
                for c in range(d):
                    s -= blocks[at, a, c] * values[j, c]
                total[a] = s
        _set(inverse, i, total, x, zeros)


@njit(cache=True, nogil=True)
def diagonal_inverses(indptr, indices, blocks, diagonal, added, inverse, start, stop, zeros):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Invert the diagonal blocks, by Gauss-Jordan elimination, after half the magnitudes of the blocks of other chunks are added.

    What is added is kept in `added` (n, d). A pivot that is not positive gives zeros.
    """
    d = len(zeros)
    left = np.empty((d, d))
    for i in range(start, stop):
        added[i] = 0.0
        for at in range(indptr[i], indptr[i + 1]):
            if start <= indices[at] < stop:
                continue
            for a in range(d):
                for b in range(d):
                    added[i, a] += 0.5 * abs(blocks[at, a, b])
        for a in range(d):
            for b in range(d):
                left[a, b] = blocks[diagonal[i], a, b]
            left[a, a] += added[i, a]
        for k in range(d):
            pivot = 1.0 / left[k, k] if left[k, k] > 0.0 else 0.0
            for a in range(d):
                if a != k:
                    factor = left[a, k] * pivot
                    for b in range(d):
                        left[a, b] -= factor * left[k, b] if b != k else 0.0
                    left[a, k] = -factor
            for b in range(d):
                left[k, b] *= pivot
            left[k, k] = pivot
        for a in range(d):
            for b in range(d):
                inverse[i, a, b] = left[a, b]


@njit(cache=True, nogil=True)
def copied(blocks, source, out, start, stop, zeros):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Copy blocks in another order, and in the precision of `out`."""
    d = len(zeros)
    for at in range(start, stop):
        for a in range(d):
            for b in range(d):
                out[at, a, b] = blocks[source[at], a, b]
