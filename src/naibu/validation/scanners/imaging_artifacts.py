"""Image formation of CT and MR scanners: blur, shading, streaks, noise, rounding; Rician noise after :cite:t:`gudbjartsson1995`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy import ndimage

from naibu.core.arrays import Float32Array, FloatArray, UInt16Array
from naibu.core.errors import InputError
from naibu.validation.scanners.metal_artifacts import streaks

Blur = float | tuple[float, float, float]


class Device(Protocol):
    """Maps the intensities of the object to those of a scan."""

    @property
    def blur_mm(self) -> Blur:
        """Standard deviation of the point spread function, a Gaussian, mm; one for all axes or along x, y, z."""
        ...

    def recorded(self, values: Float32Array, metal: Float32Array, spacing: FloatArray, rng: np.random.Generator) -> UInt16Array:
        """Return the recorded intensities, uint16.

        Parameters
        ----------
        values : ndarray, shape (nz, ny, nx)
            Blurred intensities.
        metal : ndarray, shape (nz, ny, nx)
            Fraction of every voxel that markers fill, not blurred.
        spacing : ndarray, shape (3,)
            Spacing of the voxels along x, y, z, mm.
        rng : Generator
            Source of the noise.
        """
        ...


@dataclass(frozen=True, slots=True)
class CTDevice:
    """An industrial CT scanner.

    Attributes
    ----------
    noise : float
        Standard deviation of the normally distributed noise, intensity; most of it is correlated over `correlation` pixels within a slice.
    blur_mm : float or tuple of float
        Standard deviation of the point spread function, mm.
    cupping, offset : float
        Fraction by which the centre of a slice is too dark; intensity of air.
    correlation : float
        Standard deviation of the smooth part of the noise, pixels; 0 for white noise.
    streaks_per_mm : float
        Fraction by which the attenuation of a ray by markers is underestimated for every mm of them that it crosses: dark bands between
        markers and bright streaks around them (see `naibu.validation.scanners.metal_artifacts`). 0 for none.
    metal_contrast : float
        Intensity of markers above that of their surroundings, which scales the streaks.
    """

    noise: float = 35.0
    blur_mm: Blur = 0.3
    cupping: float = 0.04
    offset: float = 100.0
    correlation: float = 0.8
    streaks_per_mm: float = 0.0
    metal_contrast: float = 2600.0

    def __post_init__(self) -> None:
        _require_not_negative(self, "noise", "blur_mm", "correlation", "streaks_per_mm")

    def recorded(self, values: Float32Array, metal: Float32Array, spacing: FloatArray, rng: np.random.Generator) -> UInt16Array:
        """Return the recorded intensities of blurred ones (nz, ny, nx) with markers; see `Device`."""
        _, ny, nx = values.shape
        x, y = (np.arange(nx) - 0.5 * (nx - 1)) * spacing[0], (np.arange(ny) - 0.5 * (ny - 1)) * spacing[1]
        wide = 0.4 * max(nx * spacing[0], ny * spacing[1])
        cup = 1.0 - self.cupping * np.exp(-(x[None, :] ** 2 + y[:, None] ** 2) / wide**2)
        shown = values * cup + self.offset
        if self.streaks_per_mm > 0.0:
            shown += self.metal_contrast * streaks(metal, spacing, self.streaks_per_mm)
        if self.noise > 0.0:
            shown += self.noise * self._grain(values.shape, rng)
        return np.asarray(np.clip(np.rint(shown), 0, 65535), dtype=np.uint16)

    def _grain(self, shape: tuple[int, ...], rng: np.random.Generator) -> Float32Array:
        """Return noise (nz, ny, nx) of standard deviation 1."""
        white = rng.standard_normal(shape, dtype=np.float32)
        if self.correlation == 0.0:
            return white
        smooth = ndimage.gaussian_filter(white, (0.0, self.correlation, self.correlation))
        grain = 0.6 * white + 0.8 * smooth / float(smooth.std())
        return np.asarray(grain / grain.std(), dtype=np.float32)


@dataclass(frozen=True, slots=True)
class MRDevice:
    """An MR scanner: Rician noise, and a coil that is more sensitive on one side (fixed in the scanner).

    Attributes
    ----------
    noise : float
        Standard deviation of the normally distributed noise of each of the two channels; the magnitude has a Rician distribution.
    blur_mm : float or tuple of float
        Standard deviation of the point spread function, mm.
    shading : float
        Fraction by which the signal varies over the field of view.
    gain : float
        Factor on all intensities, which differs from scan to scan.
    """

    noise: float = 12.0
    blur_mm: Blur = 0.4
    shading: float = 0.15
    gain: float = 1.0

    def __post_init__(self) -> None:
        _require_not_negative(self, "noise", "blur_mm", "gain")

    def recorded(self, values: Float32Array, metal: Float32Array, spacing: FloatArray, rng: np.random.Generator) -> UInt16Array:
        """Return the recorded intensities of blurred ones (nz, ny, nx); see `Device`."""
        z, y, x = (np.linspace(-1.0, 1.0, n).reshape([-1 if a == b else 1 for b in range(3)]) for a, n in enumerate(values.shape))
        coil = 1.0 + 0.5 * self.shading * (0.7 * np.sin(1.5 * y + 0.3) + 0.5 * np.cos(2.0 * x) + 0.2 * z)
        real = self.gain * values * coil + self.noise * rng.standard_normal(values.shape, dtype=np.float32)
        magnitude = np.hypot(real, self.noise * rng.standard_normal(values.shape, dtype=np.float32))
        return np.asarray(np.clip(np.rint(magnitude), 0, 65535), dtype=np.uint16)


def _require_not_negative(device: object, *names: str) -> None:
    for name in names:
        value = np.asarray(getattr(device, name), dtype=float)
        if not (np.isfinite(value).all() and (value >= 0.0).all() and value.shape in ((), (3,))):
            raise InputError(f"{name} of a {type(device).__name__} must be 0 or more, not {getattr(device, name)}")
