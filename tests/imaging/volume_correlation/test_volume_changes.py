"""Parts that change their volume, in a body that else keeps it: measured, or held by the stated regions, against a closed-form motion."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.imaging.volume_correlation.results.correlation_result import CorrelationResult
from naibu.validation.specimens.swollen_body import MIDDLE_MM, SwollenBody, SwollenSphere, swollen_body

Array = np.ndarray
CHI_SQUARED_95 = 7.815  # three degrees of freedom
LARGE, SMALL = ((24.0, 29.5, 25.5), 12.0), ((50.0, 29.5, 25.5), 6.0)
MUCH_NOISE, SEED = 20.0, 1


@cache
def measured(*parts: SwollenSphere, noise: float) -> tuple[SwollenBody, CorrelationResult]:
    body = swollen_body(parts, seed=SEED, noise=noise)
    return body, correlate_volumes(body.before, body.after, mask=body.mask)


def near(body: SwollenBody, part: SwollenSphere, radii: float) -> Array:
    """Return which voxels (nz, ny, nx) lie within so many radii of the middle of a part."""
    at = np.argwhere(np.ones(body.mask.shape, dtype=bool))[:, ::-1].reshape(*body.mask.shape, 3)
    return np.asarray(np.linalg.norm(at - np.array(part.middle_mm), axis=-1) < radii * part.radius_mm)


def held(body: SwollenBody, found: CorrelationResult, where: Array) -> float:
    """Return the part of the voxels whose true displacement lies in the stated 95 % regions."""
    at = np.argwhere(where & found.valid & body.mask)
    error = (found.displacement.vectors - body.displacement)[tuple(at.T)]
    covariance = found.covariance_at(at[:, ::-1].astype(float))
    return float((np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]) < CHI_SQUARED_95).mean())


def mean_ratio(body: SwollenBody, found: CorrelationResult, where: Array) -> float:
    """Return the mean ratio of volumes that was found there."""
    return float(np.linalg.det(np.eye(3) + found.gradient()[where & found.valid & body.mask]).mean())


@pytest.mark.parametrize("ratio", [1.15, 0.85])
def test_a_part_that_swells_or_shrinks_is_seen_to(ratio: float) -> None:
    """With one weight for the whole body its volume changed by 1 %, and the regions held less than 1 % of the part."""
    part = SwollenSphere(*LARGE, ratio)
    body, found = measured(part, SwollenSphere(*SMALL, ratio), noise=MUCH_NOISE)
    core = near(body, part, 0.6)
    assert (mean_ratio(body, found, core) - 1.0) / (ratio - 1.0) == pytest.approx(1.0, abs=0.4)
    assert held(body, found, near(body, part, 1.5)) > 0.8
    assert held(body, found, body.mask) > 0.85
    own = found.dilatation < 0.1 * np.nanmax(found.dilatation)
    assert 0 < own.sum() < 0.5 * np.isfinite(found.dilatation).sum()


def test_where_volume_is_kept_all_cells_have_one_weight() -> None:
    """The body moves rigidly; random fields that were solved to a relative 0.06 held 27 % of it where there was much noise."""
    for noise in (5.0, MUCH_NOISE):
        body, found = measured(noise=noise)
        known = found.dilatation[np.isfinite(found.dilatation)]
        assert np.ptp(known) == 0.0
        volume = np.linalg.det(np.eye(3) + found.gradient()[found.valid & body.mask])
        assert np.sqrt(np.mean((volume - 1.0) ** 2)) < 0.01
        assert held(body, found, body.mask) > 0.9


@pytest.mark.parametrize("ratio", [1.2, 0.8])
def test_a_body_that_swells_or_shrinks_as_a_whole_is_seen_to(ratio: float) -> None:
    body, found = measured(SwollenSphere(tuple(MIDDLE_MM), 100.0, ratio), noise=MUCH_NOISE)
    assert mean_ratio(body, found, body.mask) == pytest.approx(ratio, abs=0.02)
    assert held(body, found, body.mask) > 0.95


def test_the_inner_half_of_a_body_expands_as_a_lung_does() -> None:
    part = SwollenSphere(tuple(MIDDLE_MM), 19.0, 1.25)
    body, found = measured(part, noise=MUCH_NOISE)
    assert mean_ratio(body, found, near(body, part, 0.6)) == pytest.approx(1.25, abs=0.07)
    assert held(body, found, body.mask) > 0.9


def test_the_motion_has_the_stated_volumes_and_an_inverse() -> None:
    """By central differences of the closed form; `origin` undoes `moved`."""
    part, step = SwollenSphere((0.0, 0.0, 0.0), 5.0, 1.3), 1e-5
    x = np.random.default_rng(0).uniform(-12.0, 12.0, (200, 3))
    steps = step * np.eye(3)
    gradient = np.stack([(part.moved(x + s) - part.moved(x - s)) / (2.0 * step) for s in steps], axis=-1)
    assert np.allclose(np.linalg.det(gradient), np.where(np.linalg.norm(x, axis=1) < 5.0, 1.3, 1.0), atol=1e-6)
    assert np.allclose(part.origin(part.moved(x)), x, atol=1e-9)
