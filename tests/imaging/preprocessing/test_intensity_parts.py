"""Parts of an object by their intensity, on bodies whose parts are known."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from naibu.core.volume import Volume
from naibu.imaging.preprocessing.intensity_parts import intensity_parts, structures_of_another
from naibu.imaging.preprocessing.resampling import positions

SHAPE = (40, 44, 48)


def body(dark: float) -> tuple[Volume, np.ndarray, np.ndarray]:
    """Return a noisy ball with a darker ball in it, through which a thin bright vessel goes, and both balls."""
    frame = Volume.from_array(np.zeros(SHAPE), spacing_mm=(1.0, 1.0, 1.2))
    x = positions(frame) - [24.0, 22.0, 24.0]
    ball, inner = (np.linalg.norm(x, axis=-1) < radius for radius in (20.0, 11.0))
    vessel = np.hypot(x[..., 0], x[..., 1]) < 1.0
    values = np.where(ball, np.where(inner & ~vessel, dark, 100.0), 0.0) + np.random.default_rng(3).normal(0.0, 4.0, SHAPE)
    return frame.with_values(values), ball, inner


def test_the_dark_part_includes_the_vessel_that_it_surrounds() -> None:
    volume, ball, inner = body(dark=30.0)
    dark, bright = intensity_parts(volume, ball)
    assert not (dark & bright).any() and ((dark | bright) == ball).all()
    assert (dark & inner).sum() / (dark | inner).sum() > 0.9


def test_a_body_of_one_intensity_has_no_parts_of_noise() -> None:
    volume, ball, _ = body(dark=100.0)
    assert intensity_parts(volume, ball) == ()
    assert intensity_parts(volume.with_values(np.ones(SHAPE)), ball) == ()
    assert intensity_parts(volume, np.zeros(SHAPE, dtype=bool)) == ()


def test_thin_structures_belong_to_the_part_that_they_are_as_bright_as_where_they_leave_it() -> None:
    """As a wedge, but not the middle of a vessel, nor the surface, where the background is blurred in."""
    volume, ball, inner = body(dark=30.0)
    x = positions(volume) - [24.0, 22.0, 24.0]
    wedge = inner & (np.abs(x[..., 1]) < 0.3 * (x[..., 0] - 4.0))
    volume = volume.with_values(np.where(wedge, 100.0, volume.values))
    dark, bright = intensity_parts(volume, ball)
    assert (dark & wedge).sum() > 50
    thin = structures_of_another(volume, dark, bright)
    depth = ndimage.distance_transform_edt(~bright, sampling=volume.spacing_mm[::-1])
    assert not thin[bright].any() and volume.values[thin].mean() > 90.0
    assert thin[dark & wedge & (depth < 5.0)].mean() > 0.6
    assert not thin[depth > 6.0].any()
    surface = bright & ~ndimage.binary_erosion(ball)
    assert structures_of_another(volume, bright, dark)[surface].mean() < 0.01
