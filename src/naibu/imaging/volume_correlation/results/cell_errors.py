"""Variances of the errors of volume correlation by cells of its grid: noise, bias by penalties, structures at the wrong place, strain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from naibu.imaging.volume_correlation.gauss_newton import CorrelationFit
from naibu.imaging.volume_correlation.splines.spline_grid import SplineGrid, separable

VOXELS_PER_CELL = 6  # at which the random fields are evaluated: splines vary little within a cell
SHARED = 0.7  # empirical, cells: SD of the window in which cells share their samples
REMAINING = 5.0  # empirical: last steps that a cell which has not converged may still be away from the solution
# empirical: standard deviation of the bias by the penalties of bending and of dilatation along an axis, root mean square over three, in
# lengths of the change that penalising the field once more makes. That by dilatation shows in legs, most beside bones, that by bending in
# chests
BENDING_BIAS, DILATATION_BIAS, BIAS_TOLERANCE = 1.75, 2.05, 0.03
# empirical: parts of the variance of the bias along the change that penalising once more makes, and as the samples lie. Both say in which
# direction a penalty prevails, as along the skin in fat without texture; along every axis alike, regions were too narrow there
ALONG, OPEN = 0.5, 0.4
# variance along every axis, in thirds of the square of a displacement along one line of unknown direction, whose 95 % region holds 95 % of
# such: from quantiles of chi-squared of one and three degrees of freedom. A third itself would hold 89 %
ONE_LINE = 3.0 * 3.841 / 7.815
# empirical: mean square of the residuals of a cell, in variances of the noise, beyond which structures lie at the wrong place there. Edges
# in legs reach 8 in one cell of a hundred; lungs that slide by 5 to 17 mm along the chest wall 8 to 100 in one cell of twenty
MISPLACED = 8.0


def sampled_covariance(fit: CorrelationFit, samples: Float32Array) -> FloatArray:
    """Return the mean covariance (m, 3, 3), mm^2 along the axes of the volume, of the voxels of every cell.

    Parameters
    ----------
    fit : Correlation
        The fit.
    samples : ndarray, shape (n, 3, s)
        Random coefficients about those of the fit, mm.
    """
    system = fit.system
    cells, at = some_voxels(fit)
    full = np.zeros((*system.active.shape, *samples.shape[1:]), np.float32)
    full[system.active] = samples
    moves = system.grid.values(full, fit.level.index[at] * fit.level.spacing)
    each = np.einsum("nis,njs->nij", moves, moves) / samples.shape[2]
    total, count = np.zeros((len(system.cells), 3, 3)), np.bincount(cells, minlength=len(system.cells))
    np.add.at(total, cells, each)
    dense = np.zeros((*(int(n) for n in system.grid.cells[::-1]), 10))
    z, y, x = system.cells[:, 2:].T
    # a cell counts as much as it holds of the object: what little a rim cell holds is near its neighbours
    dense[z, y, x, 0] = np.maximum(count, 1e-6)
    dense[z, y, x, 1:] = total.reshape(-1, 9)
    wide = ndimage.gaussian_filter(dense, (SHARED, SHARED, SHARED, 0), mode="constant", truncate=3.0)[z, y, x]
    return np.asarray((wide[:, 1:] / wide[:, :1]).reshape(-1, 3, 3))


def biases(fit: CorrelationFit, c: FloatArray, bending: FloatArray, dilatation: FloatArray) -> tuple[Float32Array, ...]:
    """Return coefficients (n, 3), mm, as large as the standard deviation along every axis of the bias, for either penalty.

    They are what penalising a field once more takes away: see the notes of `collected`.
    """
    system = fit.system
    loads = system.bending_load(c, bending), system.dilatation_load(c, dilatation * system.gauss_volume)
    factors = BENDING_BIAS, DILATATION_BIAS
    return tuple(np.float32(factor) * system.solved(load, BIAS_TOLERANCE)[0] for factor, load in zip(factors, loads, strict=True))


def bias_covariance(fit: CorrelationFit, bias: Sequence[Float32Array], sampled: FloatArray) -> FloatArray:
    """Return the covariance (m, 3, 3), mm^2 along the axes of the volume, of the bias by the penalties, whose sizes `biases` returns.

    `sampled` (m, 3, 3) is that of the samples. They vary most in the directions that the intensities leave open, such as along layers, and
    there a penalty prevails, too. One part of the variance lies as they do, one along what penalising once more takes away, and the rest
    along every axis alike.

    It is taken at voxels: the middle of a cell at the surface may lie far outside of the object, where splines extrapolate.
    """
    system = fit.system
    cells, at = some_voxels(fit)
    full, m = np.zeros((*system.active.shape, 3)), len(system.cells)
    total = np.zeros((m, 3, 3))
    for coefficients in bias:
        full[system.active] = coefficients
        moved = system.grid.values(full, fit.level.index[at] * fit.level.spacing)
        np.add.at(total, cells, moved[:, :, None] * moved[:, None, :])
    count = fit.windowed(np.bincount(cells, minlength=m).astype(float), SHARED)
    along = fit.windowed(total, SHARED) / count[:, None, None]
    size, open_ = (np.trace(v, axis1=1, axis2=2)[:, None, None] for v in (along, sampled))
    rest = OPEN * sampled / np.maximum(open_, 1e-30) + (1.0 - ALONG - OPEN) / 3.0 * np.eye(3)
    # `biases` are as large as the deviation along every axis
    return np.asarray(3.0 * (ALONG * along + size * rest))


def variance_of_one_line(variance: FloatArray, others: FloatArray) -> FloatArray:
    """Return the variance (m,) along every axis that displacements along one line need, of `variance` (m,) along every axis in the mean.

    Beside other errors, of variance `others` (m,), regions have to be wider the more of the sum lies along one line: from the mean itself,
    beside much else, to `ONE_LINE` times that, where there is nothing else. In between, a straight line in the share of the sum holds 95 %
    to within 1 %.
    """
    share = variance / np.maximum(variance + others, 1e-30)
    return np.asarray(variance * (1.0 + (ONE_LINE - 1.0) * share))


def misplacement_variance(fit: CorrelationFit, misfit: FloatArray, unlike: BoolArray | None = None) -> FloatArray:
    """Return the variance (m,), mm^2 along every axis, of displacements that would leave the residuals beyond `MISPLACED` in a cell.

    A displacement by e leaves residuals g.e in a gradient g. Cells next to such a cell share its splines, and their errors. In cells (m,)
    that are `unlike` in both volumes all that is beyond the noise counts.
    """
    residuals, gradients, count = misfit.T
    least = MISPLACED if unlike is None else np.where(unlike, 1.0, MISPLACED)
    excess = residuals - least * fit.residual_sd**2 * count
    of_cell = per_cell(fit.system.grid, fit, np.maximum(excess, 0.0) / np.maximum(gradients, 1e-30))
    return np.asarray(ndimage.maximum_filter(np.nan_to_num(of_cell), 3)[tuple(fit.system.cells[:, 2:].T)])


def strain_variance(fit: CorrelationFit, c: FloatArray, samples: Float32Array, bias: Sequence[Float32Array]) -> FloatArray:
    """Return the mean square error (m,) of a component of the Green-Lagrange strain in the middles of the cells.

    Both parts are as those of the displacement: the samples, and the `biases`, whose direction is unknown, three times.
    """
    zero, deformation = np.zeros(len(fit.system.cells)), deformation_at_middles(fit, c)
    drawn = sum((strain_square(deformation, gradients_of(fit, samples[..., s])) for s in range(samples.shape[2])), start=zero)
    biased = sum((strain_square(deformation, gradients_of(fit, coefficients)) for coefficients in bias), start=zero)
    return averaged(fit, drawn / samples.shape[2] + 3.0 * biased)


def deformation_at_middles(fit: CorrelationFit, c: FloatArray) -> FloatArray:
    """Return the deformation gradients (m, 3, 3) of splines c (NZ, NY, NX, 3) in the middles of the cells, along the axes of the volume."""
    return np.asarray(np.eye(3) + _gradients_at_middles(fit, c))


def gradients_of(fit: CorrelationFit, change: Float32Array) -> FloatArray:
    """Return du_i/dx_j (m, 3, 3) of a change of coefficients (n, 3), mm, in the middles of the cells."""
    full = np.zeros((*fit.system.active.shape, 3))
    full[fit.system.active] = change
    return _gradients_at_middles(fit, full)


def strain_square(deformation: FloatArray, gradients: FloatArray) -> FloatArray:
    """Return the mean square (m,) of a component of the Green-Lagrange strain of a change with gradients (m, 3, 3)."""
    strained = np.swapaxes(deformation, -1, -2) @ gradients
    return np.asarray(((0.5 * (strained + np.swapaxes(strained, -1, -2))) ** 2).mean(axis=(-2, -1)))


def dilatation_square(deformation: FloatArray, gradients: FloatArray) -> FloatArray:
    """Return the square (m,) of what a change with gradients (m, 3, 3) adds to the ratio of volumes, to first order."""
    return np.asarray((np.linalg.det(deformation) * np.trace(np.linalg.solve(deformation, gradients), axis1=1, axis2=2)) ** 2)


def _gradients_at_middles(fit: CorrelationFit, c: FloatArray) -> FloatArray:
    """Return du_i/dx_j (m, 3, 3) of splines c (NZ, NY, NX, 3) in the middles of the cells, along the axes of the volume."""
    grid = fit.system.grid
    middles = [grid.origin_mm[a] + (np.arange(grid.cells[a]) + 0.5) * grid.step_mm[a] for a in range(3)]
    plain = [grid.matrix(a, middles[a]) for a in range(3)]
    at = tuple(fit.system.cells[:, 2:].T)
    out = np.empty((len(fit.system.cells), 3, 3))
    for j in range(3):
        out[..., j] = separable([grid.matrix(a, middles[a], 1) if a == j else plain[a] for a in range(3)], c)[at]
    return out


def averaged(fit: CorrelationFit, values: FloatArray) -> FloatArray:
    """Return values (m,) of the cells averaged with those of their neighbours."""
    return np.asarray(fit.windowed(values, SHARED) / fit.windowed(np.ones_like(values), SHARED))


def some_voxels(fit: CorrelationFit) -> tuple[IntArray, IntArray]:
    """Return cells and listed voxels of the object, a few of them spread over every cell."""
    every = fit.cell_of_voxel
    here = np.flatnonzero(fit.within | ~np.bincount(every, fit.within, minlength=len(fit.system.cells)).astype(bool)[every])
    of = every[here]
    count = np.bincount(of, minlength=len(fit.system.cells))
    order = np.argsort(of, kind="stable")
    first = np.cumsum(count) - count
    rank = np.arange(len(of)) - first[of[order]]
    # voxels in the middles of so many equal stretches of the cell's list
    n = np.minimum(count, VOXELS_PER_CELL)[of[order]]
    size = count[of[order]]
    chosen = (rank * n) // size != ((rank - 1) * n) // size
    return of[order][chosen], here[order[chosen]]


def per_cell(grid: SplineGrid, fit: CorrelationFit, values: FloatArray) -> FloatArray:
    """Return values (m, ...) of the cells on their grid (CZ, CY, CX, ...); NaN where there is no object."""
    out = np.full((*(int(n) for n in grid.cells[::-1]), *values.shape[1:]), np.nan)
    out[tuple(fit.system.cells[:, 2:].T)] = values
    return out
