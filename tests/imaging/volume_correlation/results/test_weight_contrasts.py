"""Errors that edges or parts share: what other weights of their voxels would move the field by, against exact motions."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.volume import Volume
from naibu.imaging.preprocessing.resampling import positions
from naibu.imaging.volume_correlation import correlate
from naibu.imaging.volume_correlation.correlate import Correlation, correlate_volumes
from naibu.imaging.volume_correlation.results.correlation_result import CorrelationResult
from naibu.imaging.volume_correlation.results.weight_contrasts import WeightContrast, contrast_errors, weight_contrasts
from naibu.imaging.volume_correlation.settings import CorrelationSettings
from naibu.validation.scanners.textures import Texture
from naibu.validation.specimens.textured_sphere import squeezed_ball

Array = np.ndarray
CHI_SQUARED_95 = 7.815  # three degrees of freedom
MIDDLE_MM, HALF_AXES_MM = np.array([24.5, 21.5, 19.5]), np.array([19.0, 17.0, 15.0])
SLIDE_MM, BESIDE_MM = 0.8, 3.0  # less than a voxel of 1 mm; from the surface along which parts slide


@pytest.fixture(scope="module")
def correlation() -> Correlation:
    """A ball that is squeezed, with weights of the penalties that do not depend on the data."""
    before, after, _, ball = squeezed_ball(seed=5)
    c = Correlation(before, after, (ball, None), CorrelationSettings(adaptive_weight=False), None)
    c.initialize()
    c.refine()
    return c


def at_voxels(correlation: Correlation, coefficients: Array) -> Array:
    """Return the field (n, 3), mm, of coefficients (n, 3) at the listed voxels."""
    fit = correlation.fit
    full = np.zeros((*fit.system.active.shape, 3))
    full[fit.system.active] = coefficients
    return np.asarray(fit.system.grid.values(full, fit.level.index * fit.level.spacing))


def test_residuals_of_a_translation_move_the_field_by_it_whatever_voxels_weigh(correlation: Correlation) -> None:
    """Penalties act on no translation, and voxels then agree: nothing is an error that some of them share."""
    fit, system = correlation.fit, correlation.fit.system
    still, shift = np.zeros_like(correlation.c), np.array([0.3, -0.2, 0.1])
    fit.compare(still)
    fit.residual[:] = fit.gradient @ shift
    fit.force[:] = (fit.weight * fit.residual)[:, None] * fit.gradient
    penalties = correlation.bending, correlation.dilatation * system.gauss_volume
    noise, upper = correlation.noise(), fit.level.index[:, 2] > np.median(fit.level.index[:, 2])
    drawn = np.zeros((system.n, 3, 2), np.float32)
    moved = weight_contrasts(fit, still, penalties, (upper, ~upper), noise, 1, drawn, np.zeros((system.n, 3), np.float32))
    assert [contrast.voxels.mean() for contrast in moved] == pytest.approx([1.0, upper.mean(), 1.0 - upper.mean()])
    for contrast in moved:
        off = at_voxels(correlation, contrast.moved / noise.scale)[contrast.voxels] - shift
        assert np.sqrt((off**2).mean()) < 0.02


def test_what_noise_may_do_is_no_error_and_the_rest_lies_along_the_contrast(correlation: Correlation) -> None:
    fit, n = correlation.fit, correlation.fit.system.n
    along_x, everywhere = np.zeros((n, 3), np.float32), np.ones(len(fit.residual), dtype=bool)
    along_x[:, 0] = 0.5
    silent, loud = np.zeros((n, 3, 2), np.float32), np.repeat(along_x[:, :, None], 2, axis=2)
    covariance, strain = contrast_errors(fit, correlation.c, (WeightContrast(along_x, silent, everywhere, 2.0),))
    np.testing.assert_allclose(covariance, np.broadcast_to(np.diag([1.0, 0.0, 0.0]), covariance.shape), atol=1e-5)
    np.testing.assert_allclose(strain, 0.0, atol=1e-9)  # a translation strains nothing
    covariance, _ = contrast_errors(fit, correlation.c, (WeightContrast(along_x, loud, everywhere, 2.0),))
    assert not covariance.any()


def slid(slide_mm: float) -> tuple[Volume, Volume, Array, Array, Array]:
    """Return scans of a textured ball of which the brighter upper half slides along x, the displacement, the ball and what is beside."""
    frame = Volume.from_array(np.zeros((40, 44, 50)), spacing_mm=(1.0, 1.0, 1.0))
    x, grey, rng = positions(frame), Texture.drawn(2.5, seed=11), np.random.default_rng(12)
    ball = (((x - MIDDLE_MM) / HALF_AXES_MM) ** 2).sum(axis=-1) < 1.0
    truth = np.where(x[..., 2:] > MIDDLE_MM[2], [slide_mm, 0.0, 0.0], 0.0)

    def seen(at: Array) -> Array:
        inside = (((at - MIDDLE_MM) / HALF_AXES_MM) ** 2).sum(axis=-1) < 1.0
        bright = np.where(at[..., 2] > MIDDLE_MM[2], 300.0, 150.0)
        values = np.where(inside, bright + 30.0 * grey(at.reshape(-1, 3)).reshape(inside.shape), 10.0)
        return np.asarray(values + rng.normal(0.0, 4.0, values.shape))

    near = ball & (np.abs(x[..., 2] - MIDDLE_MM[2]) < BESIDE_MM)
    return frame.with_values(seen(x)), frame.with_values(seen(x - truth)), truth, ball, near


def held(found: CorrelationResult, truth: Array, where: Array) -> float:
    """Return which part of the voxels where something is true the stated 95 % regions hold."""
    here = where & found.valid
    error, covariance = (found.displacement.vectors - truth)[here], found.covariance()[here].astype(float)
    return float((np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]) < CHI_SQUARED_95).mean())


def widths(found: CorrelationResult, where: Array) -> float:
    return float(np.sqrt(np.nanmedian(np.trace(found.covariance()[where & found.valid], axis1=1, axis2=2))))


def test_regions_hold_a_slide_of_less_than_a_voxel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where what parts share was not stated, they held less; and they are hardly wider for it."""
    before, after, truth, ball, near = slid(SLIDE_MM)
    found = correlate_volumes(before, after, mask=ball)
    monkeypatch.setattr(correlate, "weight_contrasts", lambda *_, **__: ())
    without = correlate_volumes(before, after, mask=ball)
    assert held(without, truth, near) < 0.9 < 0.94 < held(found, truth, near)
    assert widths(found, near) < 1.2 * widths(without, near)
    np.testing.assert_array_equal(found.coefficients, without.coefficients)


def test_parts_that_move_as_one_are_hardly_less_certain(monkeypatch: pytest.MonkeyPatch) -> None:
    before, after, _, ball, near = slid(0.0)
    found = correlate_volumes(before, after, mask=ball)
    monkeypatch.setattr(correlate, "weight_contrasts", lambda *_, **__: ())
    without = correlate_volumes(before, after, mask=ball)
    for where in (ball, near):
        assert widths(found, where) < 1.1 * widths(without, where)
