"""Virtual scans of a textured ellipsoid of which spherical parts swell or shrink, with the exact displacement at every voxel.

A sphere changes its volume by one factor everywhere, and the medium about it keeps its volume: the displacement outside is radial and
``r^3`` grows by the same amount at all radii, as about a cavity in an incompressible medium. Motions of several spheres follow one another.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.resampling import positions
from naibu.validation.scanners.textures import Texture

SHAPE = (52, 60, 68)
MIDDLE_MM, HALF_AXES_MM = np.array([33.5, 29.5, 25.5]), np.array([29.0, 24.0, 21.0])
AIR, TISSUE, TEXTURE, EDGE = 10.0, 150.0, 30.0, 0.04
TEXTURE_MM = 2.5  # distance of the knots of the texture


class SwollenSphere(NamedTuple):
    """A sphere of material that changes its volume.

    Attributes
    ----------
    middle_mm : sequence of float, shape (3,)
        Its middle, at the time it swells.
    radius_mm : float
        Its radius before.
    ratio : float
        Its volume after, in volumes before, above 0.
    """

    middle_mm: Sequence[float]
    radius_mm: float
    ratio: float

    def moved(self, x: FloatArray) -> FloatArray:
        """Return where material points (..., 3), mm, are after."""
        return self._scaled(x, self.radius_mm**3 * (self.ratio - 1.0), self.radius_mm, self.ratio)

    def origin(self, y: FloatArray) -> FloatArray:
        """Return where points (..., 3), mm, were before."""
        gained = self.radius_mm**3 * (1.0 - self.ratio)
        return self._scaled(y, gained, self.radius_mm * self.ratio ** (1.0 / 3.0), 1.0 / self.ratio)

    def _scaled(self, x: FloatArray, gained: float, radius: float, ratio: float) -> FloatArray:
        arm = x - np.asarray(self.middle_mm)
        r = np.maximum(np.linalg.norm(arm, axis=-1, keepdims=True), 1e-12)
        factor = np.where(r < radius, ratio, 1.0 + gained / r**3)
        return np.asarray(np.asarray(self.middle_mm) + arm * np.cbrt(factor))


class SwollenBody(NamedTuple):
    """Scans before and after, the true displacement (nz, ny, nx, 3), mm, and ratio of volumes (nz, ny, nx), and the body before."""

    before: Volume
    after: Volume
    displacement: FloatArray
    ratio: FloatArray
    mask: BoolArray


def swollen_body(
    parts: Sequence[SwollenSphere],
    *,
    seed: int,
    noise: float = 5.0,
    shift_mm: Sequence[float] = (0.6, -0.3, 0.4),
) -> SwollenBody:
    """Return the pair of scans, of voxels of 1 mm.

    Parameters
    ----------
    parts : sequence of SwollenSphere
        What swells, one after the other; a sphere about the whole body makes all of it swell.
    seed : int
        Of texture and noise.
    noise : float
        Standard deviation of the intensities of both scans, whose texture has one of 30.
    shift_mm : sequence of float, shape (3,)
        By which the body is shifted in the end.
    """
    frame = Volume.from_array(np.zeros(SHAPE), spacing_mm=(1.0, 1.0, 1.0))
    x, grey, rng = positions(frame), Texture.drawn(TEXTURE_MM, seed=seed), np.random.default_rng([seed, 4])

    def seen(p: FloatArray) -> FloatArray:
        inside = 1.0 / (1.0 + np.exp((_out(p) - 1.0) / EDGE))
        texture = TEXTURE * grey(p.reshape(-1, 3)).reshape(inside.shape)
        return np.asarray(AIR + inside * (TISSUE - AIR + texture) + rng.normal(0.0, noise, inside.shape))

    forward, ratio, back = x, np.ones(SHAPE), x - np.asarray(shift_mm)
    for part in parts:
        ratio = np.where(np.linalg.norm(forward - np.asarray(part.middle_mm), axis=-1) < part.radius_mm, part.ratio, 1.0) * ratio
        forward = part.moved(forward)
    for part in reversed(parts):
        back = part.origin(back)
    return SwollenBody(frame.with_values(seen(x)), frame.with_values(seen(back)), forward + shift_mm - x, ratio, _out(x) < 1.0)


def _out(p: FloatArray) -> FloatArray:
    """1 on the surface, less inside."""
    return np.asarray((((p - MIDDLE_MM) / HALF_AXES_MM) ** 2).sum(axis=-1))
