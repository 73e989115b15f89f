"""Volumes whose motion is known exactly: sums of sinusoids are evaluated where the material came from, so that nothing is interpolated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from naibu.core.volume import Volume
from naibu.imaging.preprocessing.resampling import positions

Array = np.ndarray


def grid(
    shape: tuple[int, int, int] = (24, 40, 48), spacing: tuple[float, float, float] = (1.0, 1.0, 1.0), direction: Array | None = None
) -> Volume:
    return Volume.from_array(np.zeros(shape), spacing_mm=spacing, origin_mm=(3.0, -2.0, 5.0), direction=direction)


def texture(seed: int = 0, wave_mm: tuple[float, float] = (6.0, 20.0), n: int = 60) -> Callable[[Array], Array]:
    """Return intensities at positions (..., 3): waves of random directions, about 100 with standard deviation 30."""
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((n, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    k = direction * (2 * np.pi / rng.uniform(*wave_mm, n))[:, None]
    phase = rng.uniform(0, 2 * np.pi, n)

    def grey(x: Array) -> Array:
        total = np.zeros(x.shape[:-1])
        for wave, shift in zip(k, phase, strict=True):
            total += np.cos(x @ wave + shift)
        return 100.0 + 30.0 * np.sqrt(2.0 / n) * total

    return grey


def pair(
    frame: Volume, displacement: Callable[[Array], Array], seed: int = 0, wave_mm: tuple[float, float] = (6.0, 20.0), noise: float = 0.0
) -> tuple[Volume, Volume, Array]:
    """Return reference, deformed, and the true displacement (nz, ny, nx, 3), mm, of a displacement given at reference positions."""
    grey, x = texture(seed, wave_mm), positions(frame)
    back = x.copy()
    for _ in range(200):
        back = back + 0.7 * (x - back - displacement(back))
    rng = np.random.default_rng(seed + 1)
    before, after = (v + noise * rng.standard_normal(v.shape) for v in (grey(x), grey(back)))
    return frame.with_values(before), frame.with_values(after), displacement(x)


def inner(shape: tuple[int, ...], margin: int = 6) -> tuple[slice, ...]:
    """Return the voxels further than a margin from all faces; a single slice stays."""
    return tuple(slice(margin, n - margin) if n > 2 * margin else slice(None) for n in shape)
