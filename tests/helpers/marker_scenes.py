"""Markers whose positions are known: spheres and discs in volumes, moving echoes with ghosts in speckle, strained clouds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from naibu.core.volume import Volume

Array = np.ndarray


def render_spheres(
    centres: Array,
    *,
    shape: tuple[int, int, int] = (40, 48, 52),
    spacing: tuple[float, float, float] = (0.5, 0.5, 0.5),
    diameter: float = 2.0,
    contrast: float = 400.0,
    background: float = 1000.0,
    noise: float = 20.0,
    seed: int = 0,
    direction: Array | None = None,
    radii: Array | None = None,
) -> Volume:
    """Intensities averaged over 4 x 4 x 4 points of every voxel near a sphere; centres (n, 3) are index times spacing, mm."""
    step, fine = np.array(spacing), (np.arange(4) + 0.5) / 4 - 0.5
    values = np.full(shape, background)
    for n, c in enumerate(centres):
        r = 0.5 * diameter if radii is None else radii[n]
        low = np.maximum(np.floor((c - r) / step).astype(int), 0)
        high = np.minimum(np.ceil((c + r) / step).astype(int) + 1, np.array(shape[::-1]))
        axes = [((np.arange(a, b)[:, None] + fine) * s).ravel() for a, b, s in zip(low, high, step, strict=True)]
        x, y, z = np.meshgrid(*axes, indexing="ij")
        inside = ((x - c[0]) ** 2 + (y - c[1]) ** 2 + (z - c[2]) ** 2 < r**2).astype(float)
        size = high - low
        fraction = inside.reshape(size[0], 4, size[1], 4, size[2], 4).mean(axis=(1, 3, 5))
        box = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
        values[box] += contrast * fraction.T
    values = values + noise * np.random.default_rng(seed).standard_normal(shape)
    return Volume.from_array(values.astype(np.float32), spacing_mm=spacing, origin_mm=(7.0, -3.0, 11.0), direction=direction)


def lattice(n: tuple[int, int, int], pitch: float, jitter: float, seed: int = 0, start: float = 4.0) -> Array:
    """Return jittered lattice points (n, 3), mm."""
    axes = np.meshgrid(*[start + pitch * np.arange(k) for k in n], indexing="ij")
    points = np.stack(axes, axis=-1).reshape(-1, 3)
    return points + np.random.default_rng(seed).uniform(-jitter, jitter, points.shape)


@dataclass(frozen=True)
class Cloud:
    """Two states of particles of which some vanish and some appear, and the deformed index of every reference one (-1: none)."""

    reference: Array
    deformed: Array
    truth: Array
    displacement: Array  # of the particles that are in both, in spacings

    def judged(self, pairs: Array) -> tuple[int, int, int]:
        """Return how many links are right, how many could be, and how many are wrong."""
        got = np.full(len(self.reference), -1)
        got[pairs[:, 0]] = pairs[:, 1]
        return int(((got == self.truth) & (got >= 0)).sum()), int((self.truth >= 0).sum()), int(((got >= 0) & (got != self.truth)).sum())


def particle_cloud(
    n: int,
    seed: int,
    *,
    dimensions: int = 3,
    stretch: float = 0.7,
    degrees: float = 10.0,
    shift: float = 5.0,
    waviness: float = 0.25,
    vanish: float = 0.08,
    appear: float = 0.08,
    noise: float = 0.02,
) -> Cloud:
    """Scatter particles one spacing apart on average, press them flat to `stretch` along the last axis, bend, turn and shift them.

    `waviness` is the gradient of waves as long as the object. Displacements and noise are in spacings.
    """
    rng, d = np.random.default_rng(seed), dimensions
    side = n ** (1.0 / d)
    x = rng.uniform(-0.5 * side, 0.5 * side, (n, d))
    press = np.diag([*([stretch ** (-1.0 / (d - 1))] * (d - 1)), stretch])
    turn = np.eye(d)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1] = c, -s, s, c
    k = rng.standard_normal((3, d))
    k *= 2.0 * np.pi / (side * np.linalg.norm(k, axis=1))[:, None]
    a = rng.standard_normal((3, d))
    a *= waviness / (np.linalg.norm(a, axis=1) * np.linalg.norm(k, axis=1) * np.sqrt(3.0))[:, None]
    away, phase = rng.standard_normal(d), rng.uniform(0.0, 6.28, 3)
    away *= shift / np.linalg.norm(away)

    def moved(p: Array) -> Array:
        return (p @ press + np.sin(p @ k.T + phase) @ a) @ turn.T + away

    y = moved(x)
    stays = rng.uniform(size=n) >= vanish
    new = moved(rng.uniform(-0.5 * side, 0.5 * side, (int(appear * n), d)))
    there = np.flatnonzero(stays)
    everything = np.concatenate([y[there], new])
    order = rng.permutation(len(everything))
    truth = np.full(n, -1)
    truth[there] = np.argsort(order)[: len(there)]
    seen = x + noise * rng.standard_normal(x.shape)
    return Cloud(seen, everything[order] + noise * rng.standard_normal(everything.shape), truth, np.linalg.norm(y - x, axis=1)[stays])


@dataclass(frozen=True)
class Echoes:
    """A sequence (t, ny, nx) with its true positions (t, n, 2), mm, and which echoes are there (t, n)."""

    frames: Array
    truth: Array
    there: Array
    pixel_mm: float


def ultrasound(
    seed: int = 0,
    *,
    frames: int = 150,
    size: tuple[int, int] = (160, 200),
    pixel_mm: float = 0.3,
    markers: int = 5,
    depth_mm: float = 18.0,
    pressed_mm: float = 5.0,
    drop_out: float = 0.06,
    long_gap: int = 12,
    ghost: float = 0.5,
    ghost_mm: float = 10.0,
    echo: float = 8.0,
) -> Echoes:
    """Draw bright echoes in speckle that a weight pushes down quickly at first, with weaker ghosts above.

    The envelope of speckle that is wide across the beam is compressed as on the screen. `echo` is the amplitude of a marker by the mean of
    the speckle. Markers fade and drop out, one for long.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / frames
    ny, nx = size
    x0 = np.linspace(0.2, 0.8, markers) * nx * pixel_mm + rng.uniform(-0.5, 0.5, markers)
    press = pressed_mm * (1.0 - np.exp(-t * 8.0)) * (t > 0.02) + 0.3 * np.sin(9.0 * t)
    middle = 0.5 * nx * pixel_mm
    x = x0 + 0.03 * (x0 - middle) * press[:, None] + 0.4 * np.sin(5.0 * t)[:, None]
    y = depth_mm + rng.uniform(-0.7, 0.7, markers) + press[:, None] * (1.0 - 0.5 * ((x0 - middle) / middle) ** 2)
    truth = np.stack([x, y], axis=2)
    there = rng.uniform(size=(frames, markers)) >= drop_out
    there[frames // 2 : frames // 2 + long_gap, markers // 2] = False
    strength = echo * rng.uniform(0.8, 1.3, markers) * np.exp(0.15 * gaussian_filter(rng.standard_normal((frames, markers)), (3.0, 0.0)))
    base = [rng.standard_normal((ny, nx)) for _ in range(2)]
    out = np.empty((frames, ny, nx), dtype=np.uint8)
    gy, gx = np.arange(ny) * pixel_mm, np.arange(nx) * pixel_mm
    for f in range(frames):
        field = []
        for part in base:  # half of the speckle stays, half changes from frame to frame
            mixed = 0.7 * part + 0.7 * rng.standard_normal((ny, nx))
            blurred = gaussian_filter(mixed, (0.35 / pixel_mm, 0.6 / pixel_mm))
            field.append(blurred / blurred.std())
        envelope = np.hypot(*field) / 1.25
        for k in range(markers):
            if there[f, k]:
                for scale, above in ((1.0, 0.0), (ghost, ghost_mm)):
                    spread = np.exp(-0.5 * ((gy[:, None] - y[f, k] + above) / 0.5) ** 2 - 0.5 * ((gx - x[f, k]) / 0.8) ** 2)
                    envelope = np.hypot(envelope, scale * strength[f, k] * spread)
        out[f] = np.clip(255.0 * np.log1p(2.0 * envelope) / np.log1p(2.0 * 2.0 * echo), 0, 255).astype(np.uint8)
    return Echoes(out, truth, there, pixel_mm)
