"""Gauss-Newton iterations of global digital volume correlation on one spline grid, and the most probable weights of its penalties.

Global correlation on a mesh :cite:p:`besnard2006,roux2008`, here with cubic B-splines; the weights are those of maximal evidence
:cite:p:`mackay1992`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from naibu.core.arrays import AnyFloatArray, BoolArray, Float32Array, FloatArray, IntArray
from naibu.imaging.volume_correlation._warp_kernels import add_to_cells, shrink_gradients
from naibu.imaging.volume_correlation.gain_coupling import CoupledGain, GainCoupling
from naibu.imaging.volume_correlation.image_level import GainMap, ImageLevel, most_probable_gain
from naibu.imaging.volume_correlation.intensity_comparison import ComparisonSettings, IntensityComparison
from naibu.imaging.volume_correlation.mixed_steps import MixedSteps
from naibu.imaging.volume_correlation.residual_noise import ResidualNoise
from naibu.imaging.volume_correlation.rigid_parts.rigid_inclusions import RigidInclusion
from naibu.imaging.volume_correlation.splines.normal_equations import SplineSystem

# relative accuracy of the linear solves: a Gauss-Newton step is repeated, and random fields by which weights are chosen need not be exact;
# those of the covariance do, since conjugate gradients find the smooth part last, which is most of it under stiff penalties; in the norm of
# the preconditioner, in which errors of energy are about as large
STEP_TOLERANCE, SAMPLE_TOLERANCE, COVARIANCE_TOLERANCE = 0.15, 0.08, 0.003
SAMPLES_AT_ONCE = 16  # right sides of one solve, which bound the memory
# empirical, fractions of the unknowns: at least so many count as determined by the data of a kind, and a cell's own weight starts from the
# common one with the worth of so many
LEAST_FRACTION, COMMON = 0.02, 0.05


AGREEMENT_WINDOW = 0.5  # cells: standard deviation of the window in which the gradients of both volumes are compared
LEAST_RELIABILITY = 0.01  # keeps the normal matrix regular where the gradients do not agree at all
REGULAR = 1e-6  # of the trace: gradients of a cell may all have one direction
FRESH = 2  # steps at which the reliability of the gradients is estimated anew: it varies little from step to step
INSIDE_INCLUSION = 2  # kind of cells
STILL = 0.1  # voxels: step below which a cell has converged
MOST_STEPS = 25  # by far not converged after so many, a fit never is


@dataclass(frozen=True, slots=True)
class Iterations:
    """Number of Gauss-Newton steps and their limits.

    Attributes
    ----------
    most : int
        Largest number of steps, but for those below.
    stop_voxels : float
        Root mean square step of the cells at which they end, voxels.
    limit_voxels : float
        Longest step of all but 5 % of the cells, voxels; longer ones are shortened.
    anchoring : float
        Stiffness of springs to the first displacement, as a fraction of the mean stiffness that the intensities give: keeps voxels without
        texture in position while the volumes are far from registered.
    unsettled : float
        Fraction of the cells that have not converged, above which the steps go on, up to `MOST_STEPS`.
    tolerance : float
        Relative accuracy of the linear solves.
    mixed : bool
        Whether steps are mixed with earlier ones (`MixedSteps`).
    """

    most: int = 6
    stop_voxels: float = 0.01
    limit_voxels: float = 2.0
    anchoring: float = 0.0
    unsettled: float = 1.0
    tolerance: float = STEP_TOLERANCE
    mixed: bool = False


class CorrelationFit(IntensityComparison):
    """Gauss-Newton fit of a displacement field on a spline grid to the voxels of a level.

    With `noisy` the gradients are multiplied by their reliability, cell by cell. `within` (n,) tells the listed voxels of the object from
    those of a margin about it, at which no error is stated.
    """

    def __init__(
        self,
        level: ImageLevel,
        system: SplineSystem,
        settings: ComparisonSettings,
        inclusions: Sequence[RigidInclusion] = (),
        *,
        noisy: bool = False,
    ) -> None:
        super().__init__(level, settings)
        self.system, self.inclusions, self.noisy = system, inclusions, noisy
        self.reliability: Float32Array | None = None
        self.within = np.ones(len(level.intensity), dtype=bool)
        self.last_step = np.zeros((system.n, 3), np.float32)
        self.still_mm = STILL * float(np.prod(level.spacing) ** (1 / 3))

    def forget_equations(self) -> None:
        """Let go of what only further steps and errors need, most of the memory of a fit; displacement, gain and offset stay."""
        self.products = self.agreement = self.force = self.gradient = self.reference_gradient = np.zeros((0, 3), np.float32)
        self.system.matrix = np.zeros((0, 3, 3), np.float32)

    @cached_property
    def cell_of_voxel(self) -> IntArray:
        """Number of the cell of every listed voxel (n,)."""
        system = self.system
        number = np.full(tuple(int(n) for n in system.grid.cells[::-1]), -1, np.int64)
        number[tuple(system.cells[:, 2:].T)] = np.arange(len(system.cells))
        return np.asarray(number[np.ix_(*(system.cell_of[a] for a in (2, 1, 0)))][self.level.mask])

    @property
    def last_steps_mm(self) -> FloatArray:
        """How far the middle of every cell (m,) was moved by the last step, mm."""
        return np.asarray(np.linalg.norm(self.system.at_middles(self.last_step, every=True), axis=1))

    @property
    def moving(self) -> BoolArray:
        """Cells (m,) that have not converged: the last step moved them by a tenth of a voxel or more."""
        return np.asarray(self.last_steps_mm > self.still_mm)

    @property
    def moving_fraction(self) -> float:
        """Fraction of the cells in the object that have not converged."""
        return float(self.moving[self.system.inner].mean())

    def cell_sums(self, values: AnyFloatArray) -> FloatArray:
        """Return the sums (m,) over the listed voxels (n,) of every cell."""
        return np.bincount(self.cell_of_voxel, np.asarray(values, dtype=float), minlength=len(self.system.cells)).astype(float)

    def iterate(self, c: FloatArray, bending: FloatArray, dilatation: FloatArray, times: Iterations) -> FloatArray:
        """Return the coefficients after Gauss-Newton steps from c; bending (m, 3) and dilatation (m,) are weights of the cells."""
        voxel = float(np.prod(self.level.spacing) ** (1 / 3))
        first, steps = None, MixedSteps()
        for k in range(MOST_STEPS):
            if k >= times.most and self.moving_fraction <= times.unsettled:
                break
            if k < FRESH:
                self.reliability = None
            self.compare(c)
            if times.anchoring:
                first = self.displacement.copy() if first is None else first
                self.anchor(first, times.anchoring)
            coupling = self.coupling() if times.mixed and self.settings.gain_cell_mm else None
            if coupling is not None:
                self.products *= self.curvature_share[:, None]
            load = self.system.assembled(c, self.products, self.force, bending, dilatation)
            if coupling is not None:
                load -= coupling.load(coupling.gain_step)
            step, _ = self.system.solved(load, times.tolerance, lost=None if coupling is None else coupling.lost)
            moved = self.system.at_middles(step)
            length = np.linalg.norm(moved, axis=1)
            far = float(np.percentile(length, 95))
            shrink = min(1.0, times.limit_voxels * voxel / max(far, 1e-30))
            self.last_step = steps.mixed(shrink * step, shrink * moved.ravel()) if times.mixed else shrink * step
            c = c.copy()
            c[self.system.active] += self.last_step
            if shrink * float(np.sqrt((length**2).mean())) < times.stop_voxels * voxel:
                break
        return c

    def assemble(self, c: FloatArray, bending: FloatArray, dilatation: FloatArray) -> None:
        """Assemble the normal equations of the weights themselves at coefficients c."""
        self.compare(c)
        self.system.assembled(c, self.products, self.force, bending, dilatation)

    def compare(self, c: FloatArray) -> None:
        """Warp, weight the residuals at coefficients c, and let rigid inclusions replace those of their voxels."""
        self.system.warped(c, self.value, self.reference_gradient, self.gradient, self.displacement)
        self.match()
        self.weigh()
        if self.noisy:
            if self.reliability is None:
                self.reliability = self.reliability_of(self.cell_agreement())
            shrink_gradients(self.reliability, self.cell_of_voxel, self.weight, self.residual, self.gradient, self.products, self.force)
        for inclusion in self.inclusions:
            inclusion.follow(self)

    def coupled_gain(self, lattice: GainMap) -> CoupledGain:
        """Return what gain and offset on a lattice share with the displacement."""
        curvature = self.curvature_share
        pull = self.gradient * (self.weight * curvature)[:, None]
        loads = self.system.cell_loads(np.stack([pull * self.value[:, None], pull], axis=2))
        return CoupledGain(loads, lattice.normal_equations(self.value, self.robust_weight * curvature)[0])

    def coupling(self) -> GainCoupling:
        """Return how displacement and local gain are coupled."""
        lattice, variance = GainMap(self.level, self.settings.gain_cell_mm), self.residual_sd**2
        everywhere = lattice.everywhere(self.value, self.robust_weight)
        matrix, load = lattice.normal_equations(self.value, self.robust_weight)
        to_gain = most_probable_gain(matrix, load, variance, everywhere) - self.local_gain
        at = self.system.middles_mm / self.level.spacing
        return GainCoupling(self.system, self.coupled_gain(lattice), at, lattice, (matrix, variance, everywhere), to_gain)

    def windowed(self, values: FloatArray, width: float) -> FloatArray:
        """Return values (m, ...) of the cells summed in a Gaussian window of a standard deviation in cells."""
        dense = np.zeros((*(int(n) for n in self.system.grid.cells[::-1]), *values.shape[1:]))
        at = tuple(self.system.cells[:, 2:].T)
        dense[at] = values
        sigma = (width,) * 3 + (0,) * (values.ndim - 1)
        return np.asarray(ndimage.gaussian_filter(dense, sigma, mode="constant")[at])

    def cell_misfit(self) -> FloatArray:
        """Return sums (m, 3) over the voxels of every cell: squared residuals, squared gradients, per mm^2, and their number."""
        squares = self.residual.astype(float) ** 2, (self.gradient**2).sum(axis=1)
        return np.stack([self.cell_sums(v) for v in (*squares, np.ones(len(self.residual)))], axis=1)

    def cell_agreement(self) -> FloatArray:
        """Return the products of gradients (m, 12) summed over the voxels of every cell."""
        sums = np.zeros((len(self.system.cells), 12))
        add_to_cells(self.cell_of_voxel, self.agreement, sums)
        return sums

    def reliability_of(self, sums: FloatArray) -> Float32Array:
        """Return the matrix (m, 3, 3) by which a gradient in every cell is multiplied to leave out what is noise in it.

        From the sums (m, 12) of `cell_agreement`. It is the local regression of the gradient of one volume on that of the other
        :cite:p:`fuller1987`. Noise would else count as information, above all in directions in which the image varies little, such as along
        a surface.
        """
        common, own = (_symmetric(v) for v in np.split(self.windowed(sums, AGREEMENT_WINDOW), 2, axis=-1))
        trace = np.trace(own, axis1=1, axis2=2)[:, None, None]
        root = np.linalg.cholesky(own + (REGULAR * trace + 1e-30) * np.eye(3))
        inverse = np.linalg.inv(root)
        shares, axes = np.linalg.eigh(inverse @ common @ np.swapaxes(inverse, 1, 2))
        clipped = (axes * np.clip(shares, LEAST_RELIABILITY, 1.0)[:, None, :]) @ np.swapaxes(axes, 1, 2)
        return np.ascontiguousarray(root @ clipped @ inverse, dtype=np.float32)

    def samples(
        self,
        c: FloatArray,
        bending: FloatArray,
        dilatation: FloatArray,
        count: int,
        noise: ResidualNoise | None,
        seed: int,
        tolerance: float = COVARIANCE_TOLERANCE,
    ) -> Float32Array:
        """Return random coefficients (n, 3, count), mm, about c, distributed as its error :cite:p:`papandreou2010`.

        Without `noise` the residuals of voxels are independent, and the covariance is the inverse of the normal matrix. `tolerance` is the
        relative accuracy of the linear solves.
        """
        out = np.empty((self.system.n, 3, count), np.float32)
        sensitivity = self.gradient * np.sqrt(self.weight)[:, None]
        for inclusion in self.inclusions:
            sensitivity[inclusion.voxels] = 0
        for first in range(0, count, SAMPLES_AT_ONCE):
            rng, many = np.random.default_rng((seed, first)), min(SAMPLES_AT_ONCE, count - first)
            loads = self._random_loads(sensitivity, many, noise, rng)
            self.system.add_penalty_noise(loads, c, bending, dilatation, rng)
            out[:, :, first : first + SAMPLES_AT_ONCE] = self.system.solved_many(loads, tolerance)[0]
        return out

    def noise_samples(self, count: int, noise: ResidualNoise, seed: int) -> Float32Array:
        """Return random coefficients (n, 3, count), mm, that residuals of noise alone would leave, at the penalties last assembled."""
        return self.system.solved_many(self.noise_loads(count, noise, seed), SAMPLE_TOLERANCE)[0]

    def noise_loads(self, count: int, noise: ResidualNoise, seed: int, share: Float32Array | None = None) -> Float32Array:
        """Return the loads (n, 3, count) of the residuals of which `noise_samples` are, with a `share` (n,) of the weights of voxels."""
        sensitivity = self.gradient * np.sqrt(self.weight)[:, None]
        if share is not None:
            sensitivity *= share[:, None]
        for inclusion in self.inclusions:
            sensitivity[inclusion.voxels] = 0
        return self.system.random_loads(sensitivity, noise.draws(np.random.default_rng((seed, count)), count))

    def _random_loads(self, sensitivity: Float32Array, count: int, noise: ResidualNoise | None, rng: np.random.Generator) -> Float32Array:
        if noise is not None and not self.inclusions:
            return self.system.random_loads(sensitivity, noise.draws(rng, count))
        held: list[list[FloatArray]] = []

        def residuals() -> Iterator[Float32Array]:
            for _ in range(count):
                random = rng.standard_normal(len(sensitivity), dtype=np.float32) if noise is None else noise.draw(rng)
                held.append([inclusion.perturbed(random, rng) for inclusion in self.inclusions])
                yield random

        loads = self.system.random_loads(sensitivity, residuals())
        return loads + self.inclusion_loads(held) if self.inclusions else loads

    def inclusion_loads(self, forces: Sequence[Sequence[FloatArray]]) -> Float32Array:
        """Return loads (n, 3, s) of forces (k, 3) on the voxels of every inclusion, for every sample."""
        at = np.concatenate([inclusion.voxels for inclusion in self.inclusions])
        listed = np.full(len(self.level.intensity), -1, np.int32)
        listed[at] = np.arange(len(at))
        number = np.full(self.level.mask.shape, -1, np.int32)
        number[self.level.mask] = listed
        return self.system.force_loads(np.stack([np.concatenate(each) for each in forces], axis=2).astype(np.float32), number)


def cell_kinds(fit: CorrelationFit) -> IntArray:
    """Return 0 for soft cells, 1 for those next to an inclusion, 2 for those inside one: they differ too much to share a weight."""
    system, level = fit.system, fit.level
    if not fit.inclusions:
        return np.zeros(len(system.cells), np.int64)
    rigid = np.zeros(len(level.intensity))
    for inclusion in fit.inclusions:
        rigid[inclusion.voxels] = 1
    where = (level.index.astype(np.int64) - level.low[::-1]).T
    at = tuple(system.cell_of[a][where[a]] for a in (2, 1, 0))
    shape = tuple(int(n) for n in system.grid.cells[::-1])
    flat = np.ravel_multi_index(at, shape)
    count = np.bincount(flat, minlength=int(np.prod(shape)))
    fraction = (np.bincount(flat, rigid, minlength=len(count)) / np.maximum(count, 1)).reshape(shape)
    near = ndimage.binary_dilation(fraction > 0, np.ones((3, 3, 3), dtype=bool))
    return np.asarray(np.where(fraction > 0.95, INSIDE_INCLUSION, np.where(near, 1, 0))[tuple(system.cells[:, 2:].T)], dtype=np.int64)


def chosen_weights(
    fit: CorrelationFit,
    samples: Float32Array,
    c: FloatArray,
    bending: FloatArray,
    dilatation_weight: float,
    width_mm: float,
    kinds: IntArray,
    dilating: BoolArray,
) -> tuple[FloatArray, float]:
    """Return the most probable weights of the bending penalty (m, 3), by cell and axis, and of the dilatation penalty, given the data.

    Parameters
    ----------
    fit : Correlation
        After iterations at `bending` and `dilatation_weight`.
    samples : ndarray, shape (n, 3, s)
        Random coefficients about c.
    c : ndarray
        Coefficients.
    bending : ndarray, shape (m, 3)
        Present weights.
    dilatation_weight : float
        Present weight of squared dilatation, per mm^3.
    width_mm : float
        Standard deviation of the Gaussian window in which cells share a weight, mm.
    kinds : ndarray, shape (m,)
        Only cells of one kind share a weight.
    dilating : ndarray, shape (m,), bool
        Cells that do not have the common weight of dilatation.

    Notes
    -----
    Fixed-point iteration of :cite:t:`mackay1992`: ``lambda = gamma / E``, where E is the energy of the field per unit weight and gamma the
    number of unknowns that the data determine: all that the penalty acts on, less lambda times the mean energy of the samples.
    """
    system = fit.system
    bending_energy, dilatation_energy = system.energies(samples, c)
    penalised = _unknowns(system, bending)
    determined = penalised - bending * bending_energy
    energy = np.maximum(system.bending_energy.astype(float), 0.0)  # of a rigid motion, rounding may be below zero
    out = np.empty_like(bending)
    z, y, x = system.cells[:, 2:].T
    for kind in np.unique(kinds):
        m = kinds == kind

        def windowed(v: FloatArray, m: BoolArray = m) -> FloatArray:
            full = np.zeros((*(int(n) for n in system.grid.cells[::-1]), 3))
            full[z[m], y[m], x[m]] = v[m]
            wide = ndimage.gaussian_filter(full, [*(width_mm / system.grid.step_mm[::-1]), 0], mode="constant", truncate=3.0)
            return np.asarray(wide[z[m], y[m], x[m]])

        # where the data determine little the weight is that of all cells of the kind
        common = np.maximum(determined[m].sum(axis=0), LEAST_FRACTION * penalised[m].sum(axis=0)) / np.maximum(energy[m].sum(axis=0), 1e-30)
        common_part = COMMON * windowed(penalised)
        out[m] = (np.maximum(windowed(determined), 0.0) + common_part) / (windowed(energy) + common_part / common)
    per_cell = np.where(dilating, 0.0, system.gauss_volume)
    unknowns = system.n * float(per_cell.sum()) / max(float(system.gauss_volume.sum()), 1e-30)
    left = unknowns - dilatation_weight * float(per_cell @ dilatation_energy)
    return out, left / max(float(per_cell @ system.dilatation_energy), 1e-30)


def _unknowns(system: SplineSystem, bending: FloatArray) -> FloatArray:
    """Return the number of unknowns (m, 3) on which the bending penalty of every cell and axis acts; a node's is divided by stiffness."""
    z, y, x = system.cells[:, 2:].T
    diagonal = np.diag(system.stiffness).astype(float)
    total, out = np.zeros((*system.active.shape, 3)), np.zeros_like(bending)
    for a in range(64):
        # a cell meets a node once for every a
        total[z + (a >> 4), y + ((a >> 2) & 3), x + (a & 3)] += diagonal[a] * bending
    for a in range(64):
        out += diagonal[a] * bending / total[z + (a >> 4), y + ((a >> 2) & 3), x + (a & 3)]
    return out


def _symmetric(values: FloatArray) -> FloatArray:
    """Return the symmetric matrices (m, 3, 3) of components xx, xy, xz, yy, yz, zz (m, 6)."""
    return np.asarray(values[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]])
