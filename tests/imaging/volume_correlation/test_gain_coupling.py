"""Displacement and local gain that are solved for together, beside the whole system of both unknowns."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import texture

from naibu.core.volume import Volume
from naibu.imaging.preprocessing.resampling import positions
from naibu.imaging.volume_correlation.correlate import Correlation
from naibu.imaging.volume_correlation.gauss_newton import CorrelationFit
from naibu.imaging.volume_correlation.image_level import GainMap, gain_curvature, most_probable_gain
from naibu.imaging.volume_correlation.settings import CorrelationSettings
from naibu.imaging.volume_correlation.splines.normal_equations import SplineSystem

Array = np.ndarray


@pytest.fixture(scope="module")
def fit() -> CorrelationFit:
    """Return a comparison of a moved texture whose intensities grow along x, at no displacement."""
    grid = Volume.from_array(np.zeros((24, 26, 28)), spacing_mm=(1.0, 1.1, 0.9))
    grey, x = texture(3, (5.0, 12.0), n=30), positions(grid)
    before = grid.with_values(100.0 + grey(x))
    after = grid.with_values((1.0 + 0.003 * x[..., 0]) * (100.0 + grey(x - 0.2)))
    settings = CorrelationSettings(node_spacing_mm=6.0)
    correlation = Correlation(before, after, (np.ones(before.shape, bool), np.ones(before.shape, bool)), settings, None)
    level = correlation.level((1, 1, 1), 0.5)
    out = CorrelationFit(level, SplineSystem(level, correlation.grid), correlation.comparison(3))
    out.compare(correlation.c)
    return out


def _changes(lattice: GainMap, value: Array, at: Array) -> Array:
    """Return how intensities (n,) change with gain and offset on a lattice that is taken at voxel indices (n, 3)."""
    points, weights = lattice.corners(at)
    lines = np.zeros((len(at), int(np.prod(lattice.n))))
    np.put_along_axis(lines, points, weights, axis=1)
    return (lines[:, :, None] * np.stack([value, np.ones(len(at))], axis=1)[:, None, :]).reshape(len(at), -1)


def dense(fit: CorrelationFit) -> tuple[Array, Array, Array, Array, Array]:
    """Return the matrices A, B and C, and the loads of both unknowns, by sums over voxels; in B a cell has the gain of its middle."""
    system, level = fit.system, fit.level
    lattice, at = GainMap(level, fit.settings.gain_cell_mm), level.index.astype(float) * level.spacing
    tables = [system.grid.table(a, at[:, a]) for a in range(3)]
    (cx, wx), (cy, wy), (cz, wz) = tables
    a = np.arange(64)
    nodes = system.slot[cz[:, None] + (a >> 4), cy[:, None] + ((a >> 2) & 3), cx[:, None] + (a & 3)]
    spline = np.zeros((len(at), system.n))
    np.put_along_axis(spline, nodes, wz[:, a >> 4] * wy[:, (a >> 2) & 3] * wx[:, a & 3], axis=1)
    middles = (system.grid.origin_mm + (np.stack([cx, cy, cz], axis=1) + 0.5) * system.grid.step_mm) / level.spacing
    w, slope = (fit.weight * fit.curvature_share).astype(float), fit.gradient.astype(float)
    moves = (spline[:, :, None] * slope[:, None, :]).reshape(len(at), -1)
    changes, shared = (_changes(lattice, fit.value, where) for where in (level.index.astype(float), middles))
    load = (moves * fit.residual[:, None]).T @ fit.weight.astype(float)
    everywhere = lattice.everywhere(fit.value, fit.robust_weight)
    matrix, right = lattice.normal_equations(fit.value, fit.robust_weight)
    curved = gain_curvature(changes.T @ (changes * (fit.robust_weight * fit.curvature_share)[:, None]), fit.residual_sd**2, everywhere)
    step = most_probable_gain(matrix, right, fit.residual_sd**2, everywhere) - fit.local_gain
    return (
        moves.T @ (moves * w[:, None]),
        moves.T @ (shared * w[:, None]),
        curved,
        load,
        gain_curvature(matrix, fit.residual_sd**2, everywhere) @ step,
    )


def test_the_step_is_that_of_both_unknowns(fit: CorrelationFit) -> None:
    a, b, c, load, gain_load = dense(fit)
    a += 1e-2 * np.trace(a) / len(a) * np.eye(len(a))  # in place of penalties
    both = np.linalg.solve(np.block([[a, b], [b.T, c]]), np.r_[load, gain_load])
    step, gain = both[: len(a)], both[len(a) :]
    coupling = fit.coupling()
    eliminated = a @ step - coupling.lost(step.reshape(-1, 3).astype(np.float32)).ravel()
    wanted = load - coupling.load(coupling.gain_step).ravel()
    assert np.linalg.norm(eliminated - wanted) < 1e-3 * np.linalg.norm(wanted)
    alone = np.linalg.solve(a, load)
    assert np.linalg.norm(alone - step) > 0.1 * np.linalg.norm(step)
    found = coupling.gain_step + coupling.followed(step.astype(np.float32))
    np.testing.assert_allclose(found, gain, atol=1e-3 * np.abs(gain).max())


def test_what_the_gain_takes_leaves_the_matrix_positive(fit: CorrelationFit) -> None:
    a = dense(fit)[0]
    coupling = fit.coupling()
    lost = np.stack([coupling.lost(v.reshape(-1, 3).astype(np.float32)).ravel() for v in np.eye(len(a))], axis=1)
    np.testing.assert_allclose(lost, lost.T, atol=1e-4 * np.abs(lost).max())
    assert np.linalg.eigvalsh(a - lost).min() > -1e-3 * np.linalg.eigvalsh(a).max()
