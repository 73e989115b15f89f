"""Virtual scans of a textured sphere, rotated, translated and compressed, with the exact displacement at every voxel."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.resampling import positions

SHAPE, SPACING_MM = (24, 40, 44), (1.5, 1.5, 2.0)
MIDDLE_MM, HALF_AXES_MM = np.array([32.0, 29.0, 23.0]), np.array([24.0, 22.0, 19.0])
AIR, TISSUE, TEXTURE, EDGE = 10.0, 150.0, 30.0, 0.04
WAVES, WAVE_MM = 60, (7.0, 16.0)
FIXED_POINT_STEPS = 100


class ScannedBall(NamedTuple):
    """Scans before and after, the true displacement (nz, ny, nx, 3), mm, and the ball before (nz, ny, nx)."""

    before: Volume
    after: Volume
    displacement: FloatArray
    mask: BoolArray


def squeezed_ball(
    *, seed: int, noise: float = 2.0, turn_deg: float = 3.0, shift_mm: tuple[float, float, float] = (1.5, -1.0, 0.5), bump_mm: float = 1.5
) -> ScannedBall:
    """Return the pair of scans.

    Parameters
    ----------
    seed : int
        Of texture and noise.
    noise : float
        Standard deviation of the intensities, whose texture has one of 30.
    turn_deg, shift_mm : float and three float
        The rigid part of the motion: a turn about z through the middle of the ball, and a shift.
    bump_mm : float
        Height of a smooth push along y, 20 mm wide.
    """
    frame = Volume.from_array(np.zeros(SHAPE), spacing_mm=SPACING_MM)
    x = positions(frame)
    a = np.radians(turn_deg)
    turn = np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])

    def moved(p: FloatArray) -> FloatArray:
        y = p - MIDDLE_MM
        bump = np.exp(-(y**2).sum(axis=-1, keepdims=True) / 200.0) * [0.0, bump_mm, 0.0]
        return np.asarray(y @ (turn - np.eye(3)).T + np.asarray(shift_mm) + bump)

    back = x.copy()
    for _ in range(FIXED_POINT_STEPS):
        back += 0.7 * (x - back - moved(back))
    rng = np.random.default_rng(seed)
    grey = _waves(rng)

    def seen(p: FloatArray) -> FloatArray:
        inside = 1.0 / (1.0 + np.exp((_out(p) - 1.0) / EDGE))
        return np.asarray(AIR + inside * (TISSUE + grey(p)) + rng.normal(0.0, noise, p.shape[:-1]))

    return ScannedBall(frame.with_values(seen(x)), frame.with_values(seen(back)), moved(x), _out(x) < 1.0)


def _out(p: FloatArray) -> FloatArray:
    """1 on the surface, less inside."""
    return np.asarray((((p - MIDDLE_MM) / HALF_AXES_MM) ** 2).sum(axis=-1))


def _waves(rng: np.random.Generator) -> Callable[[FloatArray], FloatArray]:
    """Intensities of waves of random directions and lengths, with standard deviation `TEXTURE`."""
    direction = rng.standard_normal((WAVES, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    k, phase = direction * (2.0 * np.pi / rng.uniform(*WAVE_MM, WAVES))[:, None], rng.uniform(0.0, 2.0 * np.pi, WAVES)

    def grey(p: FloatArray) -> FloatArray:
        total = np.zeros(p.shape[:-1])
        for wave, start in zip(k, phase, strict=True):
            total += np.cos(p @ wave + start)
        return np.asarray(TEXTURE * np.sqrt(2.0 / WAVES) * total)

    return grey
