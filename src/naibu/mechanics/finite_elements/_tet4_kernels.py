"""Assembly kernel for linear tetrahedra with one integration point each and no averaged dilatation.

With one constant deformation gradient F in a tetrahedron every term of the tangent is an outer product of vectors of its nodes a, b,

    n_a = grad N_a,   h_a = F n_a,   g_a = F^-T n_a,   k_a = 2 (I1 h_a - F F^T h_a),

so that no fourth-order tensor is formed. Threads own nodes, not elements: a thread visits all tetrahedra that touch its nodes and adds
only to their rows. Elements between two owners are computed twice; in return there is one parallel region, no colouring, and sums do not
depend on the number of threads. The nodes are partitioned along the reverse Cuthill-McKee numbering :cite:p:`cuthill1969`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import numba
import numpy as np
import scipy.sparse as sp
from numba import prange
from scipy.sparse.csgraph import reverse_cuthill_mckee

from naibu._numba.compilation import njit
from naibu.core.arrays import Int32Array, IntArray
from naibu.mechanics.finite_elements.hyperelasticity import LINEAR_ELASTIC, invariant_derivatives, inverse_transpose

# Threads that wait at a barrier sleep. By default they spin for milliseconds, which costs several times the work itself where another
# program, or the threads of the linear solver, need the core. Read when Numba starts its threads.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


@dataclass(frozen=True, slots=True, eq=False)
class ThreadPartition:
    """Partition of the nodes among threads, and the tetrahedra that each thread visits.

    Attributes
    ----------
    owner : ndarray, shape (n,), int32
        Owner of every node.
    start, cells : ndarray, int64
        Owner p visits the tetrahedra ``cells[start[p]:start[p + 1]]``.
    """

    owner: Int32Array
    start: IntArray
    cells: IntArray


def partition(connectivity: IntArray, indptr: Int32Array, indices: Int32Array, count: int) -> ThreadPartition:
    """Partition the nodes into `count` layers of the mesh graph (indptr, indices) along its reverse Cuthill-McKee numbering."""
    n = len(indptr) - 1
    if count == 1:
        return ThreadPartition(np.zeros(n, dtype=np.int32), np.array([0, len(connectivity)]), np.arange(len(connectivity)))
    graph = sp.csr_matrix((np.ones(len(indices), dtype=np.int8), indices, indptr), shape=(n, n))
    owner = np.empty(n, dtype=np.int32)
    owner[reverse_cuthill_mckee(graph, symmetric_mode=True)] = np.arange(n) * count // n
    touching = [np.flatnonzero((owner[connectivity] == p).any(axis=1)) for p in range(count)]
    start = np.concatenate([[0], np.cumsum([len(cells) for cells in touching])])
    return ThreadPartition(owner, start, np.concatenate(touching))


def thread_count() -> int:
    """Return the number of threads among which a large mesh is divided."""
    return int(numba.get_num_threads())


def _assemble(  # type: ignore[no-untyped-def]  # pragma: no cover
    owner, start, members, connectivity, gradients, volumes, cells, codes, parameters, u, positions, force, blocks
):
    """Add forces and blocks of all tetrahedra, one owner after the other or in parallel; returns energy and smallest det F."""
    count = len(start) - 1
    energies = np.zeros((count, 8))
    determinants = np.full((count, 8), np.inf)
    with_tangent = len(blocks) > 0
    for part in prange(count):
        f, ft_inv, c, d = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(9)
        vectors = np.empty((4, 4, 3))
        energy, lowest = 0.0, np.inf
        for at in range(start[part], start[part + 1]):
            e = members[at]
            nodes = connectivity[e]
            det = _kinematics(nodes, gradients[e, 0], u, f, ft_inv, vectors)
            lowest = min(lowest, det)
            if det > 0.0:
                cell = cells[e, 0]
                density = _coefficients(codes[cell], parameters[cell], f, det, c, d, vectors)
                if owner[nodes[0]] == part:
                    energy += volumes[e, 0] * density
                _scatter_forces(nodes, volumes[e, 0], d, vectors, owner, part, force)
                if with_tangent:
                    _scatter_tangent(nodes, volumes[e, 0], d, c, vectors, owner, part, positions[e], blocks)
        energies[part, 0] = energy
        determinants[part, 0] = lowest
    return energies[:, 0].sum(), determinants.min()


@njit(cache=True, inline="always")
def _kinematics(nodes, gradients, u, f, ft_inv, vectors):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Put F, F^-T and the nodal vectors n, h, g (rows 0, 1, 2 of `vectors`) in place; returns det F."""
    for i in range(3):
        for j in range(3):
            v = 1.0 if i == j else 0.0
            for a in range(4):
                v += u[nodes[a], i] * gradients[a, j]
            f[i, j] = v
    det = inverse_transpose(f, ft_inv)
    for a in range(4):
        n0, n1, n2 = gradients[a, 0], gradients[a, 1], gradients[a, 2]
        vectors[0, a, 0], vectors[0, a, 1], vectors[0, a, 2] = n0, n1, n2
        for i in range(3):
            vectors[1, a, i] = f[i, 0] * n0 + f[i, 1] * n1 + f[i, 2] * n2
            vectors[2, a, i] = ft_inv[i, 0] * n0 + ft_inv[i, 1] * n1 + ft_inv[i, 2] * n2
    return det


@njit(cache=True, inline="always")
def _coefficients(code, p, f, det, c, d, vectors):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Energy density; overwrites `d` by the factors of the outer products, `c` by F F^T, row 3 of `vectors` by k, row 2 for small strain.

    The factors are, in order, of the stress: h, g, k / 2; of the tangent: (n . n) 1, h h, h g + g h, g g, g_b g_a, k g + g k.
    """
    if code == LINEAR_ELASTIC:
        return _small_strain(p, f, c, d, vectors)
    i1, square = 0.0, 0.0
    for i in range(3):
        for j in range(3):
            c[i, j] = f[i, 0] * f[j, 0] + f[i, 1] * f[j, 1] + f[i, 2] * f[j, 2]
            square += c[i, j] * c[i, j]
        i1 += c[i, i]
    energy = invariant_derivatives(code, p, i1, 0.5 * (i1 * i1 - square), det, d)
    w1, w2, wj, w11, w1j, w2j, wjj = d[0], d[1], d[2], d[3], d[6], d[7], d[8]
    for a in range(4):
        for i in range(3):
            v = c[i, 0] * vectors[1, a, 0] + c[i, 1] * vectors[1, a, 1] + c[i, 2] * vectors[1, a, 2]
            vectors[3, a, i] = 2.0 * (i1 * vectors[1, a, i] - v)
    d[0], d[1], d[2] = 2.0 * w1, wj * det, 2.0 * w2
    d[3], d[4], d[5] = 2.0 * w1 + 2.0 * w2 * i1, 4.0 * w11, 2.0 * w1j * det
    d[6], d[7], d[8] = wjj * det * det + wj * det, -wj * det, w2j * det
    return energy


@njit(cache=True)
def _small_strain(p, f, c, d, vectors):  # type: ignore[no-untyped-def]  # pragma: no cover
    """The linear law in the same form: g is n, and h the force vector (stress times n)."""
    trace = f[0, 0] + f[1, 1] + f[2, 2] - 3.0
    energy = 0.5 * p[1] * trace * trace
    for i in range(3):
        for j in range(3):
            e = 0.5 * (f[i, j] + f[j, i]) - (1.0 if i == j else 0.0)
            c[i, j] = 2.0 * p[0] * e + (p[1] * trace if i == j else 0.0)
            energy += p[0] * e * e
    for a in range(4):
        for i in range(3):
            vectors[1, a, i] = c[i, 0] * vectors[0, a, 0] + c[i, 1] * vectors[0, a, 1] + c[i, 2] * vectors[0, a, 2]
            vectors[2, a, i] = vectors[0, a, i]
            vectors[3, a, i] = 0.0
    d[:] = 0.0
    d[0], d[3], d[6], d[7] = 1.0, p[0], p[1], p[0]
    return energy


@njit(cache=True, inline="always")
def _scatter_forces(nodes, volume, d, vectors, owner, part, force):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the nodal forces to the rows of one owner."""
    for a in range(4):
        if owner[nodes[a]] == part:
            for i in range(3):
                force[nodes[a], i] += volume * (d[0] * vectors[1, a, i] + d[1] * vectors[2, a, i] + 0.5 * d[2] * vectors[3, a, i])


@njit(cache=True, inline="always")
def _scatter_tangent(nodes, volume, d, c, vectors, owner, part, positions, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the blocks to the rows of one owner; each pair of nodes is computed once."""
    n, h, g, k = vectors[0], vectors[1], vectors[2], vectors[3]
    for a in range(4):
        mine = owner[nodes[a]] == part
        for b in range(a, 4):
            theirs = owner[nodes[b]] == part and b != a
            if not (mine or theirs):
                continue
            nn = n[a, 0] * n[b, 0] + n[a, 1] * n[b, 1] + n[a, 2] * n[b, 2]
            hh = h[a, 0] * h[b, 0] + h[a, 1] * h[b, 1] + h[a, 2] * h[b, 2]
            diagonal = volume * (d[3] * nn - d[2] * hh)
            left, right = positions[a, b], positions[b, a]
            for i in range(3):
                hi = volume * ((d[4] + 2.0 * d[2]) * h[a, i] + d[5] * g[a, i])
                gi = volume * (d[5] * h[a, i] + d[6] * g[a, i] + d[8] * k[a, i])
                ki, gb, hb = volume * d[8] * g[a, i], volume * d[7] * g[b, i], volume * d[2] * h[b, i]
                for j in range(3):
                    v = hi * h[b, j] + gi * g[b, j] + ki * k[b, j] + gb * g[a, j] - hb * h[a, j] - volume * d[2] * nn * c[i, j]
                    if i == j:
                        v += diagonal
                    if mine:
                        blocks[left, i, j] += v
                    if theirs:
                        blocks[right, j, i] += v


assemble_small = njit(cache=True, nogil=True)(_assemble)
assemble_large = njit(cache=True, parallel=True)(_assemble)
