"""Kernels that make a coarser level of smoothed aggregation: aggregates, prolongation and the Galerkin product.

Matrices are compressed rows of small blocks. Patterns are made once, values for every matrix of a pattern.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit


@njit(cache=True)
def aggregates(indptr, indices, apart):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return for every node the number of its aggregate, and their count: :cite:p:`vanek1996`, algorithm 5.1.

    Nodes of `apart` (n,) belong to none: -1. An aggregate begins as a node with all its neighbours.
    """
    n = len(indptr) - 1
    label = np.full(n, -1, np.int64)
    count = 0
    for i in range(n):
        free = not apart[i] and label[i] < 0
        for at in range(indptr[i], indptr[i + 1]):
            free = free and label[indices[at]] < 0
        if free:
            for at in range(indptr[i], indptr[i + 1]):
                if not apart[indices[at]]:
                    label[indices[at]] = count
            count += 1
    first = label.copy()
    for i in range(n):  # what is left joins the aggregate of most of its neighbours
        if apart[i] or label[i] >= 0:
            continue
        most = 0
        for at in range(indptr[i], indptr[i + 1]):
            chosen, votes = first[indices[at]], 0
            if chosen < 0:
                continue
            for other in range(indptr[i], indptr[i + 1]):
                votes += first[indices[other]] == chosen
            if votes > most:
                most, label[i] = votes, chosen
    for i in range(n):  # and where it has none, it makes one with its neighbours of the same kind
        if apart[i] or label[i] >= 0:
            continue
        for at in range(indptr[i], indptr[i + 1]):
            j = indices[at]
            if not apart[j] and label[j] < 0:
                label[j] = count
        count += 1
    return label, count


@njit(cache=True)
def members(label, count):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the nodes of all aggregates, one after the other, and where each begins (count + 1,)."""
    start = np.zeros(count + 1, np.int64)
    for i in range(len(label)):
        if label[i] >= 0:
            start[label[i] + 1] += 1
    start = np.cumsum(start)
    nodes, filled = np.empty(start[-1], np.int64), start[:-1].copy()
    for i in range(len(label)):
        if label[i] >= 0:
            nodes[filled[label[i]]] = i
            filled[label[i]] += 1
    return nodes, start


@njit(cache=True)
def orthonormal_modes(modes, nodes, start, tolerance):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Orthonormalise the modes (n, d, k) within every aggregate; return them and their coefficients (count, k, k).

    By Gram and Schmidt's method, twice; a mode that depends on those before it within its relative `tolerance` becomes zero.
    """
    n, d, k = modes.shape
    count = len(start) - 1
    q, coefficients = np.zeros((n, d, k)), np.zeros((count, k, k))
    for c in range(count):
        size = start[c + 1] - start[c]
        local = np.empty((k, size * d))
        for p in range(k):
            for m in range(size):
                for a in range(d):
                    local[p, m * d + a] = modes[nodes[start[c] + m], a, p]
        for p in range(k):
            whole = np.sqrt((local[p] * local[p]).sum())
            for _ in range(2):
                for earlier in range(p):
                    along = (local[earlier] * local[p]).sum()
                    coefficients[c, earlier, p] += along
                    local[p] -= along * local[earlier]
            left = np.sqrt((local[p] * local[p]).sum())
            if left > tolerance * whole:
                coefficients[c, p, p] = left
                local[p] /= left
            else:
                local[p] = 0.0
        for p in range(k):
            for m in range(size):
                for a in range(d):
                    q[nodes[start[c] + m], a, p] = local[p, m * d + a]
    return q, coefficients


@njit(cache=True)
def reached(indptr, indices, target_start, targets, count):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the pattern of a product of matrices: for each row the targets of all its columns, sorted.

    `targets` are the columns of the second matrix in rows that begin at `target_start`; there are `count` columns.
    """
    n = len(indptr) - 1
    seen = np.full(count, -1, np.int64)
    out_start = np.zeros(n + 1, np.int64)
    for filling in range(2):
        if filling:
            seen[:] = -1
            out_start = np.cumsum(out_start)
            out = np.empty(out_start[-1], np.int32)
        for i in range(n):
            at_out = out_start[i] if filling else 0
            for at in range(indptr[i], indptr[i + 1]):
                j = indices[at]
                for t in range(target_start[j], target_start[j + 1]):
                    if seen[targets[t]] != i:
                        seen[targets[t]] = i
                        if filling:
                            out[at_out] = targets[t]
                        at_out += 1
            if filling:
                out[out_start[i] : at_out].sort()
            else:
                out_start[i + 1] = at_out
    return out_start, out


@njit(cache=True)
def transposed(indptr, indices, count):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the pattern of the transpose, which has `count` rows, and where its blocks are stored in the matrix."""
    start = np.zeros(count + 1, np.int64)
    for j in indices:
        start[j + 1] += 1
    start = np.cumsum(start)
    filled = start[:-1].copy()
    rows, where = np.empty(len(indices), np.int32), np.empty(len(indices), np.int64)
    for i in range(len(indptr) - 1):
        for at in range(indptr[i], indptr[i + 1]):
            j = indices[at]
            rows[filled[j]], where[filled[j]] = i, at
            filled[j] += 1
    return start, rows, where


@njit(cache=True, nogil=True)
def add_blocks(indptr, indices, blocks, t_start, t_columns, t_blocks, p_start, p_columns, out, start, stop, of_row, of_mode):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set rows of `out` (in the pattern of p) to the product of the matrix with t."""
    d, k = len(of_row), len(of_mode)
    place = np.empty(p_columns.max() + 1 if len(p_columns) else 1, np.int64)
    for i in range(start, stop):
        for at in range(p_start[i], p_start[i + 1]):
            place[p_columns[at]] = at
            for a in range(d):
                for b in range(k):
                    out[at, a, b] = 0.0
        for at in range(indptr[i], indptr[i + 1]):
            j = indices[at]
            for t in range(t_start[j], t_start[j + 1]):
                into = place[t_columns[t]]
                for a in range(d):
                    for c in range(d):
                        factor = blocks[at, a, c]
                        for b in range(k):
                            out[into, a, b] += factor * t_blocks[t, c, b]


@njit(cache=True, nogil=True)
def smooth(p_start, p_columns, p_blocks, label, tentative, inverse, factor, start, stop, of_row, of_mode):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Turn rows of A T into those of T - factor D^-1 A T, in place."""
    d, k = len(of_row), len(of_mode)
    column = np.empty(d, p_blocks.dtype)
    for i in range(start, stop):
        for at in range(p_start[i], p_start[i + 1]):
            own = p_columns[at] == label[i]
            for b in range(k):
                for a in range(d):
                    column[a] = p_blocks[at, a, b]
                for a in range(d):
                    s = tentative[i, a, b] if own else tentative[i, a, b] * 0
                    for c in range(d):
                        s -= factor * inverse[i, a, c] * column[c]
                    p_blocks[at, a, b] = s


@njit(cache=True, nogil=True)
def upper_galerkin(  # type: ignore[no-untyped-def]  # pragma: no cover
    r_start, r_rows, r_where, p_blocks, ap_start, ap_columns, ap_blocks, c_start, c_columns, out, start, stop, of_row, of_mode
):
    """Set the upper triangle of rows of P^T A P."""
    d, k = len(of_row), len(of_mode)
    place = np.empty(len(r_start), np.int64)
    for coarse in range(start, stop):
        for at in range(c_start[coarse], c_start[coarse + 1]):
            place[c_columns[at]] = at
            out[at] = 0.0
        for t in range(r_start[coarse], r_start[coarse + 1]):
            i, p = r_rows[t], r_where[t]
            for at in range(ap_start[i], ap_start[i + 1]):
                if ap_columns[at] < coarse:
                    continue
                into = place[ap_columns[at]]
                for a in range(k):
                    for c in range(d):
                        factor = p_blocks[p, c, a]
                        for b in range(k):
                            out[into, a, b] += factor * ap_blocks[at, c, b]


@njit(cache=True)
def mirror(c_start, c_columns, blocks, mean):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Copy the upper triangle to the lower; `mean` stands on the diagonal of modes that a level does not have."""
    filled = c_start[:-1].copy()  # the next block of each row: columns are sorted, so rows are filled in order
    for i in range(len(c_start) - 1):
        for at in range(c_start[i], c_start[i + 1]):
            j = c_columns[at]
            if j > i:
                blocks[filled[j]] = blocks[at].T
                filled[j] += 1
            elif j == i:
                for a in range(blocks.shape[1]):
                    if blocks[at, a, a] == 0.0:
                        blocks[at, a, a] = mean
