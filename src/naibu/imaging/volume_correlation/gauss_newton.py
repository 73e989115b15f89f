"""Gauss-Newton iterations of volume correlation on one grid, and how strongly every place is smoothed (behind volume correlation)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from naibu.imaging.volume_correlation._warp_kernels import OUTSIDE, weigh
from naibu.imaging.volume_correlation.image_level import GainMap, ImageLevel
from naibu.imaging.volume_correlation.normal_equations import SplineSystem
from naibu.imaging.volume_correlation.residual_noise import ResidualNoise
from naibu.imaging.volume_correlation.rigid_inclusions import StiffBody

MAD = 1.4826  # standard deviation of a normal distribution, in median absolute deviations
SOLVE = 0.1  # relative accuracy of a step
SAMPLE_SOLVE = 0.06  # of random samples
AT_ONCE = 16
# of the unknowns: fewer than the first are not determined by any data, and the second are taken to be as everywhere else
LEAST_SHARE, COMMON = 0.02, 0.05
LEAST_AGREEMENT = 0.01


@dataclass(frozen=True, slots=True)
class Comparison:
    """How grey values are compared.

    Attributes
    ----------
    robust : float
        Multiple of the scatter of the residual where a voxel's weight has fallen to a quarter; inf for least squares.
    place : float
        Standard deviation of the place of a grey value in the voxel, voxels: steep slopes are trusted less.
    share : float
        Share of the slope that is taken from the reference, carried along; the rest from the deformed scan.
    gain_cell_mm : float
        Cell of the lattice of local gain, mm; 0 for one gain.
    reliable_mm : float
        Standard deviation of the window in which the slopes of both scans are compared, mm; 0 where all are believed.
    rough : bool
        Whether the scans are far from register: then the scatter is that of all residuals, those of edges among them.
    """

    robust: float
    place: float
    share: float
    gain_cell_mm: float
    reliable_mm: float = 0.0
    rough: bool = False


@dataclass(frozen=True, slots=True)
class Iterations:
    """How often and how far.

    Attributes
    ----------
    most : int
        Number of Gauss-Newton steps.
    stop_voxels : float
        Root mean square step of the cells at which they end, voxels.
    limit_voxels : float
        Longest step of all but 5 % of the cells, voxels; longer ones are shortened.
    constrained : float
        How strongly voxels are held where they were at first, of what the mean slope of grey values says: where there is no texture they
        would wander while the scans are far from register.
    """

    most: int = 6
    stop_voxels: float = 0.01
    limit_voxels: float = 2.0
    constrained: float = 0.0


class Correlation:
    """A field on a grid of splines that is being fitted to the voxels of a level."""

    def __init__(self, level: ImageLevel, system: SplineSystem, how: Comparison, bodies: Sequence[StiffBody] = ()) -> None:
        self.level, self.system, self.how, self.bodies = level, system, how, bodies
        n = len(level.grey)
        self.value, self.residual, self.weight = (np.zeros(n, np.float32) for _ in range(3))
        self.reference_slope, self.slope, self.move, self.force = (np.zeros((n, 3), np.float32) for _ in range(4))
        self.products, self.alike = np.zeros((n, 6), np.float32), np.zeros((n, 2), np.float32)
        self.gain, self.offset = np.ones(n, np.float32), np.zeros(n, np.float32)
        self.trust, self.scatter = np.ones(n, np.float32), 0.0
        self.last_step = np.zeros((system.n, 3), np.float32)

    @property
    def seen(self) -> BoolArray:
        """Which voxels lie in the deformed scan after they moved (n,)."""
        return np.asarray(self.value > 0.9 * OUTSIDE)

    def iterate(self, c: FloatArray, bending: FloatArray, volume: FloatArray, times: Iterations) -> FloatArray:
        """Return the coefficients after Gauss-Newton steps from c; bending (m, 3) and volume (m,) are weights of the cells."""
        voxel = float(np.prod(self.level.spacing) ** (1 / 3))
        first = None
        for _ in range(times.most):
            self.compare(c)
            if times.constrained:
                first = self.move.copy() if first is None else first
                self._hold(first, times.constrained)
            load = self.system.assembled(c, self.products, self.force, bending, volume)
            step, _ = self.system.solved(load, SOLVE)
            length = np.linalg.norm(self.system.at_middles(step), axis=1)
            far = float(np.percentile(length, 95))
            shrink = min(1.0, times.limit_voxels * voxel / max(far, 1e-30))
            self.last_step = shrink * step
            c = c.copy()
            c[self.system.active] += self.last_step
            if shrink * float(np.sqrt((length**2).mean())) < times.stop_voxels * voxel:
                break
        return c

    def _hold(self, first: Float32Array, share: float) -> None:
        diagonal = self.products[:, [0, 3, 5]]
        strength = np.float32(share * diagonal[self.seen].sum(axis=1).mean() / 3)
        for k in (0, 3, 5):
            self.products[:, k] += strength
        self.force -= strength * (self.move - first)

    def compare(self, c: FloatArray) -> None:
        """Warp, match gain and offset, and weigh the residuals at coefficients c."""
        self.system.warped(c, self.value, self.reference_slope, self.slope, self.move)
        seen, gain = self.seen, GainMap(self.level, self.how.gain_cell_mm or 1.0)
        if self.scatter == 0.0:
            self.gain[:], self.offset[:], _ = gain.everywhere(self.value, self.trust)
            self._trusted(seen)
        if self.how.gain_cell_mm:
            self.gain, self.offset = gain.local(self.value, self.trust, self.scatter**2)
        self._trusted(seen)
        scalars = np.array([self.scatter**-2, (self.how.place * self.level.spacing.mean()) ** 2, self.how.robust**-2, self.how.share])
        weigh(
            self.level.grey, self.value, self.gain, self.offset, self.reference_slope, self.slope, scalars.astype(np.float32),
            self.products, self.force, self.weight, self.residual, self.alike,
        )  # fmt: skip
        if self.how.reliable_mm:
            self._believe()
        for body in self.bodies:
            body.follow(self)

    def _believe(self) -> None:
        """Take voxels for as much as their surroundings' slopes agree in both scans: slopes of noise tell of no motion."""
        both = []
        for k in range(2):
            box = np.zeros(self.level.mask.shape, np.float32)
            box[self.level.mask] = self.alike[:, k]
            wide = ndimage.gaussian_filter(box, self.how.reliable_mm / self.level.spacing[::-1], mode="constant", truncate=2.5)
            both.append(wide[self.level.mask])
        share = np.clip(both[0] / np.maximum(both[1], 1e-30), LEAST_AGREEMENT, 1.0)
        for values in (self.products, self.force):
            values *= share[:, None]
        self.weight *= share

    def _trusted(self, seen: BoolArray) -> None:
        r = np.where(seen, self.level.grey - self.gain * self.value - self.offset, 0)
        # the scatter of noise that is rounded to grey values is never less than that of rounding
        rest = r[seen] if seen.any() else self.level.grey
        spread = float(np.sqrt(np.mean(rest**2))) if self.how.rough else MAD * float(np.median(np.abs(rest)))
        self.scatter = max(spread, 1e-6 * float(np.ptp(self.level.grey)))
        self.trust = np.where(seen, 1 / (1 + (r / (self.how.robust * self.scatter)) ** 2) ** 2, 0).astype(np.float32)

    def samples(
        self, c: FloatArray, bending: FloatArray, volume: FloatArray, count: int, noise: ResidualNoise | None, seed: int
    ) -> Float32Array:
        """Return random coefficients (n, 3, count) about c that the data leave open, mm.

        Without `noise` the residuals of voxels are independent: samples of the normal matrix alone.
        """
        out = np.empty((self.system.n, 3, count), np.float32)
        pull = self.slope * np.sqrt(self.weight)[:, None]
        for first in range(0, count, AT_ONCE):
            rng = np.random.default_rng((seed, first))
            forces = np.empty((*pull.shape, min(AT_ONCE, count - first)), np.float32)
            for k in range(forces.shape[2]):
                random = rng.standard_normal(len(pull), dtype=np.float32) if noise is None else noise.draw(rng)
                force = pull * random[:, None]
                for body in self.bodies:
                    body.waver(self, force, random, rng)
                forces[:, :, k] = force
            loads = self.system.noise_loads(c, forces, bending, volume, rng)
            out[:, :, first : first + AT_ONCE] = self.system.solved_many(loads, SAMPLE_SOLVE)[0]
        return out


def chosen_weights(
    fit: Correlation, samples: Float32Array, c: FloatArray, bending: FloatArray, volume_weight: float, width_mm: float, kinds: IntArray
) -> tuple[FloatArray, float]:
    """Return the most probable weights of bending (m, 3) of cells and axes, and of change of volume, given the data.

    Parameters
    ----------
    fit : Correlation
        After iterations at `bending` and `volume_weight`.
    samples : ndarray, shape (n, 3, s)
        Random coefficients about c.
    c : ndarray
        Coefficients.
    bending : ndarray, shape (m, 3)
        Present weights.
    volume_weight : float
        Present weight of change of volume, per mm^3.
    width_mm : float
        Standard deviation of the Gaussian window in which cells share a weight, mm.
    kinds : ndarray, shape (m,)
        Only cells of one kind share a weight.

    Notes
    -----
    The fixed point of MacKay: lambda = gamma / E, where E is the energy of the field per unit weight and gamma the number of unknowns that
    the data determine: all those that the prior holds, less lambda times the mean energy of the samples.
    """
    system = fit.system
    bent, swollen = system.energies(samples, c)
    constrained = _unknowns(system, bending)
    determined, energy = constrained - bending * bent, system.bent.astype(float)
    out = np.empty_like(bending)
    z, y, x = system.cells[:, 2:].T
    for kind in np.unique(kinds):
        m = kinds == kind

        def shared(v: FloatArray, m: BoolArray = m) -> FloatArray:
            full = np.zeros((*(int(n) for n in system.grid.cells[::-1]), 3))
            full[z[m], y[m], x[m]] = v[m]
            wide = ndimage.gaussian_filter(full, [*(width_mm / system.grid.step_mm[::-1]), 0], mode="constant", truncate=3.0)
            return np.asarray(wide[z[m], y[m], x[m]])

        # where the data say little the weight is that of all cells together
        common = np.maximum(determined[m].sum(axis=0), LEAST_SHARE * constrained[m].sum(axis=0)) / np.maximum(energy[m].sum(axis=0), 1e-30)
        believed = COMMON * shared(constrained)
        out[m] = (np.maximum(shared(determined), 0.0) + believed) / (shared(energy) + believed / common)
    per_cell = system.watched
    left = system.n - volume_weight * float(per_cell @ swollen)
    return out, left / max(float(per_cell @ system.swollen), 1e-30)


def _unknowns(system: SplineSystem, bending: FloatArray) -> FloatArray:
    """Return how many unknowns the bending of every cell and axis holds (m, 3); those of a node are shared out by stiffness."""
    z, y, x = system.cells[:, 2:].T
    diagonal = np.diag(system.stiffness).astype(float)
    total, out = np.zeros((*system.active.shape, 3)), np.zeros_like(bending)
    for a in range(64):
        # a cell meets a node once for every a
        total[z + (a >> 4), y + ((a >> 2) & 3), x + (a & 3)] += diagonal[a] * bending
    for a in range(64):
        out += diagonal[a] * bending / total[z + (a >> 4), y + ((a >> 2) & 3), x + (a & 3)]
    return out
