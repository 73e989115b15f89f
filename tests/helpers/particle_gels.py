"""Particles in a hydrogel under an indenter, as a microscope finds them: fewer and less exact with depth, some of them false."""

from __future__ import annotations

import numpy as np
from marker_scenes import Array, Cloud

SPACING_PX = 12.0
NOISE_PX = (0.2, 0.2, 0.8)


def depth_dependent_loss(depth: Array, mean: float) -> Array:
    """Probability (n,) that a particle is not found, from the surface (depth 0) to the floor (1), for a mean over all depths.

    It rises linearly, from a tenth of the mean as long as the floor keeps a twentieth of its particles, else from less steep a slope.
    """
    low = max(0.1 * mean, 2.0 * mean - 0.95)
    return np.asarray(low + (2.0 * mean - 2.0 * low) * depth)


def indented(x: Array, size: Array, *, press_px: float, shift_px: Array) -> Array:
    """Positions (n, 3), px, under an indenter at the surface z = size[2]: pressed down, aside around it, and shifted."""
    p = (x - 0.5 * size * (1.0, 1.0, 0.0)) / size[2]
    depth = 1.0 - p[:, 2]
    around = np.hypot(p[:, 0], p[:, 1])
    down = press_px * np.exp(-((around / 0.45) ** 2)) * (1.0 - depth) * np.exp(-depth)
    aside = 0.35 * press_px * np.exp(-(((around - 0.5) / 0.4) ** 2)) * (1.0 - depth)
    away = p[:, :2] / np.maximum(around, 1e-9)[:, None] * (aside * around / (around + 0.1))[:, None]
    return np.asarray(x + np.column_stack([away, -down]) + shift_px)


def particle_gel(
    n: int,
    seed: int,
    *,
    loss: float = 0.1,
    spurious: float = 0.1,
    press_px: float = 36.0,
    shift_px: float = 30.0,
    spacing_px: float = SPACING_PX,
) -> Cloud:
    """Scatter n particles in a block of 2 x 2 x 1, press it, lose particles of the second state with depth, and add spurious ones to both.

    The noise, `NOISE_PX` on average, rises threefold from the surface to the floor. Positions are in px, displacements of the cloud in
    spacings.
    """
    rng = np.random.default_rng(seed)
    edge = spacing_px * (n / 4.0) ** (1.0 / 3.0)
    size = edge * np.array([2.0, 2.0, 1.0])
    direction = rng.standard_normal(3)
    shift = shift_px * direction / np.linalg.norm(direction)
    x = rng.uniform(0.0, size, (n, 3))
    y = indented(x, size, press_px=press_px, shift_px=shift)
    depth = 1.0 - x[:, 2] / size[2]
    there = np.flatnonzero(rng.uniform(size=n) >= depth_dependent_loss(depth, loss))

    def noisy(points: Array, below: Array) -> Array:
        return np.asarray(points + np.array(NOISE_PX) * (0.5 + below)[:, None] * rng.standard_normal(points.shape))

    false = rng.uniform(0.0, size, (int(spurious * n), 3))
    others = indented(rng.uniform(0.0, size, (int(spurious * len(there)), 3)), size, press_px=press_px, shift_px=shift)
    reference = np.concatenate([noisy(x, depth), false])
    deformed = np.concatenate([noisy(y[there], depth[there]), others])
    order, turn = rng.permutation(len(deformed)), rng.permutation(len(reference))
    truth = np.full(len(reference), -1)
    truth[there] = np.argsort(order)[: len(there)]
    return Cloud(reference[turn], deformed[order], truth[turn], np.linalg.norm(y - x, axis=1) / spacing_px)
