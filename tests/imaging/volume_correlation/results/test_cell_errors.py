"""What the penalties take from a field, which its covariance and that of the blocks include."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.imaging.measure_displacement import measured_by
from naibu.imaging.volume_correlation.correlate import Correlation, correlate_volumes
from naibu.imaging.volume_correlation.results.block_displacements import LEFT
from naibu.imaging.volume_correlation.results.cell_errors import BENDING_BIAS, DILATATION_BIAS, bias_variance, biases
from naibu.imaging.volume_correlation.settings import CorrelationSettings
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
    system.summed(coefficients, np.zeros((n, 6), np.float32), np.zeros((n, 3), np.float32), correlation.bending, dilatation)
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


def test_variances_of_both_penalties_add_up(correlation: Correlation) -> None:
    bent, dilated = biases(correlation.fit, correlation.c, correlation.bending, correlation.dilatation)
    both = bias_variance(correlation.fit, (bent, dilated))
    np.testing.assert_allclose(both, bias_variance(correlation.fit, (bent,)) + bias_variance(correlation.fit, (dilated,)), rtol=1e-5)
    assert (both > 0.0).all()
    assert not biases(correlation.fit, correlation.c, correlation.bending, 0.0)[1].any()


def test_the_covariance_holds_the_bias_and_that_of_blocks_a_part_of_it() -> None:
    before, after, _, ball = squeezed_ball(seed=5)
    found = correlate_volumes(before, after, mask=ball)
    known = np.isfinite(found.cell_bias)
    assert (np.linalg.eigvalsh(found.cell_covariance[known])[:, 0] >= found.cell_bias[known]).all()
    blocks, stated = found.blocks, measured_by(found, before, ball).blocks
    assert blocks is not None and stated is not None and blocks.covariance is not None and stated.covariance is not None
    kept = np.isin(blocks.points.view("f8,f8,f8").ravel(), stated.points.view("f8,f8,f8").ravel())
    more = stated.covariance - blocks.covariance[kept]
    left = LEFT**2 * found.bias_at(stated.points) + found.misplacement_at(stated.points)
    np.testing.assert_allclose(more, left[:, None, None] * np.eye(3), atol=1e-9)
