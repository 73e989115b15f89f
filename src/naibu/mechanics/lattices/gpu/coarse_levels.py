"""Coarse levels of an additive multilevel preconditioner :cite:p:`bramble1990` for the implicit solver of a lattice on a device of Warp.

Neighbours pass a residual on slowly; hat functions of ever coarser grids over the lattice at rest, each twice as coarse as the one before,
spread it over the lattice at once. Every level but the last is solved by its diagonal, the last, of few nodes, by its inverse. All levels
use the lattice at rest: its elements are gathered as tensors in the cells of the first level (an element of stiffness s and direction n
resists the strain n . e n), summed into those of the following ones. Components that are constrained count as if their nodes hung on
springs as stiff as all their elements. It is only a preconditioner: where the lattice has turned, the solver takes more iterations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement

import numpy as np
import scipy.sparse as sp

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.lattices.gpu.device_arrays import ConstrainedArrays, compiled, warp_package
from naibu.mechanics.lattices.gpu.warp_types import WarpArray
from naibu.mechanics.lattices.model.hat_functions import corner_weights
from naibu.mechanics.lattices.model.lattice import Lattice

_MOST = 130  # unknowns of the coarsest level
_WORTH = 0.05  # mean fraction of the mass in the diagonal above which the diagonal does alone
_FEW = 7_000  # elements below which it does as well
_SHIFT = 1e-5  # of the diagonal, added to the masses: some may be zero
_PART = 0.5  # of the inverse diagonals, since the levels above and below see part of it as well
_QUARTICS = list(combinations_with_replacement(range(3), 4))  # the different components of n n n n


@dataclass(frozen=True, slots=True, eq=False)
class SparseRows:
    """Weighted sums on a device: row k adds up the entries ``first[k]`` to ``first[k + 1] - 1`` of `source` and `weight`."""

    first: WarpArray
    source: WarpArray
    weight: WarpArray

    @classmethod
    def of(cls, matrix: sp.csr_matrix, device: object) -> SparseRows:
        """Put a matrix on a device."""
        wp = warp_package()
        return cls(
            wp.array(matrix.indptr.astype(np.int32), dtype=wp.int32, device=device),
            wp.array(matrix.indices.astype(np.int32), dtype=wp.int32, device=device),
            wp.array(matrix.data.astype(np.float32), dtype=wp.float32, device=device),
        )


@dataclass(frozen=True, slots=True, eq=False)
class CoarseLevel:
    """A grid of hat functions.

    Attributes
    ----------
    weight : sparse matrix (p, n)
        Of its n nodes at the p masses, or at the nodes of the level before.
    down, up : SparseRows
        Its transpose and itself on the device.
    diagonal : ndarray, shape (n,)
        Of the matrix of the step, mean of the axes, kg.
    """

    weight: sp.csr_matrix
    down: SparseRows
    up: SparseRows
    diagonal: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CoarseLevels:
    """Coarse levels of a lattice.

    Attributes
    ----------
    levels : tuple of CoarseLevel
        From fine to coarse.
    matrix : ndarray, shape (3 n, 3 n)
        Of the last one, kg.
    diagonal : ndarray, shape (masses,)
        Of the matrix of the step, kg.
    on_device : warp array
        The same on the device.
    """

    levels: tuple[CoarseLevel, ...]
    matrix: FloatArray
    diagonal: FloatArray
    on_device: WarpArray

    @classmethod
    def of(cls, lattice: Lattice, stiff: FloatArray, diagonal: FloatArray, device: object) -> CoarseLevels | None:
        """Prepare the levels of a lattice.

        Parameters
        ----------
        lattice : Lattice
            Masses and elements.
        stiff : ndarray, shape (m,)
            h^2 a of every element, kg.
        diagonal : ndarray, shape (n,)
            Of the matrix of the step, kg.
        device : warp device
            Where it is used.

        Returns
        -------
        CoarseLevels or None
            None where they do not pay.
        """
        mass = lattice.node_mass
        if lattice.n_elements < _FEW or mass.sum() > _WORTH * diagonal.sum():
            return None
        low = lattice.points.min(axis=0)
        extent = np.ptp(lattice.points, axis=0) / (2.0 * lattice.spacing_mm)
        cells = np.maximum(np.ceil(extent - 1e-6), 1.0).astype(np.int64)
        place = (lattice.points - low) / (2.0 * lattice.spacing_mm)
        tensors = np.zeros((*cells, len(_QUARTICS)))
        _gather_tensors(lattice.elements, place, stiff, tensors)
        nodal, levels = mass + _SHIFT * diagonal, []
        while True:
            weight, used = _weights(place, cells)
            nodal = weight.T @ nodal
            own = _mean_diagonal(tensors, used) + nodal
            levels.append(CoarseLevel(weight, SparseRows.of(weight.T.tocsr(), device), SparseRows.of(weight, device), own))
            if 3 * len(used) <= _MOST or cells.max() == 1:
                break
            place, finer = _grid(used, cells) / 2.0, tensors
            cells = -(-cells // 2)
            tensors = _coarsened(finer, cells)
        matrix = _matrix(tensors, used, nodal)
        return cls(tuple(levels), matrix, diagonal, warp_package().array(diagonal, dtype=warp_package().float64, device=device))


@dataclass(frozen=True, slots=True, eq=False)
class CoarseCorrection:
    """The levels as a session uses them: with its constrained components, and arrays of its own.

    Attributes
    ----------
    levels : CoarseLevels
        Of its lattice.
    right, values : list of warp array
        Right sides and values of the nodes of every level.
    scale : list of warp array
        What the levels multiply their right sides with; nothing for the last one.
    inverse : warp array (n, n), mat33d
        Of the last level's matrix.
    device : warp device
        Where they are.
    """

    levels: CoarseLevels
    right: list[WarpArray]
    values: list[WarpArray]
    scale: list[WarpArray]
    inverse: WarpArray
    device: object

    @classmethod
    def of(cls, levels: CoarseLevels, constrained: ConstrainedArrays, device: object) -> CoarseCorrection:
        """Prepare the levels for constrained components."""
        wp = warp_package()
        sizes = [len(level.diagonal) for level in levels.levels]
        right, values = ([wp.zeros(size, dtype=wp.vec3d, device=device) for size in sizes] for _ in range(2))
        node, direction = constrained.node.numpy(), constrained.direction.numpy().reshape(-1, 3)
        chosen = (np.ones(len(node)), node, np.arange(len(node) + 1))
        held, scale, spring = sp.csr_matrix(chosen, shape=(len(node), len(levels.diagonal))), [], levels.diagonal[node]
        for level in levels.levels:
            held = held @ level.weight
            diagonal = level.diagonal + held.power(2).T @ (spring * (direction**2).sum(axis=1)) / 3.0
            scale.append(wp.array(_PART / diagonal, dtype=wp.float64, device=device))
        spread = (held.toarray()[:, :, None] * direction[:, None, :]).reshape(len(node), 3 * sizes[-1])
        inverse = np.linalg.inv(levels.matrix + spread.T @ (spring[:, None] * spread))
        blocks = (0.5 * (inverse + inverse.T)).reshape(sizes[-1], 3, sizes[-1], 3).transpose(0, 2, 1, 3)
        scale[-1] = wp.zeros(0, dtype=wp.float64, device=device)
        return cls(levels, right, values, scale, wp.array(blocks, dtype=wp.mat33d, device=device), device)

    def apply(self, smoothed: WarpArray, z: WarpArray) -> None:
        """Set z to what the smoother and all levels answer to a residual; the smoother's answer is given."""
        wp, kernels = warp_package(), compiled("_coarse_kernels")
        levels, right, values = self.levels.levels, self.right, self.values

        def launch(kernel: object, rows: SparseRows, *inputs: object) -> None:
            arrays = [rows.first, rows.source, rows.weight, *inputs]
            wp.launch(kernel, rows.first.shape[0] - 1, inputs=arrays, device=self.device)

        launch(kernels.restrict_masses, levels[0].down, self.levels.on_device, smoothed, right[0])
        for k in range(1, len(levels)):
            launch(kernels.combine, levels[k].down, right[k - 1], self.scale[-1], right[k], right[k])
        wp.launch(kernels.times, right[-1].shape[0], inputs=[self.inverse, right[-1], values[-1]], device=self.device)
        for k in range(len(levels) - 1, 0, -1):
            launch(kernels.combine, levels[k].up, values[k], self.scale[k - 1], right[k - 1], values[k - 1])
        launch(kernels.spread, levels[0].up, values[0], smoothed, z)


def _weights(place: FloatArray, cells: IntArray) -> tuple[sp.csr_matrix, IntArray]:
    """Return the weights (p, n) of the nodes of a grid at places, in cells, and which nodes of the grid they are, without gaps."""
    number, weight = corner_weights(place, cells)
    some = weight > 0.0
    used, column = np.unique(number[some], return_inverse=True)
    first = np.append(0, np.cumsum(some.sum(axis=1)))
    matrix = sp.csr_matrix((weight[some], column.astype(np.int32).ravel(), first), shape=(len(place), len(used)))
    return matrix, used


def _grid(number: IntArray, cells: IntArray) -> FloatArray:
    """Return where nodes of a grid lie, in its cells."""
    shape = cells + 1
    return np.stack([number % shape[0], number // shape[0] % shape[1], number // (shape[0] * shape[1])], axis=1).astype(float)


@cache
def _products() -> FloatArray:
    """Return means over a unit cell of products of derivatives of its hat functions, (corner, corner, axis, axis)."""
    at, w = np.polynomial.legendre.leggauss(2)
    at, w = 0.5 + 0.5 * at, 0.5 * w
    result = np.zeros((8, 8, 3, 3))
    for point in np.ndindex(2, 2, 2):
        t = at[list(point)]
        gradient = _gradients(t)
        result += np.prod(w[list(point)]) * np.einsum("kp,mq->kmpq", gradient, gradient)
    return result


def _gradients(t: FloatArray) -> FloatArray:
    """Return derivatives of the hat functions of the corners of a unit cell at a point, (corner, axis)."""
    sides = np.array(list(np.ndindex(2, 2, 2)), dtype=bool)
    value, slope = np.where(sides, t, 1.0 - t), np.where(sides, 1.0, -1.0)
    return np.stack([slope[:, a] * np.delete(value, a, axis=1).prod(axis=1) for a in range(3)], axis=1)


@cache
def _component() -> IntArray:
    """Return the numbers (axis, axis, axis, axis) of the components of a symmetric tensor among those that differ."""
    return np.array([_QUARTICS.index(tuple(sorted(index))) for index in np.ndindex(3, 3, 3, 3)]).reshape(3, 3, 3, 3)


def _corner_numbers(shape: tuple[int, ...]) -> IntArray:
    """Return the numbers (cells, 8) of the grid nodes at the corners of all cells."""
    index = np.stack(np.meshgrid(*(np.arange(k) for k in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    sides = index[:, None, :] + np.array(list(np.ndindex(2, 2, 2)))
    number: IntArray = sides[..., 0] + (shape[0] + 1) * (sides[..., 1] + (shape[1] + 1) * sides[..., 2])
    return number


def _mean_diagonal(tensors: FloatArray, used: IntArray) -> FloatArray:
    """Return the diagonal of a level, mean of the axes, at its nodes in use, without masses."""
    shape = tensors.shape[:3]
    corners = _corner_numbers(shape)
    trace = tensors.reshape(-1, len(_QUARTICS))[:, np.einsum("aapq->apq", _component())].sum(axis=1)  # (cells, p, q)
    own = np.einsum("kkpq->kpq", _products())
    values = np.einsum("cpq,kpq->ck", trace, own) / 3.0
    whole = np.bincount(corners.ravel(), values.ravel(), minlength=int(np.prod(np.array(shape) + 1)))
    return np.asarray(whole[used], dtype=float)


def _matrix(tensors: FloatArray, used: IntArray, nodal: FloatArray) -> FloatArray:
    """Return the matrix (3 n, 3 n) of a level, with its masses."""
    corners, whole = _corner_numbers(tensors.shape[:3]), tensors.reshape(-1, len(_QUARTICS))[:, _component()]
    blocks = np.einsum("capbq,kmpq->ckamb", whole, _products())
    number = np.full(int(np.prod(np.array(tensors.shape[:3]) + 1)), -1)
    number[used] = np.arange(len(used))
    result = np.zeros((len(used), 3, len(used), 3))
    for cell, block in zip(number[corners], blocks, strict=True):
        there = cell >= 0
        result[np.ix_(cell[there], range(3), cell[there], range(3))] += block[there][:, :, there]
    for axis in range(3):
        result[range(len(used)), axis, range(len(used)), axis] += nodal
    return result.reshape(3 * len(used), -1)


def _coarsened(tensors: FloatArray, cells: IntArray) -> FloatArray:
    """Return the tensors of cells twice as coarse, in units of these."""
    padded = np.pad(tensors, [*((0, 2 * c - k) for c, k in zip(cells, tensors.shape[:3], strict=True)), (0, 0)])
    whole: FloatArray = padded.reshape(cells[0], 2, cells[1], 2, cells[2], 2, -1).sum(axis=(1, 3, 5)) / 4.0
    return whole


@njit(cache=True)
def _gather_tensors(elements, place, stiff, tensors):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add s n n d d of elements of direction n and length d to the cells in which they lie; long ones are shared out along their length."""
    nx, ny, nz = tensors.shape[0] - 1, tensors.shape[1] - 1, tensors.shape[2] - 1
    for e in range(len(elements)):
        i, j = elements[e, 0], elements[e, 1]
        x, y, z = place[j, 0] - place[i, 0], place[j, 1] - place[i, 1], place[j, 2] - place[i, 2]
        square = x * x + y * y + z * z
        parts = max(round(np.sqrt(square) / 0.87), 1)  # a diagonal between neighbours is one part
        s = stiff[e] / (square * parts)
        for part in range(parts):
            t = (part + 0.5) / parts
            a = min(max(int(place[i, 0] + t * x), 0), nx)
            b = min(max(int(place[i, 1] + t * y), 0), ny)
            c = min(max(int(place[i, 2] + t * z), 0), nz)
            cell = tensors[a, b, c]
            k = 0
            for p in range(3):
                dp = place[j, p] - place[i, p]
                for q in range(p, 3):
                    dq = dp * (place[j, q] - place[i, q])
                    for u in range(q, 3):
                        du = dq * (place[j, u] - place[i, u])
                        for v in range(u, 3):
                            cell[k] += s * du * (place[j, v] - place[i, v])
                            k += 1
