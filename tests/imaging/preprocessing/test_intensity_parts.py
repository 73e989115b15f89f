"""Parts of an object by their intensity, on bodies whose parts are known."""

from __future__ import annotations

import numpy as np

from naibu.core.volume import Volume
from naibu.imaging.preprocessing.intensity_parts import intensity_parts
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
