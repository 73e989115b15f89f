"""Gain and offset between two volumes with noise, against the gain with which the volumes were made."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.imaging.volume_correlation.image_level import GainMap, ImageLevel
from naibu.imaging.volume_correlation.settings import CorrelationSettings
from naibu.validation.specimens.swollen_body import swollen_body

Array = np.ndarray


def local_gain(noise: float, gain: float, texture: Array) -> Array:
    """Return the gains that are found between a texture and itself, both with noise of SD `noise` in units of the texture's."""
    rng = np.random.default_rng(3)
    after = texture + noise * rng.standard_normal(texture.shape)
    before = gain * (texture + noise * rng.standard_normal(texture.shape)) + 5.0
    mask = np.ones(texture.shape, dtype=bool)
    level = ImageLevel(before.astype(np.float32), after.astype(np.float32), mask, np.ones(3), (1, 1, 1), 0.0)
    value, weight = after[mask].astype(np.float32), np.ones(mask.sum(), np.float32)
    lattice = GainMap(level, 12.0)
    return lattice.values(lattice.local(value, weight, 2.0 * (gain * noise) ** 2))[0]


@pytest.mark.parametrize("noise", [0.05, 0.6, 1.0])
def test_noise_does_not_lower_the_gain(noise: float) -> None:
    """The slope of a regression is lower by 1 + noise^2: .74 and .5 of the true gain."""
    texture = np.random.default_rng(1).standard_normal((24, 26, 28))
    assert np.mean(local_gain(noise, 1.3, texture)) == pytest.approx(1.3, rel=0.03)


def test_where_there_is_no_texture_the_gain_stays_that_of_all_voxels() -> None:
    """One half has a hundredth of the texture, and less noise than the rest of the volumes would let expect."""
    texture = np.random.default_rng(1).standard_normal((24, 26, 40))
    texture[..., 20:] *= 0.01
    assert np.abs(local_gain(0.02, 0.8, texture) - 0.8).max() < 0.2


@pytest.mark.parametrize("seed", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_body_that_does_not_move_does_not_swell_by_noise(seed: int) -> None:
    """A gain that noise has lowered leaves part of the surface's contrast, which pulls outward: the body swelled by .9 %."""
    body = swollen_body((), seed=seed, noise=20.0, shift_mm=(0.0, 0.0, 0.0))
    settings = CorrelationSettings(rigid_inclusions=False, dilatation_penalty=False)
    found = correlate_volumes(body.before, body.after, mask=body.mask, settings=settings)
    dilatation = np.trace(found.gradient(), axis1=-2, axis2=-1)[found.valid & body.mask]
    assert abs(dilatation.mean()) < 0.003
