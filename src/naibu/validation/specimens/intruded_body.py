"""Virtual scans of a textured ellipsoid that bends, with things in one scan that are not in the other: bubbles, needles, other tissue.

The body is that of `naibu.validation.specimens.swollen_body`. All of it moves by a smooth field of some millimetres that hardly changes its
volume; what is put into a scan hides what is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.resampling import positions
from naibu.validation.scanners.textures import Texture
from naibu.validation.specimens.swollen_body import (
    AIR,
    EDGE,
    HALF_AXES_MM,
    MIDDLE_MM,
    SHAPE,
    TEXTURE,
    TEXTURE_MM,
    TISSUE,
    SwollenSphere,
)

BLUR_MM = 0.35  # of the surface of what is put into a scan
SHIFT_MM, BEND_MM, PER_MM = np.array([0.6, -0.3, 0.4]), np.array([1.2, 0.8, 1.0]), np.array([0.05, 0.04, 0.043])
STRETCH = 0.5 / 30.0  # along x, and its reverse along y
ROUNDS = 40  # of the fixed-point iteration, each of which leaves a tenth at most
ROD = np.array([1.0, 0.3, 0.2]) / np.linalg.norm([1.0, 0.3, 0.2])


class Intruder(NamedTuple):
    """A sphere, or a rod, that one scan shows, or each of them elsewhere.

    Attributes
    ----------
    radius_mm : float
        Its radius.
    grey : float or None
        Its intensity; None for a texture of its own, like that of the tissue.
    before, after : sequence of float, shape (3,), or None
        Its middle in either scan, mm; None where the scan does not show it.
    half_length_mm : float
        Of a rod, along `ROD`; 0 for a sphere.
    """

    radius_mm: float
    grey: float | None
    before: Sequence[float] | None = None
    after: Sequence[float] | None = None
    half_length_mm: float = 0.0

    def share(self, x: FloatArray, middle_mm: Sequence[float] | None) -> FloatArray:
        """Return how much of positions x (..., 3), mm, it fills, from 0 to 1."""
        if middle_mm is None:
            return np.zeros(x.shape[:-1])
        arm = x - np.asarray(middle_mm)
        along = np.clip(arm @ ROD, -self.half_length_mm, self.half_length_mm)
        r = np.linalg.norm(arm - along[..., None] * ROD, axis=-1)
        return np.asarray(1.0 / (1.0 + np.exp(np.minimum((r - self.radius_mm) / BLUR_MM, 80.0))))


class IntrudedBody(NamedTuple):
    """Scans, the true displacement (nz, ny, nx, 3), mm, the body, and voxels (nz, ny, nx) of the body that a scan does not show."""

    before: Volume
    after: Volume
    displacement: FloatArray
    mask: BoolArray
    hidden: BoolArray


def bent(x: FloatArray) -> FloatArray:
    """Return where points (..., 3), mm, are after the smooth motion of the body."""
    arm = x - MIDDLE_MM
    wave = BEND_MM * np.sin(PER_MM * arm[..., [1, 2, 0]])
    return np.asarray(x + SHIFT_MM + wave + STRETCH * arm * [1.0, -1.0, 0.0])


def unbent(y: FloatArray) -> FloatArray:
    """Return where points (..., 3), mm, were before the smooth motion."""
    x = y
    for _ in range(ROUNDS):
        x = x + y - bent(x)
    return x


def intruded_body(
    intruders: Sequence[Intruder],
    *,
    seed: int,
    noise: float = 5.0,
    texture: float = TEXTURE,
    parts: Sequence[SwollenSphere] = (),
) -> IntrudedBody:
    """Return the pair of scans, of voxels of 1 mm.

    Parameters
    ----------
    intruders : sequence of Intruder
        What is put into the scans.
    seed : int
        Of textures and noise.
    noise : float
        Standard deviation of the intensities of both scans.
    texture : float
        That of the tissue.
    parts : sequence of SwollenSphere
        What swells before the body bends. One of hardly any radius opens as a cavity does, if an intruder fills it.
    """
    frame = Volume.from_array(np.zeros(SHAPE), spacing_mm=(1.0, 1.0, 1.0))
    x, rng = positions(frame), np.random.default_rng([seed, 6])
    grey, other = (Texture.drawn(TEXTURE_MM, seed=s) for s in (seed, seed + 10_000))

    def tissue(p: FloatArray, carried: Texture) -> FloatArray:
        inside = 1.0 / (1.0 + np.exp(np.clip((_out(p) - 1.0) / EDGE, -80.0, 80.0)))
        return np.asarray(AIR + inside * (TISSUE - AIR + texture * carried(p.reshape(-1, 3)).reshape(inside.shape)))

    forward, back = x, unbent(x)
    for part in parts:
        forward = part.moved(forward)
    for part in reversed(parts):
        back = part.origin(back)
    forward = bent(forward)
    scans, hidden = [tissue(x, grey), tissue(back, grey)], np.zeros(SHAPE, dtype=bool)
    for intruder in intruders:
        filling = tissue(x, other) if intruder.grey is None else intruder.grey
        for k, (middle, seen) in enumerate(((intruder.before, x), (intruder.after, forward))):
            share = intruder.share(x, middle)
            scans[k] = (1.0 - share) * scans[k] + share * filling
            hidden |= intruder.share(seen, middle) > 0.5
    before, after = (frame.with_values(values + rng.normal(0.0, noise, SHAPE)) for values in scans)
    mask = _out(x) < 1.0
    return IntrudedBody(before, after, forward - x, mask, hidden & mask)


def _out(p: FloatArray) -> FloatArray:
    """1 on the surface, less inside."""
    return np.asarray((((p - MIDDLE_MM) / HALF_AXES_MM) ** 2).sum(axis=-1))
