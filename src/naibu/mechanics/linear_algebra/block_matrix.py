"""Block sparse matrices: their pattern from a mesh, and the elimination of constrained rows and columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from naibu._numba.compilation import njit
from naibu.core.arrays import BoolArray, FloatArray, Int32Array, IntArray


def with_dirichlet_rows(matrix: sp.bsr_matrix, constrained: BoolArray, anchor_stiffness: float = 0.0) -> sp.bsr_matrix:
    """Return `matrix` with constrained rows and columns replaced by those of a scaled identity.

    Parameters
    ----------
    matrix : bsr_matrix, shape (n d, n d)
        Changed in place.
    constrained : ndarray, shape (n, d), bool
        Constrained components.
    anchor_stiffness : float
        Weak springs added to the diagonal of the other components, as a fraction of its mean.
    """
    _set_dirichlet_rows(matrix.indptr, matrix.indices, matrix.data, constrained, anchor_stiffness)
    return matrix


@njit(cache=True)
def _set_dirichlet_rows(indptr, indices, blocks, constrained, anchor_stiffness):  # type: ignore[no-untyped-def]  # pragma: no cover
    n, d = constrained.shape
    mean = 0.0
    for i in range(n):
        for at in range(indptr[i], indptr[i + 1]):
            if indices[at] == i:
                for a in range(d):
                    mean += blocks[at, a, a] / (d * n)
    for i in range(n):
        for at in range(indptr[i], indptr[i + 1]):
            j = indices[at]
            for a in range(d):
                for b in range(d):
                    if constrained[i, a] or constrained[j, b]:
                        blocks[at, a, b] = mean if (i == j and a == b) else 0.0
                    elif i == j and a == b:
                        blocks[at, a, b] += anchor_stiffness * mean


@dataclass(frozen=True, slots=True, eq=False)
class BlockPattern:
    """Sparsity pattern of a matrix of d x d blocks, one row of blocks a node.

    Attributes
    ----------
    indptr, indices : ndarray, int32
        Compressed rows of blocks; columns are sorted within a row.
    """

    indptr: Int32Array
    indices: Int32Array

    @property
    def n_points(self) -> int:
        """Number of rows of blocks."""
        return len(self.indptr) - 1

    @property
    def n_blocks(self) -> int:
        """Number of stored blocks."""
        return len(self.indices)

    def matrix(self, blocks: FloatArray) -> sp.bsr_matrix:
        """Return the matrix whose blocks are `blocks` (n_blocks, d, d)."""
        n = blocks.shape[1] * self.n_points
        return sp.bsr_matrix((blocks, self.indices, self.indptr), shape=(n, n))

    def diagonal(self) -> IntArray:
        """Return the indices (n,) of the diagonal blocks, which are those of nodes that belong to a group."""
        rows = np.repeat(np.arange(self.n_points), np.diff(self.indptr))
        return np.flatnonzero(self.indices == rows)

    def positions(self, connectivity: IntArray) -> Int32Array:
        """Return the indices (m, k, k) of the blocks of local nodes (a, b) of all groups (m, k)."""
        return np.asarray(_block_positions(self.indptr, self.indices, connectivity))


def block_pattern(n_points: int, *connectivities: IntArray) -> BlockPattern:
    """Return the sparsity pattern in which all nodes of a group are coupled.

    Parameters
    ----------
    n_points : int
        Number of nodes.
    *connectivities : ndarray, shape (m, k), int64
        Tables of groups of nodes: the cells of a mesh, the nodes of contact points.
    """
    incidence = []
    for table in connectivities:
        rows = np.repeat(np.arange(len(table)), table.shape[1])
        incidence.append(sp.csr_matrix((np.ones(table.size, dtype=np.int8), (rows, table.ravel())), shape=(len(table), n_points)))
    stacked = sp.vstack(incidence, format="csr").astype(bool)
    graph = (stacked.T @ stacked + sp.identity(n_points, dtype=bool, format="csr")).tocsr()
    graph.sort_indices()
    return BlockPattern(graph.indptr.astype(np.int32), graph.indices.astype(np.int32))


@njit(cache=True)
def _block_positions(indptr, indices, connectivity):  # type: ignore[no-untyped-def]  # pragma: no cover
    m, k = connectivity.shape
    out = np.empty((m, k, k), np.int32)
    for e in range(m):
        for a in range(k):
            start, stop = indptr[connectivity[e, a]], indptr[connectivity[e, a] + 1]
            for b in range(k):
                out[e, a, b] = start + np.searchsorted(indices[start:stop], connectivity[e, b])
    return out
