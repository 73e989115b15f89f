"""What the penalties take from a field, which its covariance and that of the blocks include."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.volume import Volume
from naibu.imaging.measure_displacement import measured_by
from naibu.imaging.preprocessing.resampling import positions
from naibu.imaging.volume_correlation.correlate import Correlation, correlate_volumes
from naibu.imaging.volume_correlation.results.block_displacements import LEFT
from naibu.imaging.volume_correlation.results.cell_errors import (
    BENDING_BIAS,
    DILATATION_BIAS,
    bias_covariance,
    biases,
    variance_of_one_line,
)
from naibu.imaging.volume_correlation.settings import CorrelationSettings
from naibu.validation.scanners.textures import Texture
from naibu.validation.specimens.textured_sphere import squeezed_ball

Array = np.ndarray
STEP = 0.02  # of finite differences of energies in single precision, mm


@pytest.fixture(scope="module")
def correlation() -> Correlation:
    """A ball that is squeezed, with weights of the penalties that do not depend on the data, and its matrix."""
    before, after, _, ball = squeezed_ball(seed=5)
    c = Correlation(before, after, (ball, None), CorrelationSettings(adaptive_weight=False), None)
    c.initialize()
    c.refine()
    c.fit.compare(c.c)
    c.fit.system.assembled(c.c, c.fit.products, c.fit.force, c.bending, c.dilatation * c.fit.system.gauss_volume)
    return c


def energies(correlation: Correlation, coefficients: Array) -> Array:
    """Return the energies (2,) of bending and of dilatation, without data."""
    system, n = correlation.fit.system, len(correlation.fit.residual)
    dilatation = correlation.dilatation * system.gauss_volume
    kept = system.matrix.copy()
    system.assembled(coefficients, np.zeros((n, 6), np.float32), np.zeros((n, 3), np.float32), correlation.bending, dilatation)
    system.matrix[:] = kept
    return np.array([(system.bending_energy * correlation.bending).sum(), (system.dilatation_energy * dilatation).sum()]) / 2.0


def test_the_bias_is_what_penalising_once_more_takes_away(correlation: Correlation) -> None:
    """The matrix times what is taken away is the force of the penalty, the gradient of its energy by finite differences."""
    system = correlation.fit.system
    taken = biases(correlation.fit, correlation.c, correlation.bending, correlation.dilatation)
    for k, factor in enumerate((BENDING_BIAS, DILATATION_BIAS)):
        direction, ends = taken[k] / np.sqrt(np.mean(taken[k] ** 2)), []
        for step in (-STEP, STEP):
            moved = correlation.c.copy()
            moved[system.active] += step * direction
            ends.append(energies(correlation, moved)[k])
        padded = np.concatenate([taken[k], np.zeros((1, 3), np.float32)]).astype(float)
        pulled = np.einsum("niok,nok->ni", system.matrix.reshape(system.n, 3, -1, 3), padded[system.neighbours])
        assert (pulled * direction).sum() == pytest.approx(-factor * (ends[1] - ends[0]) / (2.0 * STEP), rel=0.03)


def test_covariances_of_both_penalties_add_up(correlation: Correlation) -> None:
    fit, sampled = correlation.fit, np.broadcast_to(np.diag([3.0, 2.0, 1.0]), (len(correlation.fit.system.cells), 3, 3))
    bent, dilated = biases(fit, correlation.c, correlation.bending, correlation.dilatation)
    both, *each = (bias_covariance(fit, some, sampled) for some in ((bent, dilated), (bent,), (dilated,)))
    np.testing.assert_allclose(both, each[0] + each[1], rtol=1e-5, atol=1e-9)
    assert (np.linalg.eigvalsh(both) > 0.0).all()
    assert not biases(fit, correlation.c, correlation.bending, 0.0)[1].any()


def test_the_size_of_the_bias_does_not_depend_on_its_direction(correlation: Correlation) -> None:
    """A field that penalising moves along x by 1 mm has the variance 1 mm^2 along an axis, in the mean, most of it along x."""
    fit = correlation.fit
    moved, size = np.zeros((fit.system.n, 3), np.float32), (len(fit.system.cells), 3, 3)
    moved[:, 0] = 1.0
    alike, layered = (bias_covariance(fit, (moved,), np.broadcast_to(np.diag(s), size)) for s in ([1, 1, 1], [1, 4, 1]))
    for covariance in (alike, layered):
        np.testing.assert_allclose(np.trace(covariance, axis1=1, axis2=2), 3.0, rtol=1e-5)
        np.testing.assert_allclose(covariance[:, 0, 1:], 0.0, atol=1e-6)
    assert (alike[:, 0, 0] > 3.0 * alike[:, 1, 1]).all()
    assert (layered[:, 1, 1] > 1.5 * alike[:, 1, 1]).all()


def test_the_covariance_holds_the_bias_and_that_of_blocks_a_part_of_it() -> None:
    before, after, _, ball = squeezed_ball(seed=5)
    found = correlate_volumes(before, after, mask=ball)
    known = np.isfinite(found.cell_bias)
    assert (np.trace(found.cell_covariance[known], axis1=1, axis2=2) >= 3.0 * found.cell_bias[known]).all()
    blocks, stated = found.blocks, measured_by(found, before, ball).blocks
    assert blocks is not None and stated is not None and blocks.covariance is not None and stated.covariance is not None
    kept = np.isin(blocks.points.view("f8,f8,f8").ravel(), stated.points.view("f8,f8,f8").ravel())
    more = stated.covariance - blocks.covariance[kept]
    left = LEFT**2 * found.bias_at(stated.points) + found.misplacement_at(stated.points)
    np.testing.assert_allclose(more, left[:, None, None] * np.eye(3), atol=1e-9)


def test_regions_hold_a_part_that_swells_where_volume_is_not_penalised() -> None:
    """By 15 % in the middle of a part, in a ball that else keeps its volume: the penalty would take most of that away."""
    frame, middle = Volume.from_array(np.zeros((40, 44, 48)), spacing_mm=(1.0, 1.0, 1.0)), np.array([23.5, 21.5, 19.5])
    x, grey, rng = positions(frame), Texture.drawn(3.0, seed=1), np.random.default_rng([1, 1])

    def swollen(at: Array) -> Array:
        arm = at - middle - [5.0, 0.0, 0.0]
        return np.asarray(0.05 * arm * np.exp(-0.5 * (arm**2).sum(axis=-1, keepdims=True) / 5.0**2))

    def seen(at: Array) -> Array:
        inside = (((at - middle) / [18.0, 16.0, 15.0]) ** 2).sum(axis=-1) < 1.0
        values = np.where(inside, 150.0 + 30.0 * grey(at.reshape(-1, 3)).reshape(inside.shape), 10.0)
        return np.asarray(values + rng.normal(0.0, 9.0, inside.shape))

    origin = x.copy()
    for _ in range(60):
        origin = x - swollen(origin)
    near = np.linalg.norm(x - middle - [5.0, 0.0, 0.0], axis=-1) < 9.0
    ball = (((x - middle) / [18.0, 16.0, 15.0]) ** 2).sum(axis=-1) < 1.0
    before, after = (frame.with_values(seen(at)) for at in (x, origin))
    found = correlate_volumes(before, after, mask=ball, settings=CorrelationSettings(dilatation_penalty=False))
    where = np.argwhere(near & ball & found.valid)
    error = (found.displacement.vectors - swollen(x))[tuple(where.T)]
    covariance = found.covariance_at(where[:, ::-1].astype(float))
    held = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]) < 7.815  # chi-squared, 95 %
    assert held.mean() > 0.95
    assert np.linalg.norm(error, axis=1).mean() < 0.09


def test_regions_are_longer_along_layers_than_across_them() -> None:
    """The texture varies six times as slowly along y, along which a wave shears the body: much of it is lost."""
    frame, middle = Volume.from_array(np.zeros((40, 44, 48)), spacing_mm=(1.0, 1.0, 1.0)), np.array([23.5, 21.5, 19.5])
    x, grey, rng = positions(frame), Texture.drawn(3.0, seed=2), np.random.default_rng([2, 1])

    def sheared(at: Array) -> Array:
        arm = 2.0 * np.pi / 30.0 * (at - middle)
        along = 0.6 * np.sin(arm[..., 0] + 0.3) * np.cos(arm[..., 2])
        return np.stack([np.full_like(along, 0.4), along, np.full_like(along, -0.2)], axis=-1)

    def seen(at: Array) -> Array:
        inside = (((at - middle) / [18.0, 16.0, 15.0]) ** 2).sum(axis=-1) < 1.0
        values = np.where(inside, 150.0 + 30.0 * grey((at * [1.0, 1.0 / 6.0, 1.0]).reshape(-1, 3)).reshape(inside.shape), 10.0)
        return np.asarray(values + rng.normal(0.0, 15.0, inside.shape))

    origin = x.copy()
    for _ in range(60):
        origin = x - sheared(origin)
    ball = (((x - middle) / [18.0, 16.0, 15.0]) ** 2).sum(axis=-1) < 1.0
    before, after = (frame.with_values(seen(at)) for at in (x, origin))
    found = correlate_volumes(before, after, mask=ball, settings=CorrelationSettings(dilatation_penalty=False))
    where = np.argwhere(ball & found.valid)
    error = (found.displacement.vectors - sheared(x))[tuple(where.T)]
    covariance = found.covariance_at(where[:, ::-1].astype(float))
    squared, variance = (error**2).mean(axis=0), covariance.diagonal(axis1=1, axis2=2).mean(axis=0)
    assert squared[1] > 2.5**2 * max(squared[0], squared[2])
    assert variance[1] > 1.4**2 * max(variance[0], variance[2])
    held = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]) < 7.815  # chi-squared, 95 %
    assert held.mean() > 0.95


@pytest.mark.parametrize("size", [0.1, 0.5, 1.0, 2.0, 5.0, 100.0])
def test_regions_hold_a_displacement_along_one_line_beside_other_errors(size: float) -> None:
    """Drawn errors of unit variance along every axis, and along one of them a displacement of this size besides."""
    rng = np.random.default_rng(0)
    error = rng.normal(size=(100_000, 3))
    error[:, 1] += size * rng.normal(size=len(error))
    variance = 1.0 + float(variance_of_one_line(np.array([size**2 / 3.0]), np.array([1.0]))[0])
    held = (error**2).sum(axis=1) < 7.815 * variance
    assert 0.94 < held.mean() < 0.96
