"""Intensities of virtual objects: random textures that the material carries, and blocks of layers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from naibu.core.arrays import Float32Array, FloatArray

Intensity = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """A smooth random texture of mean 0 and standard deviation 1, carried by the material: a periodic cubic B-spline.

    Attributes
    ----------
    cell_mm : ndarray, shape (3,)
        Distance of its knots along x, y, z, mm.
    coefficients : ndarray, shape (m, m, m)
        Coefficients at the knots.
    """

    cell_mm: FloatArray
    coefficients: Float32Array

    @classmethod
    def drawn(cls, cell_mm: ArrayLike, *, seed: int, knots: int = 32) -> Texture:
        """Return a random texture.

        Parameters
        ----------
        cell_mm : float or array_like, shape (3,)
            Distance of the knots, mm.
        seed : int
            Of the coefficients.
        knots : int
            Number of knots along each axis; the texture repeats after as many.
        """
        cell = np.array(np.broadcast_to(np.asarray(cell_mm, dtype=float), (3,)))
        # standard deviation, in three dimensions, of a cubic B-spline with unit normal coefficients: (integral of B^2)^(3/2)
        spread = (151.0 / 315.0) ** 1.5
        noise = np.random.default_rng([seed, 3]).standard_normal((knots, knots, knots)) / spread
        return cls(cell, noise.astype(np.float32))

    def __call__(self, material: FloatArray) -> FloatArray:
        """Return its values (n,) at material points (n, 3), mm."""
        at = (material / self.cell_mm).T
        return np.asarray(ndimage.map_coordinates(self.coefficients, at, order=3, prefilter=False, mode="grid-wrap"), dtype=float)


def layered_block(
    size_mm: Sequence[float],
    layers: Sequence[tuple[float, float]] = ((1040.0, np.inf),),
    *,
    texture: float = 7.0,
    seed: int = 0,
    bubbles: Sequence[tuple[Sequence[float], float]] = (),
) -> Intensity:
    """Return the intensity of a block in the frame of an experiment: base at z = 0, centre at x = y = 0.

    Parameters
    ----------
    size_mm : sequence of float
        Extents along x, y, z, mm.
    layers : sequence of (intensity, height of its top in mm)
        From the base up.
    texture : float
        Standard deviation of the texture, intensity.
    seed : int
        Of the texture.
    bubbles : sequence of (centre (3,), radius), mm
        Bubbles of air.
    """
    fine, coarse = Texture.drawn(3.5, seed=seed), Texture.drawn(8.0, seed=seed + 1)
    half = np.array([0.5 * size_mm[0], 0.5 * size_mm[1]])

    def intensity(material: FloatArray) -> FloatArray:
        out = np.zeros(len(material))
        z = material[:, 2]
        inside = np.flatnonzero((np.abs(material[:, :2]) <= half).all(axis=1) & (z >= 0.0) & (z <= size_mm[2]))
        tops = np.array([top for _, top in layers])
        which = np.minimum(np.searchsorted(tops, z[inside]), len(layers) - 1)
        out[inside] = np.array([value for value, _ in layers])[which]
        if texture:
            out[inside] += texture * np.sqrt(0.5) * (fine(material[inside]) + coarse(material[inside]))
        for centre, radius in bubbles:
            out[((material - np.asarray(centre)) ** 2).sum(axis=1) < radius**2] = 0.0
        return out

    return intensity
