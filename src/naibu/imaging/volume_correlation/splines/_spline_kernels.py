# mypy: disallow-untyped-decorators=False
"""Numba kernels of the normal equations of digital volume correlation on a grid of cubic B-splines :cite:p:`unser1999`.

Cells lie in rows along x. Rows of one colour share no node, so that threads write to separate memory and every sum keeps its order. The
matrix A (n, 3, 1029) has 343 blocks of 3 x 3 for each node: those of the nodes at most three apart along every axis.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray

F = np.float32
CHUNKS = 64  # parts of a matrix product that threads take: many more than threads, so that they end together


@njit(cache=True, fastmath=True, error_model="numpy")
def cofactor(local: AnyArray, gradients: AnyArray, q: int, cof: AnyArray) -> Any:
    """Fill cof (3, 3) with the cofactors of I + grad u at a Gauss point, and return its determinant."""
    j = np.empty((3, 3), F)
    for i in range(3):
        for k in range(3):
            s = F(1) if i == k else F(0)
            for a in range(64):
                s += local[a, i] * gradients[q, k, a]
            j[i, k] = s
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for k in range(3):
            k1, k2 = (k + 1) % 3, (k + 2) % 3
            cof[i, k] = j[i1, k1] * j[i2, k2] - j[i1, k2] * j[i2, k1]
    return j[0, 0] * cof[0, 0] + j[0, 1] * cof[0, 1] + j[0, 2] * cof[0, 2]


@njit(cache=True, fastmath=True, error_model="numpy")
def gather(c: AnyArray, cell: AnyArray, local: AnyArray) -> None:
    """Fill local (64, 3) with the coefficients of a cell, relative to one of them: single precision then loses nothing."""
    z, y, x = cell[2], cell[3], cell[4]
    for a in range(64):
        for i in range(3):
            local[a, i] = c[z + (a >> 4), y + ((a >> 2) & 3), x + (a & 3), i] - c[z + 1, y + 1, x + 1, i]


@njit(cache=True, fastmath=True, error_model="numpy")
def clear(load: AnyArray) -> None:
    """Fill load with zeros; within a parallel kernel that would become a loop of its own, which takes seconds to compile."""
    load[:] = F(0)


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def product(big: AnyArray, neighbours: AnyArray, x: AnyArray, y: AnyArray) -> None:
    """Fill y (n, 3) with A x; x (n + 1, 3) ends in zeros, to which neighbours (n, 343) outside the grid point."""
    n = big.shape[0]
    for t in prange(CHUNKS):
        near = np.empty(1029, F)
        for p in range(t * n // CHUNKS, (t + 1) * n // CHUNKS):
            for o in range(343):
                q = neighbours[p, o]
                near[3 * o], near[3 * o + 1], near[3 * o + 2] = x[q, 0], x[q, 1], x[q, 2]
            s0, s1, s2 = F(0), F(0), F(0)
            for o in range(1029):
                s0 += big[p, 0, o] * near[o]
                s1 += big[p, 1, o] * near[o]
                s2 += big[p, 2, o] * near[o]
            y[p, 0], y[p, 1], y[p, 2] = s0, s1, s2


@njit(cache=True, fastmath=True, error_model="numpy")
def add_scaled(w: Any, x: AnyArray, y: AnyArray) -> None:
    """Add w x to y (k,); loops around it have bounds that the compiler does not know, so that it is not unrolled many times."""
    for k in range(len(x)):
        y[k] += w * x[k]


@njit(cache=True, fastmath=True, error_model="numpy")
def _add_forces(
    forces: AnyArray, which: AnyArray, box: AnyArray, wx: AnyArray, wy: AnyArray, wz: AnyArray, f1: AnyArray, f2: AnyArray, load: AnyArray
) -> None:
    """Add the forces (voxels, 3 s) in a cell to load (64, 3 s)."""
    for z in range(box[4], box[5]):
        f2[:] = F(0)
        for y in range(box[2], box[3]):
            f1[:] = F(0)
            for x in range(box[0], box[1]):
                p = which[z, y, x]
                if p >= 0:
                    for a in range(wx.shape[1]):
                        add_scaled(wx[x, a], forces[p], f1[a])
            for a in range(len(f2)):
                add_scaled(wy[y, a >> 2], f1[a & 3], f2[a])
        for a in range(len(load)):
            add_scaled(wz[z, a >> 4], f2[a & 15], load[a])


@njit(cache=True, fastmath=True, error_model="numpy")
def scatter(load: AnyArray, cell: AnyArray, slot: AnyArray, loads: AnyArray) -> None:
    """Add the load (64, 3 s) of a cell to loads (n, 3 s)."""
    for a in range(len(load)):
        add_scaled(F(1), load[a], loads[slot[cell[2] + (a >> 4), cell[3] + ((a >> 2) & 3), cell[4] + (a & 3)]])


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def add_forces(
    loads: AnyArray, tasks: AnyArray, cells: AnyArray, slot: AnyArray, forces: AnyArray, which: AnyArray, starts: Any, weights: Any
) -> None:
    """Add the loads of forces (voxels, 3 s) to loads (n, 3 s)."""
    many = forces.shape[1]
    for colour in range(len(tasks) - 1):
        for task in prange(tasks[colour], tasks[colour + 1]):
            f1, f2, load, box = np.empty((4, many), F), np.empty((16, many), F), np.empty((64, many), F), np.empty(6, np.int64)
            for m in range(cells[task, 0], cells[task, 1]):
                cell = cells[m]
                for a in range(3):
                    box[2 * a], box[2 * a + 1] = starts[a][cell[4 - a]], starts[a][cell[4 - a] + 1]
                clear(load)
                _add_forces(forces, which, box, weights[0], weights[1], weights[2], f1, f2, load)
                scatter(load, cell, slot, loads)


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def cell_forces(cells: AnyArray, forces: AnyArray, which: AnyArray, starts: Any, weights: Any, out: AnyArray) -> None:
    """Fill out (m, 64, 3 s) with the loads of forces (voxels, 3 s) in every cell on its nodes."""
    many = forces.shape[1]
    for m in prange(len(cells)):
        f1, f2, box = np.empty((4, many), F), np.empty((16, many), F), np.empty(6, np.int64)
        for a in range(3):
            box[2 * a], box[2 * a + 1] = starts[a][cells[m, 4 - a]], starts[a][cells[m, 4 - a] + 1]
        clear(out[m])
        _add_forces(forces, which, box, weights[0], weights[1], weights[2], f1, f2, out[m])


@njit(cache=True, fastmath=True, error_model="numpy")
def _add_dilatation(cof: AnyArray, gradients: AnyArray, t: Any, draws: AnyArray, load: AnyArray) -> None:
    """Add t times draws (s,) of the dilatation at a Gauss point with gradients (3, 64) to load (64, 3 s)."""
    samples = len(draws)
    for a in range(len(load)):
        for i in range(len(cof)):
            w = t * (cof[i, 0] * gradients[0, a] + cof[i, 1] * gradients[1, a] + cof[i, 2] * gradients[2, a])
            add_scaled(w, draws, load[a, i * samples : (i + 1) * samples])


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def add_noise(
    loads: AnyArray, tasks: AnyArray, cells: AnyArray, slot: AnyArray, c: AnyArray, bending_draws: AnyArray, dilatation: AnyArray,
    gradients: AnyArray, dilatation_draws: AnyArray,
) -> None:  # fmt: skip
    """Add the loads of random draws from the penalties to loads (n, 3 s).

    bending_draws (m, 64, 3 s): random loads of bending; dilatation_draws (m, 8, s): random dilatations.
    """
    for colour in range(len(tasks) - 1):
        for task in prange(tasks[colour], tasks[colour + 1]):
            local, cof = np.empty((64, 3), F), np.empty((3, 3), F)
            for m in range(cells[task, 0], cells[task, 1]):
                load = bending_draws[m]
                if dilatation[m] > 0:
                    gather(c, cells[m], local)
                    for q in range(len(gradients)):
                        cofactor(local, gradients, q, cof)
                        _add_dilatation(cof, gradients[q], F(np.sqrt(dilatation[m])), dilatation_draws[m, q], load)
                scatter(load, cells[m], slot, loads)


@njit(cache=True, fastmath=True, error_model="numpy")
def _energy_of_samples(xl: AnyArray, stiffness: AnyArray, d: AnyArray) -> Any:
    """Return the sum over samples of x . K x of xl (64, s); K is symmetric."""
    e = F(0)
    for a in range(len(xl)):
        d[:] = F(0)
        for b in range(a):
            add_scaled(F(2) * stiffness[a, b], xl[b], d)
        add_scaled(stiffness[a, a], xl[a], d)
        e += _squares(d, xl[a])
    return e


@njit(cache=True, fastmath=True, error_model="numpy")
def _squares(d: AnyArray, x: AnyArray) -> Any:
    e = F(0)
    for s in range(len(d)):
        e += d[s] * x[s]
    return e


@njit(cache=True, fastmath=True, error_model="numpy")
def _dilatation_of_samples(cof: AnyArray, gradients: AnyArray, xl: AnyArray, d: AnyArray) -> Any:
    """Return the sum over samples xl (3, 64, s) of their squared linear dilatation at a Gauss point with gradients (3, 64)."""
    d[:] = F(0)
    for i in range(len(xl)):
        for a in range(xl.shape[1]):
            w = cof[i, 0] * gradients[0, a] + cof[i, 1] * gradients[1, a] + cof[i, 2] * gradients[2, a]
            add_scaled(w, xl[i, a], d)
    return _squares(d, d)


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def sample_energies(
    x: AnyArray,
    cells: AnyArray,
    slot: AnyArray,
    c: AnyArray,
    stiffness: AnyArray,
    gradients: AnyArray,
    bending_energy: AnyArray,
    dilatation_energy: AnyArray,
) -> None:
    """Fill the mean over samples x (n + 1, 3, s) of the bending energy of each cell (m, 3) and of the squared linear dilatation (m,)."""
    samples = x.shape[2]
    for m in prange(len(cells)):
        cell = cells[m]
        local, xl, cof, d = np.empty((64, 3), F), np.empty((3, 64, samples), F), np.empty((3, 3), F), np.empty(samples, F)
        gather(c, cell, local)
        for a in range(xl.shape[1]):
            n = slot[cell[2] + (a >> 4), cell[3] + ((a >> 2) & 3), cell[4] + (a & 3)]
            for i in range(len(xl)):
                for s in range(samples):
                    xl[i, a, s] = x[n, i, s]
        for i in range(len(xl)):
            bending_energy[m, i] = _energy_of_samples(xl[i], stiffness, d) / samples
        e = F(0)
        for q in range(len(gradients)):
            cofactor(local, gradients, q, cof)
            e += _dilatation_of_samples(cof, gradients[q], xl, d)
        dilatation_energy[m] = e / samples
