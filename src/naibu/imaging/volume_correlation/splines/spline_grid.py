"""Tensor-product cubic B-splines on a grid: values, derivatives, refinement, bending energy :cite:p:`unser1999,rueckert1999`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from naibu.core.arrays import AnyFloatArray, FloatArray, IntArray

# Gauss-Legendre points of two-point quadrature on [0, 1]
GAUSS = np.array([0.5 - 0.5 / math.sqrt(3.0), 0.5 + 0.5 / math.sqrt(3.0)])


@dataclass(frozen=True, slots=True, eq=False)
class SplineGrid:
    """Grid of equal cells; coefficients (NZ, NY, NX, 3) of cubic B-splines belong to their corners and one row beyond.

    Attributes
    ----------
    origin_mm : ndarray, shape (3,)
        First corner along x, y, z, mm along the axes of the volume from its first voxel.
    step_mm : ndarray, shape (3,)
        Size of a cell, mm.
    cells : ndarray, shape (3,), int
        Number of cells.
    """

    origin_mm: FloatArray
    step_mm: FloatArray
    cells: IntArray

    @classmethod
    def around(cls, low: ArrayLike, high: ArrayLike, step_mm: ArrayLike, halvings: int = 0) -> SplineGrid:
        """Return the grid about a box whose cells are `step_mm` large after so many halvings."""
        a, b = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
        step = np.asarray(step_mm, dtype=float) * 2**halvings
        cells = np.maximum(np.ceil((b - a) / step - 1e-9).astype(np.int64), 1)
        return cls(0.5 * (a + b) - 0.5 * cells * step, step, cells)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of coefficients along z, y, x."""
        nx, ny, nz = (int(n) + 3 for n in self.cells)
        return nz, ny, nx

    @property
    def nodes_mm(self) -> FloatArray:
        """Positions of the coefficients (NZ, NY, NX, 3), mm, along x, y, z."""
        x, y, z = (self.origin_mm[a] + self.step_mm[a] * (np.arange(self.cells[a] + 3) - 1) for a in range(3))
        grid = np.meshgrid(z, y, x, indexing="ij")
        return np.stack(grid[::-1], axis=-1)

    def table(self, axis: int, at_mm: ArrayLike, derivative: int = 0) -> tuple[IntArray, FloatArray]:
        """Return the cells (n,) of coordinates along an axis, mm, and the four weights (n, 4) or their derivatives, per mm^derivative."""
        h = self.step_mm[axis]
        t = (np.asarray(at_mm, dtype=float) - self.origin_mm[axis]) / h
        cell = np.clip(np.floor(t).astype(np.int64), 0, self.cells[axis] - 1)
        f = t - cell
        if derivative == 0:
            w = np.stack([(1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, -3 * f**3 + 3 * f**2 + 3 * f + 1, f**3], -1) / 6
        elif derivative == 1:
            w = np.stack([-((1 - f) ** 2), 3 * f**2 - 4 * f, -3 * f**2 + 2 * f + 1, f**2], -1) / 2
        else:
            w = np.stack([1 - f, 3 * f - 2, -3 * f + 1, f], -1)
        return cell, w / h**derivative

    def matrix(self, axis: int, at_mm: ArrayLike, derivative: int = 0) -> FloatArray:
        """Return the matrix (n, N) from coefficients along an axis to values at coordinates, mm."""
        cell, w = self.table(axis, at_mm, derivative)
        out = np.zeros((len(cell), int(self.cells[axis]) + 3))
        for k in range(4):
            out[np.arange(len(cell)), cell + k] = w[:, k]
        return out

    def halved(self) -> SplineGrid:
        """Return the grid with cells half as large."""
        return SplineGrid(self.origin_mm, 0.5 * self.step_mm, 2 * self.cells)

    def refined(self, coefficients: FloatArray) -> FloatArray:
        """Return the coefficients of the same field on `halved`."""
        return separable([_two_scale(int(n)) for n in self.cells], coefficients)

    def values(self, coefficients: FloatArray, points_mm: ArrayLike) -> FloatArray:
        """Return the field (n, ...) at points (n, 3), mm along the axes of the volume from its first voxel."""
        x = np.asarray(points_mm, dtype=float)
        (cx, wx), (cy, wy), (cz, wz) = (self.table(a, x[:, a]) for a in range(3))
        _, ny, nx = self.shape
        first = (cz * ny + cy) * nx + cx
        weights = wz[:, :, None, None] * wy[:, None, :, None] * wx[:, None, None, :]
        near = first[:, None, None, None] + (np.arange(4)[:, None, None] * ny + np.arange(4)[:, None]) * nx + np.arange(4)
        size = (len(x), int(np.prod(self.shape)))
        operator = sparse.csr_array((weights.ravel(), near.ravel(), np.arange(0, 64 * len(x) + 1, 64)), shape=size)
        return np.asarray(operator @ coefficients.reshape(size[1], -1)).reshape(len(x), *coefficients.shape[3:])

    def bending(self) -> FloatArray:
        """Return the matrix (64, 64) of the integral of all squared second derivatives over a cell, mm^-1 for fields in mm."""
        x, w = np.polynomial.legendre.leggauss(4)
        x, w = 0.5 * (x + 1), 0.5 * w
        parts = []
        for a in range(3):
            tables = [self.table(a, self.origin_mm[a] + self.step_mm[a] * x, d)[1] for d in range(3)]
            parts.append([np.einsum("q,qa,qb->ab", w * self.step_mm[a], t, t) for t in tables])
        total = np.zeros((64, 64))
        for dx in range(3):
            for dy in range(3 - dx):
                dz = 2 - dx - dy
                count = 2 / (math.factorial(dx) * math.factorial(dy) * math.factorial(dz))
                total += count * np.einsum("ab,cd,ef->acebdf", parts[2][dz], parts[1][dy], parts[0][dx]).reshape(64, 64)
        return total

    def gauss_gradients(self) -> FloatArray:
        """Return the gradients (8, 3, 64), 1/mm, of the splines of a cell at its Gauss points."""
        t = [[self.table(a, self.origin_mm[a] + self.step_mm[a] * GAUSS, d)[1] for d in (0, 1)] for a in range(3)]
        out = np.empty((8, 3, 64))
        for q in range(8):
            for i in range(3):
                wx, wy, wz = t[0][int(i == 0)][q & 1], t[1][int(i == 1)][(q >> 1) & 1], t[2][int(i == 2)][q >> 2]
                out[q, i] = np.einsum("a,b,c->abc", wz, wy, wx).ravel()
        return out


def separable(matrices: Sequence[AnyFloatArray], coefficients: AnyFloatArray) -> FloatArray:
    """Return the values (nz, ny, nx, ...) on a lattice, of matrices along x, y, z and coefficients (NZ, NY, NX, ...)."""
    out = coefficients
    for axis, matrix in zip((2, 1, 0), matrices, strict=True):
        out = np.moveaxis(np.tensordot(matrix, out, (1, axis)), 0, axis)
    return np.asarray(out)


def separable_slice(x: AnyFloatArray, y: AnyFloatArray, z: AnyFloatArray, coefficients: AnyFloatArray) -> FloatArray:
    """Return one slice (ny, nx, ...) of what `separable` returns, of matrices along x and y and the weights (NZ,) along z."""
    rows = np.tensordot(y, np.tensordot(z, coefficients, (0, 0)), (1, 0))
    return np.asarray(np.moveaxis(np.tensordot(x, rows, (1, 1)), 0, 1))


def _two_scale(cells: int) -> FloatArray:
    """Return the matrix from coefficients on cells to those on half as large ones."""
    out = np.zeros((2 * cells + 3, cells + 3))
    for j in range(len(out)):
        i, odd = divmod(j - 1, 2)
        for k, w in ((1, 0.5), (2, 0.5)) if odd else ((0, 0.125), (1, 0.75), (2, 0.125)):
            # at the rim a coefficient beyond the last is taken as the last: no cell of the fine grid sees it
            out[j, min(max(i + k, 0), cells + 2)] += w
    return out
