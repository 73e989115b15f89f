"""Errors that many voxels share: by how much other weights of the voxels would move the field.

The covariance takes residuals that are more than a few voxels apart for independent. Two kinds are not. Interpolation and partial volume
shift an edge, such as the skin, alike along a long stretch, and where it is curved and little texture is beside it, that pulls the field
along the edge. Where parts of an object slide on each other by less than a voxel, one field lies between the motions of both. Either error
shows where voxels that have it count less, or not at all: the field moves by more than noise lets expect, which is the specification test
of :cite:t:`hausman1978`. What it moves by beyond that is an error of the field along that way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import BoolArray, Float32Array, FloatArray
from naibu.imaging.volume_correlation.gauss_newton import CorrelationFit
from naibu.imaging.volume_correlation.residual_noise import ResidualNoise
from naibu.imaging.volume_correlation.results.cell_errors import (
    BIAS_TOLERANCE,
    SHARED,
    averaged,
    deformation_at_middles,
    gradients_of,
    some_voxels,
    strain_square,
)

JITTIER = 3.0  # times the sub-voxel jitter, with which edges count less
# empirical: error of the field, over what it moves by when edges count less: they still count, and the penalties hold the field; and the
# part of what the penalties would then take more that is none: what they take is estimated from a field that has the error, too. Both
# chosen with two chests, and with a body whose waves the penalties flatten
OF_EDGES, OF_PENALTIES = 3.0, 0.6
# empirical: squares of what noise alone moves, as in few independent cells of a window they may be by chance, that are no error
BY_CHANCE = 1.8


@dataclass(frozen=True, slots=True, eq=False)
class WeightContrast:
    """By how much the field would move if voxels had other weights.

    Attributes
    ----------
    moved : ndarray, shape (n, 3), float32
        Change of the coefficients, mm.
    noise : ndarray, shape (n, 3, s), float32
        Such changes by residuals of noise alone, mm.
    voxels : ndarray, shape (voxels,), bool
        Listed voxels whose displacement that concerns.
    factor : float
        Error of the field over what it would move by.
    """

    moved: Float32Array
    noise: Float32Array
    voxels: BoolArray
    factor: float


def weight_contrasts(
    fit: CorrelationFit,
    c: FloatArray,
    penalties: tuple[FloatArray, FloatArray],
    parts: Sequence[BoolArray],
    noise: ResidualNoise,
    seed: int,
    drawn: Float32Array,
    bias: Float32Array,
) -> tuple[WeightContrast, ...]:
    """Return what less weight of the edges, and the voxels of each part alone, would move the field by.

    Parameters
    ----------
    fit : CorrelationFit
        Compared at the coefficients. The matrix of its equations is overwritten.
    c : ndarray, shape (NZ, NY, NX, 3)
        Coefficients, mm.
    penalties : tuple of ndarray, shapes (m, 3) and (m,)
        Weights of the bending and of the dilatation, as `SplineSystem.assembled` takes them.
    parts : sequence of ndarray, shape (voxels,), bool
        Listed voxels of parts that may slide on each other.
    noise : ResidualNoise
        Noise like the residuals.
    seed : int
        Of the random fields.
    drawn : ndarray, shape (n, 3, s)
        What `CorrelationFit.noise_samples` returns for that seed at the present weights, mm.
    bias : ndarray, shape (n, 3)
        What penalising the field once more takes away, mm.
    """
    system, jitter = fit.system, (fit.jitter_voxels * fit.level.spacing.mean() / max(fit.residual_sd, 1e-30)) ** 2

    def changed(share: Float32Array, of_penalties: float) -> tuple[Float32Array, Float32Array]:
        load = system.assembled(c, share[:, None] * fit.products, share[:, None] * fit.force, *penalties)
        loads = fit.noise_loads(drawn.shape[2], noise, seed, share)
        both = [load[:, :, None], taken[:, :, None], loads]
        solved = system.solved_many(np.concatenate(both, axis=2), BIAS_TOLERANCE)[0]
        # the weights of robust residuals make the steps shorter than they should be
        moved = np.float32(noise.scale) * solved[:, :, 0] - np.float32(of_penalties) * (solved[:, :, 1] - bias)
        return moved, solved[:, :, 2:] - drawn

    full = c.copy()
    full[system.active] -= bias
    taken = system.bending_load(full, penalties[0]) + system.dilatation_load(full, penalties[1])
    steep = jitter * (fit.gradient**2).sum(axis=1)
    soft = np.asarray((1.0 + steep) / (1.0 + JITTIER**2 * steep), dtype=np.float32)
    for inclusion in fit.inclusions:
        soft[inclusion.voxels] = 1.0
    everywhere = np.ones(len(soft), dtype=bool)
    out = []
    each = [(soft, everywhere, OF_EDGES, OF_PENALTIES), *((part.astype(np.float32), part, 1.0, 0.0) for part in parts)]
    for share, voxels, factor, of_penalties in each:
        out.append(WeightContrast(*changed(share, of_penalties), voxels, factor))
    return tuple(out)


def contrast_errors(fit: CorrelationFit, c: FloatArray, contrasts: Sequence[WeightContrast]) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (m, 3, 3), mm^2, of the errors that contrasts tell, and the variance (m,) of a component of strain."""
    system, m = fit.system, len(fit.system.cells)
    cells, at = some_voxels(fit)
    points = fit.level.index[at] * fit.level.spacing
    count = fit.windowed(np.bincount(cells, minlength=m).astype(float), SHARED)
    covariance, of_strain, deformation = np.zeros((m, 3, 3)), np.zeros(m), deformation_at_middles(fit, c)
    for contrast in contrasts:
        full = np.zeros((*system.active.shape, 3, 1 + contrast.noise.shape[2]), np.float32)
        full[system.active] = np.concatenate([contrast.moved[:, :, None], contrast.noise], axis=2)
        known = contrast.voxels[at]
        values = np.where(known[:, None, None], system.grid.values(full, points), 0.0)
        sums = np.zeros((m, 11))
        each = values[:, :, 0]
        np.add.at(sums[:, :9], cells, (each[:, :, None] * each[:, None, :]).reshape(-1, 9))
        sums[:, 9] = np.bincount(cells, (values[:, :, 1:] ** 2).sum(axis=1).mean(axis=1), minlength=m)
        sums[:, 10] = np.bincount(cells, known, minlength=m)
        wide = fit.windowed(sums, SHARED) / count[:, None]
        square, by_noise, share = wide[:, [0, 4, 8]].sum(axis=1), wide[:, 9], wide[:, 10]
        beyond = contrast.factor**2 * np.maximum(1.0 - BY_CHANCE * by_noise / np.maximum(square, 1e-30), 0.0)
        covariance += beyond[:, None, None] * wide[:, :9].reshape(-1, 3, 3)
        of_strain += beyond * share * strain_square(deformation, gradients_of(fit, contrast.moved))
    return covariance, averaged(fit, of_strain)
