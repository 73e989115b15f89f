"""Normal equations of global digital volume correlation: assembly, solution by conjugate gradients, random samples of the error.

Samples are drawn by perturbing data and penalties, and solving :cite:p:`papandreou2010`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import islice

import numpy as np

from naibu._numba.intrinsics.simd import WIDTH
from naibu.core.arrays import BoolArray, Float32Array, FloatArray, Int32Array, IntArray
from naibu.imaging.volume_correlation._warp_kernels import warp_voxels
from naibu.imaging.volume_correlation.image_level import ImageLevel
from naibu.imaging.volume_correlation.splines._assembly_kernels import ALONG, LINE, PRODUCTS, SLICE, assemble
from naibu.imaging.volume_correlation.splines._sample_kernels import add_random_forces, products_of_many
from naibu.imaging.volume_correlation.splines._spline_kernels import add_forces, add_noise, cell_forces, product, sample_energies
from naibu.imaging.volume_correlation.splines.spline_grid import SplineGrid, separable

INSIDE = 0.5  # empirical: fraction of a cell in the object above which its dilatation is penalised
REACH = 7  # nodes along an axis with which a cubic B-spline overlaps
APART = 3  # rows of cells that share nodes with one row
BLOCK = (2, 2, 2)  # nodes along z, y, x whose equations precondition together
UPPER = np.triu_indices(4)  # pairs of the four splines along an axis
ROUNDING = 1e-4  # of the diagonal, added to it in preconditioners: equations in single precision may else not be definite


class SplineSystem:
    """Normal equations of the coefficients of a spline grid, from the voxels of a level.

    Cells without voxels of the object are left out, and only the coefficients of the other cells are unknown.

    Attributes
    ----------
    level, grid : ImageLevel, SplineGrid
        Voxels and cells.
    active : ndarray, shape (NZ, NY, NX), bool
        Which coefficients are unknown; n of them.
    cells : ndarray, shape (m, 5), int64
        First cell, and the one after the last, of the task of that number; z, y, x of the cell.
    fraction : ndarray, shape (m,)
        Fraction of the cell that lies in the object.
    bending_energy, dilatation_energy : ndarray, shape (m, 3) and (m,)
        Twice the penalties of the field per unit weight, after `assembled`.
    ratio : float
        Ratio of the deformed to the reference volume at which the dilatation penalty vanishes.
    """

    def __init__(self, level: ImageLevel, grid: SplineGrid, ratio: float = 1.0) -> None:
        self.ratio = ratio
        self.level, self.grid = level, grid
        tables = [[grid.table(a, level.axes_mm[a], d) for d in (0, 1)] for a in range(3)]
        self.cell_of = tuple(t[0][0] for t in tables)
        self.weights = tuple(np.ascontiguousarray(t[0][1], dtype=np.float32) for t in tables)
        self.derivatives = tuple(np.ascontiguousarray(t[1][1], dtype=np.float32) for t in tables)
        self.starts = tuple(np.searchsorted(c, np.arange(n + 1)).astype(np.int64) for c, n in zip(self.cell_of, grid.cells, strict=True))
        self._order_cells()
        self._number_nodes()
        bending = grid.bending()
        values, vectors = np.linalg.eigh(bending)
        self.stiffness, self.root = bending.astype(np.float32), (vectors * np.sqrt(np.maximum(values, 0))).astype(np.float32)
        self.gauss = grid.gauss_gradients().astype(np.float32)
        self.along, self.pairs = _along(self.weights[0]), _pair_places()
        # weight of the volume of a Gauss point, mm^3, where the cell lies in the object
        self.gauss_volume = np.where(self.fraction > INSIDE, np.prod(grid.step_mm) / 8, 0.0)
        self.matrix = np.empty((self.n, 3, 3 * REACH**3), np.float32)
        self._inverse: Float32Array | None = None
        self.bending_energy, self.dilatation_energy = np.zeros((len(self.cells), 3), np.float32), np.zeros(len(self.cells), np.float32)

    @property
    def inner(self) -> BoolArray:
        """Which cells (m,) lie in the object; all where none does by more than a half."""
        inside = self.fraction > INSIDE
        return inside if inside.any() else np.ones_like(inside)

    @property
    def n(self) -> int:
        """Number of nodes with unknown coefficients."""
        return len(self.nodes[0])

    def _order_cells(self) -> None:
        inside = []
        for cell, n in zip(self.cell_of, self.grid.cells, strict=True):
            one = np.zeros((int(n), len(cell)))
            one[cell, np.arange(len(cell))] = 1
            inside.append(one)
        count = separable(inside, self.level.mask.astype(float))
        z, y, x = np.nonzero(count > 0)
        # columns of APART x APART cells are tasks; every other column shares no node
        tall, wide = z // APART, y // APART
        colour = (tall % 2) * 2 + wide % 2
        order = np.lexsort((x, y, z, wide, tall, colour))
        z, y, x, colour = z[order], y[order], x[order], colour[order]
        key = np.stack([colour, tall[order], wide[order]])
        first = np.flatnonzero(np.r_[True, (np.diff(key, axis=1) != 0).any(axis=0)])
        self.tasks = np.searchsorted(colour[first], np.arange(5)).astype(np.int64)
        self.cells = np.zeros((len(z), 5), np.int64)
        self.cells[: len(first), 0], self.cells[: len(first), 1] = first, np.r_[first[1:], len(z)]
        self.cells[:, 2], self.cells[:, 3], self.cells[:, 4] = z, y, x
        self.fraction = count[z, y, x] * np.prod(self.level.spacing / self.grid.step_mm)

    def _number_nodes(self) -> None:
        self.active = np.zeros(self.grid.shape, dtype=bool)
        z, y, x = self.cells[:, 2:].T
        for a in range(64):
            self.active[z + (a >> 4), y + ((a >> 2) & 3), x + (a & 3)] = True
        self.nodes = np.nonzero(self.active)
        n = len(self.nodes[0])
        self.slot = np.full(self.active.shape, -1, np.int64)
        self.slot[self.active] = np.arange(n)
        wide = np.full(tuple(s + 6 for s in self.active.shape), n, np.int32)
        wide[3:-3, 3:-3, 3:-3][self.active] = np.arange(n)
        z, y, x = self.nodes
        self.neighbours = np.empty((n, REACH**3), np.int32)
        for o in range(REACH**3):
            self.neighbours[:, o] = wide[z + o // 49, y + (o // 7) % 7, x + o % 7]
        self._divide_nodes()

    def _divide_nodes(self) -> None:
        """Divide the nodes into blocks: `members` (b, 8) of each, `there` (b, 8), which of them there are, and their `place` (n,)."""
        at = np.stack(self.nodes, axis=1)
        block = np.unique(at // BLOCK, axis=0, return_inverse=True)[1].ravel()
        within = np.ravel_multi_index(tuple((at % BLOCK).T), BLOCK)
        self.place = block * int(np.prod(BLOCK)) + within
        self.members = np.zeros((block.max() + 1, int(np.prod(BLOCK))), np.int64)
        self.members.flat[self.place] = np.arange(self.n)
        self.there = np.zeros(self.members.shape, dtype=bool)
        self.there.flat[self.place] = True
        inside = np.array(list(np.ndindex(*BLOCK)))
        # where the second node of two stands among the neighbours of the first
        self.pair_neighbours = (inside[None] - inside[:, None] + REACH // 2) @ (REACH**2, REACH, 1)

    def at_middles(self, coefficients: Float32Array, *, every: bool = False) -> FloatArray:
        """Return the field (k, 3) of coefficients (n, 3) in the middles of the cells that lie in the object, or of every cell."""
        full = np.zeros((*self.active.shape, 3))
        full[self.active] = coefficients
        return self.grid.values(full, self.middles_mm[slice(None) if every else self.inner])

    def warped(
        self, c: FloatArray, value: Float32Array, reference_gradient: Float32Array, gradient: Float32Array, displacement: Float32Array
    ) -> None:
        """Fill displacement, intensity and gradients of the voxels at coefficients c (NZ, NY, NX, 3), mm: see `warp_voxels`."""
        level = self.level
        low = (level.low[::-1] - level.first).astype(np.float32)
        warp_voxels(
            c.astype(np.float32), level.runs, self.cell_of, self.weights, self.derivatives, low,
            (1 / level.spacing).astype(np.float32), level.deformed, level.gradient, value, reference_gradient, gradient, displacement,
        )  # fmt: skip

    def assembled(
        self,
        c: FloatArray,
        products: Float32Array,
        force: Float32Array,
        bending: FloatArray,
        dilatation: FloatArray,
        given: Float32Array | None = None,
        *,
        voxels: bool = True,
    ) -> Float32Array:
        """Assemble the matrix, and return the right side (n, 3), at coefficients c; bending (m, 3) and dilatation (m,) are weights.

        To the matrix one that is given (n, 3, 1029) is added; without `voxels`, only the penalties are.
        """
        number = self.level.number if voxels else np.full_like(self.level.number, -1)
        self.matrix[:] = 0 if given is None else given
        self._inverse = None
        right = np.zeros((self.n, 3), np.float32)
        self.bending_energy[:], self.dilatation_energy[:] = 0, 0
        assemble(
            self.matrix, right, self.tasks, self.cells, self.slot, c.astype(np.float32), products, force, number, self.starts,
            self.along, self.weights, bending.astype(np.float32), self.stiffness, dilatation.astype(np.float32), self.gauss, self.ratio,
            self.pairs, self.bending_energy, self.dilatation_energy,
        )  # fmt: skip
        return right

    def sum_intensities(self, products: Float32Array) -> None:
        """Fill the matrix with that of the intensities alone, without penalties."""
        none = np.zeros((len(self.cells), 3))
        self.assembled(np.zeros((*self.active.shape, 3)), products, np.zeros((len(products), 3), np.float32), none, none[:, 0])

    def multiplied(self, matrix: Float32Array, coefficients: Float32Array) -> Float32Array:
        """Return the products (n, 3, s) of a matrix (n, 3, 1029) with coefficients (n, 3, s)."""
        given = coefficients.shape[2]
        x = np.pad(coefficients, ((0, 1), (0, 0), (0, -given % WIDTH)))
        out = np.empty_like(x[:-1])
        products_of_many(matrix, self.neighbours, x, out)
        return np.ascontiguousarray(out[:, :, :given])

    def solved(
        self, load: Float32Array, tolerance: float, most: int = 100, lost: Callable[[Float32Array], Float32Array] | None = None
    ) -> tuple[Float32Array, int]:
        """Return A^-1 load (n, 3) by conjugate gradients, preconditioned by blocks of nodes, and the number of iterations.

        From products (n, 3) of the matrix with coefficients (n, 3), `lost` of these is taken away.
        """
        x, steps = self.solved_many(load[:, :, None], tolerance, most, lost)
        return x[:, :, 0], steps

    def solved_many(
        self, loads: Float32Array, tolerance: float, most: int = 100, lost: Callable[[Float32Array], Float32Array] | None = None
    ) -> tuple[Float32Array, int]:
        """Return A^-1 loads (n, 3, s), all at once, and the number of iterations."""
        n, given = self.n, loads.shape[2]
        single = given == 1
        r = loads.copy() if single else np.pad(loads, ((0, 0), (0, 0), (0, -given % WIDTH)))
        x = np.zeros_like(r)
        p, ap = np.zeros((n + 1, *r.shape[1:]), np.float32), np.empty_like(r)
        z = self.preconditioned(r)
        p[:n] = z
        rz = first = _dot(r, z)
        steps = 0
        while steps < most:
            steps += 1
            if single:
                product(self.matrix, self.neighbours, p[:, :, 0], ap[:, :, 0])
            else:
                products_of_many(self.matrix, self.neighbours, p, ap)
            if lost is not None:
                ap[:, :, 0] -= lost(p[:n, :, 0])
            curved = _dot(p[:n], ap)
            if lost is not None and curved[0] <= 0.0:  # rounding took more than there was
                return self.solved_many(loads, tolerance, most)
            alpha = (rz / np.maximum(curved, 1e-30)).astype(np.float32)
            x += alpha * p[:n]
            r -= alpha * ap
            z = self.preconditioned(r)
            new = _dot(r, z)
            if (new <= tolerance**2 * first).all():
                break
            p[:n] *= (new / np.maximum(rz, 1e-30)).astype(np.float32)
            p[:n] += z
            rz = new
        return np.ascontiguousarray(x[:, :, :given]), steps

    def preconditioned(self, r: Float32Array) -> Float32Array:
        """Return the solutions (n, 3, s) of the equations of blocks of nodes, each without its neighbours, for residuals (n, 3, s)."""
        if self._inverse is None:  # of a part of the cells alone there may be none
            self._inverse = self._inverted_blocks()
        blocks, samples = len(self.members), r.shape[2]
        apart = self._inverse @ r[self.members].reshape(blocks, -1, samples)
        return np.asarray(apart.reshape(-1, 3, samples)[self.place])

    def _inverted_blocks(self) -> Float32Array:
        """Return the inverses (b, 24, 24) of the matrices of blocks of nodes; places without a node stand apart from the others."""
        there, size = self.there, 3 * self.members.shape[1]
        pairs = self.matrix.reshape(self.n, 3, -1, 3)[self.members[:, :, None], :, self.pair_neighbours, :]
        pairs[~(there[:, :, None] & there[:, None, :])] = 0
        whole = pairs.transpose(0, 1, 3, 2, 4).reshape(-1, size, size).astype(float)
        k = np.arange(size)
        whole[:, k, k] = np.where(np.repeat(there, 3, axis=1), (1.0 + ROUNDING) * whole[:, k, k], 1.0)
        return np.linalg.inv(whole).astype(np.float32)

    def bending_load(self, c: FloatArray, bending: FloatArray) -> Float32Array:
        """Return the loads (n, 3) of the bending penalty of weights (m, 3) at coefficients c."""
        z, y, x = self.cells[:, 2:].T
        a = np.arange(64)
        at = z[:, None] + (a >> 4), y[:, None] + ((a >> 2) & 3), x[:, None] + (a & 3)
        near = c[at]
        each = -bending[:, None, :] * np.matmul(self.stiffness.astype(float), near - near[:, :1])
        loads = np.zeros((self.n, 3))
        np.add.at(loads, self.slot[at], each)
        return loads.astype(np.float32)

    def dilatation_load(self, c: FloatArray, dilatation: FloatArray) -> Float32Array:
        """Return the loads (n, 3) of the dilatation penalty of weights (m,) at coefficients c."""
        z, y, x = self.cells[:, 2:].T
        a = np.arange(64)
        at = z[:, None] + (a >> 4), y[:, None] + ((a >> 2) & 3), x[:, None] + (a & 3)
        gradients = self.gauss.astype(float)
        deformation = np.eye(3) + np.einsum("qka,mai->mqik", gradients, c[at], optimize=True)
        determinant = np.linalg.det(deformation)
        cofactor = determinant[..., None, None] * np.swapaxes(np.linalg.inv(deformation), -1, -2)
        pressure = -dilatation[:, None] * (determinant - self.ratio)
        loads = np.zeros((self.n, 3))
        np.add.at(loads, self.slot[at], np.einsum("mq,mqik,qka->mai", pressure, cofactor, gradients, optimize=True))
        return loads.astype(np.float32)

    def force_loads(self, forces: Float32Array, number: Int32Array | None = None) -> Float32Array:
        """Return loads (n, 3, s) of forces (voxels, 3, s) on the voxels, or on those that are numbered in their box, others being -1."""
        loads = np.zeros((self.n, 3, forces.shape[2]), np.float32)
        which = self.level.number if number is None else number
        flat = forces.reshape(len(forces), 3 * forces.shape[2])  # also of no voxel
        add_forces(loads.reshape(self.n, -1), self.tasks, self.cells, self.slot, flat, which, self.starts, self.weights)
        return loads

    def cell_loads(self, forces: Float32Array) -> Float32Array:
        """Return loads (m, 64, 3, s) of forces (voxels, 3, s) on the nodes of every cell from its own voxels."""
        out = np.empty((len(self.cells), 64, 3 * forces.shape[2]), np.float32)
        flat = forces.reshape(len(forces), 3 * forces.shape[2])
        cell_forces(self.cells, flat, self.level.number, self.starts, self.weights, out)
        return out.reshape(len(self.cells), 64, 3, -1)

    @property
    def cell_nodes(self) -> IntArray:
        """Numbers (m, 64) of the nodes of every cell."""
        (z, y, x), a = self.cells[:, 2:].T[..., None], np.arange(64)
        return np.asarray(self.slot[z + (a >> 4), y + ((a >> 2) & 3), x + (a & 3)])

    @property
    def middles_mm(self) -> FloatArray:
        """Middles (m, 3) of the cells, mm."""
        return np.asarray(self.grid.origin_mm + (self.cells[:, :1:-1] + 0.5) * self.grid.step_mm)

    def random_loads(self, sensitivity: Float32Array, random: Iterable[Float32Array], number: Int32Array | None = None) -> Float32Array:
        """Return loads (n, 3, s) of the forces that random numbers (voxels,) times the sensitivity (voxels, 3) are, one load for each.

        `number` is that of `force_loads`.
        """
        which = self.level.number if number is None else number
        groups = [np.zeros((self.n, 3, 0), np.float32)]
        numbers = np.zeros((len(sensitivity), WIDTH), np.float32)
        left = iter(random)
        while drawn := list(islice(left, WIDTH)):
            for k, values in enumerate(drawn):
                numbers[:, k] = values
            loads = np.zeros((self.n, 3 * WIDTH), np.float32)
            add_random_forces(loads, self.tasks, self.cells, self.slot, sensitivity, numbers, which, self.starts, self.weights)
            groups.append(loads.reshape(self.n, 3, WIDTH)[:, :, : len(drawn)])
        return np.concatenate(groups, axis=2)

    def add_penalty_noise(
        self, loads: Float32Array, c: FloatArray, bending: FloatArray, dilatation: FloatArray, rng: np.random.Generator
    ) -> None:
        """Add loads of random draws from the penalties to loads (n, 3, s)."""
        count, m = loads.shape[2], len(self.cells)
        drawn = rng.standard_normal((m, 3, 64, count), dtype=np.float32)
        drawn *= np.sqrt(bending)[:, :, None, None].astype(np.float32)
        bent = np.ascontiguousarray(np.matmul(self.root, drawn).transpose(0, 2, 1, 3)).reshape(m, 64, 3 * count)
        add_noise(
            loads.reshape(self.n, -1), self.tasks, self.cells, self.slot, c.astype(np.float32), bent, dilatation.astype(np.float32),
            self.gauss, rng.standard_normal((m, 8, count), dtype=np.float32),
        )  # fmt: skip

    def energies(self, samples: Float32Array, c: FloatArray) -> tuple[Float32Array, Float32Array]:
        """Return the mean energies (m, 3) and (m,) of samples (n, 3, s) about coefficients c: of bending, and of linear dilatation."""
        bending_energy, dilatation_energy = np.zeros_like(self.bending_energy), np.zeros_like(self.dilatation_energy)
        x = np.concatenate([samples, np.zeros((1, *samples.shape[1:]), np.float32)])
        sample_energies(x, self.cells, self.slot, c.astype(np.float32), self.stiffness, self.gauss, bending_energy, dilatation_energy)
        return bending_energy, dilatation_energy


def _dot(a: Float32Array, b: Float32Array) -> FloatArray:
    return np.asarray(np.einsum("nis,nis->s", a, b, dtype=np.float64))


def _pair_places() -> IntArray:
    """Return where the sums of products for every two splines of a cell begin, and how far they are apart (64, 64, 2)."""
    one = np.zeros((4, 4), np.int64)
    one[UPPER] = np.arange(10)
    one = np.maximum(one, one.T)
    a = np.arange(64)
    z, y, x = (one[k[:, None], k] for k in (a >> 4, (a >> 2) & 3, a & 3))
    first = np.where(x < 8, x, 48 + PRODUCTS * (x - 8))
    return np.asarray(np.stack([z * SLICE + y * LINE + first, np.where(x < 8, 8, 1)], axis=2))


def _along(weights: Float32Array) -> Float32Array:
    """Return the numbers (n ALONG,) of voxels along x that sums are taken of, from the four weights (n, 4) of each."""
    out = np.zeros((len(weights), ALONG), np.float32)
    out[:, :10] = weights[:, UPPER[0]] * weights[:, UPPER[1]]
    out[:, 10:14] = weights
    return out.ravel()
