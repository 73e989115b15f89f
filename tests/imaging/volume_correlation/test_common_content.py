"""What one scan shows and the other does not is not measured, or with a region that holds the truth; against a closed-form motion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.imaging.volume_correlation.results.correlation_result import CorrelationResult
from naibu.validation.specimens.intruded_body import IntrudedBody, Intruder, bent, intruded_body, unbent
from naibu.validation.specimens.swollen_body import AIR, TISSUE, SwollenSphere

Array = np.ndarray
MIDDLE = (24.0, 29.5, 25.5)
THERE = tuple(bent(np.array(MIDDLE)))
CHI_SQUARED_95 = 7.815  # three degrees of freedom
INTRUDERS = {
    "a bubble comes": (Intruder(6.0, AIR, None, THERE), 5.0),
    "a bubble goes": (Intruder(6.0, AIR, MIDDLE), 5.0),
    "fluid for air": (Intruder(6.0, 190.0, None, THERE), 10.0),
    "other tissue": (Intruder(6.0, None, None, THERE), 10.0),
    "tissue without texture, in much noise": (Intruder(6.0, TISSUE, None, THERE), 20.0),
    "a needle": (Intruder(1.5, 450.0, None, THERE, 10.0), 10.0),
}


def held(body: IntrudedBody, found: CorrelationResult, where: Array) -> float:
    """Return the part of the voxels that were measured there whose true displacement lies in the stated 95 % regions."""
    kept = found.valid & body.mask & where
    error = (found.displacement.vectors - body.displacement)[kept]
    covariance = found.covariance_at(np.argwhere(kept)[:, ::-1].astype(float))
    return float((np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]) < CHI_SQUARED_95).mean())


DAILY = ("a bubble comes", "fluid for air", "other tissue")  # the others are slow studies


@pytest.mark.parametrize("name", [pytest.param(k, marks=[pytest.mark.slow] * (k not in DAILY)) for k in INTRUDERS])
def test_what_has_no_counterpart_is_not_measured(name: str) -> None:
    """All of it was; of what has no texture in much noise 3 % lay in the stated regions."""
    intruder, noise = INTRUDERS[name]
    body = intruded_body([intruder], seed=3, noise=noise)
    found = correlate_volumes(body.before, body.after, mask=body.mask)
    assert found.valid[body.hidden].mean() < 0.4
    assert found.valid[body.mask & ~body.hidden].mean() > 0.9
    assert found.blocks is not None
    at = np.rint(found.blocks.points).astype(int)[:, ::-1]
    assert body.hidden[tuple(at.T)].mean() < 0.2 * body.hidden[body.mask].mean()
    assert held(body, found, ndimage.distance_transform_edt(~body.hidden) < 4.0) > 0.9


def test_where_nothing_comes_or_goes_all_is_measured() -> None:
    body = intruded_body([], seed=3, noise=10.0)
    found = correlate_volumes(body.before, body.after, mask=body.mask)
    assert found.valid[body.mask].all()


def test_tissue_about_a_cavity_that_opens_is_not_taken_for_measured_where_it_is_not() -> None:
    """The tissue is pushed aside radially, by the radius of the cavity at its edge: no smooth field follows it there."""
    cavity, start = Intruder(5.0, AIR, None, THERE), 0.25
    body = intruded_body([cavity], seed=3, parts=[SwollenSphere(MIDDLE, start, (5.0 / start) ** 3)])
    found = correlate_volumes(body.before, body.after, mask=body.mask)
    away = np.linalg.norm(found.volume.positions() - np.array(MIDDLE), axis=-1)
    assert held(body, found, body.mask) > 0.95
    assert held(body, found, away < 10.0) > 0.9


def test_the_motion_of_the_body_hardly_changes_its_volume_and_has_an_inverse() -> None:
    x, step = np.random.default_rng(0).uniform(0.0, 60.0, (200, 3)), 1e-5
    gradient = np.stack([(bent(x + s) - bent(x - s)) / (2.0 * step) for s in step * np.eye(3)], axis=-1)
    assert np.abs(np.linalg.det(gradient) - 1.0).max() < 0.01
    assert np.allclose(unbent(bent(x)), x, atol=1e-9)
